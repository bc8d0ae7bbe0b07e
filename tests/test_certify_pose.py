"""Certificates of registration problems: which measurements, stacks, jit, and what the clique says."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import solve

import teaser_jax as tj
from teaser_jax.certify.certificate import CertificateStatus, CertifiedBy


@pytest.mark.long
@pytest.mark.parametrize("about", ["pose", "chain", "complete"])
def test_answers_of_the_cascade_are_certified(about):
    for seed in range(3):
        drawn = tj.synthetic.random_problem(seed, n=40, outlier_rate=0.7)
        graph = "complete" if about == "complete" else "chain"
        settings = tj.Settings(tim_graph=graph)
        result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, settings=settings)
        problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        found = tj.certify(problem, result.solution, about=about, iterations=60)
        assert found.is_optimal, (seed, found)
        assert found.inlier_gap >= 0
        assert 0 <= found.explained_gap < 0.2


@pytest.mark.long
def test_nothing_explained_is_said():
    drawn = tj.synthetic.random_problem(0, n=200, outlier_rate=0.95)
    result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    none = np.zeros(200, bool)
    nothing = replace(result.solution, inliers=none, cost=np.float64(200.0))
    assert tj.certify(problem, nothing).explained_gap > 0.9


@pytest.mark.long
def test_certify_under_jit_and_too_large():
    drawn = tj.synthetic.random_problem(0, n=32, outlier_rate=0.25)
    with jax.enable_x64(True):
        problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        solution = solve(problem)
        inside = jax.jit(lambda p, s: tj.certify(p, s))(problem, solution)
        outside = tj.certify(problem, solution)
        assert_allclose(inside.cost, outside.cost)
        assert bool(inside.is_optimal)
        small = jax.jit(lambda p, s: tj.certify(p, s, max_measurements=8))(problem, solution)
        assert int(small.status) == CertificateStatus.TOO_LARGE
        assert not bool(small.is_optimal)


def test_an_unknown_subject_is_refused(unchecked):
    with pytest.raises(ValueError, match="about"):
        tj.certify(None, None, about="everything")


def test_a_result_computes_its_certificate_when_asked(small):
    known = dict(noise_bound=small.noise_bound)
    plain = tj.register(small.src, small.dst, **known)
    assert "rotation: " not in str(plain)
    certified = tj.register(small.src, small.dst, **known, certify=True)
    assert "rotation: optimal within 0.10% of its cost and unique, given 16 measurements" in str(certified)
    assert plain.certificate is plain.certificate
    assert_allclose(plain.certificate.lower_bound, certified.certificate.lower_bound)
    assert plain.certificate.inlier_gap == 0
    keep = plain.inliers | plain.solution.selection.clique
    centred = [x[keep] - x[plain.inliers].mean(axis=0) for x in (small.src, small.dst)]
    bound = small.noise_bound * plain.solution.selection.widening
    assert tj.verify(*centred, plain.pose.rotation, plain.certificate, noise_bound=bound)


def test_a_certificate_never_turns_ok_true():
    drawn = tj.synthetic.random_problem(0, n=30, outlier_rate=1.0)
    result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, certify=True)
    assert not result.ok
    assert not bool(result)
    assert "NOT OK" in str(result)


def test_no_answer_has_no_certificate():
    # One usable match: the clique is that one, and nothing is claimed of its rotation.
    points = np.random.default_rng(0).normal(size=(5, 3))
    result = tj.register(points, points, noise_bound=0.1, mask=np.arange(5) == 2, certify=True)
    assert result.certificate.status == CertificateStatus.NO_MEASUREMENTS
    assert "not proved optimal (NO_MEASUREMENTS)" in str(result)


@pytest.mark.long
def test_a_stack_of_solutions_outside_jit():
    drawn = [tj.synthetic.random_problem(seed, n=32, outlier_rate=0.6) for seed in range(3)]
    problems = [tj.make_problem(d.src, d.dst, noise_bound=d.noise_bound) for d in drawn]
    stacked = tj.stack_problems(problems)
    solutions = jax.tree.map(lambda *x: np.stack(x), *(solve(problem) for problem in problems))
    found = tj.certify(stacked, solutions)
    assert found.status.shape == found.explained_gap.shape == (3,)
    for i in range(3):
        alone = tj.certify(*jax.tree.map(lambda x, i=i: x[i], (stacked, solutions)))
        assert found.status[i] == alone.status
        assert_allclose(found.lower_bound[i], alone.lower_bound, rtol=1e-6)
        assert found.inlier_gap[i] == alone.inlier_gap
    with pytest.raises(ValueError, match=r"use jax.vmap\(certify\)"):
        jax.jit(lambda p, s: tj.certify(p, s))(stacked, solutions)


@pytest.mark.long
def test_the_identity_explains_nothing_on_the_protocol():
    for n, rate in ((100, 0.5), (1000, 0.99)):
        drawn = tj.synthetic.random_problem(1, n=n, outlier_rate=rate)
        result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        r = np.linalg.norm(drawn.dst - drawn.src, axis=1) / drawn.noise_bound
        cost, inliers = np.minimum(r**2, 1).sum(), r <= 1
        nothing = replace(result.solution, cost=cost, inliers=inliers)
        assert tj.certify(result.problem, nothing, method="direct").explained_gap > 0.9


@pytest.mark.long
def test_clouds_far_from_the_origin():
    drawn = tj.synthetic.random_problem(2, n=60, outlier_rate=0.5)
    far = np.array([5e5, -3e5, 100.0])
    near = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    away = tj.register(drawn.src + far, drawn.dst - far, noise_bound=drawn.noise_bound)
    assert_allclose(away.certificate.lower_bound, near.certificate.lower_bound, rtol=1e-5)
    assert away.certificate.is_optimal


def test_a_result_keeps_what_it_was_asked(small):
    src, dst = small.src.copy(), small.dst.copy()
    result = tj.register(src, dst, noise_bound=small.noise_bound)
    src[:], dst[:] = 0, 1  # the caller's buffers are used again
    assert result.certificate.is_optimal
    assert result.certificate.measurements == 16


@pytest.mark.long
def test_after_warmup_certificates_compile_nothing():
    tj.warmup(16, certify=True)
    compiled, listening = [], [True]

    def listener(event, *_, **__):
        if listening and "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listener)
    drawn = tj.synthetic.random_problem(0, n=16, outlier_rate=0.5)
    result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, certify=True)
    assert result.certificate.method == CertifiedBy.DIRECT
    for rotation in (np.eye(3), -result.pose.rotation):  # neither is a proof by the closed form
        other = replace(result.solution, pose=replace(result.pose, rotation=rotation))
        assert not tj.certify(result.problem, other, iterations=7).is_optimal
    assert not compiled
    jax.jit(lambda x: x + 1.2345)(1.0)
    assert compiled  # whatever is new is seen
    listening.clear()


@pytest.mark.long
def test_an_answer_of_register_stands_for_problem_and_solution(small, solved):
    for ask in (tj.certify, tj.error_bounds, tj.covariance):
        alone, both = ask(solved), ask(solved.problem, solved.solution)
        assert repr(alone) == repr(both) == repr(ask(solved.problem, solved))


@pytest.mark.parametrize("ask", [tj.certify, tj.error_bounds, tj.covariance])
def test_what_is_no_problem_and_its_solution_is_named(ask, solved, unchecked):
    fewer = tj.host_problem(solved.problem.src[:9], solved.problem.dst[:9], noise_bound=0.1)
    for pair, said in (
        (
            (solved.solution, solved.problem),
            f"{ask.__name__} received Solution for a problem: give the",
        ),
        ((solved.problem,), "received NoneType for a solution"),
        ((solved.problem, solved.pose), "received Pose for a solution"),
        ((solved.problem.src, solved.solution), "received ndarray for a problem"),
        ((fewer, solved.solution), r"the problem has rows of shape \(9,\) and the solution"),
    ):
        with pytest.raises(ValueError, match=said):
            ask(*pair)
