"""Precise point positioning with float ambiguities, by real orbits and clocks: a station that stands, and a vehicle.

    python scripts/reproduce_ppp.py static ../shared/data/raw_gnss_slac_20210428

`static`: an hour of the station SLAC, GPS, 30 s, CODE's final orbits and clocks; errors against the place of its
daily series, east, north, up, over time. Its IMU at rest is SIMULATED, with the errors of a low-cost MEMS.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.config import settings_from
from graphnav.core import earth
from graphnav.estimation.pipeline import run
from graphnav.gnss.load import Sources, load_raw
from graphnav.recording import Gnss, Imu, ImuNoise, Recording

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
MEMS = ImuNoise(1.5e-4, 4e-3, 5e-6, 2e-4, 2e-3, 0.1)


def sources(data: Path) -> Sources:
    return Sources(
        (data / "slac1180.21o.gz",), (data / "brdc1180.21n.gz",), tuple(data.glob("*ORB.SP3.gz")),
        tuple(data.glob("*CLK.CLK.gz")), tuple(data.glob("*.atx*")),
    )  # fmt: skip


def standing(duration: float, place: Array, seed: int = 0) -> Imu:
    """A simulated IMU at rest, level, heading north."""
    llh = earth.ecef_to_llh(place[None])[0]
    t = np.arange(1, round(duration * RATE) + 1) / RATE
    rate = earth.RATE * np.array([0.0, np.cos(llh[0]), np.sin(llh[0])])
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
    raw, fixes, said = load_raw(sources(data), BEGIN)
    for one in said:
        print(one)
    raw = raw.take((raw.t > 0.0) & (raw.t < END - BEGIN))
    good = np.isfinite(fixes.p[:, 0]) & (fixes.t > 0.0) & (fixes.t < END - BEGIN)
    sd = np.sqrt(np.diagonal(fixes.covariance[good], axis1=1, axis2=2))
    gnss = Gnss(fixes.t[good], earth.ecef_to_llh(fixes.p[good]), sd, derived=True)
    imu = standing(END - BEGIN, MARKER)
    return Recording("SLAC, IMU simulated", "vehicle", imu, gnss, gps_zero=BEGIN, raw_gnss=raw)


def static(data: Path, chosen: dict[str, Any], solvers: tuple[str, ...]) -> None:
    recording = static_recording(data)
    settings = settings_from(
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
    for name, one in solutions.items():
        off = one.states.p - one.frame.from_llh(earth.ecef_to_llh(MARKER[None])) - [0.0, 0.0, ANTENNA]
        for minutes in (5, 10, 20, 30, 45, 59.5):
            k = int(np.searchsorted(one.t, 60.0 * minutes))
            print(f"{name:6} {minutes:5.1f} " + " ".join(f"{x:7.3f}" for x in off[min(k, len(off) - 1)]))
        P = np.sqrt(np.diagonal(one.covariance[-1])[3:6])
        print(f"{name:6} sigma " + " ".join(f"{x:7.3f}" for x in P), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("static",))
    parser.add_argument("data", type=Path)
    parser.add_argument("--solver", action="append", default=[])
    given = parser.parse_args()
    static(given.data, {}, tuple(given.solver) or ("ekf", "rts", "batch"))


if __name__ == "__main__":
    main()
