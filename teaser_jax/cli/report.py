"""The answers of ``teaser-jax register`` and ``map`` as JSON, and their errors where the truth is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from teaser_jax import metrics
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.maps.result import CloudMap
from teaser_jax.pose import Pose
from teaser_jax.register import Registration


def errors_as_text(pose: Pose, truth: Pose, name: str) -> str:
    """Tell in words how far a pose is from the truth, which the text calls by ``name``."""
    error = metrics.errors(pose, truth)
    return (
        f"\nError against the {name}\n"
        f"  rotation     {error.rotation_deg:.4g} deg\n"
        f"  translation  {float(error.translation):.4g}\n"
        f"  scale        {float(error.scale):.4g}"
    )


def as_plain_data(result: Registration, truth: Pose | None, seconds: float) -> dict[str, Any]:
    """Turn an answer into what JSON can hold; numbers that are not finite become null.

    Args:
        result: The answer.
        truth: The pose to compare with, or None.
        seconds: How long it took.
    """
    solution = result.solution
    report = {
        "ok": result.ok,
        "status": result.status.name,
        "advice": result.advice,
        "pose": _pose(result.pose),
        "matches": len(result.inliers),
        "excluded": int(solution.excluded),
        "inliers": np.flatnonzero(result.inliers).tolist(),
        "clique": {
            "size": int(solution.clique_size),
            "upper_bound": int(solution.clique_upper_bound),
            "is_maximum": bool(solution.clique_is_maximum),
        },
        "cost": _plain(solution.cost),
        "seconds": round(seconds, 6),
    }
    if result.has_certificate:
        report["certificate"] = _certificate(result.certificate)
    if truth is not None:
        error = metrics.errors(result.pose, truth)
        report["error"] = {
            "rotation_deg": _plain(error.rotation_deg),
            "translation": _plain(error.translation),
            "scale": _plain(error.scale),
        }
    return report


def clouds_as_plain_data(result: CloudRegistration) -> dict[str, Any]:
    """Turn an answer to two clouds into what JSON can hold; numbers that are not finite become null."""
    report: dict[str, Any] = {
        "ok": result.ok,
        "status": result.status.name,
        "doubt": result.doubt,
        "advice": result.advice,
        "pose": _pose(result.pose),
        "voxel_size": _plain(result.voxel_size),
        "displacement": _plain(result.displacement),
        "covariance": _plain(result.covariance),
        "centroid": _plain(result.centroid),
        "equivalent": [_plain(pose.matrix) for pose in result.equivalent],
        "free": [
            {"kind": x.kind, "axis": _plain(x.axis), "point": _plain(x.point)} for x in result.free
        ],
        "points": {
            name: {"given": x.given, "used": len(x), "left_out": str(x.left_out)}
            for name, x in (("src", result.src), ("dst", result.dst))
        },
        "candidates": [
            {"T_dst_src": _plain(x.pose.matrix), "fit": _plain(x.fit), "found_by": x.found_by}
            for x in result.candidates
        ],
        "ended_early": result.ended_early,
        "seconds": {name: round(value, 6) for name, value in result.seconds.items()},
    }  # fmt: skip
    e = result.evidence
    if e is not None:
        report["evidence"] = {
            "cells": e.cells,
            "fit": _plain(e.fit),
            "fine_fit": _plain(e.fine_fit),
            "fine_voxel_size": _plain(e.fine_voxel_size),
            "overlap": _plain(e.overlap),
            "support": _plain(e.support),
            "in_front": _plain(e.in_front),
            "beyond_planes": _plain(e.beyond_planes),
            "residual": _plain(e.residual),
            "visible": _plain(e.seen.visible),
            "explained_by_another": _plain(e.rivals.equal),
            "own": _plain(e.own),
            "lead": _plain(e.rivals.lead.share),
        }
    return report


def map_as_plain_data(result: CloudMap) -> dict[str, Any]:
    """Turn a map into what JSON can hold; clouds that are not placed have null for a pose."""
    return {
        "ok": result.ok,
        "engine": result.engine,
        "clouds": [
            {
                "name": name,
                "placed": bool(result.placed[k]),
                "confirmed": bool(result.confirmed[k]),
                "component": int(result.component[k]),
                "T_map_cloud": _plain(result.poses[k]) if result.placed[k] else None,
            }
            for k, name in enumerate(result.names)
        ],
        "pairs": [
            {
                "dst": result.names[pair.i],
                "src": result.names[pair.j],
                "status": pair.status.name,
                "doubt": pair.doubt,
                "ok": pair.ok,
                "kept": k in result.placing.kept,
                "why": result.why(pair.i, pair.j),
                "T_dst_src": _plain(pair.T),
                "displacement": _plain(pair.displacement),
                "voxel_size": _plain(pair.voxel_size),
            }
            for k, pair in enumerate(result.pairs)
        ],
        "not_asked": result.asked - len(result.pairs),
        "doubts": result.doubts,
        "seconds": {name: round(value, 6) for name, value in result.seconds.items()},
    }


def _pose(pose: Pose) -> dict[str, Any]:
    return {
        "scale": _plain(pose.scale),
        "rotation": _plain(pose.rotation),
        "quaternion_xyzw": _plain(pose.quat),
        "translation": _plain(pose.translation),
        "T_dst_src": _plain(pose.matrix),
    }


def _certificate(found: Certificate) -> dict[str, Any]:
    status = CertificateStatus(int(found.status))
    return {
        "status": status.name,
        "advice": status.advice,
        "is_optimal": bool(found.is_optimal),
        "is_unique": bool(found.is_unique),
        "suboptimality": _plain(found.suboptimality),
        "lower_bound": _plain(found.lower_bound),
        "angle_bound_deg": _plain(np.degrees(found.angle_bound)),
        "measurements": int(found.measurements),
        "iterations": int(found.iterations),
        "method": CertifiedBy(int(found.method)).name.lower(),
        "inlier_gap": _plain(found.inlier_gap),
        "explained_gap": _plain(found.explained_gap),
    }


def _plain(values: Any) -> Any:
    """Turn numbers into floats in lists, and those that are not finite into None."""

    def finite(x: Any) -> Any:
        return [finite(y) for y in x] if isinstance(x, list) else (x if math.isfinite(x) else None)

    return finite(np.asarray(values, float).tolist())
