"""The first state of a drive: attitude, velocity, position and biases at the first IMU sample, with sigmas.

A short smoothing problem is built and solved like that of the whole drive, over the first span in which the vehicle
moves. Its initial attitude comes from levelling (the mean specific force points up), its gyro bias from the median turn
rate (a vehicle mostly goes straight or stands), its heading from the rotation that maps the measured accelerations to
those of the fixes; three more headings 90 degrees apart are tried, and the one that explains the fixes best is used. So
neither speed nor a stationary start is assumed. A vehicle too slow for measurable accelerations gets its heading from
its course, taken as forwards unless they show reverse. From there the gyro carries the attitude back to the first
sample. Before any motion, two antennas give the heading of a stationary vehicle.

With stated sigmas of fixes that are far too small, a robust kernel fits a few of the fixes exactly. So sigmas that the
residuals exceed are widened, and the headings tried again (`graphnav.estimation.alignment.scale`).

The whole drive's problem uses the data of the short one again. So the result enters as its initial point, with a prior
`prior_inflation` times wider than its own sigma: information counts once. Only information that is not in the fixes,
that a vehicle's forward axis is roughly its course, enters with its own weight.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.config import Settings
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.detectors.base import NONE
from graphnav.estimation.alignment.antennas import measure_baseline_heading
from graphnav.estimation.alignment.course import COURSE_SIGMA
from graphnav.estimation.alignment.first import Alignment
from graphnav.estimation.alignment.motion import (
    FEWEST_FIXES,
    align_in_motion,
    drop_implausible,
    find_motion_span,
)
from graphnav.estimation.alignment.rest import level_at_rest
from graphnav.recording import Recording

__all__ = ["COURSE_SIGMA", "Alignment", "align", "is_ready", "use_known_heading"]


def align(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    stationary: Array = NONE,
    before: Alignment | None = None,
) -> Alignment:
    """Find the first state of a recording.

    Parameters
    ----------
    stationary : (N, 2) s, intervals in which a vehicle stands, where jumps of fixes are
        not motion; of a foot, its stances.
    before : the alignment of nearly the same recording: the search starts where that one ended.

    Raises
    ------
    EstimationError
        If nothing in the recording can give an attitude.
    """
    recording = drop_implausible(recording)
    span = find_motion_span(recording, settings, stationary)
    if span is None:
        return level_at_rest(recording, settings, frame, stationary)
    found = align_in_motion(recording, settings, frame, span, stationary, before)
    return replace(found, motion=span[0], until=span[1])


def is_ready(recording: Recording, settings: Settings, stationary: Array | None = None) -> bool:
    """Whether the fixes so far contain all the motion that an alignment needs, or two antennas give the heading.

    Of rare fixes it uses more if they are there, but nobody waits for these: its sigmas are as true with fewer.

    Parameters
    ----------
    stationary : as for `align`; None where stops have not been detected yet: it may stand throughout.
    """
    stands = NONE if stationary is None else stationary
    span = find_motion_span(drop_implausible(recording), settings, stands, FEWEST_FIXES)
    if span is None:
        return measure_baseline_heading(recording, settings, stationary) is not None
    return recording.gnss is not None and span[1] < recording.gnss.t[-1]


def use_known_heading(found: Alignment, settings: Settings) -> Alignment:
    """The alignment with the initial heading that the user states, if any."""
    known = settings.alignment.heading
    if known is None:
        return found
    rph = found.rph
    rph[2] = np.radians(known)
    sigma = found.sigma.copy()
    sigma[2] = np.radians(settings.alignment.heading_sigma)
    return replace(
        found,
        state=replace(found.state, R_nb=rotation.from_rph(rph)[None]),
        sigma=sigma,
        heading_unknown=False,
        notes=(
            *found.notes,
            Note(
                "alignment.heading_stated",
                f"start heading stated: {known:g} deg, 1-sigma {settings.alignment.heading_sigma:g} deg "
                f"(found: {np.degrees(found.rph[2]):.1f} deg)",
            ),
        ),
    )
