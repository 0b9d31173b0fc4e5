"""Raw IMU samples -> preintegrated intervals between keyframes, all intervals at once.

A sample is the mean rate and force over its period, so a measurement time inside a period splits it
into two pieces with the same rate and force. Over one piece the rotating force is integrated in
closed form, which is the exponential of the Galilean group Gal(3) (Kelly 2023; in GTSAM the
``...MeasurementsG`` kind): no first-order "force at the start of the sample" error.

With pieces k = 0..L-1 of length dt, bias-free rate w and force f, phi = w dt::

    R_0 = I           R_{k+1} = R_k Exp(phi)
    V_0 = 0           V_{k+1} = V_k + R_k Gamma1(phi) f dt
    P_0 = 0           P_{k+1} = P_k + V_k dt + R_k Gamma2(phi) f dt^2
    A_0 = 0           A_{k+1} = A_k - (R_k + R_{k+1})/2 dt       d(rotation, start frame) / d(gyro bias)

Everything else is a sum over pieces (Forster, Carlone, Dellaert, Scaramuzza, "On-manifold
preintegration", 2017, eq. 35-44 and appendix B, written as sums instead of recursions). An angle error
at time t, seen in the start frame, turns what is still to come: with a = V_T - V(t) and
b = P_T - P(t) - V(t) (T - t) it moves V_T by -[a]x and P_T by -[b]x of itself. So white rate noise of
density s^2, isotropic and therefore the same in every frame, leaves

    Q_phi,phi = s^2 sum dt I        Q_phi,v = s^2 sum dt [a]x         Q_phi,p = s^2 sum dt [b]x
    Q_v,v = s^2 sum dt (a.a I - a a^T)   Q_v,p = s^2 sum dt (a.b I - b a^T)   Q_p,p = ...

and no 15 x 15 matrix is ever propagated from sample to sample. That, and handling every interval in the
same array operation, is why this is not done with GTSAM's classes, one call per sample: the numbers are the
same (the tests compare them) in a fraction of the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.running import sum_running
from graphnav.imu.interval_noise import (
    compute_directed_covariance,
    compute_walk_covariances,
    compute_white_covariance,
    compute_white_variances,
    take_last,
)
from graphnav.imu.samples import MANY, Samples, cut_pieces, group_intervals
from graphnav.recording import Imu

NOISE_FIGURES = ("gyro_noise_density", "accel_noise_density", "gyro_bias_walk", "accel_bias_walk")
_CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
_FEW_INTERVALS = 16  # number of intervals below which calls cost more than arithmetic
_CELL = 4  # Jacobians and noise of intervals of `MANY` pieces are summed over cells of this many pieces; means are not


@dataclass(frozen=True)
class Intervals:
    """n preintegrated intervals, in the start frame unless noted otherwise.

    `covariance` is of (theta, p, v, ba, bg): theta a right perturbation of dR, p and v in body axes at the interval's
    start, biases at its end.
    """

    t0: Array  # (n,) s
    t1: Array  # (n,)
    dR: Array  # (n, 3, 3)
    dV: Array  # (n, 3) m/s
    dP: Array  # (n, 3) m
    theta_bg: Array  # (n, 3, 3) d theta / d bg, s
    v_ba: Array  # (n, 3, 3) s
    v_bg: Array  # (n, 3, 3) m
    p_ba: Array  # (n, 3, 3) s^2
    p_bg: Array  # (n, 3, 3) m s
    ba: Array  # (n, 3) the biases used for them
    bg: Array  # (n, 3)
    rate: Array  # (n, 3) mean rate and force measured, minus those biases
    force: Array  # (n, 3)
    rate_noise: Array  # (n, 3) their noise, as far as it is known: zero until the states are
    force_noise: Array  # (n, 3)
    covariance: Array  # (n, 15, 15)
    parts: Array  # (n, 4, 15, 15) contributions of each of `NOISE_FIGURES`; (n, 0, 15, 15) unless asked for
    factors: Array  # (n, 4) of the parts in the covariance
    past_turn: (
        Array  # (n, 3, 3) means over the interval, s before its end: C(s) from the axes at its end to those at s,
    )
    past_late: Array  # (n, 3, 3) s C(s), s
    past_dV: Array  # (n, 3) C(s) times the force integrated from s to the end (in the axes there), m/s
    past_ba: Array  # (n, 3, 3) and its derivative by ba, s

    def __len__(self) -> int:
        return len(self.t0)

    def __getitem__(self, index: slice | Array) -> Intervals:
        return Intervals(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @property
    def T(self) -> Array:
        """Durations, s."""
        return self.t1 - self.t0

    @property
    def inputs(self) -> tuple[Array, Array]:
        """Mean force and rate (n, 3) that scale errors multiply."""
        return self.force - self.force_noise, self.rate - self.rate_noise

    def with_input_noise(self, residual: Array) -> Intervals:
        """The intervals with the noise of mean rate and force that a residual (n, 15) of the IMU factor shows.

        It is the bias that would explain the residual.
        """
        rate, force = (
            np.linalg.solve(by, residual[:, at, None])[..., 0]
            for by, at in ((self.theta_bg, slice(0, 3)), (self.v_ba, slice(6, 9)))
        )
        return replace(self, rate_noise=rate, force_noise=force)

    def with_noise(self, factors: Array) -> Intervals:
        """The intervals with the variances of `NOISE_FIGURES` multiplied by factors (4,) or (n, 4); needs `parts`."""
        more = ((factors - 1.0) * self.factors)[:, None] @ self.parts.reshape(*self.parts.shape[:2], -1)
        covariance = self.covariance + more.reshape(self.covariance.shape)
        return replace(self, covariance=covariance, factors=factors * self.factors)

    def without_parts(self) -> Intervals:
        """The intervals without the contributions of each noise figure, to save memory."""
        n, _, *size = self.parts.shape
        return replace(self, parts=np.empty((n, 0, *size)))

    def is_out_of_range(self, bg: Array, which: slice = slice(None), angle: float = 1e-3) -> Array:
        """(n,) whether the gyro bias of some intervals moved beyond the range of the first-order correction.

        The neglected second-order term turns the force by angle^2/2: 5e-6 m/s at 1e-3 rad over 1 s.
        """
        return np.linalg.norm(bg - self.bg[which], axis=-1) * self.T[which] > angle


def preintegrate(samples: Samples, imu: Imu, t: Array, ba: Array, bg: Array, parts_of_noise: bool = False) -> Intervals:
    """Preintegrate all intervals between consecutive keyframe times.

    Parameters
    ----------
    samples : from `bridge_gaps`.
    imu : the sensor, for its noise figures.
    t : (K,) keyframe times, strictly increasing, inside the samples.
    ba, bg : (3,) or (K-1, 3) biases to integrate with, m/s^2 and rad/s.
    parts_of_noise : keep what each noise figure contributes to the covariances.
    """
    n = len(t) - 1
    ba, bg = np.broadcast_to(ba, (n, 3)), np.broadcast_to(bg, (n, 3))
    pieces = cut_pieces(samples, t)
    out: dict[str, Array] = {}
    for rows in group_intervals(pieces.count):
        dt, index = pieces.pad(rows)
        part = _integrate(samples, imu, t, rows, dt, index, ba[rows], bg[rows], parts_of_noise)
        if n == 1:
            return part
        for name, x in vars(part).items():
            if name not in out:
                out[name] = np.empty((n, *x.shape[1:]))
            out[name][rows] = x
    return Intervals(**out)


def list_unknown(t: Array, known: Mapping[float, Intervals]) -> list[int]:
    """The intervals between keyframes t that are not in `known`, by their end times."""
    return [k for k, end in enumerate(t[1:].tolist()) if end not in known or known[end].t0[0] != t[k]]


def preintegrate_unknown(
    samples: Samples,
    imu: Imu,
    t: Array,
    ba: Array,
    bg: Array,
    known: Mapping[float, Intervals],
    parts_of_noise: bool = False,
) -> Intervals:
    """`preintegrate`, except for intervals that are in `known` already, by their end times."""
    missing = list_unknown(t, known)
    if len(missing) == len(t) - 1:
        return preintegrate(samples, imu, t, ba, bg, parts_of_noise)
    parts = {k: known[float(t[k + 1])] for k in range(len(t) - 1) if k not in missing}
    for run in np.split(np.array(missing, dtype=int), np.flatnonzero(np.diff(missing) > 1) + 1):
        if len(run):
            new = preintegrate(samples, imu, t[run[0] : run[-1] + 2], ba, bg, parts_of_noise)
            parts |= {int(k): new[i : i + 1] for i, k in enumerate(run)}
    names = Intervals.__dataclass_fields__
    ordered = [parts[k] for k in range(len(t) - 1)]
    return Intervals(*(np.concatenate([getattr(part, name) for part in ordered]) for name in names))


def integrate_prefix(samples: Samples, t0: float, t: Array, ba: Array, bg: Array) -> tuple[Array, Array, Array]:
    """dR (M, 3, 3), dV (M, 3), dP (M, 3) from one keyframe to each of the ascending times t > t0 after it."""
    return integrate_within(samples, np.array([t0, t[-1]]), t, ba[None], bg[None])


def integrate_within(samples: Samples, keyframes: Array, t: Array, ba: Array, bg: Array) -> tuple[Array, Array, Array]:
    """dR (M, 3, 3), dV (M, 3), dP (M, 3) from the keyframe before (never at) each of the times t to that time.

    `ba`, `bg` are (K-1, 3), the biases of each interval; t (M,) ascending, after the first keyframe and not
    after the last.
    """
    pieces = cut_pieces(samples, keyframes, t)
    edge = np.searchsorted(pieces.edges, t)
    interval = np.searchsorted(keyframes, t, side="left") - 1
    dR, dV, dP = np.empty((len(t), 3, 3)), np.empty((len(t), 3)), np.empty((len(t), 3))
    for rows in group_intervals(pieces.count):
        dt, index = pieces.pad(rows)
        R, V, P = _integrate_pieces(_unbias(samples.gyro, index, bg[rows]), _unbias(samples.accel, index, ba[rows]), dt)
        place = np.full(len(pieces.count), -1)
        place[rows] = np.arange(len(rows))
        here = np.flatnonzero(place[interval] >= 0)
        row, column = place[interval[here]], edge[here] - pieces.first[interval[here]]
        dR[here], dV[here], dP[here] = R[column, :, :, row], V[column, :, row], P[column, :, row]
    return dR, dV, dP


def _unbias(x: Array, index: Array, bias: Array) -> Array:
    """(L, 3, n) samples of (L, n) pieces minus the bias (n, 3) of each interval.

    Pieces along the first axis and intervals along the last, here and below: every operation then runs over contiguous
    numbers.
    """
    return np.ascontiguousarray(np.swapaxes(x.take(index, axis=0), 1, 2)) - bias.T


def _multiply_cross(a: Array, b: Array) -> Array:
    """[a]x b for vectors a (L, 3, n) and vectors or matrices b (L, 3, n) or (L, 3, 3, n)."""
    a = a if b.ndim == 3 else a[:, :, None]
    out = np.empty_like(b)
    for i, j, k in _CYCLES:
        np.multiply(a[:, j], b[:, k], out=out[:, i])
        out[:, i] -= a[:, k] * b[:, j]
    return out


def _multiply(R: Array, x: Array) -> Array:
    """Matrix times vector, (L, 3, 3, n) and (L, 3, n)."""
    return R[:, :, 0] * x[:, None, 0] + R[:, :, 1] * x[:, None, 1] + R[:, :, 2] * x[:, None, 2]


def _integrate_pieces(w: Array, f: Array, dt: Array) -> tuple[Array, Array, Array]:
    """R (L+1, 3, 3, n), V, P (L+1, 3, n) (start frame) at the edges of (L, n) pieces."""
    L, n = dt.shape
    h = dt[:, None]
    phi = w * h
    x2 = phi[:, 0] * phi[:, 0] + phi[:, 1] * phi[:, 1] + phi[:, 2] * phi[:, 2]
    a, b, c, d = (x[:, None] for x in rotation.compute_coefficients(x2))
    turn = np.empty((L, n, 3, 3))
    step = turn.transpose(0, 2, 3, 1)
    np.multiply((b * phi)[:, :, None], phi[:, None], out=step)
    cosine, sine = 1.0 - b[:, 0] * x2, a * phi
    for i, j, k in _CYCLES:
        step[:, i, i] += cosine
        step[:, j, i] += sine[:, k]
        step[:, i, j] -= sine[:, k]
    R = np.ascontiguousarray(multiply_up(turn).transpose(0, 2, 3, 1))
    one = _multiply_cross(phi, f)
    two = _multiply_cross(phi, one)
    V = sum_running(_multiply(R[:-1], (f + b * one + c * two) * h))
    P = sum_running(V[:-1] * h + _multiply(R[:-1], (0.5 * f + c * one + d * two) * (h * h)))
    return R, V, P


def multiply_up(turn: Array) -> Array:
    """Running products of rotations (L, n, 3, 3) along the first axis, from the identity: one more than there are
    factors.
    """
    L, n = turn.shape[:2]
    out = np.empty((L + 1, n, 3, 3))
    out[0] = np.eye(3)
    size = 1 if n > _FEW_INTERVALS else max(1, math.isqrt(L))
    blocks = L // size
    # for few intervals the calls dominate: products within runs of pieces side by side, then across the runs
    if size > 1:
        within = turn[: blocks * size].reshape(blocks, size, n, 3, 3).copy()
        for k in range(1, size):
            np.matmul(within[:, k - 1], within[:, k], out=within[:, k])
        whole = out[1 : blocks * size + 1].reshape(blocks, size, n, 3, 3)
        whole[0] = within[0]
        for k in range(1, blocks):
            np.matmul(whole[k - 1, -1], within[k], out=whole[k])
    for k in range(blocks * size if size > 1 else 0, L):
        np.matmul(out[k], turn[k], out=out[k + 1])
    return out


def _integrate(
    samples: Samples,
    imu: Imu,
    t: Array,
    rows: Array,
    dt: Array,
    index: Array,
    ba: Array,
    bg: Array,
    parts_of_noise: bool = False,
) -> Intervals:
    L, n = dt.shape
    w, f = _unbias(samples.gyro, index, bg), _unbias(samples.accel, index, ba)
    R, V, P = _integrate_pieces(w, f, dt)
    T = dt.sum(0)
    A = sum_running((-0.5 * dt)[:, None, None] * (R[:-1] + R[1:]))
    # the rest in cells of a few pieces, within which A is linear
    cut = np.append(np.arange(0, L, _CELL if L >= MANY else 1), L)
    A, R, V, P = A[cut], R[cut], V[cut], P[cut]
    edge = sum_running(dt)[cut]
    (qg, along_gyro), (qa, along_accel) = (
        compute_white_variances(density, extra, dt, index, edge, cut)
        for density, extra in (
            (imu.noise.gyro_noise_density, samples.extra_gyro),
            (imu.noise.accel_noise_density, samples.extra_accel),
        )
    )
    h = (edge[1:] - edge[:-1])[:, None]
    # dV / d bg = -int [dV]x A, exactly for A linear in a cell: int (t - t_start) dV = h dV - int (V - V_start) dt
    dv = V[1:] - V[:-1]
    gain = P[1:] - P[:-1] - V[:-1] * h
    late = h * dv - gain
    h = h[:, None]
    slope = (A[1:] - A[:-1]) / np.maximum(h, 1e-12)
    B = sum_running(-_multiply_cross(dv, A[:-1]) - _multiply_cross(late, slope))
    PA = sum_running(0.5 * h * (A[:-1] + A[1:]))  # dP / d ba
    # dP / d bg = int B, in a cell B_start h - int [(t_end - t) dV]x A
    PB = sum_running(h * B[:-1] - _multiply_cross(gain, A[:-1] + (h / 3.0) * slope))
    left = T - edge  # time left at each edge
    a_edge = V[-1] - V
    b_edge = P[-1] - P - V * left[:, None]
    walks = compute_walk_covariances(edge, left, A, B, PA, PB, a_edge, b_edge)
    of_gyro, of_accel = imu.noise.gyro_bias_walk**2 * walks[0], imu.noise.accel_bias_walk**2 * walks[1]
    Q = compute_white_covariance(qg, qa, left, a_edge, b_edge) + of_gyro + of_accel
    if len(along_gyro) or len(along_accel):
        Q += compute_directed_covariance(along_gyro, along_accel, R, left, a_edge, b_edge)

    dR, v_ba, v_bg, p_ba, p_bg = (take_last(x) for x in (R, A, B, PA, PB))
    for when in imu.remounted:  # its biases begin anew
        anew = np.flatnonzero((t[rows] < when) & (when <= t[rows + 1]))
        for at, sigma in ((slice(9, 12), imu.noise.accel_bias_sigma), (slice(12, 15), imu.noise.gyro_bias_sigma)):
            Q[anew, at, at] += sigma**2 * np.eye(3)
    turn = np.zeros((n, 15, 15))  # theta from the start frame to a right perturbation of dR
    turn[:, 3:, 3:] = np.eye(12)
    turn[:, :3, :3] = np.swapaxes(dR, -1, -2)
    Q = turn @ Q @ np.swapaxes(turn, -1, -2)
    parts = np.empty((n, 0, 15, 15))
    if parts_of_noise:
        none, each = np.zeros_like(qg), edge[1:] - edge[:-1]
        rate = compute_white_covariance(imu.noise.gyro_noise_density**2 * each, none, left, a_edge, b_edge)
        force = compute_white_covariance(none, imu.noise.accel_noise_density**2 * each, left, a_edge, b_edge)
        parts = turn[:, None] @ np.stack([rate, force, of_gyro, of_accel], 1) @ np.swapaxes(turn, -1, -2)[:, None]
    theta_bg = np.swapaxes(dR, -1, -2) @ v_ba
    mean_rate, mean_force = (np.sum(x * dt[:, None], axis=0).T / T[:, None] for x in (w, f))
    unknown = np.zeros((n, 3))
    return Intervals(
        t[rows], t[rows + 1], dR, take_last(V), take_last(P), theta_bg, v_ba, v_bg, p_ba, p_bg,
        np.array(ba), np.array(bg), mean_rate, mean_force, unknown, unknown, Q, parts, np.ones((n, 4)),
        *_compute_mean_velocity_parts(edge, R, V, A),
    )  # fmt: skip


def _compute_mean_velocity_parts(edge: Array, R: Array, V: Array, A: Array) -> tuple[Array, Array, Array, Array]:
    """Terms of the mean velocity over an interval in the axes at its end; by the trapezoidal rule."""
    T = edge[-1]
    h = edge[1:] - edge[:-1]
    weight = np.zeros_like(edge)
    weight[1:] += h
    weight[:-1] += h
    weight /= 2.0 * T
    back = np.swapaxes(R, 1, 2)  # R(t)^T, (L, 3, 3, n)
    left = np.concatenate([(V[-1] - V)[:, :, None], A[-1] - A], axis=2)  # (L, 3, 4, n)
    left = sum(back[:, :, j, None] * left[:, None, j] for j in range(3))
    turned, late, left = (
        np.moveaxis(np.einsum("ln,lijn->ijn", w, x), -1, 0)
        for w, x in ((weight, back), (weight * (T - edge), back), (weight, left))
    )
    return turned @ take_last(R), late @ take_last(R), left[..., 0], left[..., 1:]
