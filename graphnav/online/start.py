"""Start of a running drive: the rows of an alignment, and the tracker that starts from it."""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.raw_ppp import require_precise
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.detectors import detect
from graphnav.estimation.alignment import Alignment, align, is_ready, use_known_heading
from graphnav.estimation.building import start_sigma
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.solvers.window import make_first_message
from graphnav.online.raw import use_codes_alone
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.online.walker import Walker
from graphnav.recording import Recording

_CRYSTALS = 1e-4  # s/s, 1-sigma of the relative drift of two crystals


def let_clocks_drift(settings: Settings) -> Settings:
    """The settings with the rate between the clocks of IMU and receiver as a parameter, unless they state it
    themselves.

    A recorded drive shows as a whole whether the clocks drift apart (`graphnav.estimation.contradictions`); online,
    with ordinary crystals, a constant offset is wrong by a third of a second after an hour.
    """
    if settings.gnss.clock_rate_sigma is not None:
        return settings
    return settings.model_copy(update={"gnss": settings.gnss.model_copy(update={"clock_rate_sigma": _CRYSTALS})})


def choose_settings(setup: Recording, stated: Settings | None) -> Settings:
    """The settings of a running drive.

    Raises
    ------
    RecordingError
        If precise point positioning is wanted without what it needs.
    """
    settings = let_clocks_drift(stated or Settings())
    raw, s = setup.raw_gnss, settings.raw_gnss
    if s.ppp and raw is not None and setup.is_tight(s.coupling):
        require_precise(setup.name, raw)
    return settings


def take_start_rows(sensors: Sensors, settings: Settings, now: float, last: bool) -> tuple[Recording, Array] | None:
    """The rows up to a time (s), and stops (M, 2) in them, if an alignment may succeed; None if it is too early.

    With `last`, no more rows will arrive.

    Raises
    ------
    EstimationError
        If GNSS is stated and no more rows will arrive, and none of those kept is a fix: the place is not known.
    """
    sensors.drop_unmeasured()
    recording = sensors.make_recording(-np.inf, now)
    if last and sensors.setup.gnss is not None and (recording.gnss is None or not len(recording.gnss.t)):
        raise EstimationError(
            f"no fix in the last {recording.duration:.0f} s and no motion before: there is no position",
            key="online.no_place",
        )
    waits = sensors.setup.gnss is not None and not last
    if waits and (recording.gnss is None or not is_ready(recording, settings)):
        return None
    stationary = detect(recording, settings).stationary
    if waits and not is_ready(recording, settings, stationary):
        return None  # fixes jumped at rest
    return recording, stationary


def find_start(recording: Recording, stationary: Array, settings: Settings, frame: LocalFrame) -> Alignment:
    """The state at the first row of a recording with known stops (M, 2).

    Raises
    ------
    EstimationError
        If the rows do not determine it.
    """
    return align(recording, use_codes_alone(settings), frame, stationary)


def make_tracker(
    found: Alignment, start: float, noise: NoiseModel, settings: Settings, frame: LocalFrame, setup: Recording
) -> tuple[Tracker, tuple[str, ...]]:
    """A tracker that starts at the first row (s) that an alignment has used, and notes."""
    stated = use_known_heading(found, settings)
    # whether it determines the heading is only seen later; iSAM2's tree moves its states by itself
    turns = setup.gnss is None and settings.solver.engine == "window"
    message = make_first_message(stated.state, start_sigma(stated), turns)
    kind = Walker if setup.platform == "foot" else Tracker
    tracker = kind(settings, frame, message, start, setup, noise)
    if found is not stated:
        tracker.window.head = message.move(found.state.minus(stated.state)[0])
    return tracker, tuple(stated.notes)
