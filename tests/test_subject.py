"""What a certificate of a pose is about: the vectors on the host, and the same ones under jit."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from teaser_jax.certify.subject import subject_on_host, traced_subject
from teaser_jax.problem import clean

traced = jax.jit(lambda p, s, about, most: traced_subject(clean(p)[0], s, about, most), static_argnums=(2, 3))


def existing(subject) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(subject.src)[subject.mask], np.asarray(subject.dst)[subject.mask]


def test_about_the_pose_inliers_lie_about_their_centroid(solved):
    subject = subject_on_host(solved.problem, solved.solution, "pose")
    keep = solved.inliers | solved.solution.selection.clique
    assert_array_equal(subject.mask, keep)
    for vectors in (subject.src, subject.dst):
        assert_allclose(vectors[solved.inliers].mean(axis=0), 0, atol=1e-12)
    residuals = np.linalg.norm(subject.dst - subject.src @ subject.rotation.T, axis=1)
    joint = np.linalg.norm(solved.problem.dst - solved.pose.apply(solved.problem.src), axis=1)
    assert_allclose(residuals[keep], joint[keep], atol=1e-9)  # those of the registration


def test_a_chain_is_closed(solved):
    subject = subject_on_host(solved.problem, solved.solution, "chain")
    assert subject.mask.sum() == solved.solution.clique_size
    for vectors in existing(subject):
        assert_allclose(vectors.sum(axis=0), 0, atol=1e-12)
    bound = solved.problem.noise_bound[0] * solved.solution.selection.widening
    assert_allclose(subject.noise_bound[subject.mask], 2 * bound)


@pytest.mark.long
def test_the_complete_graph_has_all_pairs_of_the_clique(solved):
    chosen = solved.solution.selection
    members = chosen.rows.order[chosen.clique[chosen.rows.order]]  # in the order in which they were solved
    src, _ = existing(subject_on_host(solved.problem, solved.solution, "complete"))
    i, j = np.triu_indices(len(members), 1)
    points = solved.problem.src[members]
    assert_allclose(src, points[j] - points[i], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("about", ["pose", "chain", "complete"])
def test_under_jit_they_are_the_same_and_in_front(about, solved, x64):
    outside = existing(subject_on_host(solved.problem, solved.solution, about))
    count = len(outside[0])
    subject, too_many = traced(solved.problem, solved.solution, about, 150)
    assert not too_many
    assert_array_equal(subject.mask, np.arange(len(subject.mask)) < count)
    for ours, theirs in zip(existing(subject), outside, strict=True):
        assert_allclose(ours, theirs, atol=1e-12)
    assert bool(traced(solved.problem, solved.solution, about, 8)[1])
