"""Fixtures for every test file."""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

# Most of a test is compilation, and what is compiled runs for milliseconds: XLA optimises little here and
# makes one piece of each program, which takes a quarter of the time. With TEASER_JAX_OPTIMIZED=1, as in
# `make slow`, all programs are those of a user.
if not os.environ.get("TEASER_JAX_OPTIMIZED"):
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    flags = "--xla_cpu_parallel_codegen_split_count=1"
    if tuple(map(int, version("jax").split(".")[:2])) < (0, 11):  # newer ones have no older emitters
        flags += " --xla_cpu_use_fusion_emitters=false --xla_disable_hlo_passes=tree_reduction_rewriter"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()

import jax
import jaxtyping
import pytest

# Tracing makes many small objects that stay: to look for cycles among them is a third of its time.
gc.set_threshold(200_000, 20, 100)

# Numba reads the source of these loops itself: they are loaded before anything is wrapped.
import teaser_jax.stages.clique.branching  # noqa: E402
import teaser_jax.stages.clique.reduction  # noqa: E402

# Annotations are checked whenever a function is called or a record made: in what is imported from here on.
jaxtyping.install_import_hook("teaser_jax", "typechecker.checked")
# No axis and no kind of number may be added in silence, neither by the package nor by a test.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

import teaser_jax as tj  # noqa: E402

# Warnings are errors from the collection on: not in pyproject.toml, where a plugin of another package that
# warns while pytest starts would stop it. Later lines win.
WARNINGS = (
    "error",
    # Raised while importing or closing other people's code, which nothing here can change.
    "ignore::DeprecationWarning:jupyter_client",
    "ignore::DeprecationWarning:nbclient",
    "ignore::DeprecationWarning:zmq",
    "ignore::DeprecationWarning:(matplotlib|pyparsing)",  # 3.9 with a newer pyparsing
    "ignore::ImportWarning:networkx",  # 3.0 without pandas
)


def pytest_configure(config: pytest.Config) -> None:
    for line in WARNINGS:
        config.addinivalue_line("filterwarnings", line)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Workers take whole files: those with most to compile come first, so that none is left to the end."""
    weight = Counter(item.path for item in items if item.get_closest_marker("long"))
    items.sort(key=lambda item: -weight[item.path])  # stable: within a file nothing moves


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX in float64 for one test; the default, float32, is what most users have."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def unchecked() -> Iterator[None]:
    """For calls that break the annotations on purpose: the words of the package must say what is wrong."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data, which a plain clone does not have."""
    named = os.environ.get("TEASER_JAX_DATA")
    if not named:
        pytest.skip("real data: TEASER_JAX_DATA names no folder")
    folder = Path(named)
    if not folder.is_dir():
        pytest.skip(f"real data: TEASER_JAX_DATA names {named}, which is no folder")
    return folder


@pytest.fixture(scope="session")
def small() -> tj.synthetic.SyntheticProblem:
    """A problem of the smallest size there is a program for: 32 matches, half of them wrong."""
    return tj.synthetic.random_problem(0, n=32, outlier_rate=0.5)


@pytest.fixture(scope="session")
def solved(small: tj.synthetic.SyntheticProblem) -> tj.Registration:
    """The answer to ``small``."""
    return tj.register(small.src, small.dst, noise_bound=small.noise_bound)
