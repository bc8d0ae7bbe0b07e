"""The studies of the paper: what is drawn, what is swept, who takes part and what is measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from teaser_jax import synthetic
from teaser_jax.ground.checks import whole_number
from teaser_jax.studies import methods as m
from teaser_jax.studies.methods import Method, Row
from teaser_jax.studies.peers import find_peers
from teaser_jax.studies.trials import Draw, Model, StudyError, Trial, seed_of
from teaser_jax.synthetic import SyntheticProblem
from teaser_jax.types import Pose

OUTLIERS, OVERLAP, MATCHES = "outlier_rate", "overlap", "n"
LABELS = {OUTLIERS: "wrong matches", OVERLAP: "overlap", MATCHES: "matches"}
TENTHS = tuple(k / 10 for k in range(10))
QUICK_RUNS = 3


@dataclass(frozen=True)
class Measure:
    """A column of the table that is drawn, and how."""

    column: str
    label: str
    log: bool = True


ROTATION = Measure("rotation_deg", "rotation error [deg]")
TRANSLATION = Measure("translation", "translation error [model size]")
SCALE = Measure("scale_error", "scale error [-]")
SECONDS = Measure("seconds", "time a problem [s]")
POSE = (ROTATION, TRANSLATION, SECONDS)
STAGES = ("stage_scale", "stage_graph", "stage_clique", "stage_rotation", "stage_translation", "stage_rest")
POSE_COLUMNS = ("rotation_deg", "translation", "seconds", "together", "ok")


@dataclass(frozen=True)
class Study:
    """One figure of the paper.

    Attributes:
        name: On the command line, and of its folder.
        figure: Of the paper.
        title: What is drawn, without the model.
        sweep: The quantity that is swept: the share of wrong matches, the overlap, or the number of matches.
        values: Its values, a cell each.
        quick_values: Those of a quick study.
        draw: The problem of a seed and a value, from a model.
        methods: Those that take part here, each with its own name.
        measures: What the figure shows, a panel each.
        columns: What the table holds, beside cell, run, method and error.
        scale: The known scale, or None.
        runs: Problems a cell.
        right: Whether a row is an accepted answer.
    """

    name: str
    figure: str
    title: str
    sweep: str
    values: tuple[float, ...]
    quick_values: tuple[float, ...]
    draw: Draw
    methods: tuple[Method, ...]
    measures: tuple[Measure, ...]
    columns: tuple[str, ...]
    right: Callable[[Row], bool]
    scale: float | None = 1.0
    runs: int = 40

    def cells(self, runs: int | None = None, *, quick: bool = False) -> list[tuple[float, range]]:
        """The values and the numbers of their runs; StudyError if there would be none."""
        usual = QUICK_RUNS if quick else self.runs
        count = usual if runs is None else whole_number("runs", runs, 1, error=StudyError)
        return [(value, range(count)) for value in (self.quick_values if quick else self.values)]

    def trial(self, seed: int, value: float, number: int, model: Model) -> Trial:
        """One problem of a cell; the same for the same arguments, on every machine.

        StudyError if the model has too few points for it, or no area.
        """
        try:
            problem = self.draw(seed_of(self.name, seed, value, number), value, model)
        except ValueError as error:
            raise StudyError(f"{self.name} cannot draw from the model {model.name!r}: {error}") from error
        return Trial(value, number, problem, self.scale)


def below(**limits: float) -> Callable[[Row], bool]:
    """Whether every one of these measures of a row is a number below its limit."""
    return lambda row: all(row.get(column, np.nan) < limit for column, limit in limits.items())


def studies() -> dict[str, Study]:
    """All studies by name, with the peers that this environment has."""
    peers, _ = find_peers()
    others = {name: m.of_peer(name, peer) for name, peer in peers.items()}

    def without(*words: str) -> tuple[Method, ...]:
        return tuple(each for name, each in others.items() if not any(word in name for word in words))

    scaled = tuple(each for each in without("RANSAC-10k") if peers[each.name].finds_scale)
    solvers = (
        m.limit(),
        m.in_batches(),
        m.in_batches(f"{m.OURS}, cascade", refine=False),
        m.in_batches(f"{m.OURS}, global", rotation="global", refine=False),
        m.one_by_one(f"{m.OURS}, sdp", suits=m.few_right, rotation="sdp", refine=False),
        m.one_by_one(f"{m.OURS}, one by one"),
    )
    pose_is_right = below(rotation_deg=5.0)
    known = Study(
        "known-scale", "Fig. 6a", "known scale, N = 100", OUTLIERS, TENTHS, (0.0, 0.5, 0.9),
        partial(_matched, n=100), (*solvers, *without("RANSAC-10k")), POSE, POSE_COLUMNS, pose_is_right,
    )  # fmt: skip
    found = [
        Study(
            "scale", "Fig. 4a", "scale of all pairs, N = 40", OUTLIERS, TENTHS, (0.0, 0.5, 0.8, 0.9),
            partial(_matched, n=40, scale=(1.0, 5.0)),
            (m.scale_by_vote("tls"), m.scale_by_vote("consensus")), (SCALE, SECONDS),
            ("scale_error", "seconds"), below(scale_error=0.3), scale=None,
        ),
        Study(
            "clique", "Fig. 4b", "wrong matches before and after the maximum clique, N = 1000",
            OUTLIERS, (*TENTHS, 0.95, 0.98, 0.99), (0.0, 0.5, 0.9, 0.99), partial(_matched, n=1000),
            (
                m.before_pruning(), m.clique_alone("maximum clique", "exact"),
                m.clique_alone("greedy", "greedy"),
            ),
            (
                Measure("outliers_left", "wrong matches left [share]", log=False),
                Measure("inliers_kept", "right matches kept [share]", log=False),
            ),
            ("outliers_left", "inliers_kept", "proved", "seconds", "together"), below(outliers_left=0.1),
        ),
        Study(
            "rotation", "Fig. 4c", "rotation alone, K = 40, wrong vectors too of the right length",
            OUTLIERS, TENTHS, (0.0, 0.5, 0.8, 0.9),
            partial(_turned, n=40),
            (
                m.rotation_alone("GNC", "gnc"), m.rotation_alone("global search", "global"),
                m.rotation_alone("semidefinite relaxation", "sdp"),
            ),
            (ROTATION, SECONDS), ("rotation_deg", "cost", "seconds"), below(rotation_deg=5.0),
        ),
        Study(
            "translation", "Fig. 4d", "translation alone, N = 40", OUTLIERS, TENTHS, (0.0, 0.5, 0.8, 0.9),
            partial(_moved, n=40), (m.translation_by_vote("tls"), m.translation_by_vote("consensus")),
            (TRANSLATION, SECONDS), ("translation", "seconds"), below(translation=0.1),
        ),
        Study(
            "certificate", "Fig. 5", "GNC's rotation and its certificate, K = 100", OUTLIERS, TENTHS,
            (0.0, 0.5, 0.8, 0.9), partial(_turned, n=100),
            (
                m.rotation_certified("GNC, certified", "splitting"),
                m.rotation_certified("GNC, certified by Algorithm 3 as printed", "reference"),
            ),
            (
                ROTATION, Measure("suboptimality", "proved suboptimality [-]"),
                Measure("iterations", "iterations", log=False), SECONDS,
            ),
            ("rotation_deg", "cost", "proved", "suboptimality", "iterations", "seconds"),
            below(rotation_deg=1.0), runs=100,
        ),
        known,
        Study(
            "extreme", "Fig. 6b", "known scale, N = 1000", OUTLIERS, (0.95, 0.96, 0.97, 0.98, 0.99),
            (0.95, 0.99), partial(_matched, n=1000), (*solvers, *without("RANSAC-1k", "ICP")), POSE,
            POSE_COLUMNS, pose_is_right,
        ),
        Study(
            "unknown-scale", "Fig. 6c", "unknown scale, N = 100", OUTLIERS, TENTHS, (0.0, 0.5, 0.8, 0.9),
            partial(_matched, n=100, scale=(1.0, 5.0)),
            (
                m.limit(), m.in_batches(), m.in_batches(f"{m.OURS}, cascade", refine=False),
                m.in_batches(f"{m.OURS}, consensus maximisation", vote="consensus"),
                m.one_by_one(f"{m.OURS}, one by one"), *scaled,
            ),
            (SCALE, *POSE), ("scale_error", *POSE_COLUMNS),
            below(rotation_deg=5.0, scale_error=0.1), scale=None,
        ),
        Study(
            "all-to-all", "Fig. 7", "no correspondences, 100 points against a part of them, bound 0.01",
            OVERLAP, tuple(k / 10 for k in range(10, 0, -1)), (1.0, 0.4, 0.1), _all_to_all,
            (m.limit(), m.in_batches(), m.stage_by_stage(), *without("RANSAC")), POSE,
            (*POSE_COLUMNS, *STAGES), pose_is_right,
        ),
        replace(
            known, name="high-noise", figure="supplement", title="known scale, N = 100, sigma 0.1",
            draw=partial(_matched, n=100, sigma=0.1), right=below(rotation_deg=30.0),
        ),
        Study(
            "scaling", "supplement", "known scale, 95 % wrong", MATCHES,
            (100, 200, 500, 1000, 2000, 5000, 10_000), (100, 500, 2000), _growing,
            (
                m.limit(), m.in_batches(), m.one_by_one(f"{m.OURS}, one by one"), m.stage_by_stage(),
                *without("RANSAC", "ICP"),
            ),
            POSE, (*POSE_COLUMNS, *STAGES), pose_is_right,
        ),
    ]  # fmt: skip
    return {study.name: study for study in found}


def _matched(seed: tuple[int, ...], value: float, model: Model, **drawn: Any) -> SyntheticProblem:
    return synthetic.random_problem(seed, outlier_rate=value, model=model.shape, **drawn)


def _turned(seed: tuple[int, ...], value: float, model: Model, n: int) -> SyntheticProblem:
    # About the mean, and wrong vectors keep their length, as those do that pass the test of lengths: others
    # would make the search easier than it is after a clique. By chance a wrong one may be right.
    rng = np.random.default_rng((*seed, 1))
    turn = Pose(synthetic.random_rotation(rng), np.zeros(3), np.asarray(1.0))
    p = _matched(seed, 0.0, model, n=n, truth=turn)
    src, inliers = p.src - p.src.mean(axis=0), np.ones(n, bool)
    dst = turn.apply(src) + (p.dst - turn.apply(p.src))
    wrong = rng.permutation(n)[: round(value * n)]
    inliers[wrong] = False
    odd = rng.standard_normal((len(wrong), 3))
    dst[wrong] = odd * (np.linalg.norm(src[wrong], axis=1) / np.linalg.norm(odd, axis=1))[:, None]
    return SyntheticProblem(src, dst, turn, inliers, p.noise_bound)


def _moved(seed: tuple[int, ...], value: float, model: Model, n: int) -> SyntheticProblem:
    shift = synthetic.in_ball(np.random.default_rng((*seed, 1)), 1, 1.0)[0]
    return _matched(seed, value, model, n=n, truth=Pose(np.eye(3), shift, np.asarray(1.0)))


def _all_to_all(seed: tuple[int, ...], value: float, model: Model) -> SyntheticProblem:
    return synthetic.all_to_all(seed, overlap=value, model=model.shape)


def _growing(seed: tuple[int, ...], value: float, model: Model) -> SyntheticProblem:
    return _matched(seed, 0.95, model, n=int(value))
