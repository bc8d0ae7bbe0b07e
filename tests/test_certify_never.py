"""Never: `is_optimal` where the cost exceeds the best known one by more than the tolerance."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from oracles import BOUND, draw_vectors, rotation_cost, tampered, turned

import teaser_jax as tj
from teaser_jax import certify_rotation, verify
from teaser_jax.certify.certificate import CertificateStatus

TOLERANCE = 1e-3
RUNS = 80  # problems in a chunk
RATES = (0.0, 0.2, 0.5, 0.8, 0.9, 1.0)
DEGREES = (0, 0.1, 1, 3, 10, 45, 90, 180)
# What is done to a rotation before it is handed in: nothing, float32, and three that leave SO(3).
SPOIL = (
    lambda r: r,
    lambda r: r.astype(np.float32).astype(np.float64),
    lambda r: -r,
    lambda r: 3 * r,
    lambda r: r + 0.05 * np.outer([1, -1, 0], [0, 1, 1]),
)


@jax.jit
@jax.vmap
def best_of_each(src, dst, bound, mask):
    return tj.solve_rotation(src, dst, noise_bound=bound, mask=mask, proof=None)


def best_of(src: np.ndarray, dst: np.ndarray, bound: float) -> tj.RotationSolution:
    """The best rotation that a search knows for each problem, of up to 12 measurements by one program."""
    count, k = src.shape[:2]
    rows = max(12, k)
    filled = np.arange(-(-count // RUNS) * RUNS) % count
    src, dst = (np.pad(x[filled], ((0, 0), (0, rows - k), (0, 0))) for x in (src, dst))
    mask = np.broadcast_to(np.arange(rows) < k, src.shape[:2])
    with jax.enable_x64(True):
        chunks = [
            jax.device_get(best_of_each(src[i], dst[i], np.full(RUNS, bound), mask[i]))
            for i in np.split(np.arange(len(filled)), len(filled) // RUNS)
        ]
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *chunks)


def projected(rotation):
    left, _, right = np.linalg.svd(rotation)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right


def candidates(k: int, rate: float, count: int, bound: float):
    """Problems, a candidate for each, and the best cost that anybody knows."""
    drawn = [draw_vectors([k, round(100 * rate), seed], k, rate, sigma=bound / 5.54) for seed in range(count)]
    src, dst = (np.stack([d[i] for d in drawn]) for i in range(2))
    found = best_of(src, dst, bound)
    given, known = [], []
    for i, (a, b, truth) in enumerate(drawn):
        moved = turned(found.rotation[i], DEGREES[i % len(DEGREES)], i)
        given.append(SPOIL[(i // len(DEGREES)) % len(SPOIL)](moved))
        known.append(min(found.cost[i], *(rotation_cost(a, b, r, bound) for r in (moved, truth))))
    return src, dst, np.stack(given), np.array(known)


def false_claims(k: int, rate: float, count: int, bound: float = BOUND, **how) -> tuple[int, int]:
    """How many claims are false or not confirmed by the verifier; how many were made."""
    src, dst, given, known = candidates(k, rate, count, bound)
    found = certify_rotation(src, dst, given, noise_bound=bound, tolerance=TOLERANCE, **how)
    wrong, made = 0, 0
    for i in range(count):
        one = jax.tree.map(lambda x, i=i: x[i], found)
        cost = rotation_cost(src[i], dst[i], projected(given[i]), bound)
        least = min(known[i], rotation_cost(src[i], dst[i], one.rotation, bound))
        excess = cost - least > TOLERANCE * cost + 1e-6 + 1e-9
        wrong += bool((one.is_optimal and excess) or one.lower_bound > least + 1e-9)
        if one.is_optimal:
            made += 1
            wrong += not verify(src[i], dst[i], given[i], one, noise_bound=bound)
            beyond = tampered(one, lower_bound=np.float64(least * (1 + 1e-6) + 1e-9))
            wrong += verify(src[i], dst[i], given[i], beyond, noise_bound=bound) and least > 1e-3
        else:
            wrong += one.status == CertificateStatus.OPTIMAL
    return wrong, made


@pytest.mark.long
def test_no_false_claim_among_hundreds():
    total = 0
    for k, rate in ((8, 0.0), (8, 0.1), (8, 0.8), (8, 1.0)):
        wrong, made = false_claims(k, rate, 80, method="direct")
        assert wrong == 0
        total += made
    assert total > 10


@pytest.mark.long
def test_no_false_claim_after_iterations():
    wrong, made = false_claims(8, 0.5, 40, iterations=30)
    assert wrong == 0
    assert made > 5


@pytest.mark.long
def test_bounds_that_only_float32_would_support():
    # The gap asked for is below what float64 resolves: nothing is claimed that the verifier cannot confirm.
    for bound in (1e-6, 1e-8):
        assert false_claims(12, 0.2, 40, bound=bound, method="direct")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("k", [3, 8, 16, 24])
@pytest.mark.parametrize("rate", RATES)
def test_no_false_claim_among_ten_thousand(k, rate):
    assert false_claims(k, rate, 400, method="direct")[0] == 0
    assert false_claims(k, rate, 40, iterations=60)[0] == 0
