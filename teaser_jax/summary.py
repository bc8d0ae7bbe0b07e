"""The words for an answer: its pose, what that rests on, and what is proved."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.solution import Solution

if TYPE_CHECKING:
    from teaser_jax.register import Registration
else:
    Registration = Any  # it imports this file


def summary(result: Registration) -> str:
    """Tell a person about an answer: its status, its pose, what that rests on, and what to do."""
    s = result.solution
    n, inliers = len(result.inliers), int(result.inliers.sum())
    excluded = f" ({int(s.excluded)} rows were not finite and left out)" if s.excluded else ""
    angle = np.degrees(so3.rotation_angle(result.pose.rotation))
    quaternion = ", ".join(f"{q:.6f}" for q in result.pose.quat)
    x, y, z = result.pose.translation
    rows = [
        f"{'ok' if result.ok else 'NOT OK'}: {result.status.name}",
        f"  inliers      {inliers} of {n} matches{excluded}",
        f"  clique       {_clique(result)}",
        f"  scale        {float(result.pose.scale):.6g}",
        f"  rotation     {angle:.3f} deg, quaternion (x, y, z, w) ({quaternion})",
        f"  translation  ({x:.6g}, {y:.6g}, {z:.6g})",
        f"  cost         {float(s.cost):.6g}: each match adds (residual / noise bound)^2, but cbar2 at most",
        *_wide(s),
        *_proofs(result),
        f"  {result.advice}",
    ]
    return "\n".join(rows)


def _wide(s: Solution) -> list[str]:
    """Tell by how much bounds are wider than those given."""
    wide = float(s.selection.widening)
    return [] if wide == 1 else [f"{'':<15}bounds are {wide:.3g} times those given, for the fit's own error"]


def _clique(result: Registration) -> str:
    """Tell how many matches agree pairwise, and whether more could."""
    s = result.solution
    size, most = int(s.clique_size), int(s.clique_upper_bound)
    if s.clique_is_maximum:
        return f"{size} matches agree pairwise, proved maximum"
    if size == most:
        return f"not searched: all {size} usable matches were taken"
    limits = "see ExactClique(seconds, nodes) in Settings, or --clique-seconds"
    return f"{size} matches agree pairwise, not proved maximum, at most {most} ({limits})"


def _proofs(result: Registration) -> list[str]:
    """Tell what is proved, a line for each thing; what is not proved has none."""
    s, known = result.solution, result.problem.scale is not None
    votes = "each axis of the translation" if known else "scale and each axis of the translation"
    most, found = int(s.clique_upper_bound), int(result.inliers.sum())
    where = "" if known else ", at the voted scale"
    lines = [
        f"votes: {votes}, global optimum of its own problem",
        f"matches: no pose explains more than {most}{where}; this one explains {found}",
    ]
    if result.has_certificate:
        lines.append(f"rotation: {certificate_line(result.certificate)}")
    return [f"  {'proved' if i == 0 else '':<13}{line}" for i, line in enumerate(lines)]


def certificate_line(certificate: Certificate) -> str:
    """Tell in one line what a certificate proves of a rotation."""
    c, status = certificate, CertificateStatus(int(certificate.status))
    measured = int(c.measurements)
    if not c.is_optimal:
        better = f", could be improved by {float(c.suboptimality):.2%} at most" if c.lower_bound > 0 else ""
        return f"not proved optimal ({status.name}{better})"
    how = CertifiedBy(int(c.method)).name.lower().replace("_", " ")
    gap = f"optimal within {float(c.suboptimality):.2%} of its cost"
    return f"{gap}{' and unique' if c.is_unique else ''}, given {measured} measurements ({how})"
