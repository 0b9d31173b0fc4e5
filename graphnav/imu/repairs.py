"""What is repaired in the rows of an IMU before they are used."""

from __future__ import annotations

from graphnav.config import Settings
from graphnav.imu.onboard_offset import remove_onboard_offset
from graphnav.imu.regular_stamps import use_regular_stamps
from graphnav.recording import Recording


def repair_imu(recording: Recording, settings: Settings) -> tuple[Recording, tuple[str, ...]]:
    """The recording as it is used, and a note on each repair."""
    recording, on_stamps = use_regular_stamps(recording, settings)
    recording, on_offset = remove_onboard_offset(recording, settings)
    return recording, (*on_stamps, *on_offset)
