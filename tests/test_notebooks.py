"""The notebooks run from the first cell to the last, and their stored output is fit to be read."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import nbformat
import pytest
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

import teaser_jax

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = [pytest.param(FOLDER / f"{name}.ipynb", id=name) for name in ("01_quickstart", "02_inside_the_method")]


@pytest.mark.parametrize("path", NOTEBOOKS)
def test_runs(path: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, km=this_python(tmp_path), timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute(env=environment(tmp_path))
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))


@pytest.mark.parametrize("path", NOTEBOOKS)
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


def this_python(folder: Path) -> AsyncKernelManager:
    """A kernel in the interpreter of the tests, whatever kernels the user has registered."""
    spec = folder / "kernels" / "python3" / "kernel.json"
    spec.parent.mkdir(parents=True)
    start = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec.write_text(json.dumps({"argv": start, "display_name": "tests", "language": "python"}))
    kernels = KernelSpecManager(kernel_dirs=[str(spec.parents[1])])
    return AsyncKernelManager(kernel_name="python3", kernel_spec_manager=kernels)


def environment(folder: Path) -> dict[str, str]:
    """No screen, no start-up files of the user, and the package under test, installed or not."""
    package = str(Path(teaser_jax.__file__).parents[1])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        **os.environ,
        "MPLBACKEND": "agg",
        "IPYTHONDIR": str(folder / "ipython"),
        "PYTHONPATH": os.pathsep.join(paths),
    }
