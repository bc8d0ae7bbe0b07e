"""The rotation by its semidefinite relaxation (23): TEASER itself, on the host, up to some 50 measurements.

The rank-one matrix x x^T of the quaternion and its clones is relaxed to any positive semidefinite Z with
equal diagonal blocks and symmetric blocks off the diagonal. A conic solver finds the best Z. If it has rank
one, its factor is the global optimum (Theorem 13); if not, its cost still bounds that of every rotation, and
its leading vectors are candidates. The solver works on the dual problem, whose variables are few:

    max nu   such that   Q - nu J + Delta >= 0,   Delta of the family in ``certify/dual.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from teaser_jax import so3
from teaser_jax.ground.extras import needed
from teaser_jax.ground.numbers import as_record, named
from teaser_jax.stages.rotation.gnc import Gnc
from teaser_jax.stages.rotation.pair_search import polish, search_pairs
from teaser_jax.stages.rotation.quadratic_form import COLUMNS, ROWS, Measurements, cost_matrix

# Eigenvalues of Z below this share of the largest are what the solver leaves of zero.
RANK_TOLERANCE = 1e-3
MAX_RELAXED = 100  # some 20 000 constraints and minutes; each more costs the sixth power


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Relaxation:
    """Find the rotation by GNC and all pairs of TIMs, then by the relaxation (23): the oracle, in seconds.

    It runs on the host, takes up to 100 TIMs, and needs the extra ``sdp``.

    Attributes:
        gnc: How GNC finds the first candidate.
    """

    name: str = named("sdp")
    gnc: Gnc = Gnc()
    needs_host: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "gnc", as_record("Relaxation.gnc", self.gnc, {Gnc.name: Gnc}))

    def turn(self, m: Measurements) -> Float[Array, "3 3"]:
        """Find the turn to the best rotation that pairs and relaxation lead to; ValueError inside jit."""
        turn = search_pairs(m)
        near = m.turned(turn)
        if not isinstance(near.src, jax.core.Tracer):  # what does not exist would be variables of the solver
            near = near._replace(src=near.src[m.mask], dst=near.dst[m.mask], mask=m.mask[m.mask])
        return turn @ jnp.asarray(solve_relaxation(near).turn, m.src.dtype)


@dataclass(frozen=True)
class RelaxationReport:
    """What the conic solver returned for (23), and what follows from it by Theorem 13.

    Attributes:
        value: Cost of the relaxation, tr(Q Z) [-]. Where it converged no rotation costs less, up to its
            accuracy.
        rank: Eigenvalues of Z above a thousandth of the largest.
        second_eigenvalue: The second largest eigenvalue of Z over the largest: zero where rank is one.
        gap: (cost of the rounded rotation - value) / cost [-].
        is_tight: Whether rank is one and the gap below a thousandth: then Theorem 13 calls the rotation the
            unique global optimum, as far as the solver's numbers go. The certificate does not rest on this.
        converged: Whether the solver reached its tolerance, and a value that no known rotation undercuts.
        iterations: Of the solver.
    """

    value: float
    rank: int
    second_eigenvalue: float
    gap: float
    is_tight: bool
    converged: bool
    iterations: int


class Relaxed(NamedTuple):
    """The solver's answer: Z, and the free numbers of Delta as ``certify/dual.py`` has them."""

    matrix: np.ndarray  # (4n, 4n)
    skew: np.ndarray  # (n, n, 6)
    diagonal: np.ndarray  # (k, 4, 4)
    value: float
    converged: bool
    iterations: int


class Rounded(NamedTuple):
    """The best rotation that the relaxation leads to, as a turn, its cost, and the relaxation."""

    turn: np.ndarray
    cost: float
    relaxed: Relaxed


def solve_relaxation(m: Measurements) -> Rounded:
    """Solve the relaxation (23) and descend from what it rounds to; keep the candidate if that is no better.

    Args:
        m: Concrete measurements, no padding, in the frame of a candidate, best a good one.

    Raises:
        ValueError: Inside jit, or for more measurements than the solver can take.
        ImportError: Without the extra ``sdp``.
    """
    if isinstance(m.src, jax.core.Tracer):
        raise ValueError("the relaxation calls a conic solver and runs outside jit only: take 'global'.")
    if len(m.src) > MAX_RELAXED:
        raise ValueError(
            f"{len(m.src)} measurements: the relaxation takes up to {MAX_RELAXED}; 'global' takes any number."
        )
    with jax.enable_x64(True):
        m = jax.tree.map(lambda x: np.asarray(x, np.float64 if x.dtype != bool else bool), m)
        relaxed = relax(np.asarray(_cost_matrix(m)))
        quats = np.concatenate([[[0, 0, 0, 1.0]], rounded(relaxed.matrix)])
        turns, costs = jax.device_get(_polished(m, quats))
        # A candidate that is as good as any stays, whatever rounding says.
        best = int(np.argmin(costs + 1e-9 * costs[0] * (np.arange(len(costs)) > 0)))
        return Rounded(turns[best], float(costs[best]), _believed(relaxed, float(costs[best])))


def _believed(relaxed: Relaxed, cost: float) -> Relaxed:
    """Take back that the solver converged where its value lies above the cost of a rotation.

    No lower bound does. Where points reach over hundreds of bounds and wrong ones are among them, a residual
    that is small beside the cost matrix is large beside the cost.
    """
    possible = relaxed.value <= cost + RANK_TOLERANCE * max(cost, 1.0)
    return relaxed._replace(converged=relaxed.converged and possible)


_cost_matrix = jax.jit(cost_matrix)


@jax.jit
def _polished(
    m: Measurements, quats: Float[Array, "t 4"]
) -> tuple[Float[Array, "t 3 3"], Float[Array, " t"]]:
    """Find the minima that the candidates descend to, and their costs."""

    def descend(quat: Array) -> tuple[Array, Array]:
        turn = so3.rotation_from_quat(quat)
        turn = turn @ polish(m.turned(turn))
        return turn, m.turned(turn).cost

    return jax.vmap(descend)(quats)


def relax(cost_matrix: np.ndarray, *, accuracy: float = 1e-6, iterations: int = 20_000) -> Relaxed:
    """Solve the relaxation (23) for a cost matrix of (k + 1)^2 blocks.

    Args:
        cost_matrix: Q, symmetric, in units of c^2.
        accuracy: Of the conic solver, absolute and relative.
        iterations: Its cap.

    Raises:
        ImportError: Without the extra ``sdp``.

    References: Yang, Shi, Carlone, T-RO 2021, Proposition 12; O'Donoghue et al., JOTA 2016 (SCS).
    """
    scs = needed("scs", "the relaxation needs a conic solver", "sdp")
    from scipy.sparse import csc_matrix

    n = len(cost_matrix) // 4
    entries = _entries(n)
    size = 4 * n * (4 * n + 1) // 2
    a = csc_matrix((entries.values, (entries.rows, entries.columns)), shape=(size, entries.unknowns))
    c = np.zeros(entries.unknowns)
    c[0] = -1  # the first unknown is nu, to be made large
    solver = scs.SCS(
        dict(A=a, b=_packed(cost_matrix), c=c), dict(s=[4 * n]),
        eps_abs=accuracy, eps_rel=accuracy, max_iters=iterations, verbose=False,
    )  # fmt: skip
    found = solver.solve()
    info, x = found["info"], np.nan_to_num(found["x"])
    skew, diagonal = _free_numbers(x[1:], n)
    z = _unpacked(np.nan_to_num(found["y"]), 4 * n)
    value = float(np.sum(cost_matrix * z))
    return Relaxed(z, skew, diagonal, value, info["status"] == "solved", int(info["iter"]))


def rounded(z: np.ndarray, count: int = 4) -> np.ndarray:
    """Find the unit quaternions, scalar last, that the leading vectors of Z hold in their first block."""
    _, vectors = np.linalg.eigh(z)
    heads = vectors[:4, ::-1][:, :count].T
    lengths = np.linalg.norm(heads, axis=1)
    return heads[lengths > 1e-9] / lengths[lengths > 1e-9, None]


def report(relaxed: Relaxed, cost: float) -> RelaxationReport:
    """Make the report of a relaxation, given the cost of the rotation that it was rounded to."""
    values = np.linalg.eigvalsh(relaxed.matrix)[::-1]
    largest = max(float(values[0]), np.finfo(float).tiny)
    rank = int(np.sum(values > RANK_TOLERANCE * largest))
    gap = (cost - relaxed.value) / cost if cost > 0 else 0.0
    tight = relaxed.converged and rank == 1 and abs(gap) <= RANK_TOLERANCE
    return RelaxationReport(
        relaxed.value, rank, float(values[1]) / largest, gap, tight, relaxed.converged, relaxed.iterations
    )


class Entries(NamedTuple):
    """The sparse matrix that takes (nu, skew, diagonal) to the packed form of nu J - Delta."""

    rows: np.ndarray
    columns: np.ndarray
    values: np.ndarray
    unknowns: int


def _entries(n: int) -> Entries:
    size = 4 * n
    rows, columns, values = [], [], []

    def put(row: np.ndarray, column: np.ndarray, unknown: np.ndarray, value: float) -> None:
        high, low = np.maximum(row, column), np.minimum(row, column)
        rows.append(low * size - low * (low - 1) // 2 + high - low)
        columns.append(unknown)
        values.append(np.where(high == low, value, np.sqrt(2) * value))

    corner = np.arange(4)
    put(corner, corner, np.zeros(4, int), 1.0)
    i, j = np.triu_indices(n, 1)
    start = 1
    for p, q in zip(ROWS, COLUMNS, strict=True):
        unknown = start + np.arange(len(i))
        put(4 * i + p, 4 * j + q, unknown, -1.0)
        put(4 * i + q, 4 * j + p, unknown, 1.0)
        start += len(i)
    k = np.arange(1, n)
    for row, column in zip(*np.tril_indices(4), strict=True):
        unknown = start + np.arange(len(k))
        put(4 * k + row, 4 * k + column, unknown, -1.0)
        put(np.full(len(k), row), np.full(len(k), column), unknown, 1.0)
        start += len(k)
    return Entries(np.concatenate(rows), np.concatenate(columns), np.concatenate(values), start)


def _free_numbers(x: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    i, j = np.triu_indices(n, 1)
    skew, diagonal = np.zeros((n, n, 6)), np.zeros((n - 1, 4, 4))
    skew[i, j] = x[: 6 * len(i)].reshape(6, len(i)).T
    p, q = np.tril_indices(4)
    blocks = x[6 * len(i) :].reshape(10, n - 1).T
    diagonal[:, p, q] = blocks
    diagonal[:, q, p] = blocks
    return skew, diagonal


def _packed(matrix: np.ndarray) -> np.ndarray:
    """Pack the lower triangle by columns, off the diagonal times the root of two, as the solver has it."""
    column, row = np.triu_indices(len(matrix))
    return np.where(row == column, 1, np.sqrt(2)) * matrix[row, column]


def _unpacked(vector: np.ndarray, size: int) -> np.ndarray:
    column, row = np.triu_indices(size)
    values = vector / np.where(row == column, 1, np.sqrt(2))
    matrix = np.zeros((size, size))
    matrix[row, column] = values
    matrix[column, row] = values
    return matrix
