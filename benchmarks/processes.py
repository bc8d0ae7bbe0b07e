"""Functions run in processes of their own: on so many cores, with nobody's compilation cache.

A benchmark that times a first call, counts programs or looks at memory needs a process without a past.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

CACHES = (
    "JAX_COMPILATION",
    "JAX_PERSISTENT",
    "NUMBA_CACHE",
)  # variables that keep programs between processes


def available_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def in_child(
    function: Callable[..., Any],
    *,
    cores: int | None = None,
    variables: dict[str, str] | None = None,
    seconds: float | None = None,
    **arguments: Any,
) -> Any:
    """What a function of a benchmark returns, as JSON; None if it takes longer than ``seconds``.

    Raises:
        subprocess.CalledProcessError: If the process fails; what it says on stderr is shown.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith(CACHES)}
    chosen = sorted(os.sched_getaffinity(0))[:cores]
    target = f"{function.__module__}:{function.__name__}"
    try:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.processes", target, json.dumps(chosen), json.dumps(arguments)],
            env={**environment, **(variables or {}), "OMP_NUM_THREADS": str(len(chosen))},
            cwd=Path(__file__).parents[1],
            stdout=subprocess.PIPE,
            timeout=seconds,
            check=True,
        )
    except subprocess.TimeoutExpired:
        return None
    return json.loads(done.stdout.decode().splitlines()[-1])


def forget_peak() -> None:
    """Let the peak of memory count from now on (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_megabytes() -> float:
    """The most memory held since ``forget_peak``."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    """The child's side: call, and print the result on the last line."""
    os.sched_setaffinity(0, json.loads(sys.argv[2]))  # before threads are made
    module, name = sys.argv[1].split(":")
    result = getattr(importlib.import_module(module), name)(**json.loads(sys.argv[3]))
    print(f"\n{json.dumps(result)}")


if __name__ == "__main__":
    main()
