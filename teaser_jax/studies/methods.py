"""Who takes part in the studies: each takes problems of one size and answers with rows of numbers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.sharding import Mesh

from teaser_jax import metrics
from teaser_jax.certify.options import CertifyMethod
from teaser_jax.certify.rotation import certify_rotation
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.pose import Pose
from teaser_jax.profile import profile
from teaser_jax.register import register
from teaser_jax.settings import Settings
from teaser_jax.solution import Solution, Status
from teaser_jax.solve_batch import solve_batch
from teaser_jax.solve_rotation import RotationSolution, solve_rotation
from teaser_jax.stages.refinement import fit_similarity
from teaser_jax.stages.scale import estimate_scale
from teaser_jax.stages.translation import estimate_translation
from teaser_jax.stages.vote.sweep import Criterion
from teaser_jax.studies.peers import Peer
from teaser_jax.studies.trials import Trial

Row: TypeAlias = dict[str, Any]
OURS = "teaser_jax"
LIMIT = "least squares on the true inliers"
BATCH, BATCH_MATCHES = 128, 100_000  # problems, and at most so many matches, fill a device that is timed
SDP_MOST = 21  # right matches whose chain the semidefinite relaxation takes in some seconds
VOTES: dict[Criterion, str] = {"tls": "TLS", "consensus": "consensus maximisation"}
STAGES = {
    "scale": "stage_scale", "consistency graph": "stage_graph", "clique, device": "stage_clique",
    "clique, host": "stage_clique", "rotation": "stage_rotation", "translation": "stage_translation",
}  # fmt: skip


@dataclass(frozen=True)
class Method:
    """A ``Method`` is one curve of a figure: somebody who is asked about the trials.

    Attributes:
        name: What table and legend call it.
        run: Answers trials of one size on a device mesh, a row of measures each.
        together: Whether it takes all trials of a cell at once, and every process must call it; otherwise
            they come one by one, so that each is saved as soon as it is there.
        suits: Whether it can be asked; cells whose first trial does not suit are left out.
        slow: Whether it takes seconds a problem and more: then it is not part of a quick study.
        others: Whether it is not ours: what it raises is noted in the row and does not end the study.
    """

    name: str
    run: Callable[[list[Trial], Mesh | None], list[Row]]
    together: bool = False
    suits: Callable[[Trial], bool] = lambda trial: True
    slow: bool = False
    others: bool = False


def in_batches(name: str = OURS, **chosen: Any) -> Method:
    """Make a method that solves all trials of a cell by ``solve_batch``; the time is a share of the batch's.

    A few problems would not fill the compiled program, and the batch would look slow: they are repeated until
    they do (``timed_together``), and the column ``together`` says how many shared the time.

    Args:
        name: What table and legend call it.
        chosen: Fields of ``Settings``.
    """
    settings = Settings(**chosen)
    return Method(name, partial(_in_batches, settings=settings), together=True)


def one_by_one(name: str, *, suits: Callable[[Trial], bool] | None = None, **chosen: Any) -> Method:
    """Make a method that solves each trial by ``register``, warm.

    Args:
        name: What table and legend call it.
        suits: Whether it can be asked; None: always.
        chosen: Fields of ``Settings``.
    """
    settings = Settings(**chosen)

    def solve(trial: Trial) -> Solution:
        p = trial.problem
        return register(
            p.src, p.dst, noise_bound=p.noise_bound, scale=trial.scale, settings=settings
        ).solution

    slow = settings.rotation.needs_host
    run = _each(solve, _judged, compiles=not slow)
    return Method(name, run, suits=suits or (lambda trial: True), slow=slow)


def few_right(trial: Trial) -> bool:
    """Tell whether the semidefinite relaxation can take the clique of a trial."""
    return bool(trial.problem.inliers.sum() <= SDP_MOST)


def stage_by_stage() -> Method:
    """Make a method that solves by ``profile``: the answer of ``register`` and the seconds of every stage."""

    def answer(trial: Trial) -> Row:
        p = trial.problem
        found = profile(p.src, p.dst, repeats=1, noise_bound=p.noise_bound, scale=trial.scale)
        row = _judged(trial, found.result.solution) | {"seconds": sum(found.warm.values())}
        for stage, seconds in found.warm.items():
            column = STAGES.get(stage, "stage_rest")
            row[column] = row.get(column, 0.0) + seconds
        return row

    return Method(f"{OURS}, stage by stage", lambda trials, mesh: [answer(trial) for trial in trials])


def limit() -> Method:
    """Make the method that knows the truth: the fit to the true inliers, which can be beaten by luck only."""

    def answer(trial: Trial) -> Row:
        p = trial.problem
        with as_on_the_host():
            fit = _fit(p.src, p.dst, p.inliers.astype(float), trial.scale)
        return errors(trial, jax.device_get(fit.pose))

    return Method(LIMIT, lambda trials, mesh: [answer(trial) for trial in trials])


def of_peer(name: str, peer: Peer) -> Method:
    """Make a method of another library, asked only what it can answer.

    The seconds are those of its own call, warm.
    """
    slow, once = name.endswith("RANSAC-60s"), _Once()

    def answer(trial: Trial) -> Row:
        p = trial.problem
        question = peer.ask(p.src, p.dst, p.noise_bound, trial.scale)
        if not slow:
            once(len(p.src), question.solve)
        found, seconds = _timed(question.solve)
        return errors(trial, question.pose(found)) | {"seconds": seconds}

    suits = lambda trial: peer.finds_scale or trial.scale is not None
    run = lambda trials, mesh: [answer(trial) for trial in trials]
    return Method(name, run, suits=suits, slow=slow, others=True)


def scale_by_vote(criterion: Criterion) -> Method:
    """Make a method that finds the scale alone, by the vote of all pairs of matches (sections VI-A, VII)."""

    def solve(trial: Trial) -> float:
        p = trial.for_solver()
        with as_on_the_host():
            return float(_scale(p.src, p.dst, p.noise_bound, p.mask, cbar2=1.0, criterion=criterion)[0])

    judge = lambda trial, scale: {"scale_error": abs(scale - float(trial.problem.truth.scale))}
    return Method(VOTES[criterion], _each(solve, judge))


def translation_by_vote(criterion: Criterion) -> Method:
    """Make a method that finds the translation alone, axis by axis, of what is not turned (VI-C, VII)."""

    def solve(trial: Trial) -> np.ndarray:
        p = trial.for_solver()
        with as_on_the_host():
            found, _ = _translation(p.dst - p.src, p.noise_bound, p.mask, cbar2=1.0, criterion=criterion)
            return np.asarray(found)

    def judge(trial: Trial, found: np.ndarray) -> Row:
        return {"translation": float(np.linalg.norm(found - trial.problem.truth.translation))}

    return Method(VOTES[criterion], _each(solve, judge))


def clique_alone(name: str, clique: str) -> Method:
    """Make a method that says what the clique leaves of the wrong matches (section VI-D).

    The time is that of the whole solve.
    """
    run = partial(_in_batches, settings=Settings(clique=clique), measure=_pruned)
    return Method(name, run, together=True)


def before_pruning() -> Method:
    """Make a method that says with what share of wrong matches the clique starts."""
    run = lambda trials, mesh: [{"outliers_left": 1 - float(t.problem.inliers.mean())} for t in trials]
    return Method("before pruning", run)


def rotation_alone(name: str, method: str) -> Method:
    """Make a method that finds the rotation between vectors alone, without a proof (sections VIII, X)."""

    def solve(trial: Trial) -> RotationSolution:
        p = trial.problem
        return solve_rotation(p.src, p.dst, noise_bound=p.noise_bound, method=method, proof=None)

    judge = lambda trial, found: errors(trial, _turn(found.rotation)) | {"cost": float(found.cost)}
    slow = method == "sdp"
    return Method(name, _each(solve, judge, compiles=not slow), slow=slow)


def rotation_certified(name: str, proof: CertifyMethod) -> Method:
    """Make a method that certifies GNC's rotation (section VIII-C), within 0.1 % and 200 iterations, or not.

    The time is that of the certificate.
    """
    once = _Once()

    def answer(trial: Trial) -> Row:
        p = trial.problem
        found = solve_rotation(p.src, p.dst, noise_bound=p.noise_bound, method="gnc", proof=None)
        certify = partial(
            certify_rotation, p.src, p.dst, found.rotation,
            noise_bound=p.noise_bound, iterations=200, method=proof,
        )  # fmt: skip
        once(len(p.src), certify)
        certificate, seconds = _timed(certify)
        return {
            **errors(trial, _turn(found.rotation)),
            "proved": int(certificate.is_optimal),
            "suboptimality": float(certificate.suboptimality),
            "iterations": int(certificate.iterations),
            "cost": float(found.cost),
            "seconds": seconds,
        }

    run = lambda trials, mesh: [answer(trial) for trial in trials]
    return Method(name, run, slow=proof == "reference")


def errors(trial: Trial, pose: Pose) -> Row:
    """Measure a pose against the truth of its trial; a known scale has no error."""
    error = metrics.errors(pose, trial.problem.truth)
    row = {"rotation_deg": float(error.rotation_deg), "translation": float(error.translation)}
    return row if trial.scale is not None else row | {"scale_error": float(error.scale)}


def _in_batches(
    trials: list[Trial],
    mesh: Mesh | None,
    *,
    settings: Settings,
    measure: Callable[[Trial, Solution], Row] | None = None,
) -> list[Row]:
    problems = [trial.for_solver() for trial in trials]
    devices = jax.device_count() if mesh is None else mesh.size
    count = timed_together(len(trials), len(problems[0].src), devices)
    solve = partial(solve_batch, [*islice(cycle(problems), count)], settings, mesh=mesh)
    solve()  # compiles, for every size of clique that comes
    found, seconds = _timed(solve)
    timing = {"seconds": seconds / count, "together": count}
    return [(measure or _judged)(t, s) | timing for t, s in zip(trials, found, strict=False)]


def timed_together(trials: int, matches: int, devices: int) -> int:
    """Count the problems of a timed batch: all trials, and so many more that every device is busy."""
    return max(trials, devices * min(BATCH, BATCH_MATCHES // matches))


def _judged(trial: Trial, found: Solution) -> Row:
    return errors(trial, found.pose) | {"ok": int(found.status == Status.OK)}


def _pruned(trial: Trial, found: Solution) -> Row:
    precision, recall = metrics.precision_recall(found.selection.clique, trial.problem.inliers)
    return {
        "outliers_left": 1 - precision,
        "inliers_kept": recall,
        "proved": int(found.clique_is_maximum),
    }


def _turn(rotation: Any) -> Pose:
    return Pose(np.asarray(rotation), np.zeros(3), np.asarray(1.0))


def _each(
    solve: Callable[[Trial], Any],
    judge: Callable[[Trial, Any], Row],
    *,
    compiles: bool = True,
) -> Callable[[list[Trial], Mesh | None], list[Row]]:
    """Make a ``run`` that asks about trials one by one: warm seconds of ``solve``, what ``judge`` says."""
    once = _Once()

    def run(trials: list[Trial], mesh: Mesh | None) -> list[Row]:
        rows = []
        for trial in trials:
            if compiles:
                once(len(trial.problem.src), partial(solve, trial))
            found, seconds = _timed(partial(solve, trial))
            rows.append(judge(trial, found) | {"seconds": seconds})
        return rows

    return run


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Time a call, and return its result and its seconds."""
    start = time.perf_counter()
    found = call()
    return found, time.perf_counter() - start


class _Once:
    """Runs something the first time a size comes, so that no compilation is timed, no start of threads."""

    def __init__(self) -> None:
        self.seen: set[int] = set()

    def __call__(self, size: int, run: Callable[[], Any]) -> None:
        if size not in self.seen:
            run()
            self.seen.add(size)


_scale = jax.jit(estimate_scale, static_argnames="criterion")
_translation = jax.jit(estimate_translation, static_argnames="criterion")
_fit = jax.jit(fit_similarity)
