"""The arrows go one way: a file imports only what the data has met before it."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "teaser_jax"

# In the order of the data. A module may import from lines above it, and from its own line downwards never.
ORDER = [
    "ground.arrays", "ground.checks", "ground.masked", "ground.loops", "ground.io", "so3", "types",
    "stages.invariants", "stages.bits", "stages.voting", "stages.histogram_voting", "stages.scale",
    "stages.consistency",
    "stages.clique_reduction", "stages.clique_branching", "stages.clique", "stages.clique_search",
    "stages.gnc", "stages.rotation", "stages.quadratic_form", "stages.rotation_global", "stages.rotation_sdp",
    "stages.translation", "stages.refinement", "stages.trust",
    "problem", "solve", "soft", "uncertainty", "compilation",
    "certify.dual", "certify.projection", "certify.splitting",
    "certify.certificate", "certify.proof", "certify.host", "certify.stack", "certify.rotation",
    "certify.relaxation",
    "certify.pose", "certify.error_bounds", "certify.verify", "wahba",
    "packing", "summary", "register", "profile",
    "batch.groups", "batch.programs", "batch.processes", "batch.run",
    "metrics", "synthetic.models", "synthetic.protocol", "synthetic.solids", "synthetic.scans",
    "learn.matching", "learn.losses", "learn.teacher", "learn.network", "learn.training",
    "files.matches", "files.models", "files.poses",
    "plots.style", "plots.answer", "plots.stages", "plots.proofs", "plots.learning",
    "studies.peers", "studies.trials", "studies.methods", "studies.study", "studies.draws",
    "studies.catalogue", "studies.shards", "studies.table", "studies.results", "studies.figures",
    "studies.run",
    "cli.endings", "cli.arguments", "cli.places", "cli.report", "cli.register", "cli.demo", "cli.study",
    "__main__",
]  # fmt: skip
# The search returns to the module that calls it for one thing: networkx, where numba cannot be had. The
# summary names the type of what it is about, for type checkers only.
KNOWN = {("stages.clique", "stages.clique_search"), ("summary", "register")}


def modules() -> dict[str, Path]:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        if not name.endswith("__init__"):
            found[name] = path
    return found


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("teaser_jax"):
            base = node.module.removeprefix("teaser_jax").removeprefix(".")
            inner = {f"{base}.{alias.name}".removeprefix(".") for alias in node.names}
            names |= {name for name in inner | {base} if name in modules()}
        if isinstance(node, ast.Import):
            names |= {
                a.name.removeprefix("teaser_jax.") for a in node.names if a.name.startswith("teaser_jax.")
            }
    return names


def test_every_module_has_its_place():
    assert sorted(modules()) == sorted(ORDER)


@pytest.mark.parametrize("name", ORDER)
def test_imports_point_back(name):
    later = {
        other
        for other in imported(modules()[name])
        if ORDER.index(other) >= ORDER.index(name) and (name, other) not in KNOWN
    }
    assert not later


@pytest.mark.parametrize("what", ["", ".cli", ".files", ".learn", ".plots", ".studies", ".synthetic"])
def test_an_import_is_light(what):
    code = f"import sys, json, teaser_jax{what}; print(json.dumps([m for m in sys.modules]))"
    loaded = json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)
    heavy = {"numba", "llvmlite", "matplotlib", "networkx", "open3d", "optax", "plotly", "scs", "trimesh"}
    assert not heavy & set(loaded)


def test_a_plain_import_touches_no_configuration():
    code = (
        "import jax; before = dict(jax.config.values); import teaser_jax; "
        "assert dict(jax.config.values) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
