"""Derivatives: time beside the solve itself, batches in a training step, memory, and what breaks them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from teaser_jax.stages.refinement import fit_similarity, squared_residuals
from teaser_jax.stages.rotation.gnc import gnc_weights

BATCH, SIZE, WRONG = 256, 64, 0.5
WANTED = 20_000  # problems a second
LARGE = 1000
CHECKS = 1000
UNROLLED = 50  # iterations, when they are differentiated one by one
GREEDY = tj.Settings(clique="greedy")


def seconds(*works: Callable[[], Any], rounds: int) -> list[float]:
    """Median times of several computations that take turns."""
    for work in works:
        jax.block_until_ready(work())
    taken: list[list[float]] = [[] for _ in works]
    for _ in range(rounds):
        for k, work in enumerate(works):
            start = time.perf_counter()
            jax.block_until_ready(work())
            taken[k].append(time.perf_counter() - start)
    return [float(np.median(x)) for x in taken]


def problem_of(seed: int, n: int, wrong: float) -> tuple[tj.Problem, tj.Pose]:
    drawn = tj.synthetic.random_problem((n, seed), n=n, outlier_rate=wrong)
    return tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound), drawn.truth


def backward(rounds: int) -> dict:
    """The backward pass of ``refit`` against the solve that it belongs to, 1000 matches."""
    problem, _ = problem_of(0, LARGE, 0.9)
    solve = jax.jit(lambda p: tj.solve(p, GREEDY))
    solution = solve(problem)

    def loss(src: Any, dst: Any) -> Any:
        pose = tj.refit(replace(problem, src=src, dst=dst), solution.selection)
        return jnp.sum(pose.matrix**2)

    slope = jax.jit(jax.grad(loss, (0, 1)))
    plain = jax.jit(loss)
    forward, both, fit = seconds(
        lambda: solve(problem),
        lambda: slope(problem.src, problem.dst),
        lambda: plain(problem.src, problem.dst),
        rounds=rounds,
    )
    return {"part": "backward", "solve": forward, "refit": fit, "refit_and_gradient": both}


def batches(rounds: int, count: int) -> dict:
    """Value and gradient of a registration loss, and how the greedy clique compares with the exact one."""
    drawn = [problem_of(k, SIZE, WRONG) for k in range(count)]
    stacked = tj.stack_problems([problem for problem, _ in drawn])
    truth = jax.tree.map(lambda *x: jnp.asarray(np.stack(x), jnp.float32), *[pose for _, pose in drawn])

    def poses(src: Any, problems: tj.Problem, settings: tj.Settings) -> tj.Solution:
        return jax.vmap(lambda p: tj.solve(p, settings))(replace(problems, src=src))

    def loss(src: Any, problems: tj.Problem, truth: tj.Pose) -> Any:
        return jnp.mean(tj.learn.point_loss(poses(src, problems, GREEDY).pose, truth, problems.src))

    first = jax.tree.map(lambda x: x[:BATCH], (stacked, truth))
    step = jax.jit(jax.value_and_grad(loss))
    src = first[0].src
    program = step.lower(src, *first)
    (taken,) = seconds(lambda: step(src, *first), rounds=rounds)
    shares = {}
    for name, settings in (("greedy", GREEDY), ("exact", tj.Settings())):
        found = jax.jit(poses, static_argnums=())(stacked.src, stacked, settings)
        error = tj.metrics.errors(found.pose, truth)
        right = (np.degrees(np.asarray(error.rotation)) < 5) & (np.asarray(error.translation) < 0.1)
        shares[name] = float(right.mean())
    return {
        "part": "batches",
        "problems_per_second": min(BATCH, count) / taken,
        "milliseconds": 1e3 * taken,
        "recall": shares,
        "problems": count,
        "host_callback": "callback" in program.as_text(),
    }


def soft(rounds: int) -> dict:
    """Implicit differentiation against that of every iteration: time and temporary memory, 1000 matches."""
    problem, _ = problem_of(1, LARGE, 0.5)
    rng = np.random.default_rng(0)
    problem = replace(problem, dst=problem.dst + 0.03 * rng.normal(size=(LARGE, 3)).astype(np.float32))
    start = jax.jit(lambda p: tj.soft_solve(p, GREEDY))(problem).solution.pose

    def implicit(dst: Any) -> Any:
        # The solve in front of the iteration is the same for both, and left out of neither.
        return jnp.sum(tj.soft_solve(replace(problem, dst=dst), GREEDY).pose.matrix ** 2)

    def unrolled(dst: Any) -> Any:
        begin = tj.solve(lax.stop_gradient(replace(problem, dst=dst)), GREEDY).pose

        def step(pose: tj.Pose, _: None) -> tuple[tj.Pose, None]:
            r2 = squared_residuals(pose, problem.src, dst, problem.noise_bound)
            w = problem.confidence / problem.noise_bound**2 * gnc_weights(r2, 1.0, problem.cbar2)
            return fit_similarity(problem.src, dst, w, problem.scale).pose, None

        return jnp.sum(lax.scan(step, begin, None, length=UNROLLED)[0].matrix ** 2)

    programs = [jax.jit(jax.grad(f)).lower(problem.dst).compile() for f in (implicit, unrolled)]
    memory = [p.memory_analysis().temp_size_in_bytes / 1e6 for p in programs]
    taken = seconds(*(lambda p=p: p(problem.dst) for p in programs), rounds=rounds)
    slopes = [np.asarray(p(problem.dst)) for p in programs]
    del start
    return {
        "part": "soft",
        "megabytes": memory,
        "milliseconds": [1e3 * t for t in taken],
        "difference": float(np.max(np.abs(slopes[0] - slopes[1])) / np.max(np.abs(slopes[1]))),
    }


KINDS = (
    "random",
    "all wrong",
    "line",
    "plane",
    "cube",
    "mirrored",
    "one point",
    "two points",
    "empty",
    "NaN",
)


def awkward(kind: str, rng: np.random.Generator, n: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Matches of some kind, most of them with an answer that is not unique, or none."""
    src = rng.uniform(-1, 1, (n, 3))
    if kind == "line":
        src = src[:, :1] * [[1.0, 2.0, 3.0]]
    if kind == "plane":
        src[:, 2] = 0
    if kind == "cube":
        src = np.resize(np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T, (n, 3))
    if kind == "one point":
        src[:] = src[0]
    if kind == "two points":
        src[::2], src[1::2] = src[0], src[1]
    rotation = tj.synthetic.draw_rotation(rng)
    dst = src @ rotation.T + rng.uniform(-1, 1, 3)
    if kind == "mirrored":
        dst = dst * [-1, 1, 1]
    if kind == "random":
        dst += 0.02 * rng.normal(size=(n, 3))
        dst[: n // 2] = rng.uniform(-3, 3, (n // 2, 3))
    if kind == "all wrong":
        dst = rng.uniform(-3, 3, (n, 3))
    if kind == "NaN":
        src[::3], dst[1::3] = np.nan, np.inf
    return src, dst


def checks(count: int) -> list[dict]:
    """Gradients in every input of ``solve`` and ``soft_solve``: how many are no numbers, kind by kind."""
    rng, rows = np.random.default_rng(0), []
    each = count // len(KINDS)
    drawn = [(kind, *awkward(kind, rng)) for kind in KINDS for _ in range(each)]
    for name, method in (("solve", tj.solve), ("soft_solve", tj.soft_solve)):
        for scale in (1.0, None):
            problems = [
                replace(
                    tj.make_problem(np.zeros((32, 3)), np.zeros((32, 3)), noise_bound=0.1, scale=scale),
                    src=jnp.asarray(src, jnp.float32),
                    dst=jnp.asarray(dst, jnp.float32),
                    mask=jnp.full(32, kind != "empty"),
                )
                for kind, src, dst in drawn
            ]
            stacked = tj.stack_problems(problems)

            def total(inputs: dict, problem: tj.Problem, method: Callable = method) -> Any:
                found = method(replace(problem, **inputs), GREEDY)
                return jnp.sum(jnp.sin(found.pose.matrix)), found.ok

            names = ["src", "dst", "noise_bound", "confidence"] + ["scale"] * (scale is not None)
            inputs = {name: getattr(stacked, name) for name in names}
            slope = jax.jit(jax.vmap(jax.value_and_grad(total, has_aux=True)))
            (_, ok), found = jax.device_get(slope(inputs, stacked))
            finite = np.all([np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in found.values()], axis=0)
            moves = np.abs(np.nan_to_num(found["dst"])).reshape(len(drawn), -1).max(axis=1) > 0
            for k, kind in enumerate(KINDS):
                mine = slice(k * each, (k + 1) * each)
                rows.append(
                    {
                        "part": "checks",
                        "method": name,
                        "scale": "known" if scale else "unknown",
                        "kind": kind,
                        "problems": each,
                        "not_finite": int(np.sum(~finite[mine])),
                        "ok": int(ok[mine].sum()),
                        "with_gradient": int(moves[mine].sum()),
                    }
                )
    return rows


def run(quick: bool) -> list[dict]:
    """All parts."""
    rounds = 5 if quick else 40
    return [
        backward(rounds),
        batches(rounds, BATCH if quick else 2048),
        soft(rounds),
        *checks(100 if quick else CHECKS),
    ]


def of(rows: list[dict], part: str) -> list[dict]:
    return [row for row in rows if row["part"] == part]


def metrics(rows: list[dict]) -> list[Metric]:
    """Ratios, throughput, and gradients that are no numbers."""
    (back,), (batch,), (soft_,) = (of(rows, part) for part in ("backward", "batches", "soft"))
    return [
        Metric("gradient of refit / solve", _share(back), "ratio", "lower", 0.5),
        Metric(
            "value_and_grad, batch of 256", batch["problems_per_second"], "problems/s", "higher", 0.3, False
        ),
        Metric(
            "greedy / exact recall",
            batch["recall"]["greedy"] / batch["recall"]["exact"],
            "ratio",
            "higher",
            0.005,
        ),
        Metric(
            "memory, unrolled / implicit",
            soft_["megabytes"][1] / soft_["megabytes"][0],
            "ratio",
            "higher",
            0.3,
        ),
        Metric(
            "gradients not finite", sum(r["not_finite"] for r in of(rows, "checks")), "count", "lower", 0.0
        ),
    ]


def _share(row: dict) -> float:
    return (row["refit_and_gradient"] - row["refit"]) / row["solve"]


def report(rows: list[dict]) -> str:
    """What is wanted, and what was measured."""
    (back,), (batch,), (soft_,) = (of(rows, part) for part in ("backward", "batches", "soft"))
    checked = of(rows, "checks")
    bad = sum(r["not_finite"] for r in checked)
    ratio = batch["recall"]["greedy"] / batch["recall"]["exact"]
    megabytes, milliseconds = soft_["megabytes"], soft_["milliseconds"]
    text = [
        "| case | wanted | measured | reached |",
        "|---|---|---|---|",
        f"| backward pass of `refit`, N = 1000 | at most the solve, {1e3 * back['solve']:.2f} ms "
        f"| {1e3 * (back['refit_and_gradient'] - back['refit']):.3f} ms | {said(_share(back) <= 1)} |",
        f"| `value_and_grad` of a registration loss, {BATCH} problems of {SIZE} matches, 50 % wrong "
        f"| {WANTED} problems/s | {batch['problems_per_second']:.0f} ({batch['milliseconds']:.1f} ms) "
        f"| {said(batch['problems_per_second'] >= WANTED)} |",
        f"| recall of the greedy clique over that of the exact one, {batch['problems']} problems | 99 % "
        f"| {100 * ratio:.2f} % | {said(ratio >= 0.99)} |",
        f"| host callback in that program | none | {'some' if batch['host_callback'] else 'none'} "
        f"| {said(not batch['host_callback'])} |",
        f"| gradients of {sum(r['problems'] for r in checked)} solves, {len(KINDS)} kinds | all finite "
        f"| {bad} not | {said(bad == 0)} |",
        "",
        f"`soft_solve`, N = 1000, gradient of the pose, with the solve in front: {megabytes[0]:.2f} MB and "
        f"{milliseconds[0]:.1f} ms;",
        f"the same by differentiating each of {UNROLLED} iterations: {megabytes[1]:.2f} MB and "
        f"{milliseconds[1]:.1f} ms (float32; the gradients",
        f"differ by {soft_['difference']:.1e} of the largest).",
        "",
        "Of so many problems of a kind (solve, known scale): answers that are ok, gradients other than 0.",
        "",
        "| kind | problems | ok | gradient |",
        "|---|---|---|---|",
    ]
    text += [
        f"| {r['kind']} | {r['problems']} | {r['ok']} | {r['with_gradient']} |"
        for r in checked
        if (r["method"], r["scale"]) == ("solve", "known")
    ]
    return "\n".join(text)
