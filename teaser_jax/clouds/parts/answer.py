"""The search for a part as an answer to a pair of clouds: its pose, those as good, and what may be said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.parts.closed import which_is_part
from teaser_jax.clouds.parts.search import LEAST_OF_PART, LEAST_OF_SCAN, search
from teaser_jax.clouds.symmetry import Axis
from teaser_jax.clouds.trust.judge import Verdict
from teaser_jax.solution import Status


@dataclass(frozen=True, eq=False)
class PartAnswer:
    """Where a part lies in its scan.

    Attributes:
        poses: From the source to the target, each about its middle: the best, and those that are as good.
        axis: About which the part may be turned by any angle, in the frame of the target, about its middle;
            None: there is no such axis.
        verdict: Whether to trust the first.
    """

    poses: tuple[Float[np.ndarray, "4 4"], ...]
    axis: Axis | None
    verdict: Verdict


def part_answer(pair: Pair, seconds: float) -> PartAnswer | None:
    """Search for a part, if one of the clouds is one and the other a scan of it; None: they are not.

    Args:
        pair: The clouds.
        seconds: After which no further pose is aligned [s].
    """
    with pair.timed("search"):
        part = which_is_part(pair.src.cloud, pair.dst.cloud)
        if part is None or seconds == 0:
            return None
        forth = part == "src"
        clouds = (pair.src.cloud, pair.dst.cloud) if forth else (pair.dst.cloud, pair.src.cloud)
        found = search(*clouds, threads=pair.dst.threads, seconds=None if np.isinf(seconds) else seconds)
    poses = tuple(x.pose if forth else np.linalg.inv(x.pose) for x in found.equivalent)
    axis = found.axis
    if axis is not None and forth:
        turn, shift = poses[0][:3, :3], poses[0][:3, 3]
        axis = Axis(turn @ axis.point + shift, turn @ axis.direction)
    covers = found.found[0].cover.scan > LEAST_OF_SCAN and found.found[0].cover.part > LEAST_OF_PART
    if not covers:
        verdict = Verdict(Status.NO_CONSENSUS, "part")
    elif len(poses) > 1 or axis is not None:
        verdict = Verdict(Status.AMBIGUOUS, "rival")
    elif not found.knows_viewpoint:
        verdict = Verdict(Status.NO_CONSENSUS, "viewpoint")
    else:
        verdict = Verdict(Status.OK, None)
    return PartAnswer(poses, axis, verdict)
