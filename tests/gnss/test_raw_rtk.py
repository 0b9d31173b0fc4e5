"""Carriers against a base station: arcs, rows, integers; on a simulated drive, against GTSAM, and on a real drive."""

from __future__ import annotations

import gzip
import itertools
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gtsam
import numpy as np
import oracle
import pytest
import raw_drive
from helpers import errors, truth_states
from test_raw_rows import scene

from graphnav.config import parse_settings
from graphnav.constraints.raw_gnss import CLOCK
from graphnav.constraints.raw_phase import GnssPhase, WholeCycles
from graphnav.core import earth
from graphnav.estimation import fixing
from graphnav.estimation.known_arcs import Known
from graphnav.estimation.pipeline import run
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.atmosphere import NIGHT, compute_directions, compute_klobuchar_delay
from graphnav.gnss.differential import add_differences
from graphnav.gnss.ephemeris import OMEGA_WGS84
from graphnav.gnss.integers import decorrelate, find_nearest
from graphnav.gnss.series import RawGnss
from graphnav.gnss.sigmas import REFLECTED, compute_code_reflection_sigma, compute_reflection_sigma
from graphnav.gnss.signals import L1, C, name_satellite, name_signal
from graphnav.recording.formats import read
from graphnav.report.satellites import tabulate_epochs, tabulate_satellites

STATED = parse_settings({"noise": {"mode": "stated"}})
WAVELENGTH = C / L1
AWAY = np.array([1500.0, -2000.0, 60.0])  # m, from the drive's start to the base


def cycles_of(satellite):
    """The integers of the rover's carriers."""
    return 1000 * (satellite.astype(int) % 97) - 31000


def with_carriers(recording, path, noise, seed=3):
    """Carriers of the rover, and differences by a base station, each with a clock and ambiguities of its own."""
    raw, rng = recording.raw_gnss, np.random.default_rng(seed)
    lever = tuple(float(x) for x in recording.gnss.lever_arm)
    t = recording.gnss.t
    places = {}
    for k, name in enumerate(raw_drive.SATELLITES):
        places[name] = k
    above = np.array(raw.place)
    llh = path.point(t, lever)[0]
    at = np.searchsorted(t, raw.t)
    azimuth, elevation = compute_directions(earth.llh_to_ecef(llh)[at], raw.p)
    delay = compute_klobuchar_delay(NIGHT, np.mod(raw.t, 604800.0), llh[at], azimuth, elevation)
    true = np.empty(len(raw))
    base = []
    R = earth.enu_axes(llh[0])
    position = earth.llh_to_ecef(llh[0]) + AWAY @ R
    fixed = earth.ecef_to_llh(position)
    for k, name in enumerate(raw_drive.SATELLITES):
        own = raw.satellite == raw_drive.number_satellite(name)
        if not own.any():
            continue
        true[own] = raw_drive.observe(lambda at: path.point(at, lever)[0], raw.t[own], above, k)[0]
        seen, p, v = raw_drive.observe(lambda at: np.tile(fixed, (len(at), 1)), t, above, k)
        high = compute_directions(np.tile(position, (len(t), 1)), p)
        of_base = compute_klobuchar_delay(NIGHT, np.mod(t, 604800.0), np.tile(fixed, (len(t), 1)), *high)
        clock = -70.0 + 0.3 * t
        base.append((raw.satellite[own][0], seen + clock, of_base, p, v))
    clock = 150.0 + 1.0 * raw.t - 40.0 * np.cos(0.05 * raw.t)
    carrier = (true + clock - delay + noise * rng.standard_normal(len(raw))) / WAVELENGTH
    carrier = carrier + cycles_of(raw.satellite) + np.where(raw.satellite >= 200, 0.3, 0.6)
    rows = [
        (when, satellite, seen[i] + of[i], (seen[i] - of[i]) / WAVELENGTH, p[i], v[i])
        for satellite, seen, of, p, v in base
        for i, when in enumerate(t)
    ]
    rows.sort(key=lambda row: (row[0], row[1]))
    when, satellite, code, phase, p, v = (np.array(x) for x in zip(*rows, strict=True))
    n = len(when)
    of_base = RawGnss(
        t=when, satellite=satellite.astype(np.int16), signal=np.full(n, raw.signal[0]), code=code,
        carrier=phase + noise / WAVELENGTH * rng.standard_normal(n), range_rate=np.full(n, np.nan),
        cn0=np.full(n, 45.0), slip=np.zeros(n, dtype=bool), half=np.zeros(n, dtype=bool), frequency=np.full(n, L1),
        p=p, v=v, clock=np.zeros(n), drift=np.zeros(n), difference=np.full(n, np.nan), zero=raw.zero,
        place=tuple(position), troposphere=True,
    )  # fmt: skip
    raw, _ = add_differences(replace(raw, carrier=carrier), of_base, position)
    return replace(recording, raw_gnss=raw), position


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_integers_are_those_that_all_tried_in_turn_find(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        A = rng.normal(size=(n, n))
        Q, a = 0.3 * A @ A.T + 1e-4 * np.eye(n), 5.0 * rng.normal(size=n)
        found = decorrelate(Q)
        assert abs(round(np.linalg.det(found.Z))) == 1
        np.testing.assert_allclose(found.Z.T @ Q @ found.Z, found.L.T @ np.diag(found.D) @ found.L, atol=1e-9)
        nearest = find_nearest(a, found)
        # no integer farther off in any number can be nearer than the second best
        reach = np.ceil(np.sqrt(np.diagonal(Q) * nearest.distance_second)).astype(int) + 1
        grid = np.array(list(itertools.product(*(range(-r, r + 1) for r in reach)))) + np.rint(a)
        far = np.einsum("ki,ij,kj->k", grid - a, np.linalg.inv(Q), grid - a)
        order = np.argsort(far)[:2]
        np.testing.assert_array_equal(grid[order], [nearest.best, nearest.second])
        np.testing.assert_allclose(far[order], [nearest.distance, nearest.distance_second])


KAMAKURA = Path(__file__).resolve().parents[2] / "data" / "kamakura_rtk"


def test_real_epochs_are_soon_fixed_and_their_integers_are_rtklibs(monkeypatch):
    """Twelve seconds of three frequencies: each search of filter and smoother, by RTKLIB's LAMBDA as well."""
    rt = pytest.importorskip("pyrtklib")
    searches, seen = [], []
    monkeypatch.setattr(fixing, "decorrelate", lambda Q: seen.append(Q) or decorrelate(Q))
    monkeypatch.setattr(
        fixing,
        "find_nearest",
        lambda a, found: searches.append((a, seen[-1], find_nearest(a, found))) or searches[-1][2],
    )
    recording = read(KAMAKURA).crop(0.0, 12.0)
    solutions = run(recording, STATED, ("ekf", "rts"))
    assert len(searches) > 3
    for a, Q, nearest in searches:
        n = len(a)
        values, covariance = rt.Arr1Ddouble(n), rt.Arr1Ddouble(n * n)
        for i in range(n):
            values[i] = float(a[i])
            for j in range(n):
                covariance[i + n * j] = float(Q[i, j])
        vectors, distances = rt.Arr1Ddouble(2 * n), rt.Arr1Ddouble(2)
        assert getattr(rt, "lambda")(n, 2, values, covariance, vectors, distances) == 0
        assert [round(vectors[i]) for i in range(2 * n)] == [*nearest.best, *nearest.second]
        np.testing.assert_allclose([distances[0], distances[1]], [nearest.distance, nearest.distance_second], rtol=1e-4)
    for one in solutions.values():
        assert one.fixed[one.fixed[:, 0] > recording.start + 2.0, 1].all()
        t = recording.truth.t
        p = np.stack([np.interp(t, one.t, one.states.p[:, i]) for i in range(3)], -1)
        off = (one.frame.from_llh(recording.truth.llh) - p)[(t > recording.start + 2.0) & (t < recording.end)]
        assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05  # m, what the reference is good to


def locate_by_rtklib(rt, folder, base):
    """(E, 5) of RTKLIB's kinematic solution: s of the week, its state, and place in e."""
    obs, nav = rt.obs_t(), rt.nav_t()
    for name, number in (("rover.obs", 1), ("base.obs", 2), ("nav", 0)):
        (folder / name).write_bytes(gzip.decompress((KAMAKURA / f"{name}.gz").read_bytes()))
        rt.readrnx(str(folder / name), number, "", obs, nav, rt.sta_t())
    rt.sortobs(obs)
    rt.uniqnav(nav)
    how, state = rt.prcopt_default, rt.rtk_t()  # of which there is one: others find it as it was
    chosen = {
        "mode": rt.PMODE_KINEMA,
        "nf": 2,
        "navsys": rt.SYS_GPS | rt.SYS_GAL,
        "elmin": np.radians(10.0),
        "modear": 3,
    }
    before = {name: getattr(how, name) for name in chosen}
    for name, value in chosen.items():
        setattr(how, name, value)
    rt.rtkinit(state, how)
    for name, value in before.items():
        setattr(how, name, value)
    for i in range(3):
        state.opt.rb[i] = state.rb[i] = base[i]
    rows = [obs.data[k] for k in range(obs.n)]
    second = np.round([rt.timediff(one.time, rt.gpst2time(2176, 0.0)) for one in rows])
    found = []
    for t in np.unique(second):
        own = sorted(np.flatnonzero(second == t), key=lambda k: rows[k].rcv)
        if len({rows[k].rcv for k in own}) < 2:
            continue
        here = rt.Arr1Dobsd_t(len(own))
        for i, k in enumerate(own):
            here[i] = rows[k]
        rt.rtkpos(state, here.ptr, len(own), nav)
        found.append((t, state.sol.stat, *(state.sol.rr[i] for i in range(3))))
    return np.array(found)


def test_places_with_integers_are_rtklibs(tmp_path):
    """Where RTKLIB has integers, by two of the three frequencies, which it has later than filter and smoother."""
    rt = pytest.importorskip("pyrtklib")
    theirs = locate_by_rtklib(rt, tmp_path, (-3959400.631, 3385704.533, 3667523.111))
    theirs = theirs[theirs[:, 1] == rt.SOLQ_FIX]
    recording = read(KAMAKURA)
    solutions = run(recording, STATED, ("ekf", "rts"))
    assert len(theirs) > 20
    for one in solutions.values():
        t = theirs[:, 0] - 282600.0
        assert one.fixed[one.fixed[:, 0] > recording.start + 2.0, 1].all()
        p = np.stack([np.interp(t, one.t, one.states.p[:, i]) for i in range(3)], -1)
        off = (p - one.frame.from_llh(earth.ecef_to_llh(theirs[:, 2:])))[t > recording.start + 2.0]
        assert np.hypot(off[:, 0], off[:, 1]).max() < 0.03
        assert np.abs(off[:, 2]).max() < 0.07  # two sigmas of unknown phase centres, of which it states none


def test_what_is_known_of_arcs_holds_however_they_were_joined():
    rng = np.random.default_rng(0)
    true = rng.integers(-100, 100, 12)
    known = Known()
    for a, b in rng.integers(0, 12, (60, 2)):
        known.join((int(a), 0), (int(b), 0), int(true[a] - true[b]))
    known.forget((3, 0))
    assert known.find((3, 0)) == ((3, 0), 0)
    others = [k for k in range(12) if k != 3]
    assert len({known.find((k, 0))[0] for k in others}) == 1
    of = [known.find((k, 0))[1] for k in others]
    np.testing.assert_array_equal(np.diff(of), np.diff(true[others]))


@pytest.fixture(scope="module")
def exact():
    path = oracle.vehicle_path(120.0, lat=-45.0)
    made, truth = oracle.drive(path, imu_noise=None, gnss_exact=True, gnss_velocity_sd=(0.1, 0.1, 0.1))
    recording = raw_drive.with_observations(made, path).crop(0.0, 40.0)
    return *with_carriers(recording, path, 0.0), truth


def test_an_arc_ends_at_flags_gaps_half_cycles_and_slips(exact):
    raw = exact[0].raw_gnss
    satellites = np.unique(raw.satellite)[:5]
    epochs, _ = raw.epochs
    assert all(len(b) == 1 for b in find_arcs(raw, base_arc=raw.base_arc).begins)

    def rows(satellite, at):
        return (raw.satellite == satellite) & (raw.t >= epochs[at])

    flagged, absent, half, slipped, of_base = satellites
    carrier, slip, open_half = raw.carrier.copy(), raw.slip.copy(), raw.half.copy()
    base_arc = raw.base_arc.copy()
    slip |= rows(flagged, 5) & ~rows(flagged, 6)
    carrier[rows(absent, 8) & ~rows(absent, 9)] = np.nan
    open_half |= rows(half, 12)
    carrier[rows(slipped, 15)] += 0.5  # nobody says so
    base_arc[rows(of_base, 18)] += 1
    arcs = find_arcs(replace(raw, carrier=carrier, slip=slip, half=open_half), base_arc=base_arc)
    begins = dict(zip(arcs.satellite.tolist(), arcs.begins, strict=True))
    for satellite, at in ((flagged, 5), (absent, 9), (half, 12), (slipped, 15), (of_base, 18)):
        np.testing.assert_allclose(begins.pop(int(satellite)), epochs[[0, at]])
    assert arcs.slips == 1
    assert all(len(b) == 1 for b in begins.values())


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_where_no_few_satellites_can_be_told_to_have_slipped_all_arcs_end(exact, share):
    """Cycles of both signs at one epoch: of few they are told apart, of most of them only that there are some."""
    raw, rng = exact[0].raw_gnss, np.random.default_rng(4)
    at = raw.epochs[0][15]
    satellites = rng.permutation(np.unique(raw.satellite[raw.t == at]))
    chosen = satellites[: round(share * len(satellites))]
    sign = {int(satellite): 1.0 - 2.0 * (k % 2) for k, satellite in enumerate(chosen)}
    cycles = np.array([sign.get(int(satellite), 0.0) for satellite in raw.satellite])
    arcs = find_arcs(replace(raw, carrier=raw.carrier + cycles * (raw.t >= at)), base_arc=raw.base_arc)
    begun = {int(arcs.satellite[k]) for k, begins in enumerate(arcs.begins) if at in begins}
    assert begun == set((chosen if share < 0.5 else satellites).tolist())


def test_the_ionosphere_changes_the_more_the_longer_an_interval_is():
    """By 7 cm on L1, three sigmas after two minutes, where two frequencies tell it, and a slip after half a minute; nor
    does it hide a cycle of one signal or of both.
    """
    path = oracle.vehicle_path(400.0)
    made = oracle.drive(path, imu_noise=None, gnss_exact=True)[0]
    whole = raw_drive.with_observations(made, path, carrier=0.002, second=True).raw_gnss
    lever = tuple(float(x) for x in made.gnss.lever_arm)
    for apart in (120, 30):
        epochs = whole.epochs[0][::apart]
        raw = whole.take(np.isin(whole.t, epochs))
        raw = replace(raw, antenna=earth.llh_to_ecef(path.point(raw.t, lever)[0]))
        own = raw.satellite == raw_drive.number_satellite("E03")  # 23 deg high
        advance = 0.07 * np.searchsorted(epochs, raw.t)[own] * (L1 / raw.frequency[own]) ** 2
        carrier = raw.carrier.copy()
        carrier[own] += advance * raw.frequency[own] / C
        signals = np.unique(raw.signal[own])

        def count(carrier, signals, raw=raw, own=own):
            arcs = find_arcs(replace(raw, carrier=carrier).take(~own | np.isin(raw.signal, signals)))
            return {name: len(begins) for name, begins in zip(arcs.names, arcs.begins, strict=True) if len(begins) > 1}

        if apart == 30:
            assert set(count(carrier, signals)) == {f"E03.{name_signal(s)}" for s in signals}
            continue
        assert count(carrier, signals) == {}
        assert set(count(carrier, signals[:1])) == {f"E03.{name_signal(signals[0])}"}
        for some in (signals[:1], signals[1:], signals):
            slipped = carrier + (own & np.isin(raw.signal, some) & (raw.t >= epochs[2]))
            found = count(slipped, signals)
            assert {f"E03.{name_signal(s)}" for s in some} <= found.keys()
            assert set(found.values()) == {2}


class SlippedEpochs:
    """Ten arcs of one signal, of which some are far off, as an epoch that is looked at."""

    def __init__(self):
        self.columns, self.far = {}, []
        self.arcs, self.time = [(f"ambiguity.{k}", 0.0) for k in range(10)], np.arange(9.0)

    def find_slipped(self, k, here):
        return tuple(self.arcs[i] for i in self.far)

    def group_arcs(self, k, known):
        sets = {}
        for arc in self.arcs:
            sets.setdefault(known.find(arc)[0], []).append(arc)
        return {0: sorted(sets.values(), key=len, reverse=True)}

    def find_inconsistent(self, k, here, known):
        return []

    def count_differences(self, k, known):
        return sum(len(one) - 1 for one in self.group_arcs(k, known)[0])

    def compute_lasting(self, k, until, since):
        return {}


def test_arcs_that_are_a_quarter_of_a_cycle_off_begin_anew(monkeypatch):
    """However many they are, and whether their integers are known or not; then nothing is decided at the epoch."""
    epochs = SlippedEpochs()
    known, asked = fixing.Known(), []
    for i, cycles in ((1, 5), (2, 7)):
        known.join(epochs.arcs[0], epochs.arcs[i], cycles)
    monkeypatch.setattr(fixing, "_decide", lambda *given, **_: asked.append(given) or [])
    here, held = SimpleNamespace(values=np.zeros((1, 0))), [fixing.Held(known)]
    for k, far in enumerate(([1], [3, 4, 6, 8, 9], [])):
        epochs.far = far
        held.append(fixing.hold_on(held[-1].go_on(), epochs, k, here, lambda: np.zeros((0, 0)), True))
        assert set(held[-1].anew) == {epochs.arcs[i] for i in far}
        assert len(asked) == (not far)
    assert set(held[-1].known.of) == {epochs.arcs[0], epochs.arcs[2]}
    assert set(held[0].known.of) == set(epochs.arcs[:3])
    assert held[-1].since == {epochs.arcs[i]: float(i != 1) for i in (1, 3, 4, 6, 8, 9)}


def test_an_arc_that_begins_anew_is_another_from_there_on(exact):
    where = scene(exact[0], STATED)
    rows = GnssPhase.build(where)
    k = int(np.unique(rows.keyframe)[6])
    of = rows.slot == 2
    arc = rows.slots[2], float(rows.begin[of][0])
    split = fixing._split_arcs(rows, where.t, [(arc, k), (arc, k)])
    np.testing.assert_array_equal(split.begin[of], np.where(rows.keyframe[of] < k, arc[1], where.t[k]))
    np.testing.assert_array_equal(split.begin[~of], rows.begin[~of])
    before, own = ({p.name: p for p in one.parameters}[arc[0]] for one in (rows, split))
    np.testing.assert_array_equal(own.begins, [*before.begins, where.t[k]])
    np.testing.assert_array_equal(own.sigma, np.tile(before.sigma, (2, 1)))


def true_values(rows, where, raw, given):
    """Parameters of the truth, up to what all carriers of a signal have in common."""
    out = {p.name: np.tile(p.initial, (len(given), 1)) for p in rows.parameters if p.begins is None}
    out[CLOCK] = np.zeros((len(given), 2))
    satellites = {name: raw_drive.number_satellite(name.split(".")[1]) for name in rows.slots}
    return out | {name: np.full((len(given), 1), float(cycles_of(np.array([k]))[0])) for name, k in satellites.items()}


def test_differences_of_carrier_rows_are_gtsams_double_differences(exact):
    """With true states and integers both are zero; off them by metres and cycles they stay the same."""
    recording, position, truth = exact
    where = scene(recording, STATED)
    rows, raw = GnssPhase.build(where), recording.raw_gnss
    frame = where.frame
    states = truth_states(truth, where.t[rows.keyframe], frame)
    R_en = frame.R_ne.T
    values = true_values(rows, where, raw, rows.keyframe)
    exact_rows = rows.linearize(states, values, slice(None)).residual[:, 0]
    off = np.array([0.4, -0.7, 0.2])
    moved = replace(states, p=states.p + off)
    values[rows.slots[1]] = values[rows.slots[1]] + 3.0
    linear = rows.linearize(moved, values, slice(None))
    model = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
    seen = 0
    for k in range(2, where.t.size, 9):
        own = np.flatnonzero(rows.keyframe == k)
        own = own[rows.satellite[own] < 200]
        for i, j in itertools.pairwise(own):
            assert abs(exact_rows[i] - exact_rows[j]) < 2e-4
            pose = gtsam.Pose3(gtsam.Rot3(R_en @ moved.R_nb[i]), frame.r_e + R_en @ moved.p[i])
            meters, sat = [], []
            for row in (i, j):
                here = np.flatnonzero((np.abs(raw.t - where.t[k]) < 1e-6) & (raw.satellite == rows.satellite[row]))[0]
                p = raw.p[here]
                # the base as our difference has it: what its carrier is off by, against its distance, which GTSAM turns
                earth_turned = OMEGA_WGS84 / C * (p[0] * position[1] - p[1] * position[0])
                away = np.linalg.norm(p - position) + earth_turned
                known = WAVELENGTH * raw.carrier[here] + raw.carrier_difference[here]
                meters.append((known + delay_of(rows, raw, here, row), away))
                sat.append(p)
            factor = gtsam.DoubleDifferenceCarrierPhaseFactorArm(
                0, 1, 2, meters[0][0], meters[0][1], meters[1][0], meters[1][1], sat[0], sat[1], sat[0], sat[1],
                position, WAVELENGTH, rows.lever_arm, model,
            )  # fmt: skip
            found = gtsam.Values()
            found.insert(0, pose)
            for key, row in ((1, i), (2, j)):
                found.insert(key, float(values[rows.slots[rows.slot[row]]][row, 0]))
            error = factor.unwhitenedError(found)[0]
            # GTSAM's is of the target less the reference
            ours = linear.residual[j, 0] - linear.residual[i, 0]
            assert abs(error) == pytest.approx(abs(ours), abs=1e-3)
            seen += 1
    assert seen > 10


def delay_of(rows, raw, here, row):
    """m, the ionosphere's advance of a carrier at the rover, which GTSAM's has no part of."""
    one = np.array([here])
    antenna = raw.antenna[one]
    azimuth, elevation = compute_directions(antenna, raw.p[one])
    return float(
        compute_klobuchar_delay(NIGHT, raw.seconds_of_week[one], earth.ecef_to_llh(antenna), azimuth, elevation)[0]
    )


def test_derivatives_are_those_of_differences(exact):
    recording, _, truth = exact
    where = scene(recording, STATED)
    rows = GnssPhase.build(where)
    pick = np.arange(0, len(rows), 17)
    states = truth_states(truth, where.t[rows.keyframe[pick]], where.frame)
    values = true_values(rows, where, recording.raw_gnss, pick)
    linear = rows.linearize(states, values, pick)
    h = 1e-4
    for column, name in enumerate(["theta"] * 3 + ["p"] * 3):
        step = np.zeros((len(pick), 15))
        step[:, column] = h
        ahead, behind = (rows.linearize(states.plus(s * step), values, pick).residual for s in (1.0, -1.0))
        numeric = (ahead - behind) / (2.0 * h)
        np.testing.assert_allclose(linear.jacobians[name][:, :, column % 3], numeric, atol=1e-5)
    for name, J in linear.jacobians.items():
        if name in values:
            for i in range(J.shape[2]):
                off = {**values, name: values[name] + h * (np.arange(J.shape[2]) == i)}
                numeric = (rows.linearize(states, off, pick).residual - linear.residual) / h
                np.testing.assert_allclose(J[:, :, i], numeric, atol=1e-5)
    both = WholeCycles(keyframe=np.zeros(2, dtype=int), slots=("a", "b", "c"), pair=np.array([[0, 1], [2, 0]]),
                       cycles=np.array([4.0, -1.0]))  # fmt: skip
    held = both.linearize(states[:2], {"a": np.full((2, 1), 6.0), "b": np.ones((2, 1)), "c": np.ones((2, 1))},
                          slice(None))  # fmt: skip
    np.testing.assert_allclose(held.residual[:, 0], [1.0, -4.0])
    np.testing.assert_allclose(held.jacobians["a"][:, 0, 0], [1.0, -1.0])


def test_reflections_that_last_are_in_the_sigma(drive):
    """As long and as large as they are taken to be, for each satellite by itself: not a shift of the place."""
    recording, truth = drive
    raw, rng = recording.raw_gnss, np.random.default_rng(8)
    carrier = raw.carrier.copy()
    _, elevation = compute_directions(raw.antenna, raw.p)
    for satellite in np.unique(raw.satellite):
        own = raw.satellite == satellite
        decay = np.exp(-np.diff(raw.t[own]) / REFLECTED)
        x = rng.standard_normal(int(own.sum()))
        for i, a in enumerate(decay):
            x[i + 1] = a * x[i] + np.sqrt(1.0 - a * a) * x[i + 1]
        carrier[own] += np.sqrt(2.0) * compute_reflection_sigma(elevation[own]) * x / WAVELENGTH
    spoilt = replace(recording, raw_gnss=replace(raw, carrier=carrier))
    rows = GnssPhase.build(scene(recording, STATED))
    own = rows.keyframe == rows.keyframe[len(rows) // 2]
    e = (rows.s_n - rows.nominal)[own]
    A = np.column_stack([e / np.linalg.norm(e, axis=1)[:, None], np.ones(len(e))]) / rows.reflected[own, None]
    # nothing is better than the mean of such a process, whose variance over a time T is at least 2 tau / (T + 2 tau)
    least = np.trace(np.linalg.inv(A.T @ A)[:3, :3]) * 2.0 * REFLECTED / (np.ptp(raw.t) + 2.0 * REFLECTED)
    for one in run(spoilt, STATED, ("ekf", "rts")).values():
        off, sigma = errors(one, truth)[:2]
        fixed = one.fixed[one.fixed[:, 1] > 0.0, 0]
        assert len(fixed) > 10
        k = np.searchsorted(one.t, fixed - 1e-6)
        assert np.sum(sigma[k] ** 2, axis=1).min() > 0.9 * least
        # three numbers that hardly change within the drive: chi-square of three or a few more, 99.9 %
        assert 0.05 < np.mean((off[k] / sigma[k]) ** 2) < 5.4


def test_float_ambiguities_know_what_lasts_in_codes():
    """Codes of each satellite are off for minutes: their mean over a drive is no better than at an epoch."""
    squares, path = [], oracle.vehicle_path(120.0, 50.0)
    for seed in range(10):
        made, truth = oracle.drive(path, seed=seed, gnss_velocity_sd=(0.1, 0.1, 0.1))
        recording = raw_drive.with_observations(made, path, noise=0.1, seed=seed).crop(0.0, 26.0)
        recording = with_carriers(recording, path, 0.001, seed=seed)[0]
        raw, rng = recording.raw_gnss, np.random.default_rng(seed)
        _, elevation = compute_directions(raw.antenna, raw.p)
        _, which = raw.satellites
        off = compute_code_reflection_sigma(elevation) * rng.standard_normal(which.max() + 1)[which]
        how = parse_settings({"noise": {"mode": "stated"}, "raw_gnss": {"integers": False}})
        one = run(replace(recording, raw_gnss=replace(raw, code=raw.code + off)), how, ("rts",))["rts"]
        error, sigma = errors(one, truth)[:2]
        squares.append(np.mean((error[-1, :2] / sigma[-1, :2]) ** 2))
    assert np.mean(squares) < 2.27  # chi-square of twenty numbers, 99.9 %, over twenty


@pytest.fixture(scope="module")
def drive():
    path = oracle.vehicle_path(120.0, 50.0)
    made, truth = oracle.drive(path, seed=5, gnss_velocity_sd=(0.1, 0.1, 0.1))
    with pytest.MonkeyPatch.context() as patch:  # reflections of half a dozen satellites would outlast the drive
        patch.setattr(raw_drive, "SATELLITES", raw_drive.MANY)
        recording = raw_drive.with_observations(made, path, noise=0.5, seed=2).crop(0.0, 26.0)
        return with_carriers(recording, path, 0.001)[0], truth  # white as modelled towards the zenith


def off_by(solution, truth):
    """m, horizontally, at the epochs with carriers, and which of these are fixed."""
    off = errors(solution, truth)[0]
    k = np.searchsorted(solution.t, solution.fixed[:, 0] - 1e-6)
    return np.linalg.norm(off[k, :2], axis=1), solution.fixed[:, 1] > 0.0


def test_every_solver_is_fixed_and_right(drive):
    recording, truth = drive
    solutions = run(recording, STATED, ("ekf", "rts", "batch"))
    for name, one in solutions.items():
        off, fixed = off_by(one, truth)
        assert fixed.any(), name
        assert fixed[np.argmax(fixed) :].all(), name  # what is found is held
        assert off[fixed].max() < 0.05, name
    assert off_by(solutions["batch"], truth)[1].all()  # a smoother knows all the time what it knows at the end
    np.testing.assert_allclose(solutions["rts"].states.p, solutions["batch"].states.p, atol=2e-3)
    real = run(recording, parse_settings({"noise": {"mode": "stated"}, "raw_gnss": {"integers": False}}), ("rts",))
    off, fixed = off_by(real["rts"], truth)
    assert not fixed.any()
    assert np.sqrt(np.mean(off**2)) > 2.0 * np.sqrt(np.mean(off_by(solutions["rts"], truth)[0] ** 2))


def test_an_unknown_phase_centre_is_in_the_height_and_in_nothing_else(drive):
    """Five centimetres above the point stated: heights are off by them, within their sigmas, and no place is."""
    recording, truth = drive
    raw, high = recording.raw_gnss, np.array([0.0, 0.0, 0.05])
    lower = replace(recording, raw_gnss=replace(raw, lever_arm=raw.lever_arm - high))
    right, off = (run(one, STATED, ("rts",))["rts"] for one in (recording, lower))
    k = np.searchsorted(off.t, off.fixed[off.fixed[:, 1] > 0.0, 0] - 1e-6)
    assert len(k) > 10
    error, sigma, _, _ = errors(off, truth)
    moved = error[k] - errors(right, truth)[0][k]
    np.testing.assert_allclose(moved, off.states.R_nb[k] @ high, atol=1e-3)  # up in the vehicle, which leans a little
    assert np.abs(error[k, 2] / sigma[k, 2]).max() < 2.0
    assert sigma[k, :2].max() < 0.02


def test_a_wrong_integer_is_let_go_of(drive, monkeypatch):
    """Every other number of the first vector that the filter takes is wrong, and nothing is noticed for some epochs."""
    recording, truth = drive
    found, noticed = [], fixing.Epochs.find_inconsistent

    def wrong(a, decorrelated):
        nearest = find_nearest(a, decorrelated)
        found.append(nearest.ratio >= fixing._RATIO)
        spoiled = (np.arange(len(a)) % 2 == 0) & found[-1] & (sum(found) == 1)
        return replace(nearest, best=nearest.best + 3 * spoiled)

    monkeypatch.setattr(fixing, "find_nearest", wrong)
    monkeypatch.setattr(fixing.Epochs, "find_slipped", lambda *_: ())
    begin = recording.raw_gnss.t[0]
    until = begin + 13.0
    monkeypatch.setattr(
        fixing.Epochs,
        "find_inconsistent",
        lambda self, k, *rest: [] if self.time[k] < until else noticed(self, k, *rest),
    )
    one = run(recording, STATED, ("ekf",))["ekf"]
    off, fixed = off_by(one, truth)
    t = one.fixed[:, 0]
    assert off[(t < until) & fixed].max() > 0.1
    late = t > until + 6.0
    assert not fixed[t > until].all()
    assert fixed[-1]
    assert off[late & fixed].max() < 0.05


def keep_four(raw, begin):
    """Four satellites alone from a time on (s), and which."""
    late = raw.t > begin
    seen = np.unique(raw.satellite[late & (compute_directions(raw.antenna, raw.p)[1] > np.radians(20.0))])
    left = seen[:: len(seen) // 4][:4]
    return raw.take(~late | np.isin(raw.satellite, left)), left


@pytest.fixture(scope="module", params=[True, False])
def four(drive, request):
    """Four satellites alone from 3 s before a time on (s), their names, and what solvers make of the drive."""
    recording, integers = drive[0], request.param
    at = recording.raw_gnss.t[0] + 15.0
    raw, left = keep_four(recording.raw_gnss, at - 3.0)
    how = parse_settings({"noise": {"mode": "stated"}, "raw_gnss": {"integers": integers}})
    return at, raw, left, how, run(replace(recording, raw_gnss=raw), how, ("ekf", "rts"))


@pytest.mark.parametrize("which", range(4))
def test_a_slip_of_one_of_four_satellites_is_told_by_the_imu(drive, four, which):
    """By a cycle that no flag tells: four changes of carriers fit any displacement."""
    recording, truth = drive
    at, raw, left, how, plain = four
    slipped = replace(raw, carrier=raw.carrier + ((raw.satellite == left[which]) & (raw.t > at - 1e-3)))
    assert find_arcs(slipped, base_arc=raw.base_arc).slips == find_arcs(raw, base_arc=raw.base_arc).slips
    for name, one in run(replace(recording, raw_gnss=slipped), how, ("ekf", "rts")).items():
        error, sigma = errors(one, truth)[:2]
        late = one.t > at
        apart = (one.states.p - plain[name].states.p)[late, :2]
        assert np.linalg.norm(error[late, :2] if how.raw_gnss.integers else apart, axis=1).max() < 0.15, name
        assert np.mean((error[late, :2] / sigma[late, :2]) ** 2) < 4.6, name  # chi-square of two, 99 %, over two
        own = one.arcs.name == f"{name_satellite(left[which])}.1C"
        assert np.abs(one.arcs.begin[own] - at).min() < 1e-3, name


def test_records_name_satellites_and_the_report_sums_them_up(drive):
    recording, _ = drive
    one = run(recording, STATED, ("rts",))["rts"]
    record = one.records["gnss_phase"]
    assert set(record.satellite) <= set(raw_drive.MANY)
    assert len(record.satellite) == len(record.elevation) == len(record.t)
    assert record.elevation.min() > np.radians(9.9)
    tables = tabulate_satellites(one)
    for name in set(record.satellite):
        own = (record.satellite == name) & (record.weight >= 0.5)
        assert f"{np.sqrt(np.mean(record.nis[own])):.4g}"[:4] in tables[0]
        assert name in tables[0]
    fixed = int((one.fixed[:, 1] > 0).sum())
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", tabulate_epochs(one)[1])
    assert cells[0] == str(len(np.unique(one.records["gnss_code"].t)))
    assert 4 <= int(cells[2]) <= int(cells[1]) <= len(set(record.satellite))
    assert cells[3:5] == [str(fixed), str(len(one.fixed) - fixed)]
    assert not tabulate_satellites(replace(one, records={}))
    assert not tabulate_epochs(replace(one, records={}))
