"""The studies of the paper, figure by figure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from teaser_jax.studies import draws
from teaser_jax.studies import methods as m
from teaser_jax.studies.methods import Method
from teaser_jax.studies.peers import find_peers
from teaser_jax.studies.study import MATCHES, OUTLIERS, OVERLAP, Measure, Study, below

TENTHS = tuple(k / 10 for k in range(10))
ROTATION = Measure("rotation_deg", "rotation error [deg]")
TRANSLATION = Measure("translation", "translation error [model size]")
SCALE = Measure("scale_error", "scale error [-]")
SECONDS = Measure("seconds", "time a problem [s]")
POSE = (ROTATION, TRANSLATION, SECONDS)
STAGES = ("stage_scale", "stage_graph", "stage_clique", "stage_rotation", "stage_translation", "stage_rest")
POSE_COLUMNS = ("rotation_deg", "translation", "seconds", "together", "ok")
ONE_BY_ONE = f"{m.OURS}, one by one"
CASCADE = f"{m.OURS}, cascade"


def studies() -> dict[str, Study]:
    """List all studies by name, with the peers that this environment has."""
    peers, _ = find_peers()
    others = [m.of_peer(name, peer) for name, peer in peers.items()]
    scaled = [each for each in others if peers[each.name].finds_scale]
    found = (
        _scale(), _clique(), _rotation(), _translation(), _certificate(),
        _known_scale(others), _extreme(others), _unknown_scale(scaled), _all_to_all(others),
        _high_noise(others), _scaling(others),
    )  # fmt: skip
    return {study.name: study for study in found}


def _without(others: list[Method], *words: str) -> Iterator[Method]:
    """Leave out the methods whose name holds one of the words."""
    return (each for each in others if not any(word in each.name for word in words))


def _solvers() -> tuple[Method, ...]:
    """List our methods where the scale is known, after the limit of all."""
    return (
        m.limit(),
        m.in_batches(),
        m.in_batches(CASCADE, refine=False),
        m.in_batches(f"{m.OURS}, global", rotation="global", refine=False),
        m.one_by_one(f"{m.OURS}, sdp", suits=m.few_right, rotation="sdp", refine=False),
        m.one_by_one(ONE_BY_ONE),
    )


def _scale() -> Study:
    return Study(
        "scale", "Fig. 4a", "scale of all pairs, N = 40",
        sweep=OUTLIERS, values=TENTHS, quick_values=(0.0, 0.5, 0.8, 0.9),
        draw=partial(draws.matched, n=40, scale=(1.0, 5.0)),
        methods=(m.scale_by_vote("tls"), m.scale_by_vote("consensus")),
        measures=(SCALE, SECONDS), columns=("scale_error", "seconds"),
        right=below(scale_error=0.3), scale=None,
    )  # fmt: skip


def _clique() -> Study:
    return Study(
        "clique", "Fig. 4b", "wrong matches before and after the maximum clique, N = 1000",
        sweep=OUTLIERS, values=(*TENTHS, 0.95, 0.98, 0.99), quick_values=(0.0, 0.5, 0.9, 0.99),
        draw=partial(draws.matched, n=1000),
        methods=(
            m.before_pruning(), m.clique_alone("maximum clique", "exact"), m.clique_alone("greedy", "greedy"),
        ),
        measures=(
            Measure("outliers_left", "wrong matches left [share]", log=False),
            Measure("inliers_kept", "right matches kept [share]", log=False),
        ),
        columns=("outliers_left", "inliers_kept", "proved", "seconds", "together"),
        right=below(outliers_left=0.1),
    )  # fmt: skip


def _rotation() -> Study:
    return Study(
        "rotation", "Fig. 4c", "rotation alone, K = 40, wrong vectors too of the right length",
        sweep=OUTLIERS, values=TENTHS, quick_values=(0.0, 0.5, 0.8, 0.9),
        draw=partial(draws.turned, n=40),
        methods=(
            m.rotation_alone("GNC", "gnc"), m.rotation_alone("global search", "global"),
            m.rotation_alone("semidefinite relaxation", "sdp"),
        ),
        measures=(ROTATION, SECONDS), columns=("rotation_deg", "cost", "seconds"),
        right=below(rotation_deg=5.0),
    )  # fmt: skip


def _translation() -> Study:
    return Study(
        "translation", "Fig. 4d", "translation alone, N = 40",
        sweep=OUTLIERS, values=TENTHS, quick_values=(0.0, 0.5, 0.8, 0.9),
        draw=partial(draws.moved, n=40),
        methods=(m.translation_by_vote("tls"), m.translation_by_vote("consensus")),
        measures=(TRANSLATION, SECONDS), columns=("translation", "seconds"),
        right=below(translation=0.1),
    )  # fmt: skip


def _certificate() -> Study:
    return Study(
        "certificate", "Fig. 5", "GNC's rotation and its certificate, K = 100",
        sweep=OUTLIERS, values=TENTHS, quick_values=(0.0, 0.5, 0.8, 0.9),
        draw=partial(draws.turned, n=100),
        methods=(
            m.rotation_certified("GNC, certified", "splitting"),
            m.rotation_certified("GNC, certified by Algorithm 3 as printed", "reference"),
        ),
        measures=(
            ROTATION, Measure("suboptimality", "proved suboptimality [-]"),
            Measure("iterations", "iterations", log=False), SECONDS,
        ),
        columns=("rotation_deg", "cost", "proved", "suboptimality", "iterations", "seconds"),
        right=below(rotation_deg=1.0), runs=100,
    )  # fmt: skip


def _known_scale(others: list[Method]) -> Study:
    return Study(
        "known-scale", "Fig. 6a", "known scale, N = 100",
        sweep=OUTLIERS, values=TENTHS, quick_values=(0.0, 0.5, 0.9),
        draw=partial(draws.matched, n=100),
        methods=(*_solvers(), *_without(others, "RANSAC-10k")),
        measures=POSE, columns=POSE_COLUMNS, right=below(rotation_deg=5.0),
    )  # fmt: skip


def _extreme(others: list[Method]) -> Study:
    return Study(
        "extreme", "Fig. 6b", "known scale, N = 1000",
        sweep=OUTLIERS, values=(0.95, 0.96, 0.97, 0.98, 0.99), quick_values=(0.95, 0.99),
        draw=partial(draws.matched, n=1000),
        methods=(*_solvers(), *_without(others, "RANSAC-1k", "ICP")),
        measures=POSE, columns=POSE_COLUMNS, right=below(rotation_deg=5.0),
    )  # fmt: skip


def _unknown_scale(scaled: list[Method]) -> Study:
    return Study(
        "unknown-scale", "Fig. 6c", "unknown scale, N = 100",
        sweep=OUTLIERS, values=TENTHS, quick_values=(0.0, 0.5, 0.8, 0.9),
        draw=partial(draws.matched, n=100, scale=(1.0, 5.0)),
        methods=(
            m.limit(), m.in_batches(), m.in_batches(CASCADE, refine=False),
            m.in_batches(f"{m.OURS}, consensus maximisation", vote="consensus"),
            m.one_by_one(ONE_BY_ONE), *_without(scaled, "RANSAC-10k"),
        ),
        measures=(SCALE, *POSE), columns=("scale_error", *POSE_COLUMNS),
        right=below(rotation_deg=5.0, scale_error=0.1), scale=None,
    )  # fmt: skip


def _all_to_all(others: list[Method]) -> Study:
    return Study(
        "all-to-all", "Fig. 7", "no correspondences, 100 points against a part of them, bound 0.01",
        sweep=OVERLAP, values=tuple(k / 10 for k in range(10, 0, -1)), quick_values=(1.0, 0.4, 0.1),
        draw=draws.all_to_all,
        methods=(m.limit(), m.in_batches(), m.stage_by_stage(), *_without(others, "RANSAC")),
        measures=POSE, columns=(*POSE_COLUMNS, *STAGES), right=below(rotation_deg=5.0),
    )  # fmt: skip


def _high_noise(others: list[Method]) -> Study:
    return replace(
        _known_scale(others),
        name="high-noise", figure="supplement", title="known scale, N = 100, sigma 0.1",
        draw=partial(draws.matched, n=100, sigma=0.1), right=below(rotation_deg=30.0),
    )  # fmt: skip


def _scaling(others: list[Method]) -> Study:
    return Study(
        "scaling", "supplement", "known scale, 95 % wrong",
        sweep=MATCHES, values=(100, 200, 500, 1000, 2000, 5000, 10_000), quick_values=(100, 500, 2000),
        draw=draws.growing,
        methods=(
            m.limit(), m.in_batches(), m.one_by_one(ONE_BY_ONE), m.stage_by_stage(),
            *_without(others, "RANSAC", "ICP"),
        ),
        measures=POSE, columns=(*POSE_COLUMNS, *STAGES), right=below(rotation_deg=5.0),
    )  # fmt: skip
