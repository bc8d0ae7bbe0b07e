"""An independent check of a certificate, in plain numpy, to be read in one sitting.

It shares no code with the certifier. From the measurements, a rotation Rp and the free numbers of Delta it
rebuilds M = Q - mu J + Delta and asks one thing: does M + s I have a Cholesky factorisation, with s small
enough for the bound that is claimed? Why that is a proof: for every rotation and every choice of signs
theta, z = [q; theta_1 q; ...; theta_K q] has |z|^2 = K + 1, z^T J z = 1, z^T Q z = its cost, and
z^T Delta z = 0, since Delta is skew off the diagonal and its diagonal blocks sum to zero. So
cost = mu + z^T M z >= mu - (K + 1) s.
"""

from __future__ import annotations

from typing import Any

import numpy as np

EPS = np.finfo(np.float64).eps


def verify(
    src: Any,
    dst: Any,
    rotation: Any,
    certificate: Any,
    *,
    noise_bound: Any,
    cbar2: Any = 1.0,
    tolerance: float = 1e-3,
) -> bool:
    """Check the claims of a certificate about a rotation, from the data and the stored dual alone.

    Args:
        src, dst, noise_bound, cbar2: The measurements that were certified, those of the mask only.
        rotation: The rotation that was certified.
        certificate: Anything with the fields of ``Certificate``, in float64.
        tolerance: The suboptimality that was to count as optimal.

    Returns:
        True if the lower bound is proved, and cost, gaps, count, status and ``is_optimal`` follow from it;
        ``is_unique`` and ``angle_bound`` are not looked at. False, also for a malformed certificate, proves
        nothing: not that the rotation is bad.

    Raises:
        ValueError: If measurements or rotation have shapes that do not fit, or an argument is no number.
    """
    a, b, r, bound, c2, within = (_numbers(x) for x in (src, dst, rotation, noise_bound, cbar2, tolerance))
    fits = a.shape == b.shape and a.shape[1:] == (3,) and r.shape == (3, 3) and bound.shape in ((), (len(a),))
    if not (fits and c2.shape == within.shape == ()):
        shapes = ", ".join(str(x.shape) for x in (a, b, r, bound, c2, within))
        raise ValueError(f"src, dst, rotation, noise_bound, cbar2 and tolerance do not fit: shapes {shapes}.")
    if not (
        np.all(bound > 0) and np.all(np.isfinite(r)) and np.all(np.isfinite(a)) and np.all(np.isfinite(b))
    ):
        return False
    with np.errstate(over="ignore", invalid="ignore"):  # infinite costs are cut off, and prove nothing
        return _holds(a, b, r, bound, certificate, float(c2), float(within))


def _holds(
    a: np.ndarray,
    b: np.ndarray,
    r: np.ndarray,
    bound: np.ndarray,
    certificate: Any,
    cbar2: float,
    within: float,
) -> bool:
    """Check a certificate against measurements that fit together."""
    a, b = a / np.broadcast_to(bound, len(a))[:, None], b / np.broadcast_to(bound, len(a))[:, None]
    try:
        return _follows(a, b, r, certificate, cbar2, within) and is_lower_bound(
            a, b, cbar2, float(certificate.lower_bound), certificate.rotation, *certificate.dual
        )
    except (AttributeError, IndexError, TypeError, ValueError):  # not what a certificate looks like
        return False


def _numbers(value: Any) -> np.ndarray:
    """Read numbers in float64; what a masked array hides becomes NaN, of which nothing is proved."""
    array = np.ma.filled(value.astype(np.float64), np.nan) if np.ma.is_masked(value) else value
    try:
        array = np.asarray(array)
        if array.dtype.kind in "fiuO":
            return array.astype(np.float64)
        reason = f"they are of type {array.dtype}"
    except (TypeError, ValueError, OverflowError) as error:
        reason = str(error)
    raise ValueError(f"verify received {type(value).__name__} that holds no real numbers: {reason}.")


def _follows(a: np.ndarray, b: np.ndarray, r: np.ndarray, c: Any, cbar2: float, tolerance: float) -> bool:
    """Check that all other claims of the certificate c follow from its lower bound."""
    left, _, right = np.linalg.svd(r)
    r = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    cost = np.minimum(np.sum((b - a @ r.T) ** 2, axis=1), cbar2).sum()
    turns = np.any(a != 0, axis=1) & np.any(b != 0, axis=1)
    gap, small = cost - float(c.lower_bound), 1e-9 * max(cost, cbar2)
    zero = cost <= 1e-6 * cbar2  # relative gaps say nothing there
    within = gap <= max(tolerance * cost, 1e-6 * cbar2) + small
    return bool(
        abs(cost - float(c.cost)) <= small
        and int(c.measurements) == turns.sum()
        and (zero or abs(gap - float(c.suboptimality) * cost) <= small)
        and abs(gap - float(c.absolute_gap) * cbar2 * max(turns.sum(), 1)) <= small
        and bool(c.is_optimal) == (int(c.status) == 0)
        and (within or not c.is_optimal)
    )


def is_lower_bound(
    a: np.ndarray, b: np.ndarray, cbar2: float, lower: float, rotation: Any, skew: Any, diagonal: Any
) -> bool:
    """Check that it is proved that no rotation of (a, b) costs less than ``lower``.

    The rotation is the one that the dual belongs to. Measurements are in units of their bounds.
    """
    rotation, skew, diagonal = (np.asarray(x, np.float64) for x in (rotation, skew, diagonal))
    if lower <= 0:
        return True
    if not (np.all(np.isfinite(rotation)) and np.isfinite([lower, cbar2]).all() and cbar2 > 0):
        return False
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-12 or np.linalg.det(rotation) < 0:
        return False
    b = b @ rotation
    cost = np.minimum(np.sum((a - b) ** 2, axis=1), cbar2)
    # A vector of no length costs the same under every rotation; the dual leaves its place empty.
    turns = np.any(a != 0, axis=1) & np.any(b != 0, axis=1)
    rows = np.flatnonzero(turns)
    a, b, mu, constant = a[turns], b[turns], cost[turns].sum(), cost[~turns].sum()
    if lower <= constant:
        return True
    skew, diagonal = skew[np.ix_([0, *(rows + 1)], [0, *(rows + 1)])], diagonal[rows]
    if not (np.all(np.isfinite(skew)) and np.all(np.isfinite(diagonal))):
        return False

    n = len(a) + 1
    matrix = _rebuilt_matrix(a, b, cbar2, mu, skew, diagonal)
    shift = (mu + constant - lower) / n
    # A factorisation that comes to its end proves eigenvalues above -(N + 2) eps trace; making M errs, too.
    size = np.sum(a * a) + np.sum(b * b) + len(a) * cbar2
    error = EPS * ((4 * n + 2) * np.abs(np.diagonal(matrix)).sum() + 32 * size)
    if not shift > 2 * error:
        return False
    try:
        np.linalg.cholesky(matrix + (shift - error) * np.eye(4 * n))
    except np.linalg.LinAlgError:
        return False
    return True


def _rebuilt_matrix(
    a: np.ndarray, b: np.ndarray, cbar2: float, mu: float, skew: np.ndarray, diagonal: np.ndarray
) -> np.ndarray:
    """Build M = Q - mu J + Delta from the measurements, their cost mu, and the free numbers of Delta."""
    n = len(a) + 1
    m = np.zeros((n, 4, n, 4))
    theta = np.where(np.sum((a - b) ** 2, axis=1) <= cbar2, 1.0, -1.0)
    for k in range(1, n):
        x, y = a[k - 1], b[k - 1]
        p = np.zeros((4, 4))  # q^T p q = y . R(q) x
        p[:3, :3] = np.outer(x, y) + np.outer(y, x) - x @ y * np.eye(3)
        p[:3, 3] = p[3, :3] = np.cross(x, y)
        p[3, 3] = x @ y
        h = (x @ x + y @ y) / 2 * np.eye(4) - p
        m[k, :, k, :] = h + cbar2 / 2 * np.eye(4)
        m[0, :, k, :] = m[k, :, 0, :] = theta[k - 1] / 2 * (h - cbar2 / 2 * np.eye(4))
    for value, (r, c) in enumerate([(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)]):
        upper = np.triu(skew[:, :, value], 1)
        free = upper - upper.T
        m[:, r, :, c] += free
        m[:, c, :, r] -= free
    symmetric = (diagonal + diagonal.transpose(0, 2, 1)) / 2
    for k in range(1, n):
        m[k, :, k, :] += symmetric[k - 1]
    m[0, :, 0, :] -= symmetric.sum(axis=0) + mu * np.eye(4)

    matrix = m.reshape(4 * n, 4 * n)
    return (matrix + matrix.T) / 2
