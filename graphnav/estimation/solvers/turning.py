"""State updates along rotations about the vertical, for problems in which the heading is unobservable.

Without fixes the heading is unobservable: IMU and stances are invariant to a rotation of the whole trajectory about the
vertical at the origin of n. Rows linear in an error state e have this invariance for the tangent only: with a heading
uncertainty of 20 deg a correction distorts what it should only rotate; and of two rows, one linearised at the old point
and one at the new, each is invariant to a different rotation, so that together they create spurious heading information
(Huang, Mourikis, Roumeliotis 2010, "Observability-based rules for designing consistent EKF SLAM estimators"). So e is
applied along the rotation. With u = R_nb^T z the vertical in the body, psi = u . theta, and the remainder of e

    theta' = theta - psi u     p' = dp - psi z x p     v' = dv - psi z x v

a state moves to

    R_nb <- Rz(psi) R_nb Exp(theta')     p <- Rz(psi) (p + p')     v <- Rz(psi) (v + v')

which to first order is `graphnav.core.state.States.plus`. An invariant row depends on theta', p', v' alone, so its old
Jacobian remains valid after any rotation, and two points on the way have the rotation in common. The Earth's rate
breaks the invariance, by less than a rotation of its own size.
"""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array, mv
from graphnav.core.state import BLOCKS, DIM, MOVING, States
from graphnav.estimation.solvers.invariant import turn

_UP = np.array([0.0, 0.0, 1.0])
_Z = rotation.skew(_UP)
_I3 = np.eye(3)


def split_turn(states: States, e: Array) -> tuple[Array, Array]:
    """Split an error state into a rotation about the vertical and the remainder.

    Parameters
    ----------
    states : K states.
    e : (K, 15) or more columns.

    Returns
    -------
    psi : (K,) rad, counter-clockwise seen from above.
    left : (K, 9) theta' (rad, body), p' (m) and v' (m/s) in n.
    """
    u = states.R_nb[:, 2]
    psi = np.sum(u * e[:, :3], axis=1)
    turned = np.concatenate([u, states.p @ _Z.T, states.v @ _Z.T], axis=1)
    return psi, e[:, :MOVING] - psi[:, None] * turned


def add_turning(states: States, e: Array) -> States:
    """K states moved by error states (K, 15) along the turns about the vertical."""
    psi, left = split_turn(states, e)
    Rz = rotation.exp(psi[:, None] * _UP)
    return States(
        Rz @ states.R_nb @ rotation.exp(left[:, :3]),
        mv(Rz, states.p + left[:, 3:6]),
        mv(Rz, states.v + left[:, 6:9]),
        states.ba + e[:, 9:12],
        states.bg + e[:, 12:DIM],
    )


def change_of_point(states: States, e: Array) -> Array:
    """Transformation of error states about a moved point into error states about the old point.

    Moved from there by e + T x, a state is where x moves it from the new point, to first order in x.

    Parameters
    ----------
    states : K states, the old points.
    e : (K, 15) what `add_turning` moves them by.

    Returns
    -------
    (K, 9, 9) T over theta, p and v; of the rest nothing changes.
    """
    psi, left = split_turn(states, e)
    u, tilt = states.R_nb[:, 2], left[:, :3]
    # Exp(tilt) Exp(x) = Rz in the body by w . x, and Exp(tilt + what x adds at right angles to u)
    J = rotation.right_jacobian_inverse(tilt)
    after = mv(np.swapaxes(rotation.exp(tilt), -1, -2), u)  # the vertical in the body there
    w = np.einsum("ki,kij->kj", u, J)
    w /= np.sum(w * after, axis=1)[:, None]
    T, back = np.zeros((len(e), MOVING, MOVING)), rotation.exp(-psi[:, None] * _UP)
    T[:, :3, :3] = u[:, :, None] * w[:, None] + J @ (_I3 - after[:, :, None] * w[:, None])
    for at in (slice(3, 6), slice(6, 9)):
        T[:, at, :3] = -(left[:, at] @ _Z.T)[:, :, None] * w[:, None]
        T[:, at, at] = back
    return T


def turn_covariance(P: Array, states: States, e: Array) -> Array:
    """Covariances (K, 15, 15) of errors about points turned into those about the points moved by e (K, 15)."""
    return np.asarray(turn(P.copy(), np.linalg.inv(change_of_point(states, e))))


def add_curvature(P: Array, states: States) -> Array:
    """Covariances (K, 15, 15) of K states with what an unknown heading makes of positions to second order.

    What a heading that is off by psi turns moves on a circle, and not on its tangent: inward by psi/2 times as far. To
    first order the part of a position that psi moves is off by psi c / var(psi), with c the covariance of both, so
    inward of that the mean square is (3/4) m m^T, of m = c turned by a quarter (E psi^4 = 3 var(psi)^2). Where fixes
    bound the position, c is nearly zero.
    """
    theta, p = BLOCKS["theta"], BLOCKS["p"]
    m = np.einsum("kij,kj->ki", P[:, p, theta], states.R_nb[:, 2]) @ _Z.T
    out = P.copy()
    out[:, p, p] += 0.75 * m[:, :, None] * m[:, None, :]
    return out
