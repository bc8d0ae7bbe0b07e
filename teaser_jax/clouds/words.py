"""The words for an answer to two clouds: its pose, what speaks for it, and what to do if it is not ok."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from teaser_jax import so3
from teaser_jax.clouds.trust.judge import LIMITS, SURELY, Evidence

if TYPE_CHECKING:
    from teaser_jax.clouds.registration import CloudRegistration
else:
    CloudRegistration = Any  # it imports this file


def advice(result: CloudRegistration) -> str:
    """Tell what happened and what to try, in sentences."""
    e = result.evidence
    if e is None:
        return (
            "No point of one cloud looks like one of the other: check that both are in one unit, or give "
            "scale; and that they show surfaces, not single points."
        )
    if result.doubt is None:
        return (
            "The clouds lie on one another, their shapes hold the pose, and no other pose explains as much: "
            f"points of the overlap are off by less than {_short(2 * e.voxel_size)} (two voxels)."
        )
    early = "The time was over before all ways to match were tried. " if result.ended_early else ""
    return early + _OF_DOUBT[result.doubt](result, e)


def _of_cells(result: CloudRegistration, e: Evidence) -> str:
    return (
        f"{e.cells} cells of {_short(e.voxel_size)} fit, and {LIMITS.cells} are needed to tell: give larger "
        "or denser clouds, or those of a place that both saw."
    )


def _of_fit(result: CloudRegistration, e: Evidence) -> str:
    fit, least = (e.fit, LIMITS.fit) if e.fit < LIMITS.fit else (e.fine_fit, LIMITS.fine_fit)
    return (
        f"No pose was found in which the clouds lie on one another: of the overlap {fit:.0%} fit in the "
        f"best, and {least:.0%} are needed. They may not show one place, or share too little of it, or be in "
        "different units (then give scale)."
    )


def _of_space(result: CloudRegistration, e: Evidence) -> str:
    return (
        f"The clouds fit, and {e.in_front:.0%} of one lies where the sensor of the other looked through: it "
        "cannot be there. They may not show one place; or src_viewpoint or dst_viewpoint is not where that "
        "sensor stood, as in a cloud merged of several scans (then leave it out)."
    )


def _of_free(result: CloudRegistration, e: Evidence) -> str:
    motions = "; ".join(str(motion) for motion in result.free)
    return (
        f"The clouds fit, and nothing holds them in place: the source {motions}. Give clouds with more shape."
    )


def _of_rival(result: CloudRegistration, e: Evidence) -> str:
    count = len(result.equivalent)
    if result.axis is not None:
        axis = ", ".join(f"{x:.2f}" for x in result.axis.direction)
        return (
            f"The part is round: any turn about the axis ({axis}) through its middle fits as well (see axis)."
        )
    others = f"{count} other pose{'s' * (count > 1)} (see equivalent)" if count else "another pose"
    return (
        f"The clouds fit as well in {others}, so no one can tell which is right: give what tells them apart, "
        "as a larger part of the scene, or initial and initial_error if the pose is known roughly."
    )


def _of_own(result: CloudRegistration, e: Evidence) -> str:
    return (
        f"The clouds fit in part ({e.fit:.0%} of the overlap), and other poses explain most of that, too: "
        "they may not show one place. Give clouds that share more of it."
    )


def _of_plain(result: CloudRegistration, e: Evidence) -> str:
    return (
        "The clouds fit, and all that fits is a few large planes, as in a corner of a room: another corner "
        "would fit as well. Give clouds that show what stands there, or that share more."
    )


def _of_tolerance(result: CloudRegistration, e: Evidence) -> str:
    return (
        f"The pose holds, and points of the overlap may be off by {_short(SURELY * e.displacement)}, more "
        f"than the tolerance of {_short(result.tolerance)}: give denser or less noisy clouds, or a larger "
        "tolerance."
    )


def _of_part(result: CloudRegistration, e: Evidence) -> str:
    return (
        "One cloud is a body and the other a scan of one side, and no pose was found in which the scan lies "
        "on the body and shows what a camera would see of it: they may not be of one object, or the scan "
        "holds other things, too (crop leaves them out)."
    )


def _of_viewpoint(result: CloudRegistration, e: Evidence) -> str:
    return (
        "The scan lies on the body, and which of its sides a camera could see decides the pose: tell where "
        "it stood, with src_viewpoint or dst_viewpoint."
    )


def _of_guess(result: CloudRegistration, e: Evidence) -> str:
    return (
        "The clouds are drawn to a pose further from the initial one than initial_error: give a larger one "
        "if that may be, or no initial pose, to look everywhere."
    )


_OF_DOUBT = {
    "cells": _of_cells, "fit": _of_fit, "space": _of_space, "free": _of_free, "rival": _of_rival,
    "own": _of_own, "plain": _of_plain, "tolerance": _of_tolerance, "part": _of_part,
    "viewpoint": _of_viewpoint, "guess": _of_guess,
}  # fmt: skip


def summary(result: CloudRegistration) -> str:
    """Tell a person about an answer: its status, its pose, what that rests on, and what to do."""
    angle = np.degrees(so3.rotation_angle(result.pose.rotation))
    x, y, z = result.pose.translation
    quaternion = ", ".join(f"{q:.6f}" for q in result.pose.quat)
    rows = [
        f"{'ok' if result.ok else 'NOT OK'}: {result.status.name}",
        f"  rotation     {angle:.3f} deg, quaternion (x, y, z, w) ({quaternion})",
        f"  translation  ({x:.6g}, {y:.6g}, {z:.6g})",
        *([] if result.evidence is None else _evidence(result, result.evidence)),
        *_left_out(result),
        f"  time         {sum(result.seconds.values()):.2f} s",
        f"  {result.advice}",
    ]
    return "\n".join(rows)


def _evidence(result: CloudRegistration, e: Evidence) -> list[str]:
    held, first = e.seen.visible[0], result.candidates[0]
    finer = f"{e.fine_fit:.0%} in cells of {_short(e.fine_voxel_size)}"
    return [
        f"  accuracy     {_short(e.displacement)} expected, in cells of {_short(e.voxel_size)}",
        f"  fit          {e.fit:.0%} of the overlap, {finer}",
        f"  overlap      {e.overlap:.0%} of the clouds; {e.cells} cells fit",
        *([] if np.isnan(e.in_front) else [f"  free space   {e.in_front:.1%} in front of what a sensor saw"]),
        f"  held         the least visible motion by {held:.1%}",
        f"  rivals       the best other pose explains {e.rivals.equal:.0%} of what fits",
        f"  candidates   {result.agreement} of {len(result.candidates)} agree: {first.found_by}",
    ]


def _left_out(result: CloudRegistration) -> list[str]:
    """Tell what was left out of the clouds, a line for each."""
    clouds = (("src", result.src), ("dst", result.dst))
    return [
        f"  left out     {x.left_out} of {x.given} points of {name}" for name, x in clouds if len(x) < x.given
    ]


def _short(length: float | None) -> str:
    return f"{length:.3g}"
