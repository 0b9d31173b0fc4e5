"""Recordings solved in parts that overlap: the same keyframes, states and uncertainty as straight through."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphnav import load
from graphnav.config import Settings
from graphnav.core.errors import EstimationError
from graphnav.core.notes import get_key
from graphnav.estimation import long_drives
from graphnav.estimation.pipeline import run
from graphnav.recording import take_rows

DEMO = Path(__file__).resolve().parents[2] / "data" / "tokyo"


def test_parts_say_what_the_whole_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """An overlap of half a minute is what a smoother sees of the future of a drive with fixes."""
    recording = load(DEMO).crop(0.0, 110.0)
    settings = Settings.model_validate({"noise": {"mode": "stated"}})
    whole = run(recording, settings, ("ekf", "rts"))
    for name, value in (("STRAIGHT", 60.0), ("PART", 40.0), ("OVERLAP", 30.0)):
        monkeypatch.setattr(long_drives, name, value)
    shares = long_drives.split_drive(recording, settings)
    assert len(shares) == 3
    assert all(a.end == b.start for a, b in itertools.pairwise(shares))
    assert all(np.shares_memory(share.recording.imu.gyro, recording.imu.gyro) for share in shares)
    assert len(long_drives.split_drive(replace(recording, gnss=None), settings)) == 1
    seam = shares[1].start
    assert recording.gnss is not None
    silent = take_rows(recording.gnss, (recording.gnss.t < seam - 25.0) | (recording.gnss.t > seam))
    monkeypatch.setattr(long_drives, "_SILENCE", 20.0)
    assert [share.start for share in long_drives.split_drive(replace(recording, gnss=silent), settings)[1:]] == [
        shares[2].start
    ]
    parts = run(recording, settings, ("ekf", "rts"))
    assert "pieces.parts" in map(get_key, parts["rts"].notes)
    seams = np.array([share.start for share in shares[1:]])
    for name, one in parts.items():
        other = whole[name]
        assert np.all(np.diff(one.t) > 0.0)
        assert set(one.records) == set(other.records)
        assert abs(len(one.records["gnss_position"].t) - len(other.records["gnss_position"].t)) <= len(seams)
        t, states, covariance = one.at(np.arange(recording.start + 2.0, recording.end - 2.0, 0.1))
        t_whole, there, covariance_whole = other.at(t)
        np.testing.assert_array_equal(t, t_whole)
        assert np.max(np.diff(t)) < 0.11  # nothing is missing at a seam
        off = states.minus(there)[:, 3:6]
        sd, sd_whole = (np.sqrt(np.diagonal(P, axis1=1, axis2=2))[:, 3:6] for P in (covariance, covariance_whole))
        if name == "rts":  # what has more data differs by N(0, P_part - P_whole)
            assert np.max(np.abs(off) / sd) < 3.0
            assert np.median(np.abs(off) / sd) < 0.5
            assert np.quantile(sd / sd_whole, 0.1) > 0.9
        every = np.concatenate([b.list_times(50.0) for b in one.between])
        assert np.all(np.diff(every) > 0.0)  # and nothing is there twice
        assert one.covariance.base is None  # nor held beyond what is said
        assert all(np.shares_memory(b.own, one.covariance) for b in one.between)  # type: ignore[attr-defined]
        assert all(d is like for d, like in zip(one.detections, parts["ekf"].detections, strict=True))
        with pytest.raises(EstimationError) as told:
            one.to_gtsam()
        assert told.value.key == "pieces.none_such"
        assert whole[name].covariance.base is None
        pictured = [d for d in one.detections if "spectrogram" in d.details]
        assert pictured
        for d in pictured:
            assert len(d.details["spectrogram"]) == len(d.details["spectrogram_t"]) > 1
            assert np.all((d.details["spectrogram_t"] >= d.t[0]) & (d.details["spectrogram_t"] <= d.t[-1]))


def test_a_drive_with_states_of_its_own_for_each_satellite_is_cut_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = load(DEMO.with_name("kamakura_rtk"))
    settings = Settings.model_validate({"noise": {"mode": "stated"}})
    for name, value in (("STRAIGHT", 60.0), ("PART", 21.0), ("OVERLAP", 10.0)):
        monkeypatch.setattr(long_drives, name, value)
    monkeypatch.setattr(long_drives, "_is_told", lambda *_: True)
    assert len(long_drives.split_drive(replace(recording, raw_gnss=None), settings)) == 1
    assert len(long_drives.split_drive(recording, settings)) == 2
    one = run(recording, settings, ("rts",))["rts"]
    assert np.all(np.diff(one.fixed[:, 0]) > 0.5)  # no epoch twice
    assert one.fixed[:, 1].all()
