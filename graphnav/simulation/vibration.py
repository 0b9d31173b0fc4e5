"""Vibration of the sprung body: engine lines, road, idling, suspension, as displacements of the IMU and small turns.

Everything is a displacement with an exact rate, so that force, rate and the true position agree: a line of 3 mg at
12.5 Hz is a movement of 5 micrometres, a passenger's weight one of millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.interpolate import BSpline

from graphnav.core.earth import MG
from graphnav.core.rotation import Array
from graphnav.simulation.motion import HEADING, SPEED, Path
from graphnav.simulation.splines import list_centres, make_spline

RIGHT, FORWARD, UP, PITCH, ROLL = range(5)  # channels: m, m, m, rad, rad
SHAKE_STEP = 0.02  # s between coefficients: movements up to some 15 Hz
SHAKE_DEGREE = 4
_MODULATION_TIME, _MODULATION_DEGREE = 0.1, 3  # s; correlation time of a line's modulation

Part = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Shake:
    """The sum of its parts: movement (n, 5) and its rate (n, 5) at times (n,)."""

    parts: tuple[Part, ...] = ()

    def __call__(self, t: Array) -> tuple[Array, Array]:
        moved, rate = np.zeros((len(t), 5)), np.zeros((len(t), 5))
        for part in self.parts:
            more, faster = part(t)
            moved += more
            rate += faster
        return moved, rate


@dataclass(frozen=True)
class Sampled:
    """A movement given by a spline of five channels."""

    value: BSpline
    rate: BSpline

    def __call__(self, t: Array) -> tuple[Array, Array]:
        return self.value(t), self.rate(t)


def shake_times(path: Path) -> Array:
    """The times (J,) at which `sample_movement` wants its movement."""
    return list_centres(path.start, path.end, SHAKE_STEP, SHAKE_DEGREE)


def sample_movement(path: Path, movement: Array) -> Sampled:
    """A part from the movement (J, 5) at `shake_times`."""
    value = make_spline(path.start, SHAKE_STEP, movement, SHAKE_DEGREE)
    return Sampled(value, value.derivative())


# --------------------------------------------------------------------------------------------------------- engine
@dataclass(frozen=True)
class Idle:
    """IMU readings of an idling engine, for each order: amplitudes of force (right, forward, up) and pitch."""

    accel_mg: tuple[tuple[float, float, float], ...]
    pitch_rate_deg_s: tuple[float, ...]


@dataclass(frozen=True)
class Engine:
    """Lines at multiples of the crankshaft's frequency, which follows the speed through the gears.

    `spans` are (start, end, Idle), s, where the amplitudes differ from `idle`; they change over two seconds.
    """

    idle: Idle
    idle_hz: float = 12.5
    orders: tuple[float, ...] = (1.0, 2.0)
    spans: tuple[tuple[float, float, Idle], ...] = ()
    gears_hz_per_mps: tuple[float, ...] = (9.0, 5.0, 3.3, 2.4, 1.9, 1.5)
    shift_down_hz: float = 22.0  # lowest frequency before changing down
    moving_gain: float = 2.0  # ratio of amplitudes under load to those at idle
    wander_hz: float = 0.0  # 1-sigma of the idling speed's slow changes
    wander_time: float = 5.0  # s

    def compute_frequency(self, speed: Array, wander: Array) -> Array:
        """Crankshaft frequency, Hz, at speeds (K,) on a regular grid of 0.1 s; `wander` is what idling adds."""
        v = np.abs(speed)
        each = v[:, None] * np.array(self.gears_hz_per_mps)
        gear = np.maximum((each > self.shift_down_hz).sum(axis=1) - 1, 0)
        idle = self.idle_hz + wander
        f = np.maximum(each[np.arange(len(v)), gear], idle)
        # the clutch engages over half a second; a standstill is all idle
        f = signal.convolve(np.pad(f, 3, mode="edge"), np.ones(7) / 7.0, mode="valid")
        return np.where(v == 0.0, idle, f)

    def simulate_lines(self, path: Path, rate: float, rng: np.random.Generator) -> Part:
        """The vibration of the engine; `rate` is the IMU's, Hz, whose averaging the stated amplitudes include."""
        t = list_centres(path.start, path.end, _MODULATION_TIME, _MODULATION_DEGREE)
        v = path.compute_speed(t)
        wander = self.wander_hz * draw_gauss_markov(len(t), _MODULATION_TIME / self.wander_time, rng)
        f = self.compute_frequency(v, wander)
        load = 1.0 + (self.moving_gain - 1.0) * v * v / (v * v + 1.0)
        accel, turn = _draw_amplitudes(self.idle, len(t))
        for a, b, idle in self.spans:
            weight = np.clip(0.5 + np.minimum(t - a, b - t) / 2.0, 0.0, 1.0)
            for value, other in zip((accel, turn), _draw_amplitudes(idle, len(t)), strict=True):
                value += weight.reshape(-1, *(1,) * (value.ndim - 1)) * (other - value)
        omega = 2.0 * np.pi * f[:, None] * np.array(self.orders)
        # averaging over a sample attenuates a line; beyond Nyquist an IMU's own low-pass filter leaves little of it
        share = omega / (2.0 * np.pi * rate)
        seen = np.sinc(np.minimum(share, 0.5)) * np.sqrt(1.0 + (2.0 * share) ** 16)
        amplitude = np.zeros((len(t), len(self.orders), 5))
        amplitude[:, :, :3] = accel * (load[:, None] / seen / omega**2)[:, :, None]
        amplitude[:, :, PITCH] = turn * load[:, None] / seen / omega
        # forward and pitch are a quarter turn apart, so that gravity on the pitching does not add to the line
        phases = rng.uniform(0.0, 2.0 * np.pi, (len(self.orders), 5))
        phases[:, PITCH] = phases[:, FORWARD] + 0.5 * np.pi
        phase = make_spline(path.start, _MODULATION_TIME, 2.0 * np.pi * f, _MODULATION_DEGREE)
        size = make_spline(path.start, _MODULATION_TIME, amplitude, _MODULATION_DEGREE)
        return _EngineOrders(phase.antiderivative(), phase, size, size.derivative(), np.array(self.orders), phases)


def _draw_amplitudes(idle: Idle, count: int) -> tuple[Array, Array]:
    accel = np.array(idle.accel_mg) * MG
    turn = np.deg2rad(np.array(idle.pitch_rate_deg_s))
    return np.tile(accel, (count, 1, 1)), np.tile(turn, (count, 1))


@dataclass(frozen=True)
class _EngineOrders:
    """Sum over orders k of A_k(t) sin(k phi(t) + phase_k)."""

    phase: BSpline
    omega: BSpline
    size: BSpline  # (orders, 5)
    size_rate: BSpline
    orders: Array
    phases: Array

    def __call__(self, t: Array) -> tuple[Array, Array]:
        phi, omega = self.phase(t), self.omega(t)
        size, size_rate = self.size(t), self.size_rate(t)
        moved, rate = np.zeros((len(t), 5)), np.zeros((len(t), 5))
        for k, order in enumerate(self.orders):
            s, c = np.sin(order * phi)[:, None], np.cos(order * phi)[:, None]
            sp, cp = np.sin(self.phases[k]), np.cos(self.phases[k])
            sine, cosine = s * cp + c * sp, c * cp - s * sp
            moved += size[:, k] * sine
            rate += size_rate[:, k] * sine + (order * omega)[:, None] * size[:, k] * cosine
        return moved, rate


# ---------------------------------------------------------------------------------------------------- road and idling
@dataclass(frozen=True)
class Mode:
    """A mode of the body: its channel, frequency and damping, and its excitation.

    `size` is the rms of its acceleration, m/s^2 for a displacement and rad/s^2 for a turn.
    """

    channel: int
    hz: float
    damping: float
    size: float


# A car at 14 m/s on asphalt: ride (heave, pitch, roll on the springs) and the wheels' hop through the rubber.
ROAD = (
    Mode(UP, 1.5, 0.3, 0.35), Mode(UP, 9.0, 0.2, 0.25), Mode(FORWARD, 2.5, 0.4, 0.12), Mode(FORWARD, 8.0, 0.3, 0.10),
    Mode(RIGHT, 2.0, 0.4, 0.12), Mode(RIGHT, 8.0, 0.3, 0.10), Mode(PITCH, 1.7, 0.3, 0.12), Mode(ROLL, 1.9, 0.3, 0.15),
)  # fmt: skip
# an idling engine shakes the body on its springs: 0.1 mg peaks near 3 Hz in the spectrum of a quarter of an hour, as in
# table 4 of Li 2024
FLOOR = (
    Mode(UP, 3.4, 0.08, 0.011), Mode(FORWARD, 3.2, 0.12, 0.011), Mode(RIGHT, 3.0, 0.12, 0.010),
    Mode(PITCH, 3.5, 0.15, 8e-4), Mode(ROLL, 3.0, 0.15, 2e-3),
)  # fmt: skip


def simulate_road_noise(path: Path, rng: np.random.Generator, size: float = 1.0, modes: Sequence[Mode] = ROAD) -> Part:
    """Excitation by the road: proportional to the root of the speed, and decreasing faster below walking pace.

    The excitation of a road whose slopes are white grows as sqrt(v) (ISO 8608, w = 2); the tyre's contact patch
    averages over shorter wavelengths, which at 0.2 m/s are all of them.
    """
    v = np.abs(path.compute_speed(shake_times(path)))
    return sample_movement(path, _excite_modes(modes, size * np.sqrt(v / 14.0) * v / (v + 2.0), rng))


def simulate_idle_floor(path: Path, rng: np.random.Generator, size: float = 1.0, modes: Sequence[Mode] = FLOOR) -> Part:
    """The coloured floor below 10 Hz of a body with a running engine."""
    return sample_movement(path, _excite_modes(modes, np.full(len(shake_times(path)), size), rng))


def _excite_modes(modes: Sequence[Mode], envelope: Array, rng: np.random.Generator) -> Array:
    """(J, 5) response of the modes to white noise of changing strength."""
    out = np.zeros((len(envelope), 5))
    for mode in modes:
        b, a = make_oscillator(mode.hz, mode.damping)
        # rms of the second derivative of the filtered unit noise, from its frequency response
        w, h = signal.freqz(b, a, 4096, fs=2.0 * np.pi / SHAKE_STEP)
        unit = np.sqrt(np.mean(np.abs(h * w**2) ** 2))
        out[:, mode.channel] += mode.size / unit * signal.lfilter(b, a, envelope * rng.standard_normal(len(envelope)))
    return out


def make_oscillator(hz: float, damping: float) -> tuple[Array, Array]:
    """A mass on spring and damper as a digital filter at 1 / STEP Hz, with unit static response."""
    w = 2.0 * np.pi * hz
    return signal.bilinear([w * w], [1.0, 2.0 * damping * w, w * w], fs=1.0 / SHAKE_STEP)


def draw_gauss_markov(count: int, step: float, rng: np.random.Generator, columns: int | None = None) -> Array:
    """Unit-variance Gauss-Markov noise, (count,) or (count, columns); `step` is in correlation times."""
    shape = count if columns is None else (count, columns)
    decay = np.exp(-step)
    white = rng.standard_normal(shape) * np.sqrt(1.0 - decay * decay)
    white[0] /= np.sqrt(1.0 - decay * decay)
    return signal.lfilter([1.0], [1.0, -decay], white, axis=0)


# ---------------------------------------------------------------------------------------------------------- springs
@dataclass(frozen=True)
class Springs:
    """Lean of the body on its springs under acceleration, and its oscillation."""

    pitch_per_accel: float = 0.15  # deg per m/s^2, nose up under power
    roll_per_accel: float = 0.35  # deg per m/s^2, outward in bends
    hz: float = 1.4
    damping: float = 0.35
    height: float = 1.2  # m, of the IMU above the axis it leans about

    def lean(self, path: Path) -> Part:
        """Squat, dive and roll, with the displacement of the IMU."""
        t = shake_times(path)
        inside = np.clip(t, path.start, path.end)
        x, dx = path.spline(inside), path.spline.derivative()(inside)
        b, a = make_oscillator(self.hz, self.damping)
        pitch = signal.lfilter(b, a, np.deg2rad(self.pitch_per_accel) * dx[:, SPEED])
        # an acceleration to the right lowers the left side
        roll = signal.lfilter(b, a, -np.deg2rad(self.roll_per_accel) * x[:, SPEED] * dx[:, HEADING])
        return sample_movement(path, compute_sway(pitch, roll, (0.0, 0.0, self.height)))


def compute_sway(pitch: Array, roll: Array, pivot_to_imu: tuple[float, float, float]) -> Array:
    """(J, 5): turns (J,) about a point of the body and the displacement of the IMU, first order."""
    right, forward, up = pivot_to_imu
    out = np.zeros((len(pitch), 5))
    out[:, PITCH], out[:, ROLL] = pitch, roll
    out[:, RIGHT], out[:, FORWARD], out[:, UP] = roll * up, -pitch * up, pitch * forward - roll * right
    return out
