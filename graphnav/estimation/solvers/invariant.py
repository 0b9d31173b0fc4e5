"""Errors of attitude and velocity that are invariant to changes of the filter's estimate.

The heading of a vehicle is observable only through its motion: at rest, and for all measurements in body axes, a state
rotated about the vertical fits equally well. As an error state of `graphnav.core.state.States.plus`, a rotation by psi
is theta = psi R_nb^T z and dv = psi z x v, which depends on the estimate. So a filter that moves its estimate and keeps
its covariance mistakes an unknown heading for another error, say a tilt, which gravity determines, and ends certain of
a heading that was never measured (Huang, Mourikis, Roumeliotis 2010, "Observability-based rules for designing
consistent EKF SLAM estimators").

With the errors of attitude and velocity in n, rotated together (Barrau, Bonnabel 2017, "The invariant extended Kalman
filter as a stable observer"),

    phi = R_nb theta     nu = dv - phi x v

a rotation is phi = psi z and nu = 0 at every estimate, the velocity in the body is linear in nu, and a state moves to

    R_nb <- Exp(phi) R_nb     v <- Exp(phi) (v + nu)     p <- p + dp

The position is not rotated: fixes determine it. To first order this is `States.plus`, so the Jacobians of rows and
steps stay; only the motion of states and covariances differs.
"""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array, mv
from graphnav.core.state import BLOCKS, MOVING, States

_THETA, _VELOCITY = BLOCKS["theta"], BLOCKS["v"]
_I9 = np.eye(MOVING)


def add_invariant(states: States, e: Array) -> States:
    """K states moved by error states (K, 15)."""
    phi, dv = mv(states.R_nb, e[:, _THETA]), e[:, _VELOCITY]
    exp_phi = rotation.exp(phi)
    return States(
        exp_phi @ states.R_nb,
        states.p + e[:, BLOCKS["p"]],
        mv(exp_phi, states.v + dv - mv(rotation.skew(phi), states.v)),
        states.ba + e[:, BLOCKS["ba"]],
        states.bg + e[:, BLOCKS["bg"]],
    )


def subtract_invariant(states: States, other: States) -> Array:
    """The error states (K, 15) with ``plus_invariant(other, e) == states``."""
    theta = rotation.log(np.swapaxes(other.R_nb, -1, -2) @ states.R_nb)
    phi = mv(other.R_nb, theta)
    dv = mv(rotation.exp(-phi), states.v) - other.v + mv(rotation.skew(phi), other.v)
    return np.concatenate([theta, states.p - other.p, dv, states.ba - other.ba, states.bg - other.bg], axis=-1)


@compile_once
def turn(P: Array, T: Array) -> Array:
    """Turn, in place, covariances P (K, D, D) of errors of which the first m are now T (K, m, m) times what they were.

    T is what a move of the point that errors are about makes of them, by how they move it: with `States.plus` a right
    Jacobian (`graphnav.estimation.solvers.points`), in the filter, whose errors turn together, that of
    `compute_transport`, and along turns about the vertical that of
    `graphnav.estimation.solvers.turning`.

    Returns
    -------
    array
        P.
    """
    m = T.shape[1]
    for k in range(len(P)):
        own = P[k]
        top = np.dot(T[k], own[:m])
        np.positive(np.dot(np.ascontiguousarray(top[:, :m]), T[k].T), own[:m, :m])
        np.positive(top[:, m:], own[:m, m:])
        np.positive(top[:, m:].T, own[m:, :m])
    return P


def transport_covariance(P: Array, states: States, moved: States) -> Array:
    """Covariances (K, D, D) of errors about K states turned into those about the states they have moved to."""
    return np.asarray(turn(P.copy(), compute_transport(states, moved)))


def compute_transport(states: States, moved: States) -> Array:
    """(K, 9, 9) what the first of errors about K states are about the states they have moved to.

    phi and nu stay: theta' = R_nb'^T R_nb theta, dv' = dv + (R_nb theta) x (v' - v).
    """
    T = np.zeros((len(states), MOVING, MOVING))
    T[:] = _I9
    T[:, _THETA, _THETA] = np.swapaxes(moved.R_nb, -1, -2) @ states.R_nb
    T[:, _VELOCITY, _THETA] = rotation.skew(states.v - moved.v) @ states.R_nb
    return T
