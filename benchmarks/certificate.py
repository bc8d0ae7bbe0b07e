"""Certificates: time and iterations beside the published method, stacks, memory, and what stays unproved."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from benchmarks.problems import DATA, protocol
from benchmarks.processes import forget_peak, in_child, peak_megabytes
from teaser_jax.studies import read_model

SIGMA, BOUND = 0.01, 0.0554
RATES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# measurements, share of wrong ones, milliseconds wanted, iterations wanted
REACH = [
    (40, 0.0, 2, 0), (40, 0.6, 25, 200), (100, 0.0, 10, 0), (100, 0.2, 60, 6), (100, 0.4, 140, 6),
    (100, 0.6, 220, 6), (200, 0.0, 50, 0), (200, 0.6, 3000, 200),
]  # fmt: skip
LARGE = [(400, 300.0), (800, 1500.0)]
CASCADE = [(100, 0.5), (1000, 0.9), (1000, 0.95), (1000, 0.98)]
RELAXED = [(10, 0.2), (20, 0.4), (20, 0.8), (30, 0.5), (50, 0.5)]
HARD = [(40, 0.8, 30), (40, 0.9, 30), (100, 0.8, 20), (100, 0.9, 20)]


def vectors(seed: tuple[int, ...], k: int, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rotation problem of Fig. 5: points of the Bunny in a unit cube, wrong ones of the right length.

    Without the Bunny, points drawn from the cube.
    """
    rng = np.random.default_rng([*seed, k, round(100 * rate)])
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    path = DATA / "models" / "bunny.ply"
    points = _points(path) if path.exists() else rng.uniform(size=(4000, 3))
    src = points[rng.permutation(len(points))[:k]] - points.mean(axis=0)
    noise = SIGMA * rng.normal(size=(k, 3))
    noise *= np.minimum(1, 0.99 * BOUND / np.linalg.norm(noise, axis=1, keepdims=True))
    dst = src @ rotation.T + noise
    bad = rng.permutation(k)[: round(rate * k)]
    odd = rng.normal(size=(len(bad), 3))
    dst[bad] = odd * (np.linalg.norm(src[bad], axis=1) / np.linalg.norm(odd, axis=1))[:, None]
    return src, dst, rotation


def _points(path: Path) -> np.ndarray:
    """Vertices of the Bunny, scaled into the unit cube."""
    points = read_model(path).shape.vertices
    points = points - points.min(axis=0)
    return points / points.max()


def cost(src: np.ndarray, dst: np.ndarray, rotation: np.ndarray) -> float:
    return float(np.minimum(np.sum(((dst - src @ rotation.T) / BOUND) ** 2, axis=1), 1).sum())


def timed(work: Callable[[], object], repeats: int) -> float:
    """Median milliseconds, after a first call that compiles."""
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds))


def reach(quick: bool) -> list[dict]:
    """GNC's rotation certified, and the published method on the same in the same run."""
    rows = []
    for k, rate, wanted, most in REACH:
        runs = 2 if quick else (10 if k <= 100 else 3)
        ours, published, its, theirs, proved = [], [], [], [], 0
        for seed in range(runs):
            src, dst, _ = vectors((1, seed), k, rate)
            start = tj.solve_rotation(src, dst, noise_bound=BOUND, method="gnc", proof=None).rotation
            certify = lambda a=src, b=dst, r=start, **how: tj.certify_rotation(
                a, b, r, noise_bound=BOUND, **how
            )
            ours.append(timed(certify, 5))
            found = certify()
            proved += bool(found.is_optimal)
            its.append(int(found.iterations))
            if k <= 100 and seed < 3:
                published.append(timed(lambda c=certify: c(method="reference"), 1))
                theirs.append(int(certify(method="reference").iterations))
        rows.append({
            "part": "reach", "k": k, "rate": rate, "milliseconds": float(np.median(ours)),
            "iterations": float(np.mean(its)), "proved": proved, "runs": runs, "wanted": wanted, "most": most,
            "published": float(np.median(published)) if published else None,
            "published_iterations": float(np.mean(theirs)) if theirs else None,
        })  # fmt: skip
    return rows


def large(k: int) -> dict:
    """In a process of its own: the inliers of a solved problem, time and peak memory above that before."""
    src, dst, rotation = vectors((2,), k, 0.0)
    rotation = tj.solve_rotation(src, dst, noise_bound=BOUND, method="gnc", proof=None).rotation
    small = slice(0, 20)
    tj.certify_rotation(src[small], dst[small], rotation, noise_bound=BOUND, method="direct")
    before = peak_megabytes()
    forget_peak()
    milliseconds = timed(lambda: tj.certify_rotation(src, dst, rotation, noise_bound=BOUND), 3)
    found = tj.certify_rotation(src, dst, rotation, noise_bound=BOUND)
    megabytes = peak_megabytes() - min(before, peak_megabytes())
    return {
        "k": k, "milliseconds": milliseconds, "megabytes": megabytes, "optimal": bool(found.is_optimal),
        "iterations": int(found.iterations),
    }  # fmt: skip


def cascade(quick: bool) -> list[dict]:
    """What a certificate adds to a call of ``register``."""
    rows = []
    for n, rate in CASCADE:
        runs = 3 if quick else 20
        added, plain, its, proved, sizes = [], [], [], 0, []
        for case in protocol(n, rate, runs):
            result = tj.register(case.src, case.dst, noise_bound=case.noise_bound)
            plain.append(timed(lambda c=case: tj.register(c.src, c.dst, noise_bound=c.noise_bound), 5))
            added.append(timed(lambda r=result: tj.certify(r.problem, r.solution), 5))
            its.append(int(result.certificate.iterations))
            proved += bool(result.certificate.is_optimal)
            sizes.append(int(result.certificate.measurements))
        rows.append({
            "part": "cascade", "cell": f"N = {n}, {rate:.0%} wrong", "runs": runs, "proved": proved,
            "register": float(np.median(plain)), "added": float(np.median(added)),
            "iterations": int(np.max(its)), "sizes": f"{min(sizes)} - {max(sizes)}",
        })  # fmt: skip
    return rows


def stack(quick: bool) -> dict:
    """64 problems of 20 measurements, 0 to 50 % wrong: all at once against one by one."""
    count = 64
    drawn = [vectors((3, i), 20, (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)[i % 6]) for i in range(count)]
    src, dst = (np.stack([d[i] for d in drawn]) for i in range(2))
    solved = [tj.solve_rotation(a, b, noise_bound=BOUND, proof=None).rotation for a, b, _ in drawn]
    rotations = np.stack(solved)

    def one_by_one(method: str) -> None:
        for a, b, r in zip(src, dst, rotations, strict=True):
            tj.certify_rotation(a, b, r, noise_bound=BOUND, method=method)

    def together(method: str) -> None:
        tj.certify_rotation(src, dst, rotations, noise_bound=BOUND, method=method)

    with jax.enable_x64(True):
        vmapped = jax.jit(
            jax.vmap(lambda a, b, r: tj.certify_rotation(a, b, r, noise_bound=BOUND, method="direct").status)
        )
        direct = timed(lambda: jax.block_until_ready(vmapped(src, dst, rotations)), 5 if quick else 15)
    found = tj.certify_rotation(src, dst, rotations, noise_bound=BOUND)
    repeats = 3 if quick else 11
    return {
        "part": "stack", "count": count, "direct_vmapped": direct,
        "direct_alone": timed(lambda: one_by_one("direct"), repeats),
        "direct_stack": timed(lambda: together("direct"), repeats),
        "alone": timed(lambda: one_by_one("splitting"), repeats),
        "together": timed(lambda: together("splitting"), repeats),
        "proved": int(found.is_optimal.sum()), "iterated": int((found.iterations > 0).sum()),
    }  # fmt: skip


def figure_5(quick: bool) -> list[dict]:
    """K = 100 at every rate: right and wrong answers of GNC and of the global search, certified or not."""
    rows = []
    for rate in RATES:
        runs = 3 if quick else 100
        row = {
            "part": "figure 5", "rate": rate, "runs": runs, "gnc_right": 0, "gnc_right_proved": 0,
            "gnc_wrong_proved": 0, "proved": 0, "iterations": [], "milliseconds": [], "left": [],
        }  # fmt: skip
        for seed in range(runs):
            src, dst, truth = vectors((4, seed), 100, rate)
            best = tj.solve_rotation(src, dst, noise_bound=BOUND, proof=None)
            gnc = tj.solve_rotation(src, dst, noise_bound=BOUND, method="gnc", proof=None)
            start = time.perf_counter()
            found = tj.certify_rotation(src, dst, best.rotation, noise_bound=BOUND)
            row["milliseconds"].append(1e3 * (time.perf_counter() - start))
            row["iterations"].append(int(found.iterations))
            row["proved"] += bool(found.is_optimal)
            least = min(best.cost, cost(src, dst, truth))
            right = gnc.cost <= least * (1 + 1e-3)
            row["gnc_right"] += bool(right)
            if right:  # the same rotation, or as good a one
                row["gnc_right_proved"] += bool(found.is_optimal)
            else:
                claimed = tj.certify_rotation(src, dst, gnc.rotation, noise_bound=BOUND, iterations=40)
                row["gnc_wrong_proved"] += bool(claimed.is_optimal)
            if not found.is_optimal:
                row["left"].append([seed, float(found.suboptimality)])
        row["iterations"] = float(np.mean(row["iterations"]))
        row["milliseconds"] = float(np.median(row["milliseconds"]))
        rows.append(row)
    return rows


def hard(quick: bool) -> list[dict]:
    """The global search where most measurements are wrong: is it the optimum, and is that proved?"""
    rows = []
    for k, rate, runs in HARD:
        runs = 3 if quick else runs
        found_best, proved, gnc_lost, milliseconds, theirs = 0, 0, 0, [], []
        for seed in range(runs):
            src, dst, truth = vectors((5, seed), k, rate)
            start = time.perf_counter()
            best = tj.solve_rotation(src, dst, noise_bound=BOUND, proof=None)
            milliseconds.append(1e3 * (time.perf_counter() - start))
            gnc = tj.solve_rotation(src, dst, noise_bound=BOUND, method="gnc", proof=None)
            found = tj.certify_rotation(src, dst, best.rotation, noise_bound=BOUND)
            found_best += best.cost <= min(cost(src, dst, truth), gnc.cost) + 1e-9
            gnc_lost += gnc.cost > best.cost + 1e-6
            proved += bool(found.is_optimal)
            theirs.append(int(found.iterations))
        rows.append({
            "part": "hard", "k": k, "rate": rate, "runs": runs, "best": int(found_best), "proved": proved,
            "gnc_lost": int(gnc_lost), "milliseconds": float(np.median(milliseconds)),
            "iterations": float(np.mean(theirs)),
        })  # fmt: skip
    return rows


def relaxation(quick: bool) -> list[dict]:
    """The semidefinite relaxation by a conic solver."""
    rows = []
    for k, rate in RELAXED[:2] if quick else RELAXED:
        src, dst, _ = vectors((6,), k, rate)
        fast = tj.solve_rotation(src, dst, noise_bound=BOUND)
        tj.solve_rotation(src[:6], dst[:6], noise_bound=BOUND, method="sdp")
        start = time.perf_counter()
        found = tj.solve_rotation(src, dst, noise_bound=BOUND, method="sdp")
        seconds = time.perf_counter() - start
        rows.append({
            "part": "relaxation", "k": k, "rate": rate, "seconds": seconds, "rank": found.relaxation.rank,
            "tight": found.relaxation.is_tight, "optimal": bool(found.certificate.is_optimal),
            "iterations": found.relaxation.iterations, "same": bool(abs(found.cost / fast.cost - 1) <= 1e-6),
            "proved_fast": bool(fast.certificate.is_optimal),
        })  # fmt: skip
    return rows


def run(quick: bool) -> list[dict]:
    """Rows of all parts."""
    sizes = LARGE[:1] if quick else LARGE
    return [
        *reach(quick),
        *({"part": "large", "wanted": most, **in_child(large, k=k)} for k, most in sizes),
        *cascade(quick),
        stack(quick),
        *hard(quick),
        *relaxation(quick),
        *figure_5(quick),
    ]


def of(rows: list[dict], part: str) -> list[dict]:
    return [r for r in rows if r["part"] == part]


def metrics(rows: list[dict]) -> list[Metric]:
    """Times of this machine; shares and ratios of any."""
    found = []
    for r in of(rows, "reach"):
        name = f"K = {r['k']}, {round(100 * r['rate'])} % wrong"
        found.append(Metric(f"{name}: time", r["milliseconds"], "ms", "lower", 0.5, portable=False))
        found.append(Metric(f"{name}: iterations", r["iterations"], "rounds", "lower", 0.3))
        found.append(Metric(f"{name}: proved", r["proved"] / r["runs"], "share", "higher", 0.05))
    for r in of(rows, "large"):
        found.append(Metric(f"K = {r['k']}: time", r["milliseconds"], "ms", "lower", 0.5, portable=False))
        found.append(Metric(f"K = {r['k']}: memory", r["megabytes"], "MB", "lower", 0.3))
    for r in of(rows, "cascade"):
        found.append(Metric(f"{r['cell']}: added", r["added"], "ms", "lower", 0.5, portable=False))
    for r in of(rows, "stack"):
        found.append(Metric("stack: times as fast", r["alone"] / r["together"], "ratio", "higher", 0.3))
    for r in of(rows, "hard"):
        name = f"global search, K = {r['k']}, {round(100 * r['rate'])} % wrong"
        found.append(Metric(f"{name}: proved", r["proved"] / r["runs"], "share", "higher", 0.1))
        found.append(Metric(f"{name}: best", r["best"] / r["runs"], "share", "higher", 0.0))
    for r in of(rows, "figure 5"):
        name = f"Fig. 5, {round(100 * r['rate'])} % wrong"
        found.append(Metric(f"{name}: proved", r["proved"] / r["runs"], "share", "higher", 0.03))
        found.append(Metric(f"{name}: false claims", r["gnc_wrong_proved"], "answers", "lower", 0.0))
    return found


def report(rows: list[dict]) -> str:
    """A table for each part."""
    text = [
        "GNC's rotation certified to 0.1 %, warm, median; *published*: Algorithm 3 as printed, same run.",
        "",
        "| measurements | wrong | time [ms] | iterations | published [ms] | iterations | proved | wanted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in of(rows, "reach"):
        good = r["milliseconds"] <= r["wanted"] and r["iterations"] <= r["most"]
        theirs = "-" if r["published"] is None else f"{r['published']:.0f}"
        rounds = "-" if r["published"] is None else f"{r['published_iterations']:.1f}"
        text.append(
            f"| {r['k']} | {r['rate']:.0%} | {r['milliseconds']:.1f} | {r['iterations']:.1f} | {theirs} "
            f"| {rounds} | {r['proved']} of {r['runs']} | {r['wanted']} ms: {said(good)} |"
        )
    text += [
        "",
        "Inliers of a solved problem, many of them.",
        "",
        "| measurements | time [ms] | memory [MB] | iterations | proved | wanted |",
        "|---|---|---|---|---|---|",
    ]
    for r in of(rows, "large"):
        good = r["milliseconds"] <= r["wanted"] and r["megabytes"] <= 2048
        text.append(
            f"| {r['k']} | {r['milliseconds']:.0f} | {r['megabytes']:.0f} | {r['iterations']} "
            f"| {said(r['optimal'])} | {r['wanted']:.0f} ms, 2 GB: {said(good)} |"
        )
    text += [
        "",
        "On top of `register`, on answers of the cascade; at most 10 ms and no iteration are wanted.",
        "",
        "| problem | measurements | register [ms] | certificate [ms] | most iterations | proved | wanted |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in of(rows, "cascade"):
        text.append(
            f"| {r['cell']} | {r['sizes']} | {r['register']:.1f} | {r['added']:.1f} | {r['iterations']} "
            f"| {r['proved']} of {r['runs']} | {said(r['added'] <= 10 and r['iterations'] == 0)} |"
        )
    for r in of(rows, "stack"):
        text += [
            "",
            f"A stack of {r['count']} problems of 20 measurements, 0 - 50 % wrong; {r['iterated']} of "
            f"them need iterations, {r['proved']} are proved. Four times as fast as one by one is wanted.",
            "",
            "| what | one by one [ms] | stack [ms] | times as fast |",
            "|---|---|---|---|",
            f"| the closed form, under vmap | {r['direct_alone']:.1f} | {r['direct_vmapped']:.1f} "
            f"| {r['direct_alone'] / r['direct_vmapped']:.1f} |",
            f"| the closed form, outside jit | {r['direct_alone']:.1f} | {r['direct_stack']:.1f} "
            f"| {r['direct_alone'] / r['direct_stack']:.1f} |",
            f"| with iterations for those it leaves | {r['alone']:.1f} | {r['together']:.1f} "
            f"| {r['alone'] / r['together']:.1f} |",
        ]
    text += [
        "",
        "The global search, wrong measurements of the right length.",
        "",
        "| measurements | wrong | no better one known | GNC worse | search [ms] | proved | iterations |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in of(rows, "hard"):
        text.append(
            f"| {r['k']} | {r['rate']:.0%} | {r['best']} of {r['runs']} | {r['gnc_lost']} "
            f"| {r['milliseconds']:.1f} | {r['proved']} of {r['runs']} | {r['iterations']:.0f} |"
        )
    text += [
        "",
        "The semidefinite relaxation (SCS).",
        "",
        "| measurements | wrong | time [s] | iterations | rank | tight | certified by its dual "
        "| same as the search |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in of(rows, "relaxation"):
        text.append(
            f"| {r['k']} | {r['rate']:.0%} | {r['seconds']:.1f} | {r['iterations']} | {r['rank']} "
            f"| {said(r['tight'])} | {said(r['optimal'])} | {said(r['same'])} |"
        )
    text += [
        "",
        "Fig. 5 of the paper: 100 measurements. A wrong answer of GNC is one that costs 0.1 % more than "
        "the best known. *Left* are those not proved within 200 iterations, with the bound reached.",
        "",
        "| wrong | runs | proved | iterations | time [ms] | GNC right | of these proved | GNC wrong, yet "
        "proved | left |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in of(rows, "figure 5"):
        left = ", ".join(f"{seed}: {gap:.2%}" for seed, gap in r["left"]) or "-"
        text.append(
            f"| {r['rate']:.0%} | {r['runs']} | {r['proved']} | {r['iterations']:.1f} "
            f"| {r['milliseconds']:.0f} | {r['gnc_right']} | {r['gnc_right_proved']} "
            f"| {r['gnc_wrong_proved']} | {left} |"
        )
    return "\n".join(text)
