"""Success and accuracy by the paper's protocol, beside least squares on the true inliers.

No method can beat that fit but by luck: it is told which matches are right. Peers take part where
they can be imported; a peer never sees other problems than ours.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import teaser_jax as tj
from benchmarks.baseline import Metric
from benchmarks.peers import PEERS, Peer, peers_for
from benchmarks.problems import Case, protocol, real_pairs
from teaser_jax.stages.refinement import fit_similarity

Solver = Callable[[Case], tj.Pose]

# rate -> cells of (N, share wrong, unknown scale, trials)
CELLS = [
    *((100, r / 100, False, 40) for r in (0, 50, 70, 80, 90)),
    *((1000, r / 100, False, 40) for r in (95, 96, 97, 98, 99)),
    *((5000, r / 100, False, 20) for r in (95, 99)),
    *((100, r / 100, True, 40) for r in (0, 50, 70, 80, 90)),
    *((1000, r / 100, True, 20) for r in (50, 80)),
]


def least_squares(case: Case) -> tj.Pose:
    """The fit to the true inliers: the limit."""
    import jax

    with jax.enable_x64(True):
        weights = case.inliers.astype(float)
        return jax.device_get(fit_similarity(case.src, case.dst, weights, case.scale).pose)


def ours(**settings: object) -> Solver:
    """``register`` with some settings."""
    chosen = tj.Settings(**settings)
    return lambda case: (
        tj.register(case.src, case.dst, noise_bound=case.noise_bound, scale=case.scale, settings=chosen).pose
    )


def answers(peer: Peer) -> Solver:
    """What another library answers."""
    return lambda case: peer.ask(case).answer()


def run(quick: bool) -> list[dict]:
    """A row a cell and method."""
    methods: dict[str, Solver] = {
        "least squares on the true inliers": least_squares,
        "teaser_jax": ours(),
        "teaser_jax, refine=False": ours(refine=False),
        "teaser_jax, refine=False, tim_graph='complete'": ours(refine=False, tim_graph="complete"),
        **{name: answers(peer) for name, peer in PEERS.items()},
    }
    rows = []
    for n, rate, unknown, trials in CELLS:
        cases = list(protocol(n, rate, 5 if quick else trials, unknown=unknown))
        for name, solver in methods.items():
            if ("complete" in name and n > 1000) or (name in PEERS and name not in peers_for(cases[0])):
                continue
            rows.append(_row(name, cases, [solver(case) for case in cases]))
    real = list(real_pairs())
    for name in ("teaser_jax", *PEERS):
        asked = [case for case in real if name not in PEERS or name in peers_for(case)]
        rows += [_row(name, [case], [methods[name](case)]) for case in asked]
    return rows


def _row(name: str, cases: list[Case], poses: list[tj.Pose]) -> dict:
    rotation = [np.degrees(tj.metrics.rotation_error(p, c.truth)) for p, c in zip(poses, cases, strict=True)]
    translation = [tj.metrics.translation_error(p, c.truth) for p, c in zip(poses, cases, strict=True)]
    return {
        "cell": cases[0].cell,
        "method": name,
        "trials": len(cases),
        "right": sum(c.is_right(p) for p, c in zip(poses, cases, strict=True)),
        "rotation_deg": float(np.median(rotation)),
        "translation": float(np.median(translation)),
    }


def metrics(rows: list[dict]) -> list[Metric]:
    """Success, and errors as ratios to the limit of the same cell."""
    limit = {r["cell"]: r for r in rows if r["method"].startswith("least squares")}
    found = []
    for r in (r for r in rows if r["method"].startswith("teaser_jax")):
        name = f"{r['cell']}, {r['method']}"
        found.append(Metric(f"{name}: right", r["right"] / r["trials"], "share", "higher", 0.0))
        if r["cell"] in limit and r["right"]:
            for key in ("rotation_deg", "translation"):
                ratio = r[key] / limit[r["cell"]][key]
                found.append(Metric(f"{name}: {key} / limit", ratio, "ratio", "lower", 0.02))
    return found


def report(rows: list[dict]) -> str:
    """Medians, and their ratio to the limit of the same cell."""
    limit = {r["cell"]: r for r in rows if r["method"].startswith("least squares")}
    lines = [
        "Success and median errors; in brackets the ratio to least squares on the true inliers.",
        "",
        "| cell | method | right | rotation [deg] | translation |",
        "|---|---|---|---|---|",
    ]
    for r in rows:
        best = limit.get(r["cell"])
        ratio = [f" ({r[k] / best[k]:.2f})" if best else "" for k in ("rotation_deg", "translation")]
        lines.append(
            f"| {r['cell']} | {r['method']} | {r['right']} of {r['trials']} "
            f"| {r['rotation_deg']:.3f}{ratio[0]} | {r['translation']:.4f}{ratio[1]} |"
        )
    return "\n".join(lines)
