"""Measurements on the host: checked, in float64, those that count moved to the front, padded to few sizes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.ground.arrays import AnyArray, namespace
from teaser_jax.reading import real_numbers, truth_values


class HostMeasurements(NamedTuple):
    """Vector pairs in float64, those that count first, padded to one of a few sizes.

    Attributes:
        src, dst: Vectors, row k with row k [length]; rows of padding hold zeros.
        noise_bound: The bound of each row [length]; 1 in padding.
        cbar2: Truncation, c-bar squared [-].
        mask: Rows that are no padding.
    """

    src: Float[AnyArray, "*batch k 3"]
    dst: Float[AnyArray, "*batch k 3"]
    noise_bound: Float[AnyArray, "*batch k"]
    cbar2: Float[AnyArray, "*batch"]
    mask: Bool[AnyArray, "*batch k"]

    @property
    def measured(self) -> int:
        """How many rows are no padding."""
        return int(self.mask.sum())


def read_measurements(src: Any, dst: Any, noise_bound: Any, cbar2: Any, mask: Any) -> HostMeasurements:
    """Read measurements on the host, drop the rows outside the mask, and pad the others.

    Raises:
        ValueError: Shapes that do not fit, a mask that holds no truth values, or bounds that are not finite
            numbers above 0.
    """
    given = {"src": src, "dst": dst, "noise_bound": noise_bound, "cbar2": cbar2}
    src, dst, noise_bound, cbar2 = (
        np.asarray(real_numbers(value, name), np.float64) for name, value in given.items()
    )
    n = len(src)
    mask = truth_values(mask, n)
    if noise_bound.shape not in ((), (n,)) or cbar2.shape != ():
        raise ValueError(
            f"noise_bound and cbar2 have shapes {noise_bound.shape} and {cbar2.shape}: expected () or "
            f"({n},), and ()."
        )
    bound = np.broadcast_to(noise_bound, (n,))
    if not (np.all((bound[mask] > 0) & (bound[mask] < np.inf)) and np.isfinite(cbar2) and cbar2 > 0):
        raise ValueError("noise_bound and cbar2 must be finite numbers above 0.")
    k = int(mask.sum())
    kept = HostMeasurements(src[mask], dst[mask], bound[mask], cbar2, np.ones(k, bool))
    return padded(kept, padded_count(k))


def comparable(
    src: Float[AnyArray, "k 3"], dst: Float[AnyArray, "k 3"], noise_bound: Float[AnyArray, " k"]
) -> Bool[AnyArray, " k"]:
    """Tell which vectors can be squared, in units of their bounds, too: iterations on infinity may never end.

    Squares are squared again where matrices of them are multiplied.
    """
    xp = namespace(src, dst, noise_bound)
    most = float(jnp.finfo(src.dtype).max) ** 0.25 / 10
    reach = xp.maximum(xp.max(xp.abs(src), axis=1), xp.max(xp.abs(dst), axis=1))
    sizes = (reach < most) & (noise_bound < most) & (noise_bound > 1 / most)
    return sizes & (reach < most * xp.where(sizes, noise_bound, 1))


def padded(measurements: HostMeasurements, size: int) -> HostMeasurements:
    """Append rows of padding to measurements until there are ``size`` rows."""

    def longer(x: np.ndarray, fill: float) -> np.ndarray:
        return np.concatenate([x, np.full((size - len(x), *x.shape[1:]), fill, x.dtype)])

    return HostMeasurements(
        longer(measurements.src, 0),
        longer(measurements.dst, 0),
        longer(measurements.noise_bound, 1),
        measurements.cbar2,
        longer(measurements.mask, 0),
    )


def without_padding(measurements: HostMeasurements) -> HostMeasurements:
    """Cut the rows of padding off the measurements."""
    k = measurements.measured
    return measurements._replace(
        src=measurements.src[:k],
        dst=measurements.dst[:k],
        noise_bound=measurements.noise_bound[:k],
        mask=measurements.mask[:k],
    )


def padded_count(k: int) -> int:
    """Round k up to the size of the program that serves it: an eighth more at most, sixteen at least."""
    step = max(8, 1 << max((k - 1).bit_length() - 3, 0))
    return max(16, -(-k // step) * step)
