"""Settings: names stand for records, numbers are plain and traced, and what makes no sense is refused."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import problem_of, random_matches

import teaser_jax as tj
from teaser_jax.settings import (
    EveryMatch,
    ExactClique,
    Gnc,
    GreedyClique,
    NetworkxClique,
    PairSearch,
    Refinement,
    Relaxation,
    ScaleVote,
    check_settings,
)

NAMES = [
    ("clique", "exact", ExactClique()), ("clique", "greedy", GreedyClique()),
    ("clique", "none", EveryMatch()), ("clique", "networkx", NetworkxClique()),
    ("rotation", "gnc", Gnc()), ("rotation", "global", PairSearch()), ("rotation", "sdp", Relaxation()),
    ("scale_search", "vote", ScaleVote()), ("refine", True, Refinement()), ("refine", False, None),
]  # fmt: skip


@pytest.mark.parametrize(("field", "name", "record"), NAMES, ids=str)
def test_a_name_is_its_record(field, name, record):
    by_name, by_record = (tj.Settings(**{field: x}) for x in (name, record))
    assert by_name == by_record
    assert hash(by_name) == hash(by_record)
    assert getattr(by_name, field) == record
    assert jax.tree.structure(by_name) == jax.tree.structure(by_record)


@pytest.mark.parametrize(
    ("field", "names"),
    [
        ("clique", ("exact", "greedy", "none", "networkx")),
        ("rotation", ("gnc", "global", "sdp")),
        ("refine", (True, False)),
    ],
)
def test_jax_tells_every_method_from_every_other(field, names):
    structures = [jax.tree.structure(tj.Settings(**{field: name})) for name in names]
    assert len(set(structures)) == len(names)


@pytest.mark.long
@pytest.mark.parametrize("door", ["jit", "batch"])  # without jit: see test_solve.py
def test_a_program_of_one_method_is_not_run_for_another(door):
    problem = problem_of(random_matches(0))
    solve = {
        "jit": jax.jit(tj.solve),
        "batch": lambda problem, settings: tj.solve_batch([problem], settings)[0],
    }[door]
    greedy, every = (solve(problem, tj.Settings(clique=name)) for name in ("greedy", "none"))
    assert int(greedy.selection.clique.sum()) < 32
    assert int(every.selection.clique.sum()) == 32


def test_every_number_is_a_plain_one():
    records = (
        Gnc(factor=2, tolerance=np.float32(0.5)),
        ExactClique(np.int64(7), 5),
        ScaleVote((0, np.float64(2))),
    )
    assert [type(x) for x in jax.tree.leaves(records)] == [float, float, int, float, float, float]
    assert Gnc(factor=2) == Gnc(factor=2.0)


def test_new_numbers_compile_nothing_and_new_caps_do():
    solve, problem = jax.jit(tj.solve), problem_of(random_matches(0))
    lowered = lambda **chosen: solve.lower(problem, tj.Settings(**chosen)).in_avals
    usual = lowered()
    assert lowered(rotation=Gnc(factor=2, tolerance=1), clique=ExactClique(nodes=3, seconds=7)) == usual
    assert lowered(scale_search=ScaleVote((1, 2))) == usual
    structure = jax.tree.structure(tj.Settings())
    assert jax.tree.structure(tj.Settings(rotation=Gnc(iterations=5))) != structure
    assert jax.tree.structure(tj.Settings(refine=Refinement(iterations=5))) != structure


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: tj.Settings(clique="best"), "Settings.clique is 'best': expected one of 'exact', 'greedy'"),
        (lambda: tj.Settings(rotation="svd"), "Settings.rotation is 'svd': expected one of 'gnc', 'global'"),
        (lambda: tj.Settings(vote="all"), "Settings.vote is 'all': expected one of 'tls', 'consensus'"),
        (lambda: tj.Settings(refine="no"), "Settings.refine is 'no': expected one of True, False"),
        (lambda: PairSearch(gnc="svd"), "PairSearch.gnc is 'svd': expected one of 'gnc'"),
        (lambda: Gnc(factor=1), "Gnc.factor is 1: expected a number above 1"),
        (lambda: Gnc(factor=True), "Gnc.factor is True: expected a number above 1"),
        (lambda: Gnc(tolerance=-1e-3), "Gnc.tolerance is -0.001: expected 0 or more"),
        (lambda: Gnc(iterations=0), "Gnc.iterations is 0: expected a whole number, 1 or above"),
        (lambda: Gnc(iterations=1.5), "Gnc.iterations is 1.5: expected a whole number"),
        (lambda: ExactClique(nodes=2.5), "ExactClique.nodes is 2.5: expected a whole number"),
        (lambda: ExactClique(seconds=float("nan")), "ExactClique.seconds is nan: expected 0 or more"),
        (lambda: ScaleVote((2, 1)), r"ScaleVote.range is \(2, 1\): expected \(low, high\) with"),
        (lambda: ScaleVote(3), r"ScaleVote.range is 3: expected \(low, high\)"),
        (lambda: ScaleVote((10**400, 10**401)), r"ScaleVote.range is .*: expected \(low, high\) with"),
        (lambda: Gnc(factor=10**400), "Gnc.factor is 10*...: expected a number above 1"),
        (lambda: Gnc(tolerance=10**5000), "Gnc.tolerance is int of too many digits: expected"),
        (lambda: Gnc(name="mine"), "Gnc.name is 'mine': it is always 'gnc', so leave it out"),
        (lambda: ExactClique(name=np.zeros(2)), "ExactClique.name is array"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_at_once(made, said, unchecked):
    with pytest.raises(ValueError, match=said):
        made()


@pytest.mark.parametrize(
    "settings",
    [
        tj.Settings(clique=Gnc()), tj.Settings(rotation=ExactClique()), tj.Settings(rotation=None),
        tj.Settings(refine=3), tj.Settings(rotation=Gnc(factor=None)),
        tj.Settings(scale_search=ScaleVote((0.5, None))),
        tj.Settings(rotation=PairSearch(gnc=Gnc(factor=jnp.float32(0.5)))), "greedy", None,
        tj.Settings(clique=GreedyClique), tj.Settings(scale_search=(1, 2)),
    ],
    ids=str,
)  # fmt: skip
def test_what_only_the_doors_can_see_is_refused_there(settings, unchecked):
    with pytest.raises(ValueError, match="expected"):
        check_settings(settings)
    with pytest.raises(ValueError, match="expected"):
        tj.solve(problem_of(random_matches(0)), settings)


def test_jax_may_put_anything_in_the_place_of_a_number():
    settings = tj.Settings()
    for stand_in in (None, object(), jax.ShapeDtypeStruct((), jnp.float32)):
        again = jax.tree.map(lambda _, x=stand_in: x, settings)
        assert isinstance(again, tj.Settings)
    assert check_settings(jax.tree.map(jnp.asarray, settings)) is None


def test_what_is_shown_is_what_was_chosen():
    assert repr(tj.Settings()) == "Settings()"
    chosen = tj.Settings(clique="greedy", rotation=Gnc(factor=2), refine=False)
    assert eval(repr(chosen), {**vars(tj.settings), "Settings": tj.Settings}) == chosen
    assert repr(chosen).startswith("Settings(clique=GreedyClique(), rotation=Gnc(factor=2.0, ")


def test_settings_stay_as_they_are():
    with pytest.raises(dataclasses.FrozenInstanceError):
        tj.Settings().clique = "greedy"
    assert dataclasses.replace(tj.Settings(), clique="greedy").clique == GreedyClique()
