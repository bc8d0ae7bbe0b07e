"""The doors of the host work whatever JAX is set to, in processes of their own."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
# Two clouds, then matches.
FIRST_EXAMPLES = "".join(re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)[:2])
SMALLER = {
    "n=1000, outlier_rate=0.95": "n=60, outlier_rate=0.5",
    "n=200_000": "n=60_000",
    "n=20_000": "n=10_000",
}
OTHERS = """
assert found.ok
assert result.ok
batch = tj.solve_batch([tj.host_problem(problem.src, problem.dst, noise_bound=problem.noise_bound)])
assert batch[0].ok
assert result.certificate.is_optimal in (True, False)
assert tj.covariance(result).covariance.shape == (6, 6)
tj.error_bounds(result)
"""
UNDER_JIT = """
task = tj.make_problem(problem.src, problem.dst, noise_bound=problem.noise_bound)
assert jax.jit(lambda task: tj.solve(task).ok)(task)
"""
# Those that only forbid or check something are set together: a door that meets none of them meets each.
SETTINGS = {
    "guards": {
        "jax_transfer_guard": "disallow",
        "jax_numpy_rank_promotion": "raise",
        "jax_numpy_dtype_promotion": "strict",
        "jax_debug_nans": True,
        "jax_platforms": "cpu",
        "jax_enable_x64": True,
    },
    "no jit": {"jax_disable_jit": True},
}


def ran(lines: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, timeout=300)


@pytest.mark.long
@pytest.mark.parametrize("flags", SETTINGS)
def test_the_first_examples_and_the_other_doors(flags):
    small = FIRST_EXAMPLES
    for usual, less in SMALLER.items():
        assert usual in small
        small = small.replace(usual, less)
    setting = "".join(f"jax.config.update({flag!r}, {value!r})\n" for flag, value in SETTINGS[flags].items())
    under_jit = "" if "jax_disable_jit" in SETTINGS[flags] else UNDER_JIT
    done = ran("import jax\n" + setting + small + OTHERS + under_jit)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.long
def test_a_platform_that_is_not_there_is_named():
    done = ran(
        "import jax\njax.config.update('jax_platforms', 'nonsense')\nimport teaser_jax as tj\n"
        "d = tj.synthetic.random_problem(0, n=30)\ntj.register(d.src, d.dst, noise_bound=0.1)"
    )
    assert done.returncode == 1
    assert re.search(r"Error: .*nonsense", done.stderr)
