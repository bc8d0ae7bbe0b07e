"""What a person reads of an answer: the pose, what it rests on, and what is proved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy

if TYPE_CHECKING:
    from teaser_jax.register import Registration


def summary(result: Registration) -> str:
    """A few lines that a person can read."""
    s = result.solution
    n, inliers = len(result.inliers), int(result.inliers.sum())
    angle = np.degrees(so3.rotation_angle(result.pose.rotation))
    x, y, z = result.pose.translation
    proof = (
        "proved maximum"
        if s.clique_is_maximum
        else "not proved maximum, "
        f"at most {int(s.clique_upper_bound)} (see Settings.clique, ExactClique(nodes, seconds))"
    )
    searched = f"{int(s.clique_size)} matches agree pairwise, {proof}"
    if s.clique_size == s.clique_upper_bound and not s.clique_is_maximum:
        searched = f"not searched: all {int(s.clique_size)} usable matches were taken"
    rows = [
        f"{'ok' if result.ok else 'NOT OK'}: {result.status.name}",
        f"  inliers      {inliers} of {n} matches"
        + (f" ({int(s.excluded)} rows were not finite and left out)" if s.excluded else ""),
        f"  clique       {searched}",
        f"  scale        {float(result.pose.scale):.6g}",
        f"  rotation     {angle:.3f} deg, quaternion (x, y, z, w) "
        + "("
        + ", ".join(f"{q:.6f}" for q in result.pose.quat)
        + ")",
        f"  translation  ({x:.6g}, {y:.6g}, {z:.6g})",
        f"  cost (6)     {float(s.cost):.6g}",
        *_proofs(result),
        f"  {result.status.advice}",
    ]
    return "\n".join(rows)


def _proofs(result: Registration) -> list[str]:
    """One line for each thing that is proved, and none for what is not."""
    s, known = result.solution, result.problem.scale is not None
    votes = "each axis of the translation" if known else "scale and each axis of the translation"
    most, found = int(s.clique_upper_bound), int(result.inliers.sum())
    where = "" if known else ", at the voted scale"
    lines = [
        f"votes: {votes}, global optimum of its own problem",
        f"matches: no pose explains more than {most}{where}; this one explains {found}",
    ]
    if "certificate" in vars(result):
        lines.append(f"rotation: {said(result.certificate)}")
    return [f"  {'proved' if i == 0 else '':<13}{line}" for i, line in enumerate(lines)]


def said(certificate: Certificate) -> str:
    """What a certificate proves, in one line."""
    c, status = certificate, CertificateStatus(int(certificate.status))
    measured = int(c.measurements)
    if not c.is_optimal:
        better = f", could be improved by {float(c.suboptimality):.2%} at most" if c.lower_bound > 0 else ""
        return f"not proved optimal ({status.name}{better})"
    how = CertifiedBy(int(c.method)).name.lower().replace("_", " ")
    gap = f"optimal within {float(c.suboptimality):.2%} of its cost"
    return f"{gap}{' and unique' if c.is_unique else ''}, given {measured} measurements ({how})"
