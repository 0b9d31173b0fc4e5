"""Scores of solutions against the fixes that were withheld from them."""

from dataclasses import replace

import numpy as np
import oracle

from graphnav import run
from graphnav.app.scores import score


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
