"""A descriptor network trained without pose labels: the solver labels, its status says which to trust.

Partial noisy scans of procedural solids; tests on families of solids never trained on, and on real models
where there are data. The same network is trained on labels of five kinds, and a classical descriptor takes
part with the same matching and the same solver.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import models
from benchmarks.baseline import Metric, said
from teaser_jax import Settings, learn, register, synthetic
from teaser_jax import metrics as pose_metrics

SEEDS = 3
STEPS = 620
NOISE_BOUND = 0.05
TURN = (20.0, 50.0)  # between the two views [deg]
LARGEST_ANGLE, LARGEST_DISTANCE = 5.0, 0.05  # of an answer that is right [deg], [1]
RIGHT_MATCH = 1.5 * NOISE_BOUND
TRAIN_KINDS: tuple[synthetic.Kind, ...] = ("box", "ball", "rod")
FAMILIES: dict[str, tuple[synthetic.Kind, ...]] = {"rings": ("ring",), "cones": ("cone",)}
RANDOM, SELF, TRUE = "random weights", "self-supervised", "true poses"
UNTRUSTED, SHUFFLED, FPFH = "without the trust mask", "shuffled labels", "FPFH"
RADII = ((0.1, 0.2), (0.15, 0.3), (0.2, 0.4), (0.15, 0.5))  # of FPFH: normals, features


def scans(seed: int, shapes: list[np.ndarray], count: int) -> list[synthetic.ScanPair]:
    """Pairs of scans, one shape after the other."""
    return [synthetic.scan_pair((seed, k), shapes[k % len(shapes)], turn=TURN) for k in range(count)]


def training_scans(count: int) -> list[synthetic.ScanPair]:
    """What networks are trained on."""
    return scans(10, models.family(0, TRAIN_KINDS, max(4, count // 5)), count)


def test_scans(count: int) -> dict[str, list[synthetic.ScanPair]]:
    """Pairs by the kind of shape, none of which is trained on: four times as many of unseen families.

    A family has many shapes, and some are harder than others: with ten of them the figure is theirs.
    """
    many = 4 * count
    shapes = {
        name: models.family(k + 1, kinds, many // 4) for k, (name, kinds) in enumerate(FAMILIES.items())
    }
    shapes["teapot"] = [models.unit(synthetic.teapot(models.DENSE))]
    shapes |= models.real_models()
    return {
        name: scans(20 + k, known, many if name in FAMILIES else count)
        for k, (name, known) in enumerate(shapes.items())
    }


def untrusted_labels(parameters: Any, pairs: learn.Pairs, noise_bound: float) -> learn.Labels:
    """Labels by the solver, every one believed."""
    labels = learn.solver_labels(parameters, pairs, noise_bound)
    return replace(labels, trusted=jnp.ones_like(labels.trusted))


def shuffled_labels(parameters: Any, pairs: learn.Pairs, noise_bound: float) -> learn.Labels:
    """The pose of another pair of the batch: nothing can be learnt from it."""
    labels = learn.solver_labels(parameters, pairs, noise_bound)
    return replace(labels, pose=jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), labels.pose))


TEACHERS = {
    SELF: learn.solver_labels,
    TRUE: learn.truth_labels,
    UNTRUSTED: untrusted_labels,
    SHUFFLED: shuffled_labels,
}


@jax.jit
def evaluate(parameters: Any, pairs: learn.Pairs) -> tuple[Any, ...]:
    """Of each pair: angle [deg] and distance from the truth, whether trusted, share of right matches."""

    def one(pair: learn.Pairs) -> tuple[Any, ...]:
        batch = jax.tree.map(lambda x: x[None], pair)
        src, dst, mask = learn.match_scans(parameters, batch)
        labels = learn.teacher(src, dst, noise_bound=NOISE_BOUND, mask=mask)
        away = jnp.linalg.norm(batch.truth.apply(src) - dst, axis=-1)
        right = jnp.mean(away < RIGHT_MATCH)
        found = pose_metrics.errors(labels.pose, batch.truth)
        return jnp.degrees(found.rotation)[0], found.translation[0], labels.trusted[0], right

    return jax.lax.map(one, pairs)


def scores(angle: Any, distance: Any, trusted: Any, right: Any) -> dict:
    """Recall, how far to trust, and the share of right matches."""
    good = (np.asarray(angle) < LARGEST_ANGLE) & (np.asarray(distance) < LARGEST_DISTANCE)
    trusted = np.asarray(trusted)
    return {
        "recall": float(good.mean()),
        "trusted": float(trusted.mean()),
        "right_of_trusted": float(good[trusted].mean()) if trusted.any() else None,
        "inlier_ratio": float(np.mean(right)),
    }


def trained(pairs: learn.Pairs, seed: int, labels: learn.Teach, steps: int) -> tuple[Any, dict]:
    """A network trained on some labels, and what happened on the way."""
    network = learn.init_network(jax.random.key(seed))
    start = time.perf_counter()
    network, history = jax.block_until_ready(
        learn.train(
            network, pairs, jax.random.key(100 + seed), optimizer=_optimizer(steps), steps=steps,
            noise_bound=NOISE_BOUND, labels=labels,
        )
    )  # fmt: skip
    few = max(1, steps // 12)
    trusted, right = np.asarray(history.trusted), np.degrees(np.asarray(history.angle)) < 10
    story = {
        "seconds": time.perf_counter() - start,
        "loss": [float(history.loss[:few].mean()), float(history.loss[-few:].mean())],
        "trusted_share": [float(trusted[:few].mean()), float(trusted[-few:].mean())],
        "labels_right": float(right[trusted].mean()) if trusted.any() else None,
    }
    return network, story


_made: dict[int, optax.GradientTransformation] = {}


def _optimizer(steps: int) -> optax.GradientTransformation:
    """The same object for the same steps: it is static, so that another would compile again."""
    return _made.setdefault(steps, optax.adam(optax.cosine_decay_schedule(4e-3, steps)))


def classical(train: list, tests: dict[str, list]) -> Iterator[dict]:
    """FPFH of Open3D, its radii and its kind of matching chosen on training pairs."""
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError):
        return
    choices = [(radii, mutual) for radii in RADII for mutual in (False, True)]
    few = train[:40]
    best = max(choices, key=lambda choice: scores(*_classical(few, *choice))["recall"])
    for name, pairs in tests.items():
        yield {"arm": FPFH, "seed": 0, "set": name, **scores(*_classical(pairs, *best)), "choice": best}


def _classical(pairs: list, radii: tuple[float, float], mutual: bool) -> tuple[np.ndarray, ...]:
    import open3d as o3d

    def describe(points: np.ndarray, viewpoint: np.ndarray) -> np.ndarray:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=radii[0], max_nn=30))
        cloud.orient_normals_towards_camera_location(viewpoint)
        near = o3d.geometry.KDTreeSearchParamHybrid(radius=radii[1], max_nn=200)
        return np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, near).data).T

    found = []
    for pair in pairs:
        a, b = describe(pair.src, pair.src_viewpoint), describe(pair.dst, pair.dst_viewpoint)
        away = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2 * a @ b.T
        to = away.argmin(axis=1)
        mask = away.argmin(axis=0)[to] == np.arange(len(to)) if mutual else np.ones(len(to), bool)
        src, dst = pair.src[mask], pair.dst[to[mask]]
        result = register(src, dst, noise_bound=NOISE_BOUND, settings=Settings(clique="greedy"))
        error = pose_metrics.errors(result.pose, pair.truth)
        right = np.linalg.norm(pair.truth.apply(src) - dst, axis=1) < RIGHT_MATCH
        found.append((np.degrees(error.rotation), error.translation, result.ok, right.mean()))
    return tuple(np.array(x) for x in zip(*found, strict=True))


def run(quick: bool) -> list[dict]:
    """A row for each arm, seed and test set, and one for each training."""
    seeds, steps, count = (1, 60, 6) if quick else (SEEDS, STEPS, 30)
    train, tests = training_scans(30 if quick else 450), test_scans(count)
    rows = list(classical(train, tests))
    pairs = learn.read_pairs(train)
    read = {name: learn.read_pairs(each) for name, each in tests.items()}

    def judged(arm: str, seed: int, network: Any) -> list[dict]:
        return [
            {"arm": arm, "seed": seed, "set": name, **scores(*evaluate(network, each))}
            for name, each in read.items()
        ]

    for seed in range(seeds):
        rows += judged(RANDOM, seed, learn.init_network(jax.random.key(seed)))
        for arm, labels in TEACHERS.items():
            network, story = trained(pairs, seed, labels, steps)
            rows += [{"arm": arm, "seed": seed, "training": story}, *judged(arm, seed, network)]
    return rows


ARMS = (RANDOM, SELF, TRUE, UNTRUSTED, SHUFFLED, FPFH)
UNSEEN = tuple(FAMILIES)
HARD = ("teapot",)  # all but round: smooth over most of what one scan sees


def mean_of(rows: list[dict], arm: str, key: str, sets: tuple[str, ...] | None = None) -> float | None:
    """Over seeds and sets; None where there are none."""
    values = [r[key] for r in rows if r["arm"] == arm and "set" in r and (sets is None or r["set"] in sets)]
    values = [v for v in values if v is not None]
    return float(np.mean(values)) if values else None


def metrics(rows: list[dict]) -> list[Metric]:
    """Recall of each arm."""
    found = []
    for arm in ARMS:
        recall = mean_of(rows, arm, "recall")
        if recall is not None and arm != SHUFFLED:
            found.append(Metric(f"{arm}: recall", recall, "share", "higher", 0.08))
    return found


def report(rows: list[dict]) -> str:
    """A line an arm; then a line a set."""
    names = list(dict.fromkeys(r["set"] for r in rows if "set" in r))
    real = tuple(name for name in names if name not in (*UNSEEN, *HARD))
    text = [
        f"Registration recall at {LARGEST_ANGLE:.0f} deg / {LARGEST_DISTANCE}: pairs of partial scans of 640",
        f"points, views {TURN[0]:.0f} to {TURN[1]:.0f} degrees apart, noise 0.005 of the longest side.",
        f"Mean over {len({r['seed'] for r in rows if r['arm'] == RANDOM})} seeds,",
        "smallest and largest in brackets. Trained on solids of boxes, balls and rods, without pose labels",
        "except where it says so; every shape tested is of another kind. Matches: each point with its most",
        "similar one. A match is right within 1.5 bounds.",
        "",
        "| labels | unseen families | real models | teapot | right matches | trusted | right of trusted "
        "| labels right | trusted, first to last | training |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    show = lambda x: "" if x is None else f"{100 * x:.0f} %"
    for arm in ARMS:
        if mean_of(rows, arm, "recall") is None:
            text.append(f"| {arm} | not installed | | | | | | | | |")
            continue
        stories = [r["training"] for r in rows if r["arm"] == arm and "training" in r]
        labels = [s["labels_right"] for s in stories if s["labels_right"] is not None]
        shares = np.mean([s["trusted_share"] for s in stories], axis=0) if stories else None
        cells = [
            _spread(rows, arm, UNSEEN),
            _spread(rows, arm, real),
            _spread(rows, arm, HARD),
            *(show(mean_of(rows, arm, key)) for key in ("inlier_ratio", "trusted", "right_of_trusted")),
            show(float(np.mean(labels))) if labels else "",
            "" if shares is None else f"{show(shares[0])} to {show(shares[1])}",
            f"{np.mean([s['seconds'] for s in stories]):.0f} s" if stories else "",
        ]
        text.append(f"| {arm} | {' | '.join(cells)} |")
    text += ["", f"| recall | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for arm in ARMS:
        each = [show(mean_of(rows, arm, "recall", (name,))) for name in names]
        text.append(f"| {arm} | {' | '.join(each)} |")
    before, after, true = (mean_of(rows, arm, "recall", UNSEEN) for arm in (RANDOM, SELF, TRUE))
    other = mean_of(rows, FPFH, "recall", UNSEEN)
    if before is None or after is None or true is None:
        return "\n".join(text)
    reached = after > 0.9 and before < 0.6
    text += [
        "",
        "On unseen families:",
        f"- above 90 % from below 60 %: {show(after)} from {show(before)}: {said(reached)}",
        f"- at least 90 % of what true poses give: {show(after / true)}: {said(after >= 0.9 * true)}",
    ]
    if other is not None:
        text.append(f"- ten points above FPFH: {100 * (after - other):+.0f}: {said(after >= other + 0.1)}")
    return "\n".join(text)


def _spread(rows: list[dict], arm: str, sets: tuple[str, ...]) -> str:
    """The mean over seeds with the smallest and the largest."""
    if not sets:
        return "no data"
    seeds = sorted({r["seed"] for r in rows if r["arm"] == arm})
    each = [mean_of([r for r in rows if r["seed"] == s], arm, "recall", sets) for s in seeds]
    values = 100 * np.array([v for v in each if v is not None])
    one = f"{values.mean():.0f} %"
    return one if len(values) == 1 else f"{one} ({values.min():.0f} - {values.max():.0f})"
