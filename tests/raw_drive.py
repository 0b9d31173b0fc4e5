"""Raw observations for a simulated drive: satellites on circles in space, codes by the time that light takes in vacuum.

Everything is worked out in a frame that does not turn, other than in the package, which turns satellites instead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from oracle_path import ExactPath

from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.gnss.atmosphere import NIGHT, compute_directions, compute_klobuchar_delay
from graphnav.gnss.ephemeris import OMEGA_WGS84
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import L1, C, number_satellite, number_signal
from graphnav.recording import Recording

RADIUS, MU = 2.656e7, 3.986004418e14
SATELLITES = [f"G{k:02d}" for k in range(1, 8)] + [f"E{k:02d}" for k in range(1, 6)]
MANY = [*SATELLITES, *(f"G{k:02d}" for k in range(8, 13)), *(f"E{k:02d}" for k in range(6, 12))]  # as many as today
BANDS = {"G": ((L1, "1C"), (1227.6e6, "2W")), "E": ((L1, "1C"), (1176.45e6, "5Q"))}
BIAS = 7.0  # m, of Galileo's signal
ZERO = 2200 * 604800.0


def turn(p: Array, angle: Array) -> Array:
    """Coordinates (n, 3) turned by angles (n,) about z: from the Earth-fixed frame into space."""
    s, c = np.sin(angle), np.cos(angle)
    return np.stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]], -1)


def in_space(k: int, t: Array, above: Array) -> Array:
    """(n, 3) satellite k at times t, which stands near the direction `above` (3,) at t = 0."""
    rng = np.random.default_rng(k)
    up = above / np.linalg.norm(above) + 0.55 * rng.standard_normal(3)
    up /= np.linalg.norm(up)
    along = np.cross(up, rng.standard_normal(3))
    along /= np.linalg.norm(along)
    angle = np.sqrt(MU / RADIUS**3) * t[:, None]
    return RADIUS * (np.cos(angle) * up + np.sin(angle) * along)


def observe(llh_of, t: Array, above: Array, k: int) -> tuple[Array, Array, Array]:
    """Ranges c tau (n,), and satellites at transmission, positions and velocities in the Earth-fixed frame of then."""
    antenna = turn(earth.llh_to_ecef(llh_of(t)), OMEGA_WGS84 * t)
    tau = np.full(len(t), 0.07)
    for _ in range(8):
        tau = np.linalg.norm(in_space(k, t - tau, above) - antenna, axis=1) / C
    sent = t - tau

    def fixed(at: Array) -> Array:
        return turn(in_space(k, at, above), -OMEGA_WGS84 * at)

    return C * tau, fixed(sent), (fixed(sent + 0.5) - fixed(sent - 0.5))


def with_observations(
    recording: Recording, path: ExactPath, noise: float = 0.0, seed: int = 0, carrier: float | None = None,
    second: bool = False,
) -> Recording:  # fmt: skip
    """The recording with raw observations at the times of its fixes, and these said to be derived from them.

    `noise` is that of the codes, m; that of range rates is a twentieth of it, m/s; `carrier` that of carriers, m, each
    with cycles of its own, and none without. `second` adds a second signal of each satellite.
    """
    gnss = recording.gnss
    t, lever = gnss.t, tuple(float(x) for x in gnss.lever_arm)
    rng = np.random.default_rng(seed)
    drift = 1.0 + 2.0 * np.sin(0.05 * t)
    clock = 150.0 + 1.0 * t - 40.0 * np.cos(0.05 * t)  # its derivative is the drift

    def llh_of(at: Array) -> Array:
        return path.point(at, lever)[0]

    llh = llh_of(t)
    antenna = earth.llh_to_ecef(llh)
    above = antenna[0]
    parts: dict[str, list[Array]] = {}
    for k, name in enumerate(SATELLITES):
        distance, p, v = observe(llh_of, t, above, k)
        h = 0.02
        inside = np.clip(t, path.t[0] + h, path.t[-1] - h)
        rate = (observe(llh_of, inside + h, above, k)[0] - observe(llh_of, inside - h, above, k)[0]) / (2.0 * h)
        azimuth, elevation = compute_directions(antenna, p)
        delay = compute_klobuchar_delay(NIGHT, np.mod(t, 604800.0), llh, azimuth, elevation)
        n, noisy = len(t), noise * rng.standard_normal(len(t))
        bias = BIAS if name[0] == "E" else 0.0
        for frequency, signal in BANDS[name[0]][: 1 + second]:
            phase = np.full(n, np.nan)
            slower = delay * (L1 / frequency) ** 2
            if carrier is not None:
                white = carrier * np.random.default_rng([seed, k]).standard_normal(n)
                phase = (distance + clock + bias - slower + white) * frequency / C + 1000.0 * k
            own = {
                "t": t, "carrier": phase, "satellite": np.full(n, number_satellite(name), dtype=np.int16),
                "signal": np.full(n, number_signal(signal), dtype=np.int16), "frequency": np.full(n, frequency),
                "code": distance + clock + bias + slower + noisy, "p": p, "v": v,
                "range_rate": rate + drift + 0.05 * noise * rng.standard_normal(n),
                "high": elevation,
            }  # fmt: skip
            for key, value in own.items():
                parts.setdefault(key, []).append(value)
    whole = {key: np.concatenate(value) for key, value in parts.items()}
    order = np.lexsort((whole["signal"], whole["satellite"], whole["t"]))
    order = order[whole.pop("high")[order] > np.radians(10.0)]
    whole = {key: value[order] for key, value in whole.items()}
    n, at = len(order), np.searchsorted(t, whole["t"])
    rough = antenna + 20.0 * np.random.default_rng(1).standard_normal(antenna.shape)
    raw = RawGnss(
        **whole, cn0=np.full(n, 45.0), slip=np.zeros(n, dtype=bool),
        half=np.zeros(n, dtype=bool), clock=np.zeros(n), drift=np.zeros(n),
        difference=np.full(n, np.nan), zero=ZERO, place=tuple(above), troposphere=True, antenna=rough[at],
        receiver_clock=np.stack([clock + 5.0, drift], -1)[at], lever_arm=gnss.lever_arm, precise=True,
    )  # fmt: skip
    return replace(recording, gnss=replace(gnss, derived=True), raw_gnss=raw)
