"""Thousands of inputs for every door: no crash, no hang, no bare exception and no false ``ok``.

Seeds are fixed, so that a finding comes again. Warnings are errors, as everywhere in the tests.
"""

from __future__ import annotations

import faulthandler
import io
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields, replace
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest
from fuzzing import (
    BOUND,
    ODD,
    Case,
    check_pose,
    draw,
    odd_calls,
    outcome,
    seeds,
    spoiled,
    stacked,
)
from fuzzing_text import argument_lists, broken_files

import teaser_jax as tj
from teaser_jax import files, learn, settings
from teaser_jax.cli import main
from teaser_jax.cli.arguments import parser

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("unchecked")]
# Of each door, and an eighth of it where a call takes many milliseconds: two minutes in all. Before a release
# and after a change of a door, TEASER_JAX_FUZZ=20000 takes some twelve.
INPUTS = int(os.environ.get("TEASER_JAX_FUZZ", 3_000))
TOGETHER = 500  # problems in a batch
ROWS = 32


@pytest.fixture(autouse=True)
def no_hang() -> Iterator[None]:
    faulthandler.dump_traceback_later(900, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="module")
def answers() -> list[tj.Registration]:
    """Answers of all kinds, with what they answer."""
    found = []
    for rng in seeds(0, 60):
        case = draw(rng)
        answer = outcome(lambda case=case: tj.register(case.src, case.dst, **case.known), case.kind)
        found += [answer] if answer is not None else []
    return found


def test_register():
    came = Counter()
    for rng in seeds(1, INPUTS):
        case = spoiled(rng, draw(rng))
        told = (case.kind, case.src, case.dst, case.known)
        answer = outcome(lambda case=case: tj.register(case.src, case.dst, **case.known), told)
        came["refused" if answer is None else answer.status.name] += 1
        if answer is not None:
            check_pose(case, answer.pose, answer.status, answer.inliers)
            if rng.random() < 0.1:  # the words for a failure may take as long as the answer
                assert answer.status.name in str(answer)
    assert min(came["refused"], came["OK"], came["NO_CONSENSUS"]) > INPUTS / 30, came


def test_solve_batch():
    """Problems as ``host_problem`` makes them, and records that somebody changed."""
    came, waiting = Counter(), []
    for rng in seeds(2, INPUTS):
        case = draw(rng)
        problem = outcome(lambda case=case: tj.host_problem(case.src, case.dst, **case.known), case.known)
        if problem is not None and rng.random() < 0.3:
            field = str(rng.choice([each.name for each in fields(problem)]))
            problem = replace(problem, **{field: ODD[rng.integers(len(ODD))]})
            case = Case("changed", case.src, case.dst, {field: "odd"})
            if outcome(lambda problem=problem: tj.solve_batch([problem]), problem) is None:
                came["refused"] += 1
                continue
        if problem is not None:
            waiting.append((case, problem))
        if len(waiting) == TOGETHER:
            for (case, _), answer in zip(waiting, tj.solve_batch([x for _, x in waiting]), strict=True):
                check_pose(case, answer.pose, answer.status, answer.inliers)
                came[tj.Status(int(answer.status)).name] += 1
            waiting = []
    assert min(came["refused"], came["OK"], came["NO_CONSENSUS"]) > INPUTS / 100, came


def _unread(rng: np.random.Generator) -> tuple[Case, tj.Problem]:
    """A problem whose numbers nobody looks at before they are inside jit, padded to one size."""
    case = draw(rng)
    n, known = len(case.src), case.known
    number = lambda name, default: np.broadcast_to(np.asarray(known.get(name, default), float), n)
    with np.errstate(over="ignore"):
        problem = tj.Problem(
            src=np.asarray(case.src, np.float32).reshape(-1, 3),
            dst=np.asarray(case.dst, np.float32).reshape(-1, 3),
            noise_bound=number("noise_bound", BOUND).astype(np.float32),
            cbar2=np.asarray(known.get("cbar2", 1.0), np.float32),
            mask=np.asarray(known.get("mask", np.ones(n, bool))),
            confidence=number("confidence", 1.0).astype(np.float32),
            scale=np.asarray(1.0 if known.get("scale", 1.0) is None else known.get("scale", 1.0), np.float32),
        )
    from teaser_jax.problem import pad_problem

    return case, pad_problem(problem, ROWS)


def test_solve_under_jit_and_vmap():
    greedy = tj.Settings(clique="greedy")
    many = jax.jit(jax.vmap(lambda p: tj.solve(p, greedy)))
    some = jax.jit(tj.solve)
    came, waiting = Counter(), []
    for k, rng in enumerate(seeds(3, INPUTS)):
        case, problem = _unread(rng)
        if k % 20 == 0:
            answer = some(problem)
            check_pose(case, answer.pose, answer.status, np.asarray(answer.inliers), slack=1.5)
        waiting.append((case, problem))
        if len(waiting) == TOGETHER:
            batch = jax.device_get(many(stacked([problem for _, problem in waiting])))
            for j, (case, _) in enumerate(waiting):
                one = jax.tree.map(lambda x, j=j: x[j], batch)
                check_pose(case, one.pose, one.status, one.inliers, slack=1.5)
                came[tj.Status(int(one.status)).name] += 1
            waiting = []
    assert min(came["OK"], came["NO_CONSENSUS"]) > INPUTS / 30, came


def certifiers(answer: tj.Registration) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    p, rotation = answer.problem, answer.pose.rotation
    vectors = {"src": p.src, "dst": p.dst, "noise_bound": p.noise_bound, "cbar2": p.cbar2, "mask": p.mask}
    options = {"method": "direct", "tolerance": 1e-3, "iterations": 3, "max_measurements": 100}
    return {
        "certify": (tj.certify, {"problem": p, "solution": answer.solution, "about": "pose", **options}),
        "certify_rotation": (tj.certify_rotation, {**vectors, "rotation": rotation, **options}),
        "solve_rotation": (tj.solve_rotation, {**vectors, "method": "gnc", "proof": None, "tolerance": 1e-3}),
    }


def test_certify(answers):
    def look(name: str, found: Any) -> None:
        certificate = found if isinstance(found, tj.Certificate) else found.certificate
        if certificate is not None:
            assert not np.any(certificate.is_optimal & (certificate.status != 0))
            assert np.all(certificate.lower_bound <= certificate.cost * (1 + 1e-9) + 1e-300)
        assert repr(found)

    odd_calls(4, INPUTS // 8, answers, certifiers, look)


def bounders(answer: tj.Registration) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    p = answer.problem
    both = {"problem": p, "solution": answer.solution}
    proved = {"certificate": answer.certificate, "noise_bound": p.noise_bound}
    return {
        "error_bounds": (tj.error_bounds, {**both, "wrong": 1, "certificate": answer.certificate}),
        "covariance": (tj.covariance, {**both, "sigma": 0.01, "convention": "gtsam"}),
        "verify": (tj.verify, {
            "src": p.src, "dst": p.dst, "rotation": answer.pose.rotation, **proved, "tolerance": 1e-3,
            "cbar2": p.cbar2,
        }),
        "refit": (tj.refit, {"problem": p, "selection": answer.solution.selection}),
        "errors": (tj.metrics.errors, {"estimate": answer, "truth": answer.pose.matrix}),
        "precision_recall": (tj.metrics.precision_recall, {"found": answer.inliers, "right": p.mask}),
        "from_matrix": (tj.Pose.from_matrix, {"matrix": answer.pose.matrix}),
        "apply": (answer.pose.apply, {"points": p.src}),
    }  # fmt: skip


def test_bounds_and_errors(answers):
    odd_calls(5, INPUTS // 8, answers[:12], bounders, lambda name, found: repr(found))


def test_learn():
    """The teacher under vmap, of numbers that nobody looked at; then losses and shapes that do not fit."""
    teach = jax.jit(lambda src, dst, bound, mask: learn.teacher(src, dst, noise_bound=bound, mask=mask))
    waiting = []
    for rng in seeds(6, INPUTS):
        waiting.append(_unread(rng))
        if len(waiting) == TOGETHER:
            p = stacked([problem for _, problem in waiting])
            labels = jax.device_get(teach(p.src, p.dst, p.noise_bound, p.mask))
            for j, (case, _) in enumerate(waiting):
                one = jax.tree.map(lambda x, j=j: x[j], labels)
                plain = not set(case.known) & {"scale", "cbar2", "confidence"}
                if plain:
                    check_pose(case, one.pose, one.status, one.inliers, slack=1.5)
                assert bool(one.trusted) <= (int(one.status) == tj.Status.OK)
            waiting = []


def test_records_and_synthetic():
    """Settings, the records of methods, and problems from seeds."""
    records = {
        each.__name__: (each, {f.name: getattr(each(), f.name) for f in fields(each)})
        for each in (
            settings.Gnc, settings.ExactClique, settings.ScaleVote, settings.Refinement, settings.PairSearch,
            settings.Relaxation, settings.GreedyClique, tj.Settings,
        )
    }  # fmt: skip
    drawn = {"seed": 0, "n": 8, "outlier_rate": 0.5, "scale": (1, 5), "sigma": 0.01, "noise_bound": 0.05}
    makers = {
        **records,
        "random_problem": (tj.synthetic.random_problem, {**drawn, "radius": 5.0}),
        "descriptor_problem": (tj.synthetic.descriptor_problem, {**drawn, "hubs": 0.5}),
    }

    def look(name: str, found: Any) -> None:
        if isinstance(found, tj.Settings):
            outcome(lambda: settings.check_settings(found), found)
        assert repr(found)

    odd_calls(7, INPUTS, [None], lambda _: makers, look)


def test_files(tmp_path):
    came = Counter()
    for path, kind in broken_files(8, INPUTS, tmp_path):
        read = files.read_shape if kind == "model" else files.read_matches
        found = outcome(lambda read=read, path=path: read(path), path.read_bytes(), files.FileError)
        came[kind, found is not None] += 1
    assert min(came.values()) > INPUTS / 1000, came


def test_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("teaser_jax.cli.parser", cache(parser))  # to make it takes as long as to register
    came = Counter()
    for arguments in argument_lists(9, INPUTS, tmp_path):
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            try:
                code = main(arguments)
            except SystemExit as end:  # of --help and --version
                code = end.code
                assert code == 0
                assert out.getvalue(), arguments
            except BaseException as error:
                error.add_note(f"the fuzz was at {arguments}")
                raise
        said = err.getvalue().splitlines()
        assert code in (0, 1, 2), arguments
        assert all(line.startswith("teaser-jax: ") for line in said), (arguments, said)
        assert (len(said) >= 1) if code == 2 else out.getvalue(), (arguments, said)
        came[code] += 1
    assert min(came[0], came[1], came[2]) > INPUTS / 1000, came
