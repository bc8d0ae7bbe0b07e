"""The rotation of a set of TIMs by any method: graduated non-convexity first, then what the method adds."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from teaser_jax.stages.rotation.gnc import Gnc, gnc_rotation
from teaser_jax.stages.rotation.pair_search import PairSearch
from teaser_jax.stages.rotation.quadratic_form import in_frame_of
from teaser_jax.stages.rotation.relaxation import Relaxation
from teaser_jax.stages.rotation.tims import Rotation, Tims, descend, listed_tims

# The methods there are: a record each.
RotationMethod: TypeAlias = Gnc | PairSearch | Relaxation


class ListedTims(NamedTuple):
    """TIMs one by one: source (scaled) and target, their bounds [length], and which of them exist."""

    src: Float[Array, "k 3"]
    dst: Float[Array, "k 3"]
    bounds: Float[Array, " k"]
    mask: Bool[Array, " k"]


def robust_rotation(
    listed: ListedTims, every: Tims | None, *, method: RotationMethod, cbar2: Float[Array, ""]
) -> Rotation:
    """Find the rotation (12) of TIMs, and which of them agree with it.

    Args:
        listed: The TIMs that a search looks at: the ring of the clique, or those of given pairs.
        every: The set that decides, if it is another one: the complete graph of the clique.
        method: How to find the rotation.
        cbar2: Truncation of the squared residual [-].

    Raises:
        ValueError: Inside jit, where the method runs on the host.

    Gradients: none, the members are a choice; inputs must be stopped by the caller.
    """
    dtype = listed.src.dtype
    judged = listed_tims(*listed) if every is None else every
    if isinstance(method, Gnc):
        return gnc_rotation(judged, method, cbar2=cbar2, dtype=dtype)
    found = gnc_rotation(judged, method.gnc, cbar2=cbar2, dtype=dtype)
    measurements = in_frame_of(
        found.rotation, listed.src, listed.dst,
        noise_bound=listed.bounds, cbar2=cbar2, mask=listed.mask, dtype=dtype,
    ).measurements  # fmt: skip
    # The search knows the listed ones; which of the two rotations is better is judged on all.
    first, cost = descend(judged, found.rotation, cbar2=cbar2)
    other, its_cost = descend(judged, found.rotation @ method.turn(measurements), cbar2=cbar2)
    return jax.tree.map(lambda x, y: jnp.where(its_cost < cost, y, x), first, other)
