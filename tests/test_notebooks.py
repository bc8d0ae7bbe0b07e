"""The notebooks run from the first cell to the last, and their stored output is fit to be read."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import teaser_jax

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = [
    FOLDER / f"{name}.ipynb"
    for name in (
        "01_quickstart",
        "02_inside_the_method",
        "03_certificates",
        "04_learning_through_registration",
        "05_batches_and_devices",
        "06_two_scans",
        "08_scan_matching",
    )
]


# They register a thousand problems, train three networks, compile for four devices, register 30 clouds.
SLOW = (
    "03_certificates",
    "04_learning_through_registration",
    "05_batches_and_devices",
    "06_two_scans",
    "08_scan_matching",
)
LONG = [pytest.param(p, marks=pytest.mark.slow) if p.stem in SLOW else p for p in NOTEBOOKS]


@pytest.mark.long
@pytest.mark.parametrize("path", LONG, ids=lambda path: path.stem)
def test_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in surroundings(tmp_path).items():
        monkeypatch.setenv(name, value)
    if path.stem in SLOW:
        monkeypatch.delenv("JAX_DISABLE_MOST_OPTIMIZATIONS")  # runs longer than it compiles
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, kernel_name="python3", timeout=600, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_output(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "make notebooks"
    assert path.stat().st_size < 1_500_000
    assert notebook.metadata.kernelspec.name == "python3"
    outputs = [output for cell in code for output in cell.outputs]
    kinds = {output.get("name", output.output_type) for output in outputs}
    assert kinds <= {"stdout", "display_data", "execute_result"}, "an error or a warning is stored"
    machine = re.search(r"/(home|root|tmp|work|Users|mnt|private|var|opt)/", json.dumps(outputs))
    assert machine is None, "a path of some machine is stored"


def surroundings(folder: Path) -> dict[str, str]:
    """A kernel in the interpreter of the tests, the package under test, no screen, no start-up files."""
    spec = folder / "kernels" / "python3" / "kernel.json"
    spec.parent.mkdir(parents=True)
    start = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec.write_text(json.dumps({"argv": start, "display_name": "tests", "language": "python"}))
    paths = [str(Path(teaser_jax.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        "JUPYTER_PATH": str(folder),  # its kernels come before any that the user has registered
        "IPYTHONDIR": str(folder / "ipython"),
        "MPLBACKEND": "agg",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",  # compiles in half the time
        "PYTHONPATH": os.pathsep.join(paths),
    }
