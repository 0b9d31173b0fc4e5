"""Precise point positioning with float ambiguities, by real orbits and clocks: antennas that stand, and vehicles.

    python scripts/reproduce_ppp.py static ../shared/data/raw_gnss_slac_20210428
    python scripts/reproduce_ppp.py static ../shared/data/cssrlib_2021_078
    python scripts/reproduce_ppp.py drive ../shared/data/cssrlib_2021_265 --solver ekf --solver rts
    python scripts/reproduce_ppp.py li ../shared/data/raw_gnss_slac_20210428 --solver ekf --solver batch

`static`: an hour of the station SLAC every 30 s, or a quarter of an hour of another antenna every second, CODE's final
orbits and clocks; errors against the known place, east, north, up, over time. The IMU at rest is SIMULATED, with the
errors of a low-cost MEMS.

`drive`: six minutes of a vehicle, whole and in halves, against RTKLIB's fixed places, with the simulated IMU of
`scripts/reproduce_rtk.py`: errors at the last epoch, and the sum of squares of these over their covariance.

`li`: the experiment of Li 2024, PPP and IMU coupled tightly with zero velocity where the spectrum of the idling engine
says that the vehicle stands, on the simulated drive of `scripts/reproduce_li2024.py`, stops of 60, 120 and 90 s. Orbits
and clocks are CODE's of that day; observations of two signals are SIMULATED along the drive, with noise, reflections in
the carriers, an ionosphere, a wet delay that differs from the standard one, satellites 2.5 cm off and ambiguities; the
models of tide, wind-up and antenna are those of the estimate. Each stop is run by itself, with GNSS gone from its first
second. Printed are the share of stopped seconds found (the paper's Table 5) and the changes of position in the stops
(its Table 6), and the errors of the place before the stop, which the paper does not give.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from reproduce_li2024 import TABLE_5, TABLE_6, detection, stops_of, variation, without_gnss
from reproduce_rtk import DRIVES, simulate_imu, truth_of
from scipy.signal import lfilter

from graphnav.config import parse_settings
from graphnav.core import earth, rotation
from graphnav.estimation.pipeline import run
from graphnav.gnss.antex import compute_satellite_axes, compute_wind_up
from graphnav.gnss.ephemeris import rotate_earth
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.ppp import combine_ionosphere_free
from graphnav.gnss.precise import read_precise
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import GALILEO, GPS, L1, C, find_frequencies, number_signal
from graphnav.gnss.single_point import SinglePoint, look
from graphnav.gnss.tides import locate_sun_and_moon
from graphnav.recording import Gnss, Imu, ImuNoise, Recording
from graphnav.simulation import Simulated, simulate
from graphnav.simulation.inertial import MEMS as CONSUMER

Array = np.ndarray
# m in e, of the marker in IGS14 on that day. The header's place is of NAD 83 (2011), 1.8 m from it. Of the station's
# daily series (UNAVCO, SLAC.cwu.rapid_nam14.pos, release of 2022-07-06): its reference position at 2010.0 and that of
# 2022-06-19, interpolated, turned from the North American plate to IGS14 by the pole of Altamimi et al. 2017 (0.024,
# -0.694, -0.063 mas a year). Good to a few centimetres
MARKER = np.array([-2703116.3143, -4291766.7591, 3854248.0714])
# m, up, of the phase centre of the ionosphere-free combination over the marker: the antenna stands 8 mm over it, and
# its centres (TRM59800.80 NONE, igs14.atx) are 89.51 and 117.13 mm over its reference point
ANTENNA = 0.0083 + 2.5457 * 0.08951 - 1.5457 * 0.11713
DAY = 2155 * 604800.0 + 3 * 86400.0  # s since the GPS epoch
BEGIN, END = DAY + 19.5 * 3600.0, DAY + 20.5 * 3600.0  # of the clocks that come with the data
RATE = 20.0  # Hz
MINUTES = (5.0, 10.0, 14.9, 20.0, 30.0, 45.0, 59.5)
MEMS = ImuNoise(1.5e-4, 4e-3, 5e-6, 2e-4, 2e-3, 0.1)


@dataclass(frozen=True)
class Station:
    """An antenna at a known place (m in e), which it is `up` m above, and times, s since the GPS epoch."""

    place: Array
    up: float
    begin: float
    end: float


STATIONS = {
    "raw_gnss_slac_20210428": Station(MARKER, ANTENNA, BEGIN, END),
    "cssrlib_2021_078": Station(
        np.array([-3962108.673, 3381309.574, 3668678.638]), 0.0, 2149 * 604800.0 + 475190.0, 2149 * 604800.0 + 476100.0
    ),
}


def sources(data: Path) -> Sources:
    if (data / "rover.obs.gz").exists():
        return Sources((data / "rover.obs.gz",), (data / "nav.gz",), (data / "orbit.sp3.gz",))
    return Sources(
        (data / "slac1180.21o.gz",), (data / "brdc1180.21n.gz",), tuple(data.glob("*ORB.SP3.gz")),
        tuple(data.glob("*CLK.CLK.gz")), tuple(data.glob("*.atx*")),
    )  # fmt: skip


def standing(duration: float, place: Array, seed: int = 0) -> Imu:
    """A simulated IMU at rest, level, heading north."""
    llh = earth.ecef_to_llh(place[None])[0]
    t = np.arange(1, round(duration * RATE) + 1) / RATE
    rate = earth.EARTH_RATE * np.array([0.0, np.cos(llh[0]), np.sin(llh[0])])
    rng, dt = np.random.default_rng(seed), 1.0 / RATE
    values = []
    for true, density, walk, turn_on in (
        (rate, MEMS.gyro_noise_density, MEMS.gyro_bias_walk, MEMS.gyro_bias_sigma),
        (
            np.array([0.0, 0.0, float(earth.gravity(llh[0], llh[2]))]),
            MEMS.accel_noise_density,
            MEMS.accel_bias_walk,
            MEMS.accel_bias_sigma,
        ),
    ):
        shape = (len(t), 3)
        bias = turn_on * rng.standard_normal(3) + np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(shape), axis=0)
        values.append(true + bias + density / np.sqrt(dt) * rng.standard_normal(shape))
    return Imu(t, values[0], values[1], MEMS)


def static_recording(data: Path) -> Recording:
    at = STATIONS[data.name]
    raw, fixes, said = load_raw(sources(data), at.begin)
    for one in said:
        print(one)
    return simulated_beside(data.name, raw, fixes, standing(at.end - at.begin, at.place), (0.0, at.end - at.begin))


def simulated_beside(name: str, raw: RawGnss, fixes: SinglePoint, imu: Imu, span: tuple[float, float]) -> Recording:
    """The observations of a span, with a simulated IMU."""
    good = np.isfinite(fixes.p[:, 0]) & (fixes.t > span[0]) & (fixes.t < span[1])
    sd = np.sqrt(np.diagonal(fixes.covariance[good], axis1=1, axis2=2))
    gnss = Gnss(fixes.t[good], earth.ecef_to_llh(fixes.p[good]), sd, derived=True)
    raw = raw.take((raw.t > span[0]) & (raw.t < span[1]))
    return Recording(f"{name}, IMU simulated", "vehicle", imu, gnss, gps_zero=raw.zero, raw_gnss=raw)


def static(data: Path, chosen: dict[str, Any], solvers: tuple[str, ...]) -> None:
    recording = static_recording(data)
    settings = parse_settings(
        {
            "raw_gnss": {"coupling": "tight", "ppp": True, **chosen},
            "alignment": {"heading": 0.0},
            "keyframes": {"rate": 0.1},
        }
    )
    began = time.process_time()
    solutions = run(recording, settings, solvers)
    print(f"{time.process_time() - began:.0f} s of processor time")
    print("m against the station's place, east, north, up, by the minutes since the first epoch; 1-sigma at the end")
    at = STATIONS[data.name]
    for name, one in solutions.items():
        off = one.states.p - one.frame.from_llh(earth.ecef_to_llh(at.place[None])) - [0.0, 0.0, at.up]
        for minutes in (x for x in MINUTES if 60.0 * x < at.end - at.begin):
            k = int(np.searchsorted(one.t, 60.0 * minutes))
            print(f"{name:6} {minutes:5.1f} " + " ".join(f"{x:7.3f}" for x in off[min(k, len(off) - 1)]))
        P = np.sqrt(np.diagonal(one.covariance[-1])[3:6])
        print(f"{name:6} sigma " + " ".join(f"{x:7.3f}" for x in P), flush=True)


def drive(data: Path, solvers: tuple[str, ...]) -> None:
    known = DRIVES[data.name]
    raw, fixes, said = load_raw(sources(data), 604800.0 * known.week)
    for one in said:
        print(one)
    t, places = truth_of(data, known, raw)
    at, gyro, accel, _ = simulate_imu(t, places)
    whole = simulated_beside(data.name, raw, fixes, Imu(at, gyro, accel, CONSUMER.noise), (at[0], at[-1]))
    settings = parse_settings({"raw_gnss": {"coupling": "tight", "ppp": True}})
    print(
        "m, east, north, up at the last epoch of a span (s from the start); 1-sigma; sum of squares over the covariance"
    )
    half = 0.5 * whole.duration
    for span in ((0.0, whole.duration), (0.0, half), (half, whole.duration)):
        for name, one in run(whole.crop(*span), settings, solvers).items():
            epochs, k = np.flatnonzero(np.isin(one.t, t)), np.flatnonzero(np.isin(t, one.t))
            off = one.states.p[epochs[-1]] - one.frame.from_llh(earth.ecef_to_llh(places[k[-1:]]))[0]
            P = one.covariance[epochs[-1]][3:6, 3:6]
            print(
                f"{name:6} {span[0]:4.0f} to {span[1]:4.0f}",
                *(f"{x:7.3f}" for x in (*off, *np.sqrt(np.diagonal(P)))),
                f"{off @ np.linalg.solve(P, off):7.2f}",
                flush=True,
            )


CODE, CARRIER, ORBIT, WET, ZENITH = 0.3, 0.003, 0.025, 0.05, 2.0  # m: noise, satellites, wet delay, ionosphere on L1
REFLECTED, LASTS = 0.003, 20.0  # m towards the zenith (RTKLIB 2.4.3, rtkpos.c, varerr), and s: of carriers
SECOND = {GPS: "2W", GALILEO: "5Q"}


def observed(made: Simulated, orbits: Any, mask: float = 15.0, seed: int = 0) -> Recording:
    """The simulated drive with simulated observations of two signals under real orbits and clocks, once a second."""
    recording, truth = made.recording, made.truth
    zero = BEGIN + 120.0 - recording.start
    t = np.arange(np.ceil(recording.start) + 1.0, recording.end, 1.0)
    k = np.searchsorted(truth.t, t - 1e-6)
    assert recording.gnss is not None
    lever = recording.gnss.lever_arm
    R_ln = rotation.from_rph(truth.rph[k])
    R_le = earth.enu_axes(truth.llh[k])
    antenna = earth.llh_to_ecef(truth.llh[k]) + np.einsum("nji,nj->ni", R_le, R_ln @ lever)
    names = np.array(sorted(x for x in orbits.orbit if x in orbits.clock and x // 100 in SECOND), dtype=np.int16)
    satellite, at = np.tile(names, len(t)), np.repeat(np.arange(len(t)), len(names))
    sent = t[at] - 0.075
    for _ in range(4):
        found = orbits.place(satellite, sent, zero)
        found = orbits.place(satellite, sent + np.nan_to_num(found.clock), zero)
        range_now = np.linalg.norm(rotate_earth(found.p, t[at] - sent) - antenna[at], axis=1)
        sent = np.where(np.isfinite(range_now), t[at] - range_now / C, sent)
    n = len(at)
    rng = np.random.default_rng(seed)
    clock = 30.0 + 0.1 * np.cumsum(rng.standard_normal(len(t)))
    nothing = np.zeros(n, dtype=bool)
    raw = RawGnss(
        t=t[at], satellite=satellite, signal=np.full(n, number_signal("1C"), dtype=np.int16), code=np.zeros(n),
        carrier=np.zeros(n), range_rate=np.full(n, np.nan), cn0=np.full(n, 47.0), slip=nothing, half=nothing,
        frequency=np.full(n, L1), p=found.p, v=found.v, clock=C * found.clock, drift=C * found.drift,
        difference=np.full(n, np.nan), zero=zero, place=tuple(antenna[0]), antenna=antenna[at],
        receiver_clock=np.stack([clock[at], np.zeros(n)], -1), lever_arm=lever, precise=True,
    )  # fmt: skip
    geometry = look(raw, raw.antenna, None)
    raw = raw.take((geometry.elevation > np.radians(mask)) & np.isfinite(found.clock))
    at = np.searchsorted(t, raw.t)
    other = np.zeros(len(raw), dtype=np.int16)
    for system, name in SECOND.items():
        other[raw.satellite // 100 == system] = number_signal(name)
    pair = _both(raw, other)
    free = combine_ionosphere_free(raw, pair)
    assert free is not None
    assert len(free.which) == len(raw)
    of = np.searchsorted(names, raw.satellite)
    axes = compute_satellite_axes(free.geometry.s, locate_sun_and_moon(raw.t + zero)[0])
    wound = compute_wind_up(raw.satellite, raw.t, axes, free.geometry.e, earth.enu_axes(earth.ecef_to_llh(raw.antenna)))
    wet = WET * (1.0 + 0.2 * np.cumsum(rng.standard_normal(len(t))) / np.sqrt(len(t)))
    common = free.known + clock[at] - raw.clock + free.wet * wet[at] + ORBIT * rng.standard_normal(len(names))[of]
    delay = ZENITH / np.maximum(np.sin(free.geometry.elevation), 0.2)
    noisy = []
    draws = rng.spawn(1)[0]
    for one in (raw, _second_of(raw, other)):
        slower, length = delay * (L1 / one.frequency) ** 2, C / one.frequency
        whole = rng.integers(-(10**6), 10**6, len(names))[of]
        size = REFLECTED * np.hypot(1.0, 1.0 / np.sin(free.geometry.elevation))
        lasting = size * _draw_lasting(draws, len(t), len(names))[at, of]
        phase = common - slower + lasting + CARRIER * rng.standard_normal(len(raw))
        noisy.append((common + slower + CODE * rng.standard_normal(len(raw)), phase / length + wound + whole))
    raw = _both(raw, other, noisy)
    rough = earth.ecef_to_llh(antenna + 1.5 * rng.standard_normal(antenna.shape))
    v = truth.v[k] + 0.05 * rng.standard_normal((len(t), 3))
    gnss = Gnss(t, rough, np.full((len(t), 3), 1.5), v, np.full((len(t), 3), 0.05), lever, derived=True)
    nominal = earth.llh_to_ecef(rough)[np.searchsorted(t, raw.t)]
    return replace(recording, gnss=gnss, raw_gnss=replace(raw, antenna=nominal), gps_zero=zero)


def _draw_lasting(rng: np.random.Generator, epochs: int, series: int) -> Array:
    """(epochs, series) of unit variance, once a second, that fade over `LASTS`."""
    kept = np.exp(-1.0 / LASTS)
    white = rng.standard_normal((epochs, series))
    white[1:] *= np.sqrt(1.0 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], white, axis=0))


def _both(raw: RawGnss, other: Array, noisy: list[tuple[Array, Array]] | None = None) -> RawGnss:
    """First and second signals in one series, with codes (m) and carriers (cycles) of both."""
    parts = [raw, _second_of(raw, other)]
    if noisy is not None:
        parts = [replace(one, code=code, carrier=phase) for one, (code, phase) in zip(parts, noisy, strict=True)]
    arrays = {
        f.name: np.concatenate([getattr(one, f.name) for one in parts])
        for f in fields(RawGnss)
        if f.name != "lever_arm" and isinstance(getattr(raw, f.name), np.ndarray) and len(getattr(raw, f.name))
    }
    return replace(raw, **arrays).take(np.lexsort((arrays["signal"], arrays["satellite"], arrays["t"])))


def _second_of(raw: RawGnss, other: Array) -> RawGnss:
    return replace(raw, signal=other, frequency=find_frequencies(raw.satellite, other))


def li(data: Path, solvers: tuple[str, ...], stops: int, seed: int = 0) -> None:
    made = simulate("li2024", seed, short=True)
    some = sources(data)
    recording = observed(made, read_precise(list(some.sp3), list(some.clk)), seed=seed)
    rates = detection(replace(made, recording=recording), ["fused", "fft"])
    print("Table 5: % of stopped seconds found, by stop and in all; the paper's, and ours (simulated)")
    print("paper", *TABLE_5)
    for name, row in rates.items():
        print(f"{name}:", " ".join(f"{x:.2f}" for x in row[:4]), f"false alarms {row[4]:.2f} % of moving seconds")
    print("\nTable 6: change of position in a stop, cm, east north up; PPP before it, no GNSS in it")
    print("paper, mean of its stops", TABLE_6)
    for number, stop in enumerate(stops_of(made)[:stops]):
        part = without_gnss(recording.crop(0.0, stop[1] - recording.start), [(stop[0] - 0.5, stop[1] + 1.0)])
        for fire in ("fft", "fused"):
            settings = parse_settings(
                {
                    "raw_gnss": {"coupling": "tight", "ppp": True, "doppler": False, "elevation": 15.0},
                    "detectors": {"fire": [fire]},
                }
            )
            began = time.process_time()
            for name, one in run(replace(part, truth=None), settings, solvers).items():
                change = variation(one, stop)
                k = int(np.searchsorted(one.t, stop[0] - 1.0))
                true = made.truth.llh[np.searchsorted(made.truth.t, one.t[k] - 1e-6)]
                off = one.states.p[k] - one.frame.from_llh(true[None])[0]
                print(
                    f"stop {number + 1}, {fire} decides, {name:5}",
                    *(
                        f"{word} {' '.join(f'{x:.2f}' for x in row)};"
                        for word, row in zip(TABLE_6, change, strict=True)
                    ),
                    f"before the stop off by {' '.join(f'{x:.3f}' for x in off)} m;",
                    f"{time.process_time() - began:.0f} s",
                    flush=True,
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("static", "drive", "li"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--solver", action="append", default=[])
    parser.add_argument("--stops", type=int, default=3, help="of the vehicle's drive")
    parser.add_argument("--seed", type=int, default=0, help="of the vehicle's drive and its observations")
    given = parser.parse_args()
    solvers = tuple(given.solver) or ("ekf", "rts", "batch")
    if given.what == "static":
        static(given.data, {}, solvers)
    elif given.what == "drive":
        drive(given.data.resolve(), solvers)
    else:
        li(given.data, solvers, given.stops, given.seed)


if __name__ == "__main__":
    main()
