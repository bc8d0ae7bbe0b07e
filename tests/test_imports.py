"""The arrows go one way: a file imports only what the data has met before it, and files stay small."""

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
    "ground.forks", "ground.flags", "ground.arrays", "ground.checks", "ground.numbers", "ground.loops",
    "ground.branches", "ground.bits", "ground.masked", "ground.extras", "ground.io",
    "ground.steps",
    "so3", "pose", "reading", "problem", "rows", "solution",
    "stages.pairs", "stages.vote.sweep", "stages.vote.histogram", "stages.scale", "stages.consistency",
    "stages.one_to_one", "stages.widening",
    "stages.clique.clique", "stages.clique.every_match", "stages.clique.greedy", "stages.clique.oracle",
    "stages.clique.reduction", "stages.clique.branching", "stages.clique.watch", "stages.clique.exact",
    "stages.clique.maximum",
    "stages.rotation.tims", "stages.rotation.gnc", "stages.rotation.quadratic_form",
    "stages.rotation.pair_search",
    "stages.rotation.relaxation", "stages.rotation.robust",
    "stages.translation", "stages.refinement", "stages.assignment", "stages.position", "stages.chance",
    "stages.verdict",
    "stages.rivals.seeds", "stages.rivals.evidence", "stages.rivals.search", "stages.rivals.congruent",
    "settings", "refit", "agreement", "cascade", "solve", "soft", "uncertainty",
    "engine.compiler", "engine.sizes", "engine.packing", "engine.frames", "engine.compaction",
    "engine.programs", "engine.single", "diagnosis",
    "engine.groups", "engine.processes", "engine.batch",
    "certify.dual", "certify.projection", "certify.semidefinite", "certify.splitting",
    "certify.certificate",
    "certify.options", "certify.proof",
    "certify.host_measurements", "certify.host", "certify.traced", "certify.stack", "certify.rotation",
    "certify.relaxation", "certify.subject", "certify.pose",
    "certify.bounds", "certify.whole_set", "certify.paper_bounds", "certify.error_bounds",
    "certify.verify",
    "solve_rotation", "summary", "register", "profile", "all_to_all", "solve_batch",
    "metrics", "synthetic.models",
    "files.tables", "files.poses", "files.matches", "files.models", "files.cloud_file", "files.kinds",
    "files.formats.meshes", "files.formats.ply", "files.formats.pcd", "files.formats.arrays",
    "files.formats.bare", "files.formats.las", "files.formats.e57", "files.clouds",
    "clouds.extra", "clouds.sizes", "clouds.neighbours", "clouds.cloud", "clouds.voxel",
    "clouds.features.normals", "clouds.features.fpfh", "clouds.features.matching", "clouds.surface",
    "clouds.trust.pairing", "clouds.trust.space", "clouds.trust.table", "clouds.prepared", "clouds.fine",
    "clouds.pair",
    "clouds.trust.observability",
    "clouds.trust.planes", "clouds.trust.alternatives", "clouds.trust.lead", "clouds.trust.rivals",
    "clouds.trust.judge", "clouds.support", "clouds.several", "clouds.candidates",
    "clouds.symmetry", "clouds.parts.closed", "clouds.parts.turns", "clouds.parts.field",
    "clouds.parts.sweep", "clouds.parts.settle", "clouds.parts.sight", "clouds.parts.weigh",
    "clouds.parts.search", "clouds.parts.answer", "clouds.words", "clouds.registration", "clouds.register",
    "maps.motions", "maps.pair", "maps.graph", "maps.cycles", "maps.placing", "maps.shelf", "maps.chosen",
    "maps.store", "maps.work", "maps.words", "maps.result", "maps.register",
    "synthetic.protocol", "synthetic.solids", "synthetic.scans",
    "learn.matching", "learn.losses", "learn.teacher", "learn.network", "learn.training",
    "plots.style", "plots.panels", "plots.answer", "plots.scene", "plots.clouds", "plots.either",
    "plots.view", "plots.stages", "plots.proofs", "plots.learning",
    "studies.peers", "studies.trials", "studies.methods", "studies.study", "studies.draws",
    "studies.catalogue", "studies.shards",
    "studies.looks", "studies.table", "studies.answers", "studies.results", "studies.figures", "studies.run",
    "cli.endings", "cli.places", "cli.report", "cli.clouds", "cli.register", "cli.map", "cli.demo",
    "cli.study", "cli.arguments",
    "__main__",
]  # fmt: skip
MOST_LINES, MOST_LINES_OF_A_FUNCTION = 400, 50  # docstrings of functions apart
THE_PAGE, MOST_LINES_OF_THE_PAGE = "solve", 200
LONGER = {
    "certify.verify.is_lower_bound",  # a proof is read from top to bottom, without help from elsewhere
}


def modules() -> dict[str, Path]:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        if not name.endswith("__init__"):
            found[name] = path
    return found


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports when it runs, anywhere in it."""
    tree = ast.parse(path.read_text())
    for_types = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    names = set()
    for node in ast.walk(tree):
        if node in for_types:
            continue
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


@pytest.mark.long
@pytest.mark.parametrize("name", ORDER)
def test_imports_point_back(name):
    assert not {other for other in imported(modules()[name]) if ORDER.index(other) >= ORDER.index(name)}


@pytest.mark.long
@pytest.mark.parametrize("name", ORDER)
def test_files_and_functions_are_short(name):
    text = modules()[name].read_text()
    assert len(text.splitlines()) <= (MOST_LINES_OF_THE_PAGE if name == THE_PAGE else MOST_LINES)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and f"{name}.{node.name}" not in LONGER:
            told = node.body[0] if ast.get_docstring(node) else None
            length = node.end_lineno - node.lineno + 1
            length -= told.end_lineno - told.lineno + 1 if told else 0
            assert length <= MOST_LINES_OF_A_FUNCTION, f"{node.name} has {length} lines"


# First words of descriptions: what follows them is no deed.
NO_VERB = {"A", "An", "The", "All", "Both", "Each", "Every", "How", "One", "That", "This", "Those", "What"}
NO_VERB |= {"Where", "Whether", "Which"}


@pytest.mark.long
@pytest.mark.parametrize("name", ORDER)
def test_docstrings_of_functions_begin_with_a_verb(name):
    """In a tooltip a docstring stands alone: it says what the function does, and not what something is."""
    for node in ast.walk(ast.parse(modules()[name].read_text())):
        if isinstance(node, ast.FunctionDef) and not any(
            "property" in ast.unparse(d) for d in node.decorator_list
        ):
            told = ast.get_docstring(node)
            assert told is None or told.split()[0] not in NO_VERB, f"{node.name}: {told}"


def in_a_fresh_python(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True
    ).stdout  # fmt: skip


def test_a_plain_import_loads_nothing_else():
    code = "import sys, json, teaser_jax; print(json.dumps([m for m in sys.modules]))"
    loaded = json.loads(in_a_fresh_python(code))
    assert not {"jax", "numpy", "numba", "matplotlib", "networkx", "tqdm", "plotly", "optax"} & set(loaded)


@pytest.mark.long
def test_the_doors_load_what_they_need_and_no_more():
    code = (
        "import sys, json, teaser_jax as tj; tj.register; tj.solve_batch; print(json.dumps([*sys.modules]))"
    )
    loaded = json.loads(in_a_fresh_python(code))
    assert not {"numba", "llvmlite", "matplotlib", "networkx", "plotly", "optax"} & set(loaded)


@pytest.mark.long
def test_the_front_page_is_whole():
    """Every name loads, is listed, and stays itself when the module that it lives in is imported."""
    code = """
import importlib, sys, teaser_jax as tj
assert set(tj.__all__) <= set(dir(tj))
for name, home in tj._HOMES.items():
    importlib.import_module(f"teaser_jax.{home}")
    assert getattr(tj, name).__name__ == name, name
    assert not isinstance(getattr(tj, name), type(sys)), name
for name in tj.__all__:
    getattr(tj, name)
assert not hasattr(tj, "no_such_name")
"""
    in_a_fresh_python(code)


@pytest.mark.long
def test_a_plain_import_touches_no_configuration():
    in_a_fresh_python(
        "import jax; before = dict(jax.config.values); import teaser_jax; teaser_jax.register; "
        "teaser_jax.solve_batch; teaser_jax.learn; assert dict(jax.config.values) == before"
    )
