"""The paper's cascade behind the clique: the rotation from TIMs, then the translation from points."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.ground.steps import Run, plainly
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem
from teaser_jax.refit import chosen_pairs, positive_scale
from teaser_jax.settings import Settings
from teaser_jax.stages.pairs import tim_bounds, tims, usable_pairs
from teaser_jax.stages.rotation.robust import ListedTims, robust_rotation
from teaser_jax.stages.rotation.tims import Chosen, Rotation, complete_tims
from teaser_jax.stages.translation import estimate_translation


class Cascade(NamedTuple):
    """What rotation and translation give: a pose, the TIMs and the points of each axis behind it."""

    pose: Pose
    tims: Chosen
    axes: Bool[Array, "n 3"]
    settled: Bool[Array, ""]


def find_cascade(
    p: Problem, scale: Float[Array, ""], members: Bool[Array, " n"], settings: Settings, run: Run = plainly
) -> Cascade:
    """Find the rotation among the members of the clique, then the translation."""
    scale = positive_scale(scale)
    turned = run("rotation", find_rotation, p, scale, members, settings)
    translation, axes = run("translation", find_translation, p, scale, members, turned.rotation, settings)
    return Cascade(Pose(turned.rotation, translation, scale), turned.members, axes, turned.converged)


def find_rotation(
    p: Problem, scale: Float[Array, ""], members: Bool[Array, " n"], settings: Settings
) -> Rotation:
    """Find the rotation (12) of the TIMs among the members of the clique, as ``settings.rotation`` asks."""
    pairs = chosen_pairs(p, members)
    listed = ListedTims(
        tims(scale * p.src, pairs),
        tims(p.dst, pairs),
        tim_bounds(p.noise_bound, pairs),
        usable_pairs(pairs, members),
    )
    every = None
    if p.pairs is None and settings.tim_graph == "complete":
        every = complete_tims(scale * p.src, p.dst, p.noise_bound, members)
    return robust_rotation(listed, every, method=settings.rotation, cbar2=p.cbar2)


def find_translation(
    p: Problem, scale: Float[Array, ""], members: Bool[Array, " n"], rotation: Float[Array, "3 3"],
    settings: Settings,
) -> tuple[Float[Array, "3"], Bool[Array, "n 3"]]:  # fmt: skip
    """Find the translation by the vote of each axis (13), and the members that agree with it."""
    offsets = p.dst - scale * so3.rotate(rotation, p.src)
    return estimate_translation(offsets, p.noise_bound, members, cbar2=p.cbar2, criterion=settings.vote)
