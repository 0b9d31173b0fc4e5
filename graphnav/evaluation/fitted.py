"""Covariance of the errors that remain after a yaw and an offset have been fitted.

Position and heading of a walk count from its start, where they are certain; a truth in a frame of its own is fitted
over all epochs. The remaining error at an epoch is then not the error e_i whose covariance P_i the estimate states, but

    r_i = e_i - B_i theta,   theta = sum_j G_j e_j        B_i = [I, J a_i],  J a = (-a_y, a_x),  a_i = p_i - mean

(least squares of e_j on an offset and a yaw), with the covariance

    cov r_i = P_i - B_i K_i - K_i' B_i' + B_i S B_i',     K_i = sum_j G_j cov(e_j, e_i),  S = cov theta

At the start P is zero and r is caused by all other errors through the fit; in the middle r is far smaller than e. The
estimate states no covariances between epochs. Here errors of position and heading persist, as in dead reckoning: for j
> i

    e_j = e_i + J (p_j - p_i) psi_i + later contributions, independent of both

which is exact for a filter without fixes, and for a smoother as far as later measurements carry no information about
earlier states. The later contributions are the growth of the stated covariances. Where these shrink, as where a
smoother knows the end of a walk better than its middle, the contribution is set to zero, and the covariance of all
later epochs is larger than stated: a test against it is then lenient, and `propagate_fit` returns by how much.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array

_HEADING = 8  # of position, velocity, roll, pitch, heading
_STATE = (0, 1, 2, _HEADING)


def propagate_fit(cov: Array, p: Array, v: Array | None) -> tuple[Array, float]:
    """Covariances (N, 9, 9) of errors after a yaw and an offset have been fitted over all of the epochs.

    Also how much larger than stated the horizontal sigma had to be taken, rms over the epochs: 1 for dead reckoning.

    Parameters
    ----------
    cov : (N, 9, 9) of position (m), velocity (m/s), roll, pitch, heading (rad), as stated; of one local frame.
    p, v : (N, 3) m, m/s, in that frame.
    """
    n = len(p)
    v = np.zeros((n, 3)) if v is None else np.nan_to_num(v)
    a = p - p.mean(axis=0)
    turned, turned_v = _rotate_quarter(a), _rotate_quarter(v)
    size = float(np.sum(a[:, :2] ** 2))
    G = np.zeros((n, 4, 3))
    G[:, :3] = np.eye(3) / n
    G[:, 3] = turned / size
    B = np.zeros((n, 9, 4))
    B[:, :3, :3], B[:, :3, 3], B[:, 3:6, 3], B[:, _HEADING, 3] = np.eye(3), turned, turned_v, -1.0
    sign = np.array([1.0, 1.0, 1.0, -1.0])  # a yaw is anticlockwise, a heading clockwise
    stated = cov[:, _STATE][:, :, _STATE] * sign[:, None] * sign
    X = _propagate_dead_reckoning(stated, turned)
    cov = cov.copy()
    cov[np.ix_(range(n), _STATE, _STATE)] = X * sign[:, None] * sign
    # epochs from i on: their errors contain its error
    ahead, moved = _sum_from(G), _sum_from(np.einsum("jkl,jl->jk", G, turned))
    moved = moved - np.einsum("ikl,il->ik", ahead, turned)
    K = ahead @ cov[:, :3] - moved[..., None] * cov[:, None, _HEADING]
    # epochs before i: its error contains theirs
    places, yaws = _sum_before(G @ X[:, :3, :3]), _sum_before(np.einsum("jkl,jl->jk", G, X[:, :3, 3]))
    about = _sum_before(np.einsum("jkl,jl,jm->jkm", G, X[:, :3, 3], turned))
    K[:, :, :3] += places + yaws[..., None] * turned[:, None] - about
    K[:, :, 3:6] += yaws[..., None] * turned_v[:, None]
    K[:, :, _HEADING] -= yaws
    S = np.einsum("ikl,iml->km", K[:, :, :3], G)
    BK = B @ K
    rest = np.asarray(cov - BK - np.swapaxes(BK, -1, -2) + B @ S @ np.swapaxes(B, -1, -2))
    horizontal = [np.trace(x[:, :2, :2], axis1=1, axis2=2).sum() for x in (X, stated)]
    return rest, float(np.sqrt(horizontal[0] / horizontal[1])) if horizontal[1] > 0.0 else 1.0


def _propagate_dead_reckoning(X: Array, turned: Array) -> Array:
    """Covariances (N, 4, 4) of position and yaw consistent with dead reckoning, nowhere below the stated ones."""
    out = X.copy()
    F = np.eye(4)
    for k in range(1, len(X)):
        F[:3, 3] = turned[k] - turned[k - 1]
        before = F @ out[k - 1] @ F.T
        # scaled to unit diagonal, so that metres and radians have equal weight
        sd = np.sqrt(np.maximum(np.diagonal(X[k]), 1e-30))
        value, axes = np.linalg.eigh((X[k] - before) / np.outer(sd, sd))
        out[k] = before + (axes * np.maximum(value, 0.0)) @ axes.T * np.outer(sd, sd)
    return out


def _rotate_quarter(x: Array) -> Array:
    """(N, 3) rotated anticlockwise by a quarter turn in the horizontal plane."""
    return np.column_stack([-x[:, 1], x[:, 0], np.zeros(len(x))])


def _sum_from(x: Array) -> Array:
    """Sums of the rows from each row on."""
    return np.asarray(np.cumsum(x[::-1], axis=0)[::-1])


def _sum_before(x: Array) -> Array:
    """Sums of the rows before each row."""
    return np.asarray(np.cumsum(x, axis=0) - x)
