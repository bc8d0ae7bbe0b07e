"""Other libraries: what is timed of them, and that they answer a repeated question as before."""

from __future__ import annotations

import time

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.studies import Model, studies
from teaser_jax.studies.methods import of_peer
from teaser_jax.studies.peers import Peer, Question, find_peers


@pytest.mark.long
def test_a_peer_is_timed_warm_and_without_what_we_make_of_problems_and_answers():
    calls = []

    def ask(src, dst, bound, scale):
        def solve():
            time.sleep(0.3 if not calls else 0.01)  # a library's first call starts its threads
            calls.append(len(src))

        def pose(found):
            time.sleep(0.3)
            return tj.Pose(np.eye(3), np.zeros(3), np.asarray(1.0))

        time.sleep(0.3)
        return Question(solve, pose)

    study = studies()["known-scale"]
    trials = [study.trial(0, 0.5, k, Model()) for k in range(2)]
    rows = of_peer("peer", Peer(ask)).run(trials, None)
    assert calls == [100, 100, 100]
    assert all(0.01 <= row["seconds"] < 0.25 for row in rows)


@pytest.mark.parametrize("name", sorted(name for name in find_peers()[0] if "RANSAC" not in name))
def test_a_peer_that_is_asked_again_answers_as_before(name):
    peer, study = find_peers()[0][name], studies()["known-scale"]
    problems = [study.trial(0, rate, 0, Model()).problem for rate in (0.3, 0.6)]

    def asked(p, factor):
        return peer.ask(p.src, p.dst, factor * p.noise_bound, 1.0)

    questions = [asked(problems[0], 1.0), asked(problems[1], 1.0), asked(problems[0], 3.0)]
    first = [question.answer().matrix for question in questions]
    again = [question.answer().matrix for question in questions]
    np.testing.assert_array_equal(first, again)
    for question, problem in zip(questions[:2], problems, strict=True):
        if name != "Open3D ICP":
            assert tj.metrics.rotation_error(question.answer(), problem.truth) < 0.1
