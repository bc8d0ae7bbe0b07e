"""The answer of ``teaser-jax register`` as JSON, and its errors where the truth is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from teaser_jax import metrics
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
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
    pose, solution = result.pose, result.solution
    report = {
        "ok": result.ok,
        "status": result.status.name,
        "advice": result.advice,
        "pose": {
            "scale": _plain(pose.scale),
            "rotation": _plain(pose.rotation),
            "quaternion_xyzw": _plain(pose.quat),
            "translation": _plain(pose.translation),
            "T_dst_src": _plain(pose.matrix),
        },
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
        error = metrics.errors(pose, truth)
        report["error"] = {
            "rotation_deg": _plain(error.rotation_deg),
            "translation": _plain(error.translation),
            "scale": _plain(error.scale),
        }
    return report


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
