"""What carriers of single satellites tell from epoch to epoch, on ucr_riverside_20200712 with a simulated IMU.

    python scripts/reproduce_carrier.py increments ../shared/data/ucr_riverside_20200712
    python scripts/reproduce_carrier.py windows ../shared/data/ucr_riverside_20200712 --window 0 300
    python scripts/reproduce_carrier.py canyon ../shared/data/ucr_riverside_20200712

`increments` solves the displacement of each epoch from the carriers' changes alone and compares it with the truth's,
and with what residuals and geometry lead to expect; by halves of the satellites, whose errors share only the truth's.
`windows` has the errors of parts of a drive without a base, with changes of carriers and without; of
cssrlib_2021_265 as well, with the simulated IMU of scripts/reproduce_rtk.py. `canyon` takes satellites away by a mask:
in ten spans of 60 s the 4, 3, 2, 1, 0 highest are left, and the table has the horizontal errors in the spans, of
filter, smoother and batch, with changes of carriers and without. Each span is solved with what is a minute before and
half a minute behind it.

The recording has no IMU. Its samples are SIMULATED: a spline through the reference positions is the motion, level but
for the slope, heading along the way; errors are those of a low-cost MEMS (the figures of data/tokyo_raw). Carriers,
codes and Doppler shifts are the receiver's.
"""

from __future__ import annotations

import argparse
import gzip
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import reproduce_rtk
from pyins import sim
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import brentq
from scipy.special import erf

from graphnav.config import parse_settings
from graphnav.core import earth
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.carrier import pair_consecutive
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.series import RawGnss, choose_primary
from graphnav.gnss.sigmas import compute_carrier_sigma
from graphnav.gnss.signals import GPS, C
from graphnav.gnss.single_point import Geometry, SinglePoint, choose_coefficients, look
from graphnav.recording import Gnss, Imu, ImuNoise, Recording, Truth

Array = np.ndarray
ZERO = 2114 * 604800.0 + 5784.0  # s since the GPS epoch of the reference's first row
RATE = 100.0  # Hz of the simulated IMU
MEMS = ImuNoise(1.5e-4, 4e-3, 5e-6, 2e-4, 2e-3, 0.1)
SPAN, SPANS, FIRST, APART = 60.0, 10, 150.0, 210.0  # s: of a canyon, how many, where the first begins, and the others
BEFORE, AFTER = 60.0, 30.0  # s, of the drive around a canyon that is solved with it
SOLVERS = ("ekf", "rts", "batch")
MOVING, STANDING = 1.0, 0.1  # m/s, from which on a heading is that of the way, and below which the car stands
FEWEST, FAR = 6, 0.03  # satellites of an increment; m, of errors of increments that are compared


def observations(data: Path) -> tuple[RawGnss, SinglePoint, Array]:
    """The rover's series, its single-point fixes, and the reference (2400, 3), m in e, one row a second."""
    raw, fixes, _ = load_raw(Sources((data / "rover.obs.gz",), (data / "nav.gz",)), ZERO)
    with gzip.open(data / "truth.csv.gz", "rt") as file:
        rows = np.genfromtxt(file, delimiter=",", names=True)
    return raw, fixes, np.stack([rows["x"], rows["y"], rows["z"]], -1)


def increments(data: Path) -> None:
    """Displacements from epoch to epoch by carriers alone against those of the reference."""
    raw, _, truth = observations(data)
    whole = raw
    raw = raw.take(choose_primary(raw) & np.isfinite(raw.p[:, 0]) & ~(raw.cn0 < 30.0))
    epochs, of = raw.epochs
    true = truth[np.clip(np.round(epochs).astype(int), 0, len(truth) - 1)]
    geometry = look(raw, true[of], choose_coefficients(raw))
    high = geometry.elevation > np.radians(10.0)
    raw, of = raw.take(high), of[high]
    geometry = look(raw, true[of], choose_coefficients(raw))
    before, after = pair_consecutive(raw, whole)
    level = geometry.distance - geometry.ionosphere + geometry.troposphere - raw.clock
    level -= raw.carrier * C / raw.frequency
    change = level[after] - level[before]
    sigma = np.hypot(
        *(compute_carrier_sigma(raw.cn0[k], geometry.elevation[k], C / raw.frequency[k]) for k in (before, after))
    )
    d, expected, seen = solve_increments(geometry, true, of, after, change, sigma)
    h, up = np.hypot(d[:, 0], d[:, 1]), np.abs(d[:, 2])
    slips = find_arcs(whole).slips
    print(f"{len(after)} changes of carriers, {slips} slips without a flag, {np.isfinite(h).sum()} epochs")
    print("mm against the reference's increments: 50 %, 95 %, 99 %, rms, and % of the epochs within 1 cm")
    for name, x in (("horizontal", h), ("up", up)):
        at = [*np.nanpercentile(x, [50, 95, 99]), np.sqrt(np.nanmean(x**2))]
        share = np.mean(x[np.isfinite(x)] < 0.01)
        print(f"{name:10} " + " ".join(f"{1e3 * v:6.1f}" for v in at) + f" {100.0 * share:6.1f}")
    both = np.isfinite(d[1:, 0]) & np.isfinite(d[:-1, 0])
    alike = [np.corrcoef(d[1:, i][both], d[:-1, i][both])[0, 1] for i in range(3)]
    print("correlation of an epoch's errors and the next's, east, north, up: " + " ".join(f"{x:.2f}" for x in alike))
    print(
        "up, by satellites: 95 % of the errors, and of normal ones of the sigmas that residuals and geometry state; mm"
    )
    speed = np.linalg.norm(np.gradient(true, epochs, axis=0), axis=1)
    solved = np.isfinite(up)
    for name, some in (
        ("all", solved),
        ("standing", solved & (speed < STANDING)),
        *(
            (f"{low} to {high - 1}", solved & (seen >= low) & (seen < high))
            for low, high in ((6, 12), (12, 17), (17, 40))
        ),
    ):
        normal = brentq(lambda x, s=expected[some]: float(np.mean(erf(x / s / np.sqrt(2.0)))) - 0.95, 1e-6, 10.0)
        print(f"{name:10} {some.sum():5} {1e3 * np.percentile(up[some], 95):6.1f} {1e3 * normal:6.1f}")
    system = raw.satellite[after] // 100
    first, second = (
        solve_increments(geometry, true, of, after, change, np.where(part, sigma, np.inf))[0][:, 2]
        for part in (system == GPS, system != GPS)
    )
    both = (np.abs(first) < FAR) & (np.abs(second) < FAR)
    rms = (1e3 * np.sqrt(np.mean(x[both] ** 2)) for x in (first, second))
    print(
        f"up by GPS and by the others alone, {both.sum()} epochs: rms {' and '.join(f'{x:.1f}' for x in rms)} mm, "
        f"correlation {np.corrcoef(first[both], second[both])[0, 1]:.2f}"
    )


def solve_increments(
    geometry: Geometry, true: Array, of: Array, after: Array, change: Array, sigma: Array
) -> tuple[Array, Array, Array]:
    """Errors (E, 3) of each epoch's displacement, east, north, up, 1-sigma (E,) of up, m, and satellites (E,).

    The sigma is that of the geometry times the root of the mean square residual. Infinite sigmas leave rows out.
    """
    E = len(true)
    off, up, seen = np.full((E, 3), np.nan), np.full(E, np.nan), np.zeros(E, dtype=int)
    R = earth.enu_axes(earth.ecef_to_llh(true))
    for k in range(1, E):
        own = np.flatnonzero((of[after] == k) & np.isfinite(sigma))
        seen[k] = len(own)
        if len(own) < FEWEST:
            continue
        H = np.column_stack([-geometry.e[after[own]] @ R[k].T, np.ones(len(own))]) / sigma[own, None]
        y = -change[own] / sigma[own]
        Q = np.linalg.pinv(H.T @ H)
        x = Q @ (H.T @ y)
        off[k], up[k] = x[:3], np.sqrt(Q[2, 2] * np.sum((y - H @ x) ** 2) / (len(own) - 4))
    return off, up, seen


def simulated_imu(t: Array, place: Array, seed: int = 0) -> tuple[Imu, Array, Array, Array]:
    """An IMU (RFU, at the antenna) on the spline through places (n, 3), m in e, at times t (n,), and its motion.

    Times (m,), places (m, 3) in rad, rad, m, and velocities (m, 3) in east, north, up, of the motion come after it.
    """
    llh = earth.ecef_to_llh(place)
    at = np.linspace(t[0], t[-1], round((t[-1] - t[0]) * RATE) + 1)
    curve = CubicSpline(t, llh)
    way = curve(at)
    enu = np.einsum("nij,nj->ni", earth.enu_axes(llh), CubicSpline(t, place)(t, 1))
    speed = np.hypot(enu[:, 0], enu[:, 1])
    moving = speed > MOVING
    heading = PchipInterpolator(t[moving], np.unwrap(np.arctan2(enu[moving, 0], enu[moving, 1])))
    pitch = PchipInterpolator(t[moving], np.arctan2(enu[moving, 2], speed[moving]))
    inside = np.clip(at, t[moving][0], t[moving][-1])
    rph = np.degrees(np.stack([np.zeros(len(at)), pitch(inside), heading(inside)], -1))
    lla = np.column_stack([np.degrees(way[:, :2]), way[:, 2]])
    found, imu = sim.generate_imu(at, lla, rph, None, "increment")
    values, rows = imu.to_numpy()[1:], found.to_numpy()
    period = np.diff(at)[:, None]
    gyro, accel = (values[:, k : k + 3][:, [1, 0, 2]] * (1.0, 1.0, -1.0) / period for k in (0, 3))
    rng, dt = np.random.default_rng(seed), 1.0 / RATE
    for x, density, walk, turn_on in (
        (gyro, MEMS.gyro_noise_density, MEMS.gyro_bias_walk, MEMS.gyro_bias_sigma),
        (accel, MEMS.accel_noise_density, MEMS.accel_bias_walk, MEMS.accel_bias_sigma),
    ):
        bias = turn_on * rng.standard_normal(3) + np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(x.shape), axis=0)
        x += bias + density / np.sqrt(dt) * rng.standard_normal(x.shape)
    return Imu(at[1:], gyro, accel, MEMS), at, np.column_stack([np.radians(rows[:, :2]), rows[:, 2]]), rows[:, 3:6]


def recording_of(data: Path) -> Recording:
    """The drive with a simulated IMU; the reference is of the receiver's own epochs."""
    raw, fixes, truth = observations(data)
    epochs, _ = raw.epochs
    place = truth[np.clip(np.round(epochs).astype(int), 0, len(truth) - 1)]
    imu, *_ = simulated_imu(epochs, place)
    good = np.isfinite(fixes.p[:, 0])
    sd = np.sqrt(np.diagonal(fixes.covariance[good], axis1=1, axis2=2))
    v = np.einsum("nij,nj->ni", earth.enu_axes(earth.ecef_to_llh(fixes.p[good])), fixes.v[good])
    sd_v = np.sqrt(np.diagonal(fixes.covariance_v[good], axis1=1, axis2=2))
    gnss = Gnss(fixes.t[good], earth.ecef_to_llh(fixes.p[good]), sd, v, sd_v, derived=True)
    llh = earth.ecef_to_llh(place)
    return Recording(
        f"{data.name}, IMU simulated", "vehicle", imu, gnss, truth=Truth(epochs, llh), gps_zero=ZERO, raw_gnss=raw
    )


def masked(recording: Recording, spans: list[tuple[float, float]], left: int) -> Recording:
    """With the highest `left` satellites of each span's middle, and no fixes in it."""
    raw, gnss = recording.raw_gnss, recording.gnss
    assert raw is not None
    assert gnss is not None
    elevation = look(raw, raw.antenna, None).elevation
    kept, fixes = np.ones(len(raw), dtype=bool), np.ones(len(gnss.t), dtype=bool)
    for a, b in spans:
        inside = (raw.t - recording.start > a) & (raw.t - recording.start < b)
        seen, many = np.unique(
            raw.satellite[inside & np.isfinite(raw.carrier) & np.isfinite(elevation)], return_counts=True
        )
        height = [np.median(elevation[inside & (raw.satellite == s)]) for s in seen[many > 0.9 * SPAN]]
        best = seen[many > 0.9 * SPAN][np.argsort(height)[::-1][:left]]
        kept &= ~inside | np.isin(raw.satellite, best)
        fixes &= (gnss.t - recording.start < a) | (gnss.t - recording.start > b)
    some = {name: getattr(gnss, name)[fixes] for name in ("t", "llh", "sd", "v", "sd_v")}
    return replace(recording, raw_gnss=raw.take(kept), gnss=replace(gnss, **some))


def errors(solution: Solution, recording: Recording, spans: list[tuple[float, float]]) -> tuple[Array, Array]:
    """(n,) m, horizontal, at the reference's epochs in the spans: whole, and less that of the span's first epoch."""
    truth = recording.truth
    assert truth is not None
    assert truth.llh is not None
    whole, drift = [], []
    for a, b in spans:
        inside = (truth.t - recording.start > a) & (truth.t - recording.start < b) & (truth.t <= solution.t[-1])
        p = np.stack([np.interp(truth.t[inside], solution.t, solution.states.p[:, i]) for i in range(3)], -1)
        e = (p - solution.frame.from_llh(truth.llh[inside]))[:, :2]
        whole.append(np.hypot(*e.T))
        drift.append(np.hypot(*(e - e[0]).T))
    return np.concatenate(whole), np.concatenate(drift)


def canyon(data: Path, spans: list[int], counts: list[int], solvers: tuple[str, ...]) -> None:
    whole = recording_of(data)
    print(f"spans of {SPAN:.0f} s, IMU simulated; horizontal errors in the spans, m; drift: since they began")
    print(
        f"{'satellites':>10} {'carriers':>8} {'solver':6} {'H50':>6} {'H95':>6} {'max':>6} {'rms':>6} {'drift50':>7} "
        f"{'drift95':>7} {'rms':>6} {'spans':>5}"
    )
    found: dict[tuple[int, bool, str], list[tuple[Array, Array]]] = {}
    for k in spans:
        begin = FIRST + APART * k
        window = whole.crop(begin - BEFORE, begin + SPAN + AFTER)
        span = [(BEFORE, BEFORE + SPAN)]
        for differences in (True, False):
            settings = parse_settings({"raw_gnss": {"coupling": "tight", "differences": differences}})
            # a drive is long beside its canyons: how good the sensors are is known from without
            noise = run(window, settings, ("ekf",))["ekf"].noise
            for left in counts:
                solutions = run(masked(window, span, left), settings, solvers, noise=noise)
                for solver, one in solutions.items():
                    h, d = errors(one, window, span)
                    found.setdefault((left, differences, solver), []).append((h, d))
                    size = " ".join(f"{np.sqrt(np.mean(x**2)):6.2f}" for x in (h, d))
                    seconds = time.process_time()
                    name = "yes" if differences else "no"
                    print(f"span {k}: {left:3} {name:>8} {solver:6} rms, drift {size} {seconds:6.0f} s", flush=True)
    for (left, differences, solver), parts in sorted(found.items(), key=lambda one: (-one[0][0], not one[0][1])):
        h, d = (np.concatenate(some) for some in zip(*parts, strict=True))
        cells = " ".join(f"{x:6.2f}" for x in (*np.percentile(h, [50, 95, 100]), np.sqrt(np.mean(h**2))))
        cells += " " + " ".join(f"{x:7.2f}" for x in np.percentile(d, [50, 95]))
        cells += f" {np.sqrt(np.mean(d**2)):6.2f} {len(parts):5}"
        print(f"{left:10} {'yes' if differences else 'no':>8} {solver:6} {cells}", flush=True)


def windows(data: Path, spans: list[list[float]], solvers: tuple[str, ...]) -> None:
    if data.name.startswith("ucr"):
        whole = recording_of(data)
    else:
        folder = Path(tempfile.mkdtemp())
        whole, t, places = reproduce_rtk.recording_of(data.resolve(), folder, with_base=False)
        whole = replace(whole, truth=Truth(t, earth.ecef_to_llh(places)))
    print(
        f"{'window, s':>11} {'carriers':>8} {'solver':6} {'H rms':>6} {'shape':>6} {'U rms':>6} {'NEES H':>6} {'s':>4}"
    )
    for begin, end in spans:
        recording = whole.crop(begin, min(end, whole.duration))
        truth = recording.truth
        assert truth is not None
        assert truth.llh is not None
        for differences in (False, True):
            settings = parse_settings({"raw_gnss": {"coupling": "tight", "differences": differences}})
            began = time.process_time()
            solutions = run(recording, settings, solvers)
            seconds = time.process_time() - began
            for solver, one in solutions.items():
                inside = (truth.t >= one.t[0]) & (truth.t <= one.t[-1])
                at = truth.t[inside]
                p = np.stack([np.interp(at, one.t, one.states.p[:, i]) for i in range(3)], -1)
                e = p - one.frame.from_llh(truth.llh[inside])
                k = np.argmin(np.abs(one.t[None] - at[:, None]), axis=1)
                P = one.covariance[k][:, 3:5, 3:5]
                nees = np.mean(np.einsum("ni,nij,nj->n", e[:, :2], np.linalg.inv(P), e[:, :2])) / 2.0
                shape = np.hypot(*(e - e.mean(axis=0))[:, :2].T)
                sizes = (np.sqrt(np.mean(x**2)) for x in (np.hypot(e[:, 0], e[:, 1]), shape, e[:, 2]))
                cells = " ".join(f"{x:6.2f}" for x in (*sizes, nees))
                print(
                    f"{begin:5.0f}-{end:5.0f} {'yes' if differences else 'no':>8} {solver:6} {cells} {seconds:4.0f}",
                    flush=True,
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("increments", "windows", "canyon"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--span", type=int, action="append", help="of ten, counted from 0; repeatable, all without")
    parser.add_argument("--satellites", type=int, nargs="+", default=[4, 3, 2, 1, 0])
    parser.add_argument("--solver", action="append", default=[], help="repeatable; all three without")
    parser.add_argument("--window", type=float, nargs=2, action="append", help="s from the start; repeatable")
    given = parser.parse_args()
    if given.what == "increments":
        increments(given.data)
    elif given.what == "windows":
        windows(given.data, given.window or [[0.0, np.inf]], tuple(given.solver) or SOLVERS)
    else:
        canyon(given.data, given.span or list(range(SPANS)), given.satellites, tuple(given.solver) or SOLVERS)


if __name__ == "__main__":
    main()
