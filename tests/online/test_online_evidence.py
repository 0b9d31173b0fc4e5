"""Wrong fixes of a running drive: evidence decides on those that the noise model was estimated from."""

from __future__ import annotations

import numpy as np

from graphnav import load
from graphnav.online import Online, drop_rows, list_rows


def test_no_right_fix_is_left_out_that_the_noise_model_was_estimated_from() -> None:
    """Gaps of a second and a half in the IMU, and outages: the filter's tests by themselves leave out 27 fixes."""
    recording = load("kitti").crop(82.0, 262.0)
    for span in ((40.0, 60.0), (140.0, 160.0)):
        recording = recording.without("gnss", span)
    online = Online(drop_rows(recording))
    for row in list_rows(recording)[1]:
        online.add(row)
    online.finish()
    assert online.tracker is not None
    assert np.isfinite(online.tracker.judged)
    assert online.excluded == ()
