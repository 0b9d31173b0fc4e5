"""Detection of stationary intervals, and of when a foot is on the floor.

`detect` runs the detectors on a recording; those named by `detectors.fire` decide. One file per detector; every
concrete `Detector` in this folder is found automatically.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Sequence
from functools import cache

import numpy as np

from graphnav.config import Settings
from graphnav.config.detectors import FUSED
from graphnav.core.errors import ConfigError
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.detectors.base import NONE, Detection, Detections, drop_short, mask_inside, subtract_spans
from graphnav.detectors.fusion import StopDecision, check_intervals, decide_fused, merge_decisions
from graphnav.detectors.glrt import STATISTICS, compute_glrt
from graphnav.detectors.scene import Detector, Scene
from graphnav.detectors.stance import detect_stances
from graphnav.recording import Recording

__all__ = ["Detection", "Detections", "Detector", "compute_glrt", "detect", "find_stops", "list_detectors"]

_SHORTEST_RECORDING = 3.0  # s, the shortest recording that is examined


@cache
def list_detectors() -> dict[str, type[Detector]]:
    """All detector classes by name, sorted."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        for member in vars(importlib.import_module(f"{__name__}.{module.name}")).values():
            named = isinstance(member, type) and issubclass(member, Detector) and hasattr(member, "name")
            if named and not inspect.isabstract(member):
                found[member.name] = member
    return dict(sorted(found.items()))


def detect(recording: Recording, settings: Settings | None = None, since: float = -np.inf) -> Detections:
    """Find the stationary intervals of a recording, with the statistics they are based on.

    Never fails: a note states what could not be done.

    Parameters
    ----------
    recording
        The recording, as read.
    settings
        The defaults when None.
    since
        s; the limits of stances that end before this time need not be determined.

    Returns
    -------
    Detections
        The fused answer, (M, 2) s on the recording's clock, and that of each detector.
    """
    d = (settings or Settings()).detectors
    scene = Scene(recording, d)
    if recording.platform == "foot" and scene.period > 0.0:
        fire = [name for name in (("glrt",) if d.fire == (FUSED,) else d.fire) if name in STATISTICS]
        idle = [name for name in d.fire if name not in fire and name != FUSED]
        stances = detect_stances(recording.imu, scene.period, d.stance, fire, since)
        idle += [kind.name for kind in recording.own.detectors]
        more = (Note("detectors.vehicles_only", f"{', '.join(idle)}: not used on a foot"),) if idle else ()
        return Detections(stances.stationary, stances.all, (*d.notes, *more, *stances.notes))
    if not recording.duration >= _SHORTEST_RECORDING or not scene.period > 0.0:
        return Detections(
            NONE,
            (),
            (
                *d.notes,
                Note("detectors.too_short", f"no detection: the recording is shorter than {_SHORTEST_RECORDING:g} s"),
            ),
        )
    if not len(scene.low.t):
        return Detections(
            NONE,
            (),
            (*d.notes, Note("detectors.too_slow", f"no detection: an IMU at {1.0 / scene.period:.3g} Hz is too slow")),
        )
    found = _decide_stops(scene)
    reference = found.found[0]
    mask = mask_inside(reference.t, found.spans)
    answer = Detection(
        FUSED, reference.t, reference.statistic, reference.threshold, mask, found.spans, found.notes,
        {"disturbed": found.disturbed},
    )  # fmt: skip
    return Detections(found.spans, (*found.found, answer), (*d.notes, *found.notes))


def _decide_stops(scene: Scene, shown: bool = True) -> StopDecision:
    """The decision of the detectors that fire."""
    if scene.settings.fire == (FUSED,):
        found = [decide_fused(scene, list_detectors(), shown)]
    else:
        found = [check_intervals(scene, list_detectors()[name], shown) for name in scene.settings.fire]
    found += [check_intervals(scene, kind, shown) for kind in scene.recording.own.detectors]
    return found[0] if len(found) == 1 else merge_decisions(found)


def check_own(kinds: Sequence[type[Detector]]) -> tuple[type[Detector], ...]:
    """Check the detectors of a script and sort them by name.

    Raises
    ------
    ConfigError
        If one is no complete detector, or has a name that is taken.
    """
    taken = {FUSED, *list_detectors()}
    for kind in kinds:
        if not (isinstance(kind, type) and issubclass(kind, Detector)):
            raise ConfigError(
                f"detectors: {kind!r} is no class derived from graphnav.detectors.Detector", key="class.kind"
            )
        missing = [*(["name"] if not hasattr(kind, "name") else []), *sorted(kind.__abstractmethods__)]
        if missing:
            raise ConfigError(f"detectors: {kind.__name__} lacks {', '.join(missing)}", key="class.incomplete")
        if kind.name in taken:
            raise ConfigError(
                f"detectors: there is a detector '{kind.name}' already; choose another name", key="class.name_taken"
            )
        taken.add(kind.name)
    return tuple(sorted(kinds, key=lambda kind: kind.name))


def find_stops(
    recording: Recording, settings: Settings, since: float, until: float, before: Array, new: float
) -> Array | None:
    """The stationary intervals of a vehicle between two times, (M, 2) s, as `detect` finds them, without its
    statistics.

    Spectra are computed only where something is still. Returns None where odometer or GNSS show certain motion from the
    time `new` on and none in the stops (K, 2) found `before`: then nothing can have changed. Where speeds come from
    positions alone, the last seconds over which positions were compared are left open if they show motion: a smooth
    drive would pass for a stop there.
    """
    d = settings.detectors
    scene = Scene(recording, d)
    if not recording.duration >= _SHORTEST_RECORDING or not scene.period > 0.0:
        return NONE
    certain = scene.certain
    left = drop_short(subtract_spans(np.array([[recording.start, recording.end]]), certain), d.fusion.min_duration)
    before = np.clip(before, since, until)
    in_doubt = any(((certain[:, 0] < b) & (certain[:, 1] > a)).any() for a, b in before if b > a)
    if not in_doubt and not ((left[:, 0] < until) & (left[:, 1] > new)).any():
        return None
    for one in scene.known:
        if one.half > 0.0 and one.speed[-1] > one.limit[-1]:
            until = max(min(until, float(one.t[-1]) - one.half), since)
    if not len(scene.low.t):
        return NONE
    spans = np.clip(_decide_stops(scene, shown=False).spans, since, until)
    return np.asarray(spans[spans[:, 1] > spans[:, 0]])
