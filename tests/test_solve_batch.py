"""Batches: every answer that of its own problem alone, whatever stands around it."""

from __future__ import annotations

import dataclasses
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import Mesh
from oracles import solve

import teaser_jax as tj
from teaser_jax.engine.batch import Solver
from teaser_jax.engine.compaction import ALL_ROWS, rows_for
from teaser_jax.engine.programs import MOST
from teaser_jax.engine.sizes import Size
from teaser_jax.problem import pad_problem
from teaser_jax.synthetic import random_problem

HERE = Path(__file__).parent
SETS = ("clique", "rotation", "translation", "inliers")


def problem(seed, n=30, rate=0.5, scale=1.0, **known):
    drawn = random_problem(seed, n=n, outlier_rate=rate, scale=(1.0, 5.0) if scale is None else scale)
    return tj.host_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, scale=scale, **known)


def assert_same(a, b):
    """The same bits in every field."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def many():
    """More than one run of the program, sizes mixed within a bucket, some beyond saving."""
    rates = (0.0, 0.5, 0.7, 1.0)
    return [problem(k, n=20 + k % 13, rate=rates[k % 4]) for k in range(MOST + 16)]


@pytest.fixture(scope="module")
def answers(many):
    return tj.solve_batch(many)


@pytest.mark.long
def test_one_that_goes_its_own_way_leaves_the_others_in_place():
    """A full run, of which a single problem has a larger clique than the rest and needs more rows."""
    some = [problem(k, n=30, rate=0.0 if k == 1 else 0.6) for k in range(MOST)]
    found = tj.solve_batch(some)
    sizes = np.array([answer.clique_size for answer in found])
    assert np.all((sizes > 16) == (np.arange(MOST) == 1))
    for k in (0, 1, 2, MOST // 2, MOST - 1):
        assert_same(found[k], tj.solve_batch([some[k]])[0])


@pytest.mark.long
def test_waiting_for_a_device_changes_nothing(many, answers, monkeypatch):
    """On accelerators threads take turns; here the host is asked to."""
    monkeypatch.setattr(Solver, "on_cpu", property(lambda self: False))
    for one, other in zip(tj.solve_batch(many), answers, strict=True):
        assert_same(one, other)


@pytest.mark.skipif(jax.default_backend() == "cpu", reason="no accelerator")
def test_an_accelerator_finds_what_the_processor_finds(many):
    there, here = (Mesh(np.array(jax.devices(kind)[:1]), ("x",)) for kind in (jax.default_backend(), "cpu"))
    found = [tj.solve_batch(many, mesh=mesh) for mesh in (there, here)]
    for one, other in zip(*found, strict=True):
        for name in SETS:
            np.testing.assert_array_equal(getattr(one.selection, name), getattr(other.selection, name))
        for x, y in zip(jax.tree.leaves(one.pose), jax.tree.leaves(other.pose), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-12)


KINDS = {
    "known scale": {},
    "voted scale": dict(scale=None),
    "pairs": dict(pairs=np.stack(np.triu_indices(30, 1), axis=1)[::2]),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_the_answers_are_those_of_solve(kind, x64):
    problems = [problem(k, **KINDS[kind]) for k in range(6)]
    for one, found in zip(problems, tj.solve_batch(problems), strict=True):
        made = tj.make_problem(
            one.src, one.dst, noise_bound=one.noise_bound, scale=one.scale, pairs=one.pairs
        )
        expected = solve(pad_problem(made, 32, 496))  # other tests have programs of these sizes
        for name in SETS:
            mine, theirs = (getattr(x.selection, name) for x in (found, expected))
            np.testing.assert_array_equal(mine, theirs[: len(mine)])
        np.testing.assert_allclose(found.pose.matrix, expected.pose.matrix, atol=1e-12, rtol=1e-12)
        assert found.status == expected.status
        assert found.clique_upper_bound == expected.clique_upper_bound


@pytest.mark.long
def test_answers_are_ordinary_solutions(many, answers):
    assert [len(a.inliers) for a in answers] == [len(p.src) for p in many]
    assert [a.ok for a in answers[::4]] == [True] * len(answers[::4])
    assert not any(a.ok for a in answers[3::4])
    for leaf in jax.tree.leaves(answers[0]):
        assert isinstance(leaf, np.ndarray | np.generic)
        assert leaf.dtype.kind != "f" or leaf.dtype == np.float64
        assert np.ndim(leaf) == 0 or leaf.flags.writeable
    assert not jax.config.jax_enable_x64


@pytest.mark.long
def test_order_neighbours_and_chunks_do_not_matter(many, answers):
    order = np.random.default_rng(0).permutation(len(many))
    for place, found in zip(order, tj.solve_batch([many[k] for k in order], chunk_size=1), strict=True):
        assert_same(found, answers[place])
    assert_same(tj.solve_batch(many[7:8])[0], answers[7])


@pytest.mark.long
def test_large_problems_are_solved_in_turn_and_by_the_size_of_their_cliques():
    """Cliques of 13 to 256 members: 32, 64 and 256 rows, and all."""
    rates = (0.975, 0.9, 0.8, 0.5, 0.3)
    problems = [problem(k, n=512, rate=rates[k % 5]) for k in range(10)]
    expected = tj.solve_batch(problems)
    assert all(found.ok for found in expected)
    order = np.random.default_rng(1).permutation(10)
    for place, found in zip(order, tj.solve_batch([problems[k] for k in order], chunk_size=1), strict=True):
        assert_same(found, expected[place])
    for one, found in zip(problems[:5], expected, strict=False):
        alone = tj.register(one.src, one.dst, noise_bound=one.noise_bound).solution
        for name in SETS:
            np.testing.assert_array_equal(getattr(found.selection, name), getattr(alone.selection, name))
        np.testing.assert_allclose(found.pose.matrix, alone.pose.matrix, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize(
    ("settings", "offered"),
    [
        ({}, True),
        ({"tim_graph": "complete"}, False),
        ({"clique": "none"}, False),
        ({"clique": "greedy"}, True),
    ],
)
def test_room_for_every_clique(settings, offered):
    sizes = np.arange(257)
    rows = rows_for(Size(256, None, True), tj.Settings(**settings), sizes)
    assert np.all((rows == ALL_ROWS) | (rows >= sizes))
    assert (len(np.unique(rows)) > 1) == offered
    assert np.all(
        rows_for(Size(256, 512, True), tj.Settings(**settings), sizes) == ALL_ROWS
    )  # pairs are given


@pytest.mark.long
def test_a_stack_comes_back_as_a_stack(many):
    stack = tj.stack_problems(many[:10])
    assert isinstance(stack.src, np.ndarray)
    found = tj.solve_batch(stack)
    assert found.inliers.shape == stack.mask.shape
    listed = tj.solve_batch([jax.tree.map(lambda x, k=k: x[k], stack) for k in range(10)])
    for k, one in enumerate(listed):
        assert_same(jax.tree.map(lambda x, k=k: x[k], found), one)


@pytest.mark.long
def test_far_from_the_origin(many, answers):
    """Points that float32 could not tell apart are moved to their middle, and their poses back."""
    far = np.array([5e5, -1e5, 2e5])
    moved = [dataclasses.replace(p, src=p.src + far, dst=p.dst - far) for p in many[:4]]
    for near, there, p in zip(answers, tj.solve_batch(moved + many[:4]), moved, strict=False):
        np.testing.assert_array_equal(there.inliers, near.inliers)
        np.testing.assert_allclose(there.pose.apply(p.src) + far, near.pose.apply(p.src - far), atol=1e-8)


NAN = np.full((30, 3), np.nan)
POISON = {
    "nan": lambda p: dataclasses.replace(p, src=NAN),
    "infinite bound": lambda p: dataclasses.replace(p, noise_bound=np.full(30, np.inf)),
    "negative truncation": lambda p: dataclasses.replace(p, cbar2=np.float64(-1)),
    "masked": lambda p: dataclasses.replace(p, mask=np.zeros(30, bool)),
    "all wrong": lambda p: problem(1234, rate=1.0),
    "empty": lambda p: jax.tree.map(lambda x: x[:0] if np.ndim(x) else x, p),
    "huge": lambda p: dataclasses.replace(p, src=p.src * 1e300),
    "at the end of all numbers": lambda p: dataclasses.replace(
        p, src=np.full((30, 3), 1.7e308), dst=np.full((30, 3), -1.7e308)
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", POISON)
def test_poison_in_any_place_spoils_nothing(kind):
    healthy = [problem(k) for k in range(5)]
    expected = tj.solve_batch(healthy)
    for place in range(5):
        found = tj.solve_batch([*healthy[:place], POISON[kind](healthy[place]), *healthy[place + 1 :]])
        for k in range(5):
            if k != place:
                assert_same(found[k], expected[k])
        assert not found[place].ok
        assert np.isfinite(found[place].pose.matrix).all()


@pytest.mark.long
def test_choices_reach_the_programs():
    problems = [problem(k) for k in range(3)]
    greedy = tj.solve_batch(problems, tj.Settings(clique="greedy", refine=False))
    oracle = tj.solve_batch(problems, tj.Settings(clique="networkx"))
    assert not any(found.selection.refined for found in greedy)
    assert all(found.clique_is_maximum for found in oracle)


@pytest.mark.long
def test_graphs_without_a_proof_go_to_the_host():
    drawn = [tj.synthetic.all_to_all(k, n=12, noise_bound=0.05) for k in range(3)]
    hard = [tj.host_problem(d.src, d.dst, noise_bound=d.noise_bound) for d in drawn]
    for p, found in zip(hard, tj.solve_batch(hard), strict=True):
        alone = tj.register(p.src, p.dst, noise_bound=p.noise_bound)
        assert found.clique_is_maximum
        assert found.clique_size == alone.solution.clique_size


def test_nothing_and_bad_input(unchecked):
    good = problem(0)
    assert tj.solve_batch([]) == []
    with pytest.raises(ValueError, match=r"problems\[1\] is of type tuple"):
        tj.solve_batch([good, (1, 2)])
    with pytest.raises(ValueError, match=r"problems\[0\] has dst of shape \(4, 3\): expected \(30, 3\)"):
        tj.solve_batch([dataclasses.replace(good, dst=np.zeros((4, 3)))])
    with pytest.raises(ValueError, match="a stack goes in by itself"):
        tj.solve_batch([tj.stack_problems([good, good])])
    with pytest.raises(ValueError, match=r"expected \(b, n, 3\)"):
        tj.solve_batch(good)
    for wrong in (
        {"mask": np.full(30, np.nan)}, {"src": good.src * 1j}, {"noise_bound": None},
        {"pairs": np.full((3, 2), 0.5)},
        {"src": np.zeros((30, 3), [("x", float)])}, {"src": [[1, 2, 3], [4]]},
    ):  # fmt: skip
        with pytest.raises(ValueError, match="make problems with make_problem"):
            tj.solve_batch([dataclasses.replace(good, **wrong)])
    with pytest.raises(ValueError, match=r"problems\[0\] has src with hidden entries"):
        tj.solve_batch([dataclasses.replace(good, src=np.ma.masked_less(good.src, 0))])
    with pytest.raises(ValueError, match=r"problems\[0\] has src without numbers"):
        tj.solve_batch([jax.eval_shape(lambda p: p, good)])
    with pytest.raises(ValueError, match=r"src of shape \(3, 30\): expected \(..., n, 3\)"):
        tj.solve_batch([dataclasses.replace(good, src=good.src.T)])
    with pytest.raises(ValueError, match="expected a jax.sharding.Mesh"):
        tj.solve_batch([good], mesh=jax.devices())
    with pytest.raises(ValueError, match="mesh has no device"):
        tj.solve_batch([good], mesh=jax.sharding.Mesh(np.empty(0, object), ("x",)))
    with pytest.raises(ValueError, match="expected a list"):
        tj.solve_batch("")
    with pytest.raises(ValueError, match="expected a list"):
        tj.solve_batch(p for p in [good])
    with pytest.raises(ValueError, match="chunk_size is 0"):
        tj.solve_batch([good], chunk_size=0)
    with pytest.raises(ValueError, match="solved on the host"):
        tj.solve_batch([good], tj.Settings(rotation="sdp"))
    with pytest.raises(ValueError, match="rows that do not exist"):
        tj.solve_batch([dataclasses.replace(good, pairs=np.array([[0, 99]]))])
    with pytest.raises(ValueError, match="inside jit"):
        jax.jit(lambda p: tj.solve_batch([p]))(good)
    with pytest.raises(ValueError, match="no problem"):
        tj.solve_batch(jax.tree.map(lambda x: x[:0], tj.stack_problems([good])))


@pytest.mark.long
def test_a_bar_is_drawn(capsys):
    tj.solve_batch([problem(0)], progress=True)
    assert "1/1" in capsys.readouterr().err


def run(name, *arguments, **variables):
    return subprocess.Popen(
        [sys.executable, str(HERE / name), *map(str, arguments)],
        env={**os.environ, "JAX_PLATFORMS": "cpu", **variables},
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.mark.long
def test_four_devices_give_the_bits_of_one():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    forced = run("four_devices.py", XLA_FLAGS=flags)
    out, _ = forced.communicate(timeout=300)
    said = json.loads(out.splitlines()[-1])
    assert said == {"devices": 4, "same": True, "right": 64, "compiled": 2}


@pytest.mark.long
def test_two_processes_share_the_work():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    both = [run("two_processes.py", f"127.0.0.1:{port}", 2, k) for k in range(2)]
    said = [json.loads(each.communicate(timeout=300)[0].splitlines()[-1]) for each in both]
    assert said == [{"processes": 2, "same": True, "shares": [5, 6], "refused": True}] * 2
