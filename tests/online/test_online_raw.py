"""Raw observations as they come: the same rows as in a recording, in both engines, and what is wrong with epochs."""

from __future__ import annotations

import pickle
from collections.abc import Iterable

import numpy as np
import oracle
import pytest
import raw_drive

from graphnav.config import Settings, settings_from
from graphnav.core.notes import key_of
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.pipeline import run
from graphnav.online import Online, Row, rows_of, without_rows
from graphnav.recording import Recording

CODES = {"differences": False, "carrier": False}
LONG = {"noise": {"mode": "stated"}, "solver": {"lag": 1000.0}}


@pytest.fixture(scope="module")
def recording() -> Recording:
    path = oracle.vehicle_path(130.0, 50.0)
    made, _ = oracle.drive(path, seed=3, outages=[(60.0, 75.0)], gnss_velocity_sd=(0.1, 0.1, 0.1))
    return raw_drive.with_observations(made, path, noise=1.0, seed=2, carrier=0.003).crop(0.0, 100.0)


@pytest.fixture(scope="module")
def rows(recording: Recording) -> list[Row]:
    return rows_of(recording)[1]


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


@pytest.mark.parametrize("engine", ["window", "isam2"])
def test_with_a_long_lag_it_is_the_smoother_of_the_recording(
    recording: Recording, rows: list[Row], engine: str
) -> None:
    online, track = played(without_rows(recording), rows, settings_from(LONG), engine)
    assert "online.raw" in map(key_of, online.notes)
    whole = run(recording, settings_from(LONG | {"raw_gnss": CODES}), ("batch",))["batch"]
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
    setup, how = without_rows(recording), settings_from(LONG)
    plain, delayed = (played(setup, some, how) for some in (kept, late + held))
    assert delayed[0].late["raw_gnss"] >= 2
    np.testing.assert_array_equal(delayed[1].t, plain[1].t)
    apart = (delayed[1].llh - plain[1].llh) * np.array([6.37e6, 6.37e6 * np.cos(plain[1].llh[0, 0]), 1.0])
    assert np.abs(apart[:, [1, 0, 2]] / plain[1].sd_p).max() < 0.02


def test_it_goes_on_from_its_checkpoint(recording: Recording, rows: list[Row]) -> None:
    how = settings_from({"noise": {"mode": "stated"}, "solver": {"lag": 20.0}})
    kept = [row for row in rows if row[1] < 70.0]
    _, plain = played(without_rows(recording), kept, how)
    online, parts = Online(without_rows(recording), how), []
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
    setup, how = without_rows(recording), settings_from(LONG)
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
    loose = settings_from(LONG | {"raw_gnss": {"coupling": "loose"}})
    online = Online(without_rows(recording), loose)
    for row in rows:
        online.add(row)
    assert "online.raw" not in map(key_of, online.notes)
    assert not online.sensors.counts["raw_gnss"]
    assert online.tracker is not None
    online.finish()
    assert not online.failures
