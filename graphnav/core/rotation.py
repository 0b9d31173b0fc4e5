"""SO(3) for whole arrays: every function takes leading axes of any shape.

Rotation matrices are ``(..., 3, 3)``, rotation vectors ``(..., 3)`` in radians. ``R_nb`` turns body
coordinates into navigation coordinates: ``v_n = R_nb @ v_b``. Perturbations act on the right:
``R <- R Exp(theta)``. Closed forms as in Sola, Deray, Atchuthan, "A micro Lie theory for state
estimation in robotics" (2018), eq. 132-147.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_I3 = np.eye(3)
_GENERATORS = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float
)
# coefficients of (x^2)^j, j = 0..4, of sin(x)/x, (1 - cos x)/x^2 and the two that follow: (-1)^j / (2j + 1 + k)!
_TAYLOR = np.array([[(-1.0) ** j / math.factorial(2 * j + 1 + k) for k in range(4)] for j in range(5)])
# of ww, xx, yy, zz, wx, wy, wz, xy, xz, yz: the products of each component with w, x, y, z
_WITH = np.array([[0, 4, 5, 6], [4, 1, 7, 8], [5, 7, 2, 9], [6, 8, 9, 3]])
_LEAST_COSINE = 1e-16  # of a pitch
_TINY = 1e-300  # makes sin(x)/x = 1 at x = 0 without a separate case


def skew(v: Array) -> Array:
    """Cross-product matrix: ``skew(a) @ b == cross(a, b)``; (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    if v.size == 3:  # fast path for the single vectors of a filter, where general array code is mostly overhead
        x, y, z = v.ravel().tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).reshape(*v.shape, 3)
    return (v @ _GENERATORS).reshape(*v.shape, 3)


def stack_columns(*parts: Array) -> Array:
    """``np.stack(parts, axis=-1)``, several times faster for few rows."""
    out = np.empty((*np.shape(parts[0]), len(parts)))
    for k, part in enumerate(parts):
        out[..., k] = part
    return out


def mv(M: Array, v: Array) -> Array:
    """Matrix times vector along the leading axes: (..., m, k), (..., k) -> (..., m)."""
    return (M @ v[..., None])[..., 0]


def move_components_first(M: Array) -> Array:
    """Matrices or vectors (n, ...) as (..., n), so that operations on a component run over contiguous numbers."""
    return np.ascontiguousarray(np.moveaxis(M, 0, -1))


def compute_coefficients(theta2: Array) -> tuple[Array, Array, Array, Array]:
    """sin(x)/x, (1 - cos x)/x^2, (x - sin x)/x^3 and (1/2 - (1 - cos x)/x^2)/x^2 for x^2 = theta2.

    The first four coefficients of the series that Exp, its Jacobians and integrals are made of; below
    0.1 rad by their Taylor series (error < 1e-13), because the quotients lose digits there.
    """
    x2 = np.asarray(theta2, dtype=float)
    power = np.multiply.outer(_TAYLOR[4], x2)
    for term in (_TAYLOR[3], _TAYLOR[2], _TAYLOR[1]):  # Horner, all four at once
        power += term.reshape(-1, *(1,) * x2.ndim)
        power *= x2
    power += _TAYLOR[0].reshape(-1, *(1,) * x2.ndim)
    a, b, c, d = power
    large = x2 > 1e-2
    if np.any(large):
        y2 = np.where(large, x2, 1.0)
        y = np.sqrt(y2)
        s, q = np.sin(y) / y, 2.0 * (np.sin(0.5 * y) / y) ** 2
        a, b = np.where(large, s, a), np.where(large, q, b)
        c, d = np.where(large, (1.0 - s) / y2, c), np.where(large, (0.5 - q) / y2, d)
    return a, b, c, d


def _evaluate_polynomial(v: Array, first: Array, second: Array) -> Array:
    """I + first [v]x + second [v]x^2."""
    S = skew(v)
    return _I3 + first[..., None, None] * S + second[..., None, None] * (S @ S)


def _evaluate_polynomial_one(x: float, y: float, z: float, a: float, b: float) -> Array:
    """`_evaluate_polynomial` of a single vector: (3, 3)."""
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [1.0 - b * (y * y + z * z), xy - a * z, xz + a * y],
            [xy + a * z, 1.0 - b * (x * x + z * z), yz - a * x],
            [xz - a * y, yz + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def exp(v: Array) -> Array:
    """Exp of rotation vectors: (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    if v.size == 3:
        return _exp_one(*v.ravel().tolist()).reshape(*v.shape, 3)
    x = np.sqrt(np.sum(v * v, axis=-1) + _TINY)
    half = np.sin(0.5 * x) / x
    return _evaluate_polynomial(v, np.sin(x) / x, 2.0 * half * half)


def _exp_one(x: float, y: float, z: float) -> Array:
    """`exp` of a single vector."""
    n = math.sqrt(x * x + y * y + z * z + _TINY)
    half = math.sin(0.5 * n) / n
    return _evaluate_polynomial_one(x, y, z, math.sin(n) / n, 2.0 * half * half)


def log(R: Array) -> Array:
    """Rotation vectors in [0, pi] of rotation matrices: (..., 3, 3) -> (..., 3)."""
    R = np.asarray(R, dtype=float)
    if R.size == 9 and (one := _log_one(*R.ravel().tolist())) is not None:
        return one.reshape(R.shape[:-1])
    w = 0.5 * stack_columns(R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1])
    c = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    s = np.sqrt(np.sum(w * w, axis=-1) + _TINY)
    v = w * (np.arctan2(s, c) / s)[..., None]
    if np.min(c, initial=1.0) < -0.5:  # towards pi the antisymmetric part vanishes; the quaternion does not
        q = to_quaternion(R)
        n = np.linalg.norm(q[..., 1:], axis=-1)
        far = q[..., 1:] * (2.0 * np.arctan2(n, q[..., 0]) / np.maximum(n, 1e-9))[..., None]
        v = np.where((c < -0.5)[..., None], far, v)
    return v


def _log_one(
    xx: float, xy: float, xz: float, yx: float, yy: float, yz: float, zx: float, zy: float, zz: float
) -> Array | None:
    """`log` of a single matrix; None towards pi."""
    c = 0.5 * (xx + yy + zz - 1.0)
    if not c >= -0.5:
        return None
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    s = math.sqrt(x * x + y * y + z * z + _TINY)
    a = math.atan2(s, c) / s
    return np.array([x * a, y * a, z * a])


def right_jacobian(v: Array) -> Array:
    """Jr with Exp(v + d) = Exp(v) Exp(Jr d) to first order; (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    _, b, c, _ = compute_coefficients(np.sum(v * v, axis=-1))
    return _evaluate_polynomial(v, -b, c)


def right_jacobian_inverse(v: Array) -> Array:
    """Inverse of `right_jacobian`; singular at 2 pi, which `log` never returns."""
    v = np.asarray(v, dtype=float)
    if v.size == 3:
        return _right_jacobian_inverse_one(*v.ravel().tolist()).reshape(*v.shape, 3)
    theta2 = np.sum(v * v, axis=-1)
    a, b, _, _ = compute_coefficients(theta2)
    small = theta2 < 1e-4
    second = np.where(small, 1.0 / 12.0 + theta2 / 720.0, (1.0 - 0.5 * a / b) / np.where(small, 1.0, theta2))
    return _evaluate_polynomial(v, np.full_like(theta2, 0.5), second)


def _right_jacobian_inverse_one(x: float, y: float, z: float) -> Array:
    """`right_jacobian_inverse` of a single vector."""
    n2 = x * x + y * y + z * z
    if n2 < 1e-4:
        return _evaluate_polynomial_one(x, y, z, 0.5, 1.0 / 12.0 + n2 / 720.0)
    n = math.sqrt(n2)
    return _evaluate_polynomial_one(x, y, z, 0.5, (1.0 - 0.5 * n / math.tan(0.5 * n)) / n2)


def to_quaternion(R: Array) -> Array:
    """Unit quaternions (w, x, y, z) with w >= 0: (..., 3, 3) -> (..., 4)."""
    R = np.asarray(R, dtype=float)
    x, y, z = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    trace = x + y + z
    products = stack_columns(  # of components, four times
        1 + trace, 1 + 2 * x - trace, 1 + 2 * y - trace, 1 + 2 * z - trace,
        R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1],
        R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1],
    )  # fmt: skip
    # those with the largest component, so that no quotient is small
    q = np.take_along_axis(products, _WITH[np.argmax(products[..., :4], -1)], -1)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def from_quaternion(q: Array) -> Array:
    """Rotation matrices of quaternions (w, x, y, z), normalised first: (..., 4) -> (..., 3, 3)."""
    q = np.asarray(q, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    S = skew(q[..., 1:])
    return np.eye(3) + 2.0 * q[..., 0, None, None] * S + 2.0 * (S @ S)


def from_rph(rph: Array) -> Array:
    """R_nb (ENU from RFU) of (roll, pitch, heading) in radians: (..., 3) -> (..., 3, 3).

    Roll right side down, pitch nose up, heading clockwise from north; applied heading, pitch, roll.
    """
    roll, pitch, heading = np.moveaxis(np.asarray(rph, dtype=float), -1, 0)
    sr, cr, sp, cp, sh, ch = (
        np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch), np.sin(heading), np.cos(heading)
    )  # fmt: skip
    rows = [
        [ch * cr + sh * sp * sr, sh * cp, ch * sr - sh * sp * cr],
        [-sh * cr + ch * sp * sr, ch * cp, -sh * sr - ch * sp * cr],
        [-cp * sr, sp, cp * cr],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def to_rph(R_nb: Array) -> Array:
    """(roll, pitch, heading) in radians, heading in [0, 2 pi): inverse of `from_rph`."""
    R = np.asarray(R_nb, dtype=float)
    roll = np.arctan2(-R[..., 2, 0], R[..., 2, 2])
    pitch = np.arctan2(R[..., 2, 1], np.hypot(R[..., 2, 0], R[..., 2, 2]))
    heading = np.mod(np.arctan2(R[..., 0, 1], R[..., 1, 1]), 2 * np.pi)
    return np.stack([roll, pitch, heading], -1)


def rph_jacobian(rph: Array) -> Array:
    """d(roll, pitch, heading) / d(theta) for R_nb <- R_nb Exp(theta): (..., 3) -> (..., 3, 3).

    Grows as 1/cos(pitch), as Euler angles do.
    """
    roll, pitch, _ = np.moveaxis(np.asarray(rph, dtype=float), -1, 0)
    rows = _list_rph_jacobian(np.sin(roll), np.cos(roll), np.tan(pitch), np.cos(pitch))
    return np.stack([np.stack(r, -1) for r in rows], -2)


def _list_rph_jacobian(sr: Array, cr: Array, tp: Array, cp: Array) -> list[list[Array]]:
    """The rows of `rph_jacobian`, by sine and cosine of roll, tangent and cosine of pitch."""
    zero = np.zeros_like(sr)
    return [[sr * tp, zero + 1.0, -cr * tp], [cr, zero, sr], [sr / cp, zero, -cr / cp]]


def find_rph(R_nb: Array, R_ln: Array) -> tuple[Array, Array]:
    """`to_rph` of R_ln R_nb, (n, 3), and `rph_jacobian` there, (3, 3, n); of `move_components_first` (3, 3, n)."""
    x, y, z = np.einsum("in,ijn->jn", R_ln[2], R_nb)
    cp = np.maximum(np.hypot(x, z), _LEAST_COSINE)
    heading = np.arctan2(*(np.einsum("in,in->n", R_ln[i], R_nb[:, 1]) for i in (0, 1)))
    J: Array = np.array(_list_rph_jacobian(-x / cp, z / cp, y / cp, cp))
    return stack_columns(np.arctan2(-x, z), np.arctan2(y, cp), np.mod(heading, 2 * np.pi)), J


def wrap(angle: Array) -> Array:
    """Angles into [-pi, pi)."""
    return np.mod(np.asarray(angle, dtype=float) + np.pi, 2 * np.pi) - np.pi
