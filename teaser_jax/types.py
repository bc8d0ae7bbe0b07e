"""The records that travel through the method. Every one is an immutable JAX pytree."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, get_args

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax import so3
from teaser_jax.ground.checks import whole_number
from teaser_jax.so3 import AnyArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


class Status(enum.IntEnum):
    """What became of a solve. ``OK`` is the only one to act upon. Held as int32 inside JAX."""

    OK = 0
    TOO_FEW_POINTS = 1
    NO_CONSENSUS = 2
    DEGENERATE = 3
    NOT_CONVERGED = 5  # 4 is kept for answers that have a rival

    @property
    def advice(self) -> str:
        """One sentence: what happened and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "The pose is determined by its inliers, and they agree better than chance allows.",
    Status.TOO_FEW_POINTS: (
        "Fewer than 3 usable matches: check for non-finite rows, the mask and the confidences, and that "
        "noise_bound, cbar2 and scale are numbers above 0; or give more matches."
    ),
    Status.NO_CONSENSUS: (
        "No set of matches agrees better than wrong matches would by chance: check that the two "
        "clouds overlap and that noise_bound is in their unit, or find better matches."
    ),
    Status.DEGENERATE: (
        "The inliers lie on a point or a line compared with noise_bound, so they do not determine "
        "the rotation or the scale: add matches away from that line."
    ),
    Status.NOT_CONVERGED: (
        "An iteration cap was reached before the inliers settled: raise Settings.gnc_iterations "
        "or Settings.refine_iterations."
    ),
}


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["src", "dst", "noise_bound", "cbar2", "mask", "confidence", "scale", "pairs"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Problem:
    """Matched points and what is known about them. Built by ``make_problem``.

    Attributes:
        src, dst: Matched points, row i with row i [length unit of the user].
        noise_bound: beta_i, the largest error of a right match [same unit].
        cbar2: Truncation c-bar squared of the cost (6) [-].
        mask: Rows to use; padding is masked.
        confidence: Weight of each match in the final fit, w_i = confidence_i / beta_i^2 [-].
        scale: Known scale [-], or None: estimate it. None is structure, so static under jit.
        pairs: Index pairs whose TIMs are used, or None for all. A pair (i, i) is padding.
    """

    src: Float[Array, "n 3"]
    dst: Float[Array, "n 3"]
    noise_bound: Float[Array, " n"]
    cbar2: Float[Array, ""]
    mask: Bool[Array, " n"]
    confidence: Float[Array, " n"]
    scale: Float[Array, ""] | None = None
    pairs: Int[Array, "m 2"] | None = None


CliqueMethod = Literal["exact", "greedy", "networkx", "none"]
RotationMethod = Literal["gnc", "global", "sdp"]
TimGraph = Literal["chain", "complete"]
Criterion = Literal["tls", "consensus"]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["gnc_factor", "gnc_tolerance", "scale_range"],
    meta_fields=[
        "clique", "rotation", "tim_graph", "vote", "refine",
        "gnc_iterations", "refine_iterations", "clique_nodes", "clique_seconds",
    ],
)  # fmt: skip
@dataclass(frozen=True)
class Settings:
    """How to solve. Choices and caps are static under jit, numbers are traced.

    Attributes:
        clique: ``"exact"`` maximum clique (host search where the device has no proof),
            ``"greedy"`` on the device, ``"networkx"`` slow oracle, ``"none"`` no pruning.
        rotation: ``"gnc"``, graduated non-convexity; ``"global"``, the same and a search over all pairs
            of TIMs, for hard rotations; ``"sdp"``, the relaxation (23), on the host, up to 100 TIMs.
        tim_graph: TIMs of the rotation stage: ``"chain"`` of consecutive clique members, closed
            to a ring, or the ``"complete"`` graph of the clique. Given pairs take their place.
        vote: Scalar estimates by ``"tls"`` (11) or by maximum ``"consensus"``.
        refine: End by descending the joint cost (6); False gives the paper's plain cascade.
        gnc_iterations, refine_iterations: Caps on rounds.
        clique_nodes, clique_seconds: Budget of the exact search; when it is spent the best
            clique so far and a proved upper bound are returned.
        gnc_factor: Growth of the GNC control parameter each round [-].
        gnc_tolerance: Relative change of the GNC cost that counts as none [-].
        scale_range: Search interval of an unknown scale [-]. The refined scale may leave it by two
            parts in a hundred; an answer further away has no consensus.
    """

    clique: CliqueMethod = "exact"
    rotation: RotationMethod = "gnc"
    tim_graph: TimGraph = "chain"
    vote: Criterion = "tls"
    refine: bool = True
    gnc_iterations: int = 100
    refine_iterations: int = 50
    clique_nodes: int = 100_000_000
    clique_seconds: float = 60.0
    gnc_factor: float | Float[Array, ""] = 1.4
    gnc_tolerance: float | Float[Array, ""] = 1e-6
    scale_range: tuple[Any, Any] = field(default=(0.0, float("inf")))

    def __post_init__(self) -> None:
        # JAX rebuilds records with placeholders for numbers; choices and caps are always themselves.
        for name, kind in _CHOICES.items():
            if getattr(self, name) not in get_args(kind):
                allowed = ", ".join(repr(x) for x in get_args(kind))
                raise ValueError(f"Settings.{name} is {getattr(self, name)!r}: expected one of {allowed}.")
        for name in ("gnc_iterations", "refine_iterations", "clique_nodes"):
            whole_number(f"Settings.{name}", getattr(self, name), 1)
        if not isinstance(self.refine, bool):
            raise ValueError(f"Settings.refine is {self.refine!r}: expected True or False.")
        if isinstance(self.gnc_factor, str) or isinstance(self.gnc_tolerance, str):
            raise ValueError(
                f"Settings.gnc_factor and gnc_tolerance are {self.gnc_factor!r} and {self.gnc_tolerance!r}: "
                "expected numbers."
            )
        if isinstance(self.gnc_factor, float | int) and not self.gnc_factor > 1:
            raise ValueError(f"Settings.gnc_factor is {self.gnc_factor!r}: expected a number above 1.")
        if not isinstance(self.scale_range, tuple) or len(self.scale_range) != 2:
            raise ValueError(f"Settings.scale_range is {self.scale_range!r}: expected (low, high).")
        low, high = self.scale_range
        if isinstance(low, float | int) and isinstance(high, float | int) and not 0 <= low < high:
            raise ValueError(f"Settings.scale_range is {self.scale_range!r}: expected 0 <= low < high.")
        if not isinstance(self.clique_seconds, Real) or not self.clique_seconds >= 0:
            raise ValueError(
                f"Settings.clique_seconds is {self.clique_seconds!r}: expected 0 or more seconds."
            )


_CHOICES = {"clique": CliqueMethod, "rotation": RotationMethod, "tim_graph": TimGraph, "vote": Criterion}


@partial(jax.tree_util.register_dataclass, data_fields=["rotation", "translation", "scale"], meta_fields=[])
@dataclass(frozen=True)
class Pose:
    """The similarity ``b = s R a + t`` from the source to the target frame, ``T_dst_src``.

    Fields may be numpy or JAX arrays, with leading batch axes; results are of the same kind.
    """

    rotation: Float[AnyArray, "*batch 3 3"]
    translation: Float[AnyArray, "*batch 3"]
    scale: Float[AnyArray, "*batch"]

    @classmethod
    def from_matrix(cls, matrix: Any) -> Pose:
        """From ``[s R, t; 0, 1]``. Raises ValueError if a concrete s R is not a scaled rotation."""
        xp = so3.namespace(matrix)
        matrix = xp.asarray(matrix)
        if matrix.shape[-2:] != (4, 4):
            raise ValueError(f"a pose matrix has shape (4, 4), received {matrix.shape}")
        if not isinstance(matrix, jax.core.Tracer):
            _check_similarity(np.asarray(matrix, np.float64))
        block = matrix[..., :3, :3]
        scale = xp.cbrt(xp.linalg.det(block))
        return cls(block / scale[..., None, None], matrix[..., :3, 3], scale)

    @property
    def matrix(self) -> Float[AnyArray, "*batch 4 4"]:
        """``T_dst_src = [s R, t; 0, 1]``."""
        xp = so3.namespace(self.rotation, self.translation, self.scale)
        scaled = self.scale[..., None, None] * self.rotation
        top = xp.concatenate([scaled, self.translation[..., None]], axis=-1)
        bottom = xp.broadcast_to(xp.asarray([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
        return xp.concatenate([top, bottom], axis=-2)

    @property
    def quat(self) -> Float[AnyArray, "*batch 4"]:
        """Unit quaternion of the rotation, scalar last."""
        return so3.quat_from_rotation(self.rotation)

    def apply(self, points: Float[AnyArray, "*batch n 3"]) -> Float[AnyArray, "*batch n 3"]:
        """Source points (rows) in the target frame. Raises ValueError on other shapes than (..., n, 3)."""
        if points.ndim < 2 or points.shape[-1] != 3:
            raise ValueError(f"points have shape {points.shape}: expected (n, 3), one point a row.")
        rotated = so3.rotate(self.rotation, points)
        return self.scale[..., None, None] * rotated + self.translation[..., None, :]

    def inverse(self) -> Pose:
        """The pose from the target to the source frame, ``T_src_dst``."""
        xp = so3.namespace(self.rotation, self.translation, self.scale)
        transposed = xp.swapaxes(self.rotation, -1, -2)
        scale = 1 / self.scale
        moved = so3.rotate(transposed, self.translation[..., None, :])[..., 0, :]
        return Pose(transposed, -scale[..., None] * moved, scale)

    def __matmul__(self, other: Pose) -> Pose:
        """Composition: ``(T_c_b @ T_b_a).apply(p) == T_c_b.apply(T_b_a.apply(p))``."""
        moved = self.apply(other.translation[..., None, :])[..., 0, :]
        rotation = so3.rotate(self.rotation, other.rotation.swapaxes(-1, -2)).swapaxes(-1, -2)
        return Pose(rotation, moved, self.scale * other.scale)

    def as_scipy(self) -> Rotation:
        """The rotation as ``scipy.spatial.transform.Rotation``."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_matrix(np.asarray(self.rotation))


def _check_similarity(matrix: np.ndarray) -> None:
    """Raise unless each matrix is [s R, t; 0, 1] with s above 0, to one in a thousand."""
    block = matrix[..., :3, :3]
    with np.errstate(invalid="ignore"):
        scale2 = np.cbrt(np.linalg.det(block))[..., None, None] ** 2
        error = np.abs(np.swapaxes(block, -1, -2) @ block - scale2 * np.eye(3))
        proper = np.all(error <= 1e-3 * scale2) and np.all(np.linalg.det(block) > 0)
        bottom = np.allclose(matrix[..., 3, :], [0, 0, 0, 1])
    if not (proper and bottom and np.all(np.isfinite(matrix))):
        raise ValueError(
            "the matrix is not [s R, t; 0, 1] with a positive scale and a rotation: is it transposed, "
            "sheared or mirrored?"
        )


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["scale_pairs", "clique", "rotation", "translation", "inliers", "refined"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Selection:
    """Which measurements to trust: the discrete half of the method. No gradient flows into it.

    Attributes:
        scale_pairs: TRIMs in the consensus of the scale: packed bit rows (bit t of word j in row
            i is the pair (i, 32 j + t)), or a mask of the given pairs, or None: scale known.
        clique: Members of the clique.
        rotation: TIMs kept by the rotation stage: by their first member (chain), packed bit rows
            (complete), or a mask of the given pairs.
        translation: Points in the consensus of each axis of the translation.
        inliers: Joint residual within c beta_i when refined, otherwise clique and all three axes.
        refined: Whether the pose is the joint fit to ``inliers``.
    """

    scale_pairs: UInt32[AnyArray, "n w"] | Bool[AnyArray, " m"] | None
    clique: Bool[AnyArray, " n"]
    rotation: Bool[AnyArray, " k"] | UInt32[AnyArray, "n w"]
    translation: Bool[AnyArray, "n 3"]
    inliers: Bool[AnyArray, " n"]
    refined: Bool[AnyArray, ""]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "pose", "selection", "inliers", "status", "clique_size", "clique_upper_bound",
        "clique_is_maximum", "excluded", "cost",
    ],
    meta_fields=[],
)  # fmt: skip
@dataclass(frozen=True, repr=False)
class Solution:
    """The answer of ``solve``. Finite even when ``status`` says that it failed.

    Attributes:
        pose: Equal to ``refit(problem, selection)``, if there is an inlier.
        selection: The sets behind the pose.
        inliers: ``selection.inliers``, in the user's order.
        status: A ``Status`` as int32; the first failure sticks.
        clique_size: Members of the clique.
        clique_upper_bound: No clique of the consistency graph is larger: proved.
        clique_is_maximum: Whether the two are equal, which proves the maximum; never without pruning.
        excluded: Rows left out because they hold NaN or infinity.
        cost: The joint cost (6) of the pose [-].
    """

    pose: Pose
    selection: Selection
    inliers: Bool[AnyArray, " n"]
    status: Int[AnyArray, ""]
    clique_size: Int[AnyArray, ""]
    clique_upper_bound: Int[AnyArray, ""]
    clique_is_maximum: Bool[AnyArray, ""]
    excluded: Int[AnyArray, ""]
    cost: Float[AnyArray, ""]

    @property
    def ok(self) -> Bool[AnyArray, ""]:
        """Whether the pose can be trusted. A proof elsewhere never turns this true."""
        return self.status == Status.OK

    def __repr__(self) -> str:
        if isinstance(self.status, jax.core.Tracer) or np.shape(self.status) != ():
            return f"Solution(status={self.status!r}, inliers of shape {np.shape(self.inliers)})"
        return (
            f"Solution(status={Status(int(self.status)).name}, {int(np.sum(self.inliers))} of "
            f"{np.shape(self.inliers)[-1]} matches, pose={self.pose!r})"
        )
