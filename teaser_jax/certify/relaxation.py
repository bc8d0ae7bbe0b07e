"""What the semidefinite relaxation proves: its dual solution is a dual matrix like any other."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertifiedBy
from teaser_jax.certify.dual import Dual, dual_matrix
from teaser_jax.certify.host import framed
from teaser_jax.certify.host_measurements import HostMeasurements, without_padding
from teaser_jax.certify.proof import Attempt, claim_of, lowest_if_unproved, read_off
from teaser_jax.certify.semidefinite import reaches
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.stages.rotation.quadratic_form import Measurements
from teaser_jax.stages.rotation.relaxation import RelaxationReport, report, solve_relaxation


class RelaxedRotation(NamedTuple):
    """The rotation that the relaxation was rounded to, or the one given if that is no worse."""

    rotation: Float[np.ndarray, "3 3"]
    cost: float
    certificate: Certificate
    relaxation: RelaxationReport


def relaxed_rotation(
    measurements: HostMeasurements, rotation: Float[np.ndarray, "3 3"], tolerance: float
) -> RelaxedRotation:
    """Solve the relaxation (23), round it, and turn the dual solution into a certificate.

    Args:
        measurements: Vector pairs; padding is cut off.
        rotation: The best rotation known; the relaxation is written in its frame.
        tolerance: The suboptimality that counts as optimal [-].
    """
    with as_on_the_host():
        m, frame, constant = framed(without_padding(measurements), rotation)
        best = solve_relaxation(m)
        dual = Dual(best.relaxed.skew, best.relaxed.diagonal)
        frame, rounds = np.asarray(frame) @ best.turn, np.int32(best.relaxed.iterations)
        found = _certificate(m, frame, constant, dual, best.turn, np.float64(tolerance), rounds)
        cost = best.cost + float(constant)
        relaxation = report(best.relaxed, best.cost)
        return RelaxedRotation(frame, cost, jax.device_get(found), relaxation)


@jax.jit
def _certificate(
    m: Measurements, frame: Array, constant: Array, dual: Dual, turn: Array, tolerance: Array, rounds: Array
) -> Certificate:
    """Certify the candidate that lies a turn from the one in whose frame the relaxation was written."""
    claim = claim_of(m.turned(turn), constant, tolerance)
    matrix = turned_dual(m, dual, turn @ claim.turn)
    proved = reaches(claim.polished, matrix, claim.shift)
    attempt = Attempt(matrix, proved, rounds, jnp.int32(CertifiedBy.RELAXATION))
    return read_off(frame, claim, attempt, lowest_if_unproved(claim, attempt))


def turned_dual(m: Measurements, dual: Dual, turn: Float[Array, "3 3"]) -> Float[Array, "n4 n4"]:
    """Carry the dual matrix M to the frame of another candidate, which lies a turn from this one.

    Quaternions of the two frames differ by a left factor, so blocks are multiplied by its 4 x 4 matrix on
    both sides, and those of measurements whose inlier label changes take the other sign.
    """
    other = m.turned(turn)
    # The dual of zeros, which leaves Q - mu J.
    nothing = Dual(jnp.zeros_like(dual.skew), jnp.zeros_like(dual.diagonal))
    delta = dual_matrix(m, dual) - dual_matrix(m, nothing)
    u, t = jnp.split(so3.quat_from_rotation(turn), [3])
    left = jnp.block([[t[None] * jnp.eye(3) + so3.hat(u), u[:, None]], [-u[None], t[None]]])
    signs = jnp.where(m.inliers == other.inliers, 1.0, -1.0)
    change = jnp.kron(jnp.diag(jnp.concatenate([jnp.ones(1), signs])), left)
    return dual_matrix(other, nothing) + change.T @ delta @ change
