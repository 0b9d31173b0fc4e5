"""One-cycle slips that no flag tells, of several satellites at once, and what becomes of integers after them.

    python scripts/reproduce_slips.py ../shared/data/ucr_riverside_20200712 -o build/slips --begin 300 --begin 600
    python scripts/reproduce_slips.py ../shared/data/ucr_riverside_20200712 -o build/slips --begin 600 --unsearched
    python scripts/reproduce_slips.py ../shared/data/ucr_riverside_20200712 -o build/slips --begin 600 --left 4

Of 50 s from `--begin` on, by filter and smoother with stated noise: slips after 20 s of some satellites that are
drawn, and of filter and smoother, the worst of the draws: epochs after them that are not fixed, those that are fixed
and wrong (more than 0.1 m off), and the largest horizontal error at them, m. `--unsearched` takes the arcs from the
observations without slips, so that integers have to be let go of. `--left` leaves the highest so many satellites from
15 s on.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from reproduce_rtk import WRONG, errors, recording_of

from graphnav.config import Settings, parse_settings
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.series import RawGnss
from graphnav.gnss.single_point import choose_coefficients, look
from graphnav.recording import Recording

Array = np.ndarray
_SLIP, _LENGTH = 20.0, 50.0  # s from the begin of a stretch
_FEW = 5.0  # s before the slips, from which few satellites are left


def list_satellites(raw: RawGnss, at: float) -> Array:
    """Satellites of which carriers are used at the first epoch from a time on."""
    defaults = Settings().raw_gnss
    epochs, _ = raw.epochs
    here = raw.take(raw.t == epochs[np.searchsorted(epochs, at - 0.01)])
    high = look(here, here.antenna, choose_coefficients(here)).elevation >= np.radians(defaults.elevation)
    there = np.isfinite(here.carrier) & np.isfinite(here.carrier_difference)
    return np.unique(here.satellite[there & high & ~(here.cn0 < defaults.cn0)])


def leave(raw: RawGnss, at: float, left: int) -> RawGnss:
    """The observations with the highest so many satellites from before a time on."""
    elevation = look(raw, raw.antenna, choose_coefficients(raw)).elevation
    own = list_satellites(raw, at)
    height = [-float(np.median(elevation[raw.satellite == one])) for one in own]
    return raw.take((raw.t < at - _FEW) | np.isin(raw.satellite, own[np.argsort(height)[:left]]))


def slip(raw: RawGnss, at: float, count: int, seed: int) -> RawGnss:
    """The carriers of so many of the satellites that are used, drawn, off by a cycle from a time on, up or down."""
    rng = np.random.default_rng(seed)
    carrier = raw.carrier.copy()
    for satellite in rng.permutation(list_satellites(raw, at))[:count]:
        for signal in np.unique(raw.signal[raw.satellite == satellite]):
            own = (raw.satellite == satellite) & (raw.signal == signal) & (raw.t >= at - 0.01)
            carrier[own] += rng.choice([-1.0, 1.0])
    return replace(raw, carrier=carrier)


def measure(one: Solution, t: Array, places: Array, at: float) -> tuple[int, int, float]:
    """Epochs from a time on that are not fixed, those fixed and wrong, and the largest horizontal error, m."""
    h = np.hypot(*errors(one.t, one.trajectory().llh, t, places)[:, :2].T)
    k = np.argmin(np.abs(one.fixed[None, :, 0] - t[:, None]), axis=1)
    fixed, after = one.fixed[k, 1] > 0.0, t >= at - 0.01
    return int(np.sum(~fixed & after)), int(np.sum(fixed & after & (h > WRONG))), float(np.nanmax(h[after]))


def stretch_of(recording: Recording, begin: float) -> tuple[Recording, float]:
    """The stretch, and when slips are made, s."""
    return recording.crop(begin, begin + _LENGTH), recording.start + begin + _SLIP


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--begin", type=float, action="append", help="s, of a stretch; repeatable")
    parser.add_argument("--draws", type=int, default=2, help="of each number of satellites")
    parser.add_argument("--unsearched", action="store_true", help="without the search for slips")
    parser.add_argument("--left", type=int, help="satellites, of the highest, that are left; all without")
    given = parser.parse_args()
    folder = (given.output / given.data.name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    whole, t, places = recording_of(given.data.resolve(), folder)
    stated = parse_settings({"noise": {"mode": "stated"}})
    print(f"{'begin':>6} {'of':>3} {'slip':>4} {'draws':>5} {'found':>7}   ekf: float wrong max   rts: the same")
    for begin in given.begin or [0.0]:
        recording, at = stretch_of(whole, begin)
        raw = recording.raw_gnss
        assert raw is not None
        if given.left:
            raw = leave(raw, at, given.left)
        inside = (t >= recording.start) & (t <= recording.end)
        before = find_arcs(raw, base_arc=raw.base_arc)
        many = len(list_satellites(raw, at))
        for count in (0, 1, 2) if given.left else (0, 1, 2, 4, many // 2, many - 3):
            found, worst = [], []
            for draw in range(given.draws if count else 1):
                slipped = slip(raw, at, count, 100 * count + draw)
                found.append(find_arcs(slipped, base_arc=raw.base_arc).slips - before.slips)
                if given.unsearched:
                    slipped = replace(slipped, arc_begin=before.begin)
                solved = run(replace(recording, raw_gnss=slipped), stated, ("ekf", "rts"))
                worst.append([x for one in solved.values() for x in measure(one, t[inside], places[inside], at)])
            numbers = np.max(worst, axis=0)
            columns = "   ".join(f"{numbers[i]:10.0f} {numbers[i + 1]:6.0f} {numbers[i + 2]:5.3f}" for i in (0, 3))
            search = "" if given.unsearched else f"{min(found)}-{max(found)}"
            print(f"{begin:6.0f} {many:3} {count:4} {len(worst):5} {search:>7}   {columns}", flush=True)


if __name__ == "__main__":
    main()
