"""Checks of a recording beside its solving."""

from __future__ import annotations

from pathlib import Path

import oracle
import pytest

from graphnav.app import checking
from graphnav.app.workflow import Request, run_request
from graphnav.core.errors import EstimationError, RecordingError
from graphnav.core.findings import Finding
from graphnav.estimation import building
from graphnav.estimation.solvers import disturbance, recursion
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.writer import write_recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording, _ = oracle.drive(oracle.vehicle_path(duration=120, rate=50.0, seed=6), seed=5)
    path = tmp_path_factory.mktemp("drive")
    log = Log(recording.name, recording.imu, recording.gnss, recording.odometer, platform=recording.platform)
    write_recording(log, path)
    return path


def refuse(*_: object) -> tuple[Finding, ...]:
    return (Finding("refused", "the gyro is in another unit", "imu.gyro_unit"),)


def test_what_the_checks_refuse_is_not_solved(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "_check", refuse)
    monkeypatch.setattr(building, "build_problem", lambda *_, **__: pytest.fail("a problem is built"))
    with pytest.raises(RecordingError) as caught:
        run_request(Request(str(folder), ("ekf",)))
    assert caught.value.key == "imu.gyro_unit"


def test_a_refusal_comes_before_what_it_causes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise EstimationError("no motion", key="alignment.none")

    monkeypatch.setattr(building, "align", fail)
    with pytest.raises(EstimationError):
        run_request(Request(str(folder), ("ekf",)))
    monkeypatch.setattr(checking, "_check", refuse)
    with pytest.raises(RecordingError) as caught:
        run_request(Request(str(folder), ("ekf",)))
    assert caught.value.key == "imu.gyro_unit"


def test_what_is_loaded_is_what_solvers_call(folder: Path) -> None:
    """Otherwise each recursion would be compiled a second time."""
    run_request(Request(str(folder), ("rts",)))
    compiled = recursion.filter_rows, recursion.smooth_filtered, disturbance.smooth_rows
    assert [len(getattr(one, "signatures", [()])) for one in compiled] == [1, 1, 1]
