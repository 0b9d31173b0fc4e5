"""Codes and carriers against a base station: differential codes and RTK, tables of their gates.

    python scripts/reproduce_rtk.py ../shared/data/ucr_riverside_20200712 -o build/rtk
    python scripts/reproduce_rtk.py ../shared/data/cssrlib_2021_265 -o build/rtk
    python scripts/reproduce_rtk.py ../shared/data/cssrlib_2021_078 -o build/rtk --end 60

Prints horizontal errors (50 %, 95 %, largest), that of height (95 %), the share of epochs that are fixed and that of
the fixed ones that are wrong (more than 0.1 m off), of filter, smoother and batch. These drives have no IMU: one is
simulated from a spline through the truth, with the errors of a consumer-grade one, and called so. The last stands, and
has a minute of its base station.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator, make_interp_spline

from graphnav.config import parse_settings
from graphnav.core import earth, rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.interpolation import pick_nearest
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.series import RawGnss
from graphnav.recording import Recording
from graphnav.recording.formats import read
from graphnav.simulation.inertial import MEMS

Array = np.ndarray
_RATE = 50.0  # Hz of the simulated IMU
_GAP = 20.0  # s
_NO_IMU = 5.0  # m/s^2/sqrt(Hz): 5 m/s of velocity in a second, more than a car's brakes
WRONG = 0.1  # m, half a wavelength: farther off horizontally a fixed epoch is wrong


@dataclass(frozen=True)
class Drive:
    """A set with a base station; `offset` (east, north, up; m) is what its truth is off by as a whole."""

    week: int
    start: float  # s of the week
    truth: str | tuple[float, float, float]  # a table, or where the antenna stands, m in e
    base: tuple[float, float, float]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_file: str = "base.obs.gz"


DRIVES = {
    "ucr_riverside_20200712": Drive(
        2114, 5784.0, "truth.csv.gz", (-2430697.636, -4704189.056, 3544329.070), (-0.011, 0.061, -0.142)
    ),
    "cssrlib_2021_265": Drive(2176, 282600.0, "reference_rtk.csv.gz", (-3959400.631, 3385704.533, 3667523.111)),
    "cssrlib_2021_078": Drive(
        2149,
        475200.0,
        (-3962108.673, 3381309.574, 3668678.638),
        (-3959400.631, 3385704.533, 3667523.111),
        base_file="base_1min.obs.gz",
    ),
}
VARIANTS: dict[str, dict[str, Any]] = {
    "codes, Doppler": {"carrier": False, "differences": False},
    "and changes of carriers": {"carrier": False},
    "and carriers, float": {"integers": False},
    "and carriers, integers": {},
}
# no stops, which the IMU shows, and nothing of how a vehicle moves
WITHOUT_IMU: dict[str, Any] = {
    "noise": {"mode": "stated"},
    "vehicle": {"nhc": False},
    "standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False},
}
TOML = """format = "graphnav-recording/1"
name = "{name}"
platform = "vehicle"
clock = "gps week {week}"

[imu]
file = "{folder}/imu.csv"
axes = "RFU"

[imu.noise]
{noise}

[raw_gnss]
rover = "{data}/rover.obs.gz"
nav = "{data}/nav.gz"
"""
BASE = """base = "{data}/{base_file}"
base_position = [{base[0]}, {base[1]}, {base[2]}]
"""


def truth_of(data: Path, drive: Drive, raw: RawGnss) -> tuple[Array, Array]:
    """Times of the rover's own epochs (s of the week) and places of the antenna (N, 3), e, the offset taken off."""
    if not isinstance(drive.truth, str):
        epochs, _ = raw.epochs
        return epochs, np.tile(drive.truth, (len(epochs), 1))
    table = np.genfromtxt(data / drive.truth, delimiter=",", names=True)
    places = np.stack([table["x"], table["y"], table["z"]], -1)
    places = places + np.array(drive.offset) @ earth.enu_axes(earth.ecef_to_llh(places[0]))
    epochs, _ = raw.epochs
    nearest = epochs[np.argmin(np.abs(epochs[None] - table["sow"][:, None]), axis=1)]
    return np.where(np.abs(nearest - table["sow"]) < 0.01, nearest, table["sow"]), places


def simulate_imu(t: Array, places: Array, seed: int = 1) -> tuple[Array, Array, Array, LocalFrame]:
    """Times (N,), rates and specific forces (N, 3) of a consumer-grade IMU at the antenna of a vehicle."""
    frame = LocalFrame(earth.ecef_to_llh(places[0]))
    p = (places - frame.r_e) @ frame.R_ne.T
    path = [make_interp_spline(t, p[:, i], k=5) for i in range(3)]
    at = np.arange(t[0], t[-1], 1.0 / _RATE)
    v = np.stack([one(at, 1) for one in path], -1)
    u = np.stack([one(t, 1) for one in path], -1)
    speed = np.hypot(u[:, 0], u[:, 1])
    moving = speed > 1.0  # m/s, below which millimetres of the truth would turn the vehicle
    rph = np.zeros((len(at), 3))
    if moving.any():
        heading = PchipInterpolator(t[moving], np.unwrap(np.arctan2(u[moving, 0], u[moving, 1])))
        pitch = PchipInterpolator(t[moving], np.arctan2(u[moving, 2], speed[moving]))
        inside = np.clip(at, *t[moving][[0, -1]])
        rph[:, 1], rph[:, 2] = pitch(inside), heading(inside)
    R = rotation.from_rph(rph)
    dt = np.diff(at)[:, None]
    middle = R[:-1] @ rotation.exp(0.5 * rotation.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]))
    rate = rotation.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) / dt + frame.omega_n @ middle
    place = np.stack([one(at[:-1] + 0.5 * dt[:, 0]) for one in path], -1)
    force = np.diff(v, axis=0) / dt + 2.0 * np.cross(frame.omega_n, 0.5 * (v[1:] + v[:-1])) - frame.gravity_n(place)
    force = np.einsum("nji,nj->ni", middle, force)
    gyro, accel, _, _ = MEMS.change_rate(_RATE).read(rate, force, seed)
    return at[1:], gyro, accel, frame


def recording_of(data: Path, folder: Path, with_base: bool = True) -> tuple[Recording, Array, Array]:
    """The drive with a simulated IMU, written into a folder, and its truth."""
    drive = DRIVES[data.name]
    sources = Sources(
        rover=(data / "rover.obs.gz",), nav=(data / "nav.gz",), base=(data / drive.base_file,), base_position=drive.base
    )
    raw, _, _ = load_raw(sources, zero=drive.week * 604800.0)
    t, places = truth_of(data, drive, raw)
    at, gyro, accel, _ = simulate_imu(t, places)
    table = np.column_stack([at, gyro, accel])
    np.savetxt(folder / "imu.csv", table, "%.9g", ",", header="t,gx,gy,gz,ax,ay,az", comments="")
    noise = "\n".join(f"{name} = {value:.6g}" for name, value in vars(MEMS.noise).items() if isinstance(value, float))
    text = (TOML + BASE if with_base else TOML).format(
        name=data.name,
        folder=folder,
        data=data,
        noise=noise,
        base=drive.base,
        week=drive.week,
        base_file=drive.base_file,
    )
    (folder / f"{data.name}.toml").write_text(text, encoding="utf-8")
    return read(folder / f"{data.name}.toml", allow_outside=True), t, places


def errors(t: Array, llh: Array, at: Array, places: Array) -> Array:
    """(N, 3) east, north, up (m) of positions at the truth's epochs."""
    r = earth.llh_to_ecef(llh)
    k = pick_nearest(t, at)
    good = np.abs(t[k] - at) < 2e-3
    R = earth.enu_axes(earth.ecef_to_llh(places))
    out = np.einsum("nij,nj->ni", R, r[k] - places)
    out[~good] = np.nan
    return out


def line(name: str, e: Array) -> str:
    """A row of the table."""
    e = e[np.isfinite(e[:, 0])]
    h, up = np.hypot(e[:, 0], e[:, 1]), np.abs(e[:, 2])
    return f"{name:34} {len(e):6} {np.median(h):7.3f} {np.percentile(h, 95):7.3f} {h.max():7.3f} " + (
        f"{np.percentile(up, 95):7.3f}"
    )


def consistency(solution: Solution, t: Array, e: Array) -> float:
    """Horizontal NEES per degree of freedom; the IMU is at the antenna."""
    k = np.argmin(np.abs(solution.t[None] - t[:, None]), axis=1)
    good = np.isfinite(e[:, 0])
    P = solution.covariance[k[good]][:, 3:5, 3:5]
    return float(np.mean(np.einsum("ni,nij,nj->n", e[good, :2], np.linalg.inv(P), e[good, :2])) / 2.0)


def shares(solution: Solution, t: Array, e: Array) -> str:
    """Share of epochs that are fixed, and of the fixed ones that are wrong, %."""
    if not len(solution.fixed):
        return ""
    k = np.argmin(np.abs(solution.fixed[None, :, 0] - t[:, None]), axis=1)
    fixed = (solution.fixed[k, 1] > 0.0) & (np.abs(solution.fixed[k, 0] - t) < 2e-3)
    h = np.hypot(e[:, 0], e[:, 1])
    wrong = np.mean(h[fixed] > WRONG) if fixed.any() else 0.0
    first = t[fixed][0] - t[0] if fixed.any() else np.nan
    some = f", their H95 {np.nanpercentile(h[fixed], 95):.3f}" if fixed.any() else ""
    return f"   fixed {100.0 * fixed.mean():.1f} %, wrong {100.0 * wrong:.2f} %, first after {first:.0f} s{some}"


def again(solution: Solution, end: float) -> float:
    """Seconds from the end of a gap to the first epoch that is fixed."""
    after = solution.fixed[(solution.fixed[:, 0] > end) & (solution.fixed[:, 1] > 0.0), 0]
    return float(after[0] - end) if len(after) else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--begin", type=float, default=0.0)
    parser.add_argument("--end", type=float, default=None)
    parser.add_argument("--solver", action="append")
    parser.add_argument("--gap", type=float, action="append", help="s, where 20 s without GNSS begin; repeatable")
    parser.add_argument("--without-imu", action="store_true", help="let the IMU say nothing of where the vehicle goes")
    parser.add_argument("--only", action="append", help="variants whose name begins so; repeatable")
    given = parser.parse_args()
    folder = (given.output / given.data.name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    recording, t, places = recording_of(given.data.resolve(), folder)
    recording = recording.crop(given.begin, given.end or recording.duration)
    for gap in given.gap or ():
        recording = recording.without("gnss", (gap, gap + _GAP))
    if given.without_imu:
        loose = replace(recording.imu.noise, accel_noise_density=_NO_IMU)
        recording = replace(recording, imu=replace(recording.imu, noise=loose))
    inside = (t >= recording.start) & (t <= recording.end)
    t, places = t[inside], places[inside]
    print(f"{'':34} {'epochs':>6} {'H50':>7} {'H95':>7} {'max':>7} {'U95':>7} {'NEES':>6}")
    assert recording.gnss is not None
    fixes = errors(recording.gnss.t, recording.gnss.llh, t, places)
    print(line("codes by epoch, no IMU", fixes))
    solvers = tuple(given.solver or ("ekf", "rts", "batch"))
    for name, chosen in VARIANTS.items():
        if given.only and not any(name.startswith(one) for one in given.only):
            continue
        began = time.process_time()
        settings = {"raw_gnss": chosen, **(WITHOUT_IMU if given.without_imu else {})}
        solutions = run(recording, parse_settings(settings), solvers)
        seconds = time.process_time() - began
        for solver, one in solutions.items():
            e = errors(one.t, one.trajectory().llh, t, places)
            print(f"{line(f'{name}, {solver}', e)} {consistency(one, t, e):6.2f}{shares(one, t, e)}")
            for gap in given.gap or ():
                after = again(one, recording.start + gap + _GAP)
                print(f"{'':34} fixed again {after:.2f} s after {gap:.0f} + {_GAP:.0f} s")
        print(f"{'':34} {seconds:.0f} s of processor time")


if __name__ == "__main__":
    main()
