"""Raw observations as they come: the same rows as in a recording, in both engines, and what is wrong with epochs."""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import oracle
import pytest
import raw_drive
from helpers import refused
from test_raw_rtk import keep_four, with_carriers

from graphnav.config import Settings, parse_settings
from graphnav.constraints.raw_phase import WholeCycles
from graphnav.constraints.raw_ppp import CARRIER_SLOW
from graphnav.core import earth
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import interpolate
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.estimation import fixing
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.evaluation.evaluate import find_truth
from graphnav.gnss.antex import SatelliteAntenna
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.carrier import pair_consecutive
from graphnav.gnss.integers import find_nearest
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import name_satellite, number_satellite
from graphnav.online import Online, Row, drop_rows, list_rows
from graphnav.online import raw as online_raw
from graphnav.online.lines import format_head, format_line, parse_row, parse_setup
from graphnav.online.raw import RawEpochs
from graphnav.online.raw_lines import LiveRaw, describe_live_raw, drop_epochs, list_epochs
from graphnav.recording import Recording

CODES = {"differences": False, "carrier": False}
PPP = {"ppp": True, "robust": "none"}
LONG = {"noise": {"mode": "stated"}, "solver": {"lag": 1000.0}}


@pytest.fixture(scope="module")
def recording() -> Recording:
    return observed_drive().crop(0.0, 100.0)


def observed_drive(**more: object) -> Recording:
    path = oracle.vehicle_path(130.0, 25.0)
    made, _ = oracle.drive(path, seed=3, outages=[(60.0, 75.0)], gnss_velocity_sd=(0.1, 0.1, 0.1))
    return raw_drive.with_observations(made, path, noise=1.0, seed=2, carrier=0.003, **more)


@pytest.fixture(scope="module")
def rows(recording: Recording) -> list[Row]:
    return list_rows(recording)[1]


def played(setup: Recording, rows: Iterable[Row], how: Settings, engine: str = "window") -> tuple[Online, Trajectory]:
    online, parts = Online(setup, how, engine), []
    for row in rows:
        online.add(row)
        parts += online.settled()
    online.finish()
    assert not online.failures
    parts += online.settled()
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "llh", "sd_p")}
    return online, Trajectory(**arrays)


# a kernel weighs a row by what is known when it comes, so changes of carriers are compared without
@pytest.mark.parametrize(("engine", "chosen"), [("window", CODES), ("isam2", {"robust": "none"})])
def test_with_a_long_lag_it_is_the_smoother_of_the_recording(
    recording: Recording, rows: list[Row], engine: str, chosen: dict[str, object]
) -> None:
    how = parse_settings(LONG | {"raw_gnss": chosen})
    online, track = played(drop_rows(recording), rows, how, engine)
    assert online.tracker is not None
    assert ("gnss_carrier" in online.tracker.in_force) == (chosen is not CODES)
    whole = run(recording, how, ("batch",))["batch"]
    at = np.argmin(np.abs(whole.t - track.t[:, None]), axis=1)
    same = np.abs(whole.t[at] - track.t) < 1e-6
    assert same.sum() > 80
    apart = whole.frame.from_llh(track.llh[same]) - whole.states.p[at[same]]
    # nodes of what lasts begin elsewhere, and the rest is linearised elsewhere: a fiftieth of what is not known
    assert np.abs(apart / track.sd_p[same]).max() < 0.02
    sigma = np.sqrt(np.diagonal(whole.covariance[at[same], 3:6, 3:6], axis1=1, axis2=2))
    np.testing.assert_allclose(track.sd_p[same], sigma, rtol=0.01)


def test_a_late_epoch_counts_at_its_own_time(recording: Recording, rows: list[Row]) -> None:
    """Nor does it matter to the others' clocks."""
    kept = [row for row in rows if row[1] < 58.0]
    late, held = [], []
    for row in kept:
        if row[0] == "raw_gnss" and round(row[1]) % 3 == 1:
            held.append(row)
            continue
        late.append(row)
        if held and row[1] > held[0][1] + 1.5:
            late.append(held.pop(0))
    setup, how = drop_rows(recording), parse_settings(LONG | {"raw_gnss": CODES})
    plain, delayed = (played(setup, some, how) for some in (kept, late + held))
    assert delayed[0].late["raw_gnss"] >= 2
    np.testing.assert_array_equal(delayed[1].t, plain[1].t)
    apart = (delayed[1].llh - plain[1].llh) * np.array([6.37e6, 6.37e6 * np.cos(plain[1].llh[0, 0]), 1.0])
    assert np.abs(apart[:, [1, 0, 2]] / plain[1].sd_p).max() < 0.02


def test_changes_of_carriers_pass_a_late_epoch_by(recording: Recording) -> None:
    """It comes when the changes around it are counted, each from one of two places that take turns."""
    setup = drop_rows(recording).raw_gnss
    assert setup is not None
    assert recording.raw_gnss is not None
    kept, used = RawEpochs(setup, Settings().raw_gnss), list_epochs(recording.raw_gnss)[:6]
    for t, values in (*used[:2], *used[3:5], used[2], used[5]):
        kept.add(t, values)
    series = kept.build_between(used[1][0], used[5][0])
    t, first = np.unique(series.t, return_index=True)
    np.testing.assert_array_equal(t, [at for at, _ in used])  # with the one before
    assert series.number[first].tolist() == [0, 1, -1, 2, 3, 4]
    before, after = pair_consecutive(series, series, 1.0)
    pairs = {(float(a), float(b)) for a, b in zip(series.t[before], series.t[after], strict=True)}
    late = t[2]
    assert pairs == {(a, b) for a, b in itertools.pairwise(t[t != late].tolist())}


def test_precise_point_positioning_is_that_of_the_recording(two: Recording) -> None:
    # a stop is found a little later as it drives, which sums of changes of carriers tell
    still = {"zero_velocity": False, "zero_rate": False, "held_position": False}
    how = parse_settings(LONG | {"raw_gnss": PPP, "standstill": still})
    setup = parse_setup(format_head(two))
    assert setup.raw_gnss is not None
    assert setup.raw_gnss.antennas.keys() == two.raw_gnss.antennas.keys()
    assert setup.raw_gnss.clock_noise == two.raw_gnss.clock_noise
    rows = [parse_row(format_line(row)) if row[0] == "raw_gnss" else row for row in list_rows(two)[1]]
    online, track = played(setup, rows, how)
    assert online.tracker is not None
    assert {"gnss_ppp_code", "gnss_ppp_carrier"} < online.tracker.in_force.keys()
    whole = run(two, how, ("rts",))["rts"]
    assert CARRIER_SLOW in whole.parameters
    at = np.argmin(np.abs(whole.t - track.t[:, None]), axis=1)
    same = np.abs(whole.t[at] - track.t) < 1e-6
    assert same.sum() > 35
    apart = whole.frame.from_llh(track.llh[same]) - whole.states.p[at[same]]
    assert np.abs(apart / track.sd_p[same]).max() < 0.02
    sigma = np.sqrt(np.diagonal(whole.covariance[at[same], 3:6, 3:6], axis1=1, axis2=2))
    np.testing.assert_allclose(track.sd_p[same], sigma, rtol=0.01)


@pytest.fixture(scope="module")
def two() -> Recording:
    """Two signals of each satellite, and of one an antenna a metre off its centre of mass and an unsteady clock."""
    made = observed_drive(second=True).crop(0.0, 45.0)
    antenna = SatelliteAntenna(
        -np.inf,
        np.inf,
        {band: np.array([0.2, 0.0, 1.0 + 0.1 * band]) for band in (1, 2, 5)},
        {1: np.array([0.01, 0.02, -0.03])},
    )
    g01 = number_satellite("G01")
    return replace(made, raw_gnss=replace(made.raw_gnss, antennas={g01: (antenna,)}, clock_noise={g01: (0.03, 300.0)}))


def test_precise_point_positioning_says_what_it_lacks(recording: Recording, two: Recording) -> None:
    settings, broadcast = parse_settings({"raw_gnss": {"ppp": True}}), replace(two.raw_gnss, precise=False)
    for one, key in ((recording, "raw.ppp_signals"), (replace(two, raw_gnss=broadcast), "raw.ppp_orbits")):
        with refused(key, RecordingError):
            Online(drop_rows(one), settings)


def test_it_goes_on_from_its_checkpoint(recording: Recording, rows: list[Row]) -> None:
    how = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 20.0}})
    kept = [row for row in rows if row[1] < 70.0]
    _, plain = played(drop_rows(recording), kept, how)
    online, parts = Online(drop_rows(recording), how), []
    for k, row in enumerate(kept):
        online.add(row)
        parts += online.settled()
        if k % 1500 == 1499:
            online = pickle.loads(pickle.dumps(online))
    online.finish()
    parts += online.settled()
    np.testing.assert_array_equal(np.concatenate([part.llh for part in parts]), plain.llh)


def test_epochs_that_are_of_no_use_are_counted(recording: Recording, rows: list[Row]) -> None:
    epochs = [row for row in rows if row[0] == "raw_gnss" and 28.5 < row[1] < 30.0]
    setup, how = drop_rows(recording), parse_settings(LONG)
    online = Online(setup, how)
    for row in rows:
        if row[1] < 30.0:
            online.add(row)
    before = online.sensors.counts["raw_gnss"]
    _, t, values = epochs[0]
    unknown = (9999.0, *values[1:])
    for row in (
        ("raw_gnss", t, values), ("raw_gnss", t + 0.3, values), ("raw_gnss", t + 0.5, unknown),
        ("raw_gnss", t + 0.5, values[:-1]), ("raw_gnss", float("nan"), values),
    ):  # fmt: skip
        online.add(row)
    counts = online.sensors.counts
    assert counts["raw_gnss"] == before
    assert sum(n for key, n in counts.items() if key.startswith("raw_gnss:")) == 5


def test_loose_coupling_uses_the_fixes(recording: Recording, rows: list[Row]) -> None:
    loose = parse_settings(LONG | {"raw_gnss": {"coupling": "loose"}})
    online = Online(drop_rows(recording), loose)
    for row in rows:
        online.add(row)
    assert "online.raw" not in map(get_key, online.notes)
    assert not online.sensors.counts["raw_gnss"]
    assert online.tracker is not None
    online.finish()
    assert not online.failures


# ------------------------------------------------------------------------------------------- carriers against a base
@pytest.fixture(scope="module")
def rtk() -> Recording:
    path = oracle.vehicle_path(130.0, 25.0)
    made, _ = oracle.drive(path, seed=3, gnss_velocity_sd=(0.1, 0.1, 0.1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raw_drive, "SATELLITES", raw_drive.MANY)
        made = raw_drive.with_observations(made, path, noise=0.3, seed=2).crop(0.0, 50.0)
        return with_carriers(made, path, 0.003)[0]


def test_wind_up_goes_on_through_whole_cycles_however_epochs_come(
    two: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unwrapped(raw: RawGnss) -> np.ndarray:  # of a piece: its first value is within half a cycle
        return np.unwrap(np.mod(0.3 * raw.t + 0.5, 1.0) - 0.5, period=1.0)

    monkeypatch.setattr(online_raw, "compute_series_wind_up", unwrapped)
    raw = two.raw_gnss.take(two.raw_gnss.satellite == two.raw_gnss.satellite[0])
    epochs = list_epochs(raw)
    for order in (epochs, [*epochs[:3], *epochs[5:8], *epochs[3:5], *epochs[8:]]):
        buffer = RawEpochs(drop_epochs(raw), parse_settings({"raw_gnss": {"ppp": True}}).raw_gnss)
        for t, values in order:
            buffer.add(t, values)
        part = buffer.build_between(-np.inf, np.inf)
        assert np.ptp(part.wound - 0.3 * part.t) < 1e-6


def test_arcs_are_those_of_the_series_however_its_epochs_come(rtk: Recording) -> None:
    """Flags, gaps, open half cycles, slips that no flag tells, arcs of the base, and epochs that are not used."""
    raw, rng = rtk.raw_gnss, np.random.default_rng(4)
    own = {name: getattr(raw, name).copy() for name in ("slip", "half", "base_arc", "carrier")}  # others use it, too
    raw = replace(raw, lock=np.full(len(raw), np.nan), **own)
    n = len(raw)
    raw.slip[rng.integers(0, n, 20)] = True
    raw.half[(raw.satellite == raw.satellite[0]) & (raw.t > 20.0) & (raw.t < 30.0)] = True
    raw.base_arc[(raw.satellite == raw.satellite[1]) & (raw.t > 40.0)] += 1
    raw.carrier[(raw.satellite == raw.satellite[2]) & (raw.t > 25.0)] += 3.0
    raw = raw.take(rng.random(n) > 0.03)
    raw = raw.take(np.abs(raw.t - 15.0) > 2.5)
    whole = find_arcs(raw, base_arc=raw.base_arc)
    assert whole.slips >= 1
    assert sum(map(len, whole.begins)) > 3 * len(whole.names)
    settings = parse_settings({"raw_gnss": {"period": 3.0}}).raw_gnss
    epochs = list_epochs(raw)
    shuffled = [epochs[k] for k in np.argsort(np.arange(len(epochs)) + rng.normal(0.0, 1.0, len(epochs)))]
    for order in (epochs, shuffled):
        buffer = RawEpochs(drop_epochs(raw), settings)
        for t, values in order:
            buffer.add(t, values, used=buffer.is_wanted(t))
        assert len(buffer) < 0.6 * len(epochs)
        part = buffer.build_between(-np.inf, np.inf)
        own = np.isin(raw.t, part.t)
        np.testing.assert_array_equal(part.arc_begin, whole.begin[own])


@pytest.fixture(scope="module")
def offline(rtk: Recording) -> dict[str, Solution]:
    return run(rtk, parse_settings({"noise": {"mode": "stated"}}), ("ekf", "rts"))


@pytest.mark.parametrize("engine", ["window", "isam2"])
def test_integers_online_are_those_of_the_recording(rtk: Recording, offline: dict[str, Solution], engine: str) -> None:
    online, track = played(drop_rows(rtk), list_rows(rtk)[1], parse_settings(LONG), engine)
    tracker = online.tracker
    assert tracker is not None
    whole, filtered = offline["rts"], offline["ekf"].fixed
    assert (tracker.epochs, tracker.fixed) == (len(filtered), np.sum(filtered[:, 1]))
    at = np.argmin(np.abs(whole.t - track.t[:, None]), axis=1)
    same = np.abs(whole.t[at] - track.t) < 1e-6
    assert same.sum() > 40
    apart = whole.frame.from_llh(track.llh[same]) - whole.states.p[at[same]]
    assert np.abs(apart).max() < 2e-3  # m, as between the solvers of a recording
    sigma = np.sqrt(np.diagonal(whole.covariance[at[same], 3:6, 3:6], axis1=1, axis2=2))
    share = track.sd_p[same] / sigma  # a smoother fixes arcs that had ended before a filter could
    assert np.median(share) == pytest.approx(1.0, abs=0.01)
    assert share.min() > 0.99


def test_a_satellite_that_rises_costs_earlier_epochs_no_carriers(rtk: Recording) -> None:
    """All is linearised anew at the end, where ambiguities are known that had not begun at most of the epochs."""
    raw = rtk.raw_gnss
    rising = np.isin(raw.satellite, np.unique(raw.satellite)[:2]) & (raw.t < raw.t[-1] - 1.5)  # aligned by then
    one = replace(rtk, raw_gnss=raw.take(~rising))
    whole = run(one, parse_settings(LONG), ("rts",))["rts"]
    for engine in ("window", "isam2"):
        _, track = played(drop_rows(one), list_rows(one)[1], parse_settings(LONG), engine)
        at = np.argmin(np.abs(whole.t - track.t[:, None]), axis=1)
        same = np.abs(whole.t[at] - track.t) < 1e-6
        assert same.sum() > 40
        apart = whole.frame.from_llh(track.llh[same]) - whole.states.p[at[same]]
        assert np.abs(apart).max() < 2e-3, engine  # m
        sigma = np.sqrt(np.diagonal(whole.covariance[at[same], 3:6, 3:6], axis1=1, axis2=2))
        assert np.median(track.sd_p[same] / sigma) == pytest.approx(1.0, abs=0.01), engine


def test_integers_are_rows_and_go_on_from_a_checkpoint_and_from_lines(rtk: Recording) -> None:
    how = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 10.0}})
    rows = list_rows(rtk)[1]
    _, plain = played(drop_rows(rtk), rows, how)
    online, parts, seen = Online(parse_setup(format_head(rtk)), how), [], 0
    for k, row in enumerate(rows):
        online.add(parse_row(format_line(row)) if row[0] != "gnss" else row)  # degrees round
        parts += online.settled()
        if k % 100 == 99 and online.tracker is not None:
            online = pickle.loads(pickle.dumps(online))
            stages, held = online.tracker.window.stages, online.tracker._held
            counts = [sum(len(m.b) for m in stage.measured if m.name == WholeCycles.name) for stage in stages]
            assert counts == [len(one.found) for one in held]
            assert held[-1].fixed
            seen += 1
    online.finish()
    parts += online.settled()
    assert seen
    np.testing.assert_array_equal(np.concatenate([part.llh for part in parts]), plain.llh)


@pytest.mark.parametrize(("ppp", "engine"), [(False, "window"), (True, "isam2")])
def test_slips_of_float_ambiguities_that_only_the_imu_tells_begin_new_arcs(
    rtk: Recording, two: Recording, ppp: bool, engine: str
) -> None:
    """Four satellites are left, and every signal of one slips by a cycle."""
    one = two if ppp else rtk
    at = one.raw_gnss.t[-1] - 4.0
    raw, left = keep_four(one.raw_gnss, at - 6.0)
    slipped = replace(raw, carrier=raw.carrier + ((raw.satellite == left[1]) & (raw.t > at - 1e-3)))
    base = None if ppp else raw.base_arc
    assert find_arcs(slipped, base_arc=base).slips == find_arcs(raw, base_arc=base).slips
    how = parse_settings(LONG | {"raw_gnss": {"integers": False, "ppp": ppp}})
    tracks, begun = [], []
    for some in (raw, slipped):
        part = replace(one, raw_gnss=some)
        online, track = played(drop_rows(part), list_rows(part)[1], how, engine)
        tracks.append(track)
        begun.append({name for name, _ in online.tracker._head_held.since})
        assert online.tracker.epochs == 0  # that could be fixed
    assert not begun[0]
    assert {name.partition(".")[2].partition(".")[0] for name in begun[1]} == {name_satellite(left[1])}
    apart = earth.llh_to_ecef(tracks[1].llh) - earth.llh_to_ecef(tracks[0].llh)
    assert np.linalg.norm(apart, axis=1).max() < 0.1  # m


def test_wrong_integers_are_let_go_of(rtk: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every other number of the first vector that is found is wrong, and nothing is noticed for some epochs."""
    found, noticed, until = [], fixing.Epochs.find_inconsistent, 25.0

    def wrong(a, decorrelated):
        found.append(find_nearest(a, decorrelated))
        spoiled = (np.arange(len(a)) % 2 == 0) & (len(found) == 1)
        return replace(found[-1], best=found[-1].best + spoiled)

    monkeypatch.setattr(fixing, "find_nearest", wrong)
    monkeypatch.setattr(fixing.Epochs, "find_slipped", lambda *_: ())
    monkeypatch.setattr(
        fixing.Epochs,
        "find_inconsistent",
        lambda self, k, *rest: [] if self.time[k] < until else noticed(self, k, *rest),
    )
    how = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 5.0}})
    online, track = played(drop_rows(rtk), list_rows(rtk)[1], how, "isam2")
    tracker = online.tracker
    assert tracker is not None
    # between the truth's rows, which need not be at the keyframes' times
    true, inside = interpolate(find_truth(rtk)[0], track.t)
    assert inside.all()
    h = np.hypot(*((track.llh - true.llh)[:, :2] * 6.37e6 * [1.0, np.cos(true.llh[0, 0])]).T)
    assert h[(track.t > 15.0) & (track.t < until - 1.0)].max() > 0.05
    assert h[track.t > until + 10.0].max() < 0.05
    assert tracker._head_held.fixed


@pytest.mark.parametrize(
    "spoil",
    [
        lambda line: line.replace(",1C,", ",1,", 1),
        lambda line: line.replace(";", ",", 1),
        lambda line: line.replace("G0", "Q0", 1),
        lambda line: line[: len(line) // 2],
        lambda line: line.replace(".", "x", 1),
        lambda line: "R,",
    ],
)
def test_lines_that_are_no_epochs_are_told(rtk: Recording, spoil: Callable[[str], str]) -> None:
    line = format_line(("raw_gnss", *list_epochs(rtk.raw_gnss)[0]))
    with pytest.raises(ValueError, match=r"\w"):
        parse_row(spoil(line))


@pytest.mark.parametrize("name", ["1K", "9C", "C"])
def test_a_source_is_refused_that_names_a_signal_that_its_satellites_do_not_send(rtk: Recording, name: str) -> None:
    said = describe_live_raw(rtk.raw_gnss)
    assert LiveRaw.model_validate(said).make_setup().catalogue == drop_epochs(rtk.raw_gnss).catalogue
    with refused("online.raw_names", RecordingError, f"'{name}'"):
        LiveRaw.model_validate(said | {"signals": [("G", name)]}).make_setup()
    line = format_line(("raw_gnss", *list_epochs(rtk.raw_gnss)[0]))
    with pytest.raises(ValueError, match=r"\w"):
        parse_row(line.replace(",1C,", f",{name},", 1))


def test_a_satellite_that_cannot_be_costs_only_itself(rtk: Recording) -> None:
    t, values = list_epochs(rtk.raw_gnss)[0]
    rows, setup = np.reshape(values, (-1, 26)), drop_epochs(rtk.raw_gnss)
    for column, value in ((2, 1e300), (9, np.nan), (9, 1e300), (4, -1e9), (8, 0.0), (12, 1e9), (3, np.inf)):
        spoilt = rows.copy()
        spoilt[1, column] = value
        buffer = RawEpochs(setup, parse_settings({}).raw_gnss)
        assert buffer.find_fault(tuple(spoilt.ravel())) is None
        buffer.add(t, tuple(spoilt.ravel()))
        left = buffer.build_between(t, t)
        np.testing.assert_array_equal(left.satellite, np.delete(rows[:, 0], 1).astype(int))
        assert np.isfinite(left.antenna).all()
