"""The first answer of a fresh process, with and without anything kept on disk.

Nothing heavy is imported up here: a first call counts from before that.
"""

from __future__ import annotations

import tempfile
import time

from benchmarks.processes import forget_peak, in_child, peak_megabytes

# N, share wrong, unknown scale
FIRST = ((100, 0.5, False), (1000, 0.95, False), (5000, 0.95, False), (1000, 0.8, True))
WANTED = {"none": 3.0, "filled": 1.0}  # seconds, import included
WANTED_KERNELS = 0.6


def first(n: int, rate: float, unknown: bool) -> dict:
    """Seconds to import, to trace, compile and run, and what that takes in memory."""
    start = time.perf_counter()
    import jax

    import teaser_jax as tj

    imported = time.perf_counter()
    from benchmarks.problems import protocol

    case = next(protocol(n, rate, 1, unknown=unknown))
    jax.block_until_ready(jax.numpy.zeros(1) + 1)
    forget_peak()
    idle, ready = peak_megabytes(), time.perf_counter()
    result = tj.register(case.src, case.dst, noise_bound=case.noise_bound, scale=case.scale)
    return {
        "import": imported - start,
        "first": time.perf_counter() - ready,
        "megabytes": peak_megabytes() - idle,
        "right": case.is_right(result.pose),
    }


def kernels() -> dict:
    """Seconds until the host's clique search stands ready, after teaser_jax was imported."""
    from teaser_jax.stages.clique.exact import load_kernels

    start = time.perf_counter()
    load_kernels()
    return {"seconds": time.perf_counter() - start}


def run(quick: bool) -> list[dict]:
    """A row a size and cache; medians of three processes."""
    rows = []
    for n, rate, unknown in FIRST[1:2] if quick else FIRST:
        name = f"{'unknown' if unknown else 'known'} scale, N = {n}, {round(100 * rate)} % wrong"
        with tempfile.TemporaryDirectory() as folder:
            kept = {
                "JAX_COMPILATION_CACHE_DIR": folder,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            }
            in_child(first, variables=kept, n=n, rate=rate, unknown=unknown)
            for cache, variables in (("none", {}), ("filled", kept)):
                runs = [
                    in_child(first, variables=variables, n=n, rate=rate, unknown=unknown)
                    for _ in range(1 if quick else 3)
                ]
                middle = sorted(runs, key=lambda r: r["first"])[len(runs) // 2]
                rows.append({"part": "first", "cell": name, "cache": cache, **middle})
    with tempfile.TemporaryDirectory() as folder:
        for cache in ("none", "filled"):
            ready = in_child(kernels, variables={"NUMBA_CACHE_DIR": folder})
            rows.append({"part": "kernels", "cache": cache, **ready})
    return rows


def metrics(rows: list[dict]):
    """Seconds and megabytes of this machine."""
    from benchmarks.baseline import Metric

    found = []
    for r in (r for r in rows if r["part"] == "first"):
        name = f"{r['cell']}, cache: {r['cache']}"
        found.append(Metric(f"{name}: first call", r["first"], "s", "lower", 0.3, portable=False))
        found.append(Metric(f"{name}: memory", r["megabytes"], "MB", "lower", 0.3, portable=False))
    for r in (r for r in rows if r["part"] == "kernels"):
        name = f"clique search ready, cache: {r['cache']}"
        found.append(Metric(name, r["seconds"], "s", "lower", 0.3, portable=False))
    return found


def report(rows: list[dict]) -> str:
    """A table, and the clique search."""
    from benchmarks.baseline import said

    text = [
        "The first answer of a fresh process, and the peak of its memory above an idle one. Cache: the",
        "programs that JAX keeps on disk where `jax_compilation_cache_dir` names a folder. Wanted: import",
        f"and first call within {WANTED['none']:.0f} s, with a filled cache within {WANTED['filled']:.0f} s.",
        "",
        "| cell | cache | import [s] | first call [s] | together [s] | memory [MB] | wanted |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in (r for r in rows if r["part"] == "first"):
        total = r["import"] + r["first"]
        reached = r["right"] and total < WANTED[r["cache"]]
        text.append(
            f"| {r['cell']} | {r['cache']} | {r['import']:.2f} | {r['first']:.2f} | {total:.2f} "
            f"| {r['megabytes']:.0f} | {said(reached)} |"
        )
    none, kept = (r["seconds"] for r in rows if r["part"] == "kernels")
    text += [
        "",
        f"The clique search for hard graphs stands ready after {none:.1f} s on a machine that never ran it,",
        f"and after {kept:.2f} s from then on (wanted: {WANTED_KERNELS} s: {said(kept < WANTED_KERNELS)}).",
    ]
    return "\n".join(text)
