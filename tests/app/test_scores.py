"""Scores of solutions against the fixes that were withheld from them."""

from dataclasses import replace

import numpy as np
import oracle
import pytest

from graphnav import run
from graphnav.app.scores import score
from graphnav.estimation import long_drives


def test_fixes_stamped_late_are_no_errors_of_the_solution() -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(duration=200, rate=50.0, seed=6), seed=5)
    gnss = recording.gnss
    assert gnss is not None
    late = replace(recording, truth=None, gnss=replace(gnss, t=gnss.t + 0.1))
    used = late.without("gnss", (60.0, 80.0))
    solutions = run(used, None, ("rts",))
    offset = solutions["rts"].parameters["gnss_time_offset"]
    assert abs(offset.value[-1, 0] + 0.1) < 5.0 * offset.sigma[-1, 0]
    metrics, _, names = score(late, used, solutions, (("gnss", (60.0, 80.0)),))
    span = metrics["rts"].spans[0]
    assert names == ("without gnss",)
    assert span.n == np.sum((gnss.t - late.start >= 59.9) & (gnss.t - late.start <= 79.9))
    assert span.nees is not None
    assert span.nees < 3.0
    assert span.max_h < 0.3  # some 1 m at 10 m/s where the stamps are taken as they are


def test_fixes_withheld_from_each_part_are_met_as_that_part_has_the_antenna(monkeypatch: pytest.MonkeyPatch) -> None:
    """The receiver's clock jumps by 0.2 s where the second part begins: no one offset is that of the whole drive."""
    recording, _ = oracle.drive(oracle.vehicle_path(duration=400, rate=50.0, seed=6), seed=5)
    gnss = recording.gnss
    assert gnss is not None
    for name, value in (("STRAIGHT", 300.0), ("PART", 200.0), ("OVERLAP", 0.0)):
        monkeypatch.setattr(long_drives, name, value)
    monkeypatch.setattr(long_drives, "_is_told", lambda *_: True)
    jump = recording.start + 200.0
    late = replace(recording, truth=None, gnss=replace(gnss, t=gnss.t + np.where(gnss.t < jump, 0.1, -0.1)))
    withheld = (60.0, 80.0), (300.0, 320.0)
    used = late.without("gnss", withheld[0]).without("gnss", withheld[1])
    solutions = run(used, None, ("rts",))
    offset = solutions["rts"].parameters["gnss_time_offset"]
    assert offset.t[1] == jump
    np.testing.assert_allclose(offset.value[:, 0], [-0.1, 0.1], atol=0.02)
    metrics, _, _ = score(late, used, solutions, tuple(("gnss", span) for span in withheld))
    assert [span.n for span in metrics["rts"].spans] == [20, 20]
    for span in metrics["rts"].spans:
        assert span.nees is not None
        assert span.nees < 3.0
        assert span.max_h < 0.3  # some 2 m at 10 m/s with the other part's offset
