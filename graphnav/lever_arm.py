"""Whether the antenna is where the recording says: its lever arm estimated from the drive, beside the one stated.

A wrong lever arm, or one with a wrong sign, fits no turn: the fixes swing about the IMU otherwise than stated. The
estimate is that of `gnss.lever_arm_sigma`, from the first part of the drive, with next to nothing known before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.alignment import align
from graphnav.config import Settings
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.findings import Finding
from graphnav.noise.apply import with_noise
from graphnav.noise.estimate import estimate_noise
from graphnav.pipeline import origin
from graphnav.problem import pose
from graphnav.progress import tell
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solvers.batch import batch
from graphnav.solvers.ekf import ekf
from graphnav.solvers.rts import backward, rts

_UNKNOWN = 2.0  # m, 1-sigma before the drive
_SURE = 8.0  # sigmas: 4, and twice that because errors of fixes are alike for minutes


@dataclass(frozen=True)
class Antenna:
    """Where the antenna is, from the IMU, right, forward, up."""

    stated: Array  # (3,) m
    found: Array  # (3,) m
    sigma: Array  # (3,) m, of `found`

    @property
    def agrees(self) -> bool:
        """Whether the drive has nothing against what is stated."""
        return bool((np.abs(self.found - self.stated) <= _SURE * self.sigma).all())

    @property
    def finding(self) -> Finding:
        """It in a sentence."""
        found = ", ".join(f"{x:.2f} +- {s:.2f}" for x, s in zip(self.found, self.sigma, strict=True))
        stated = ", ".join(f"{x:.2f}" for x in self.stated)
        if self.agrees:
            return Finding(
                "note", f"antenna: the drive finds it at [{found}] m, which agrees with [{stated}] as stated"
            )
        return Finding(
            "warning",
            f"antenna: the drive finds it at [{found}] m and not at [{stated}] as stated: look at lever_arm in [gnss] "
            "(right, forward, up of the IMU) and its signs, or let gnss.lever_arm_sigma estimate it",
        )


def find_antenna(recording: Recording) -> Antenna:
    """Estimate the lever arm of the antenna.

    Raises
    ------
    EstimationError
        Without GNSS, or if the drive cannot be aligned.
    """
    if recording.gnss is None or not len(recording.gnss.t):
        raise EstimationError(f"'{recording.name}': there is no GNSS whose antenna could be found")
    settings, frame = Settings(), LocalFrame(origin(recording))
    tell("detection")
    still = detect(recording, settings).stationary
    tell("alignment")
    aligned = align(recording, settings, frame, lambda p, start: batch(p, start, wanted=(0,), reintegrate=False))
    if aligned.motion is None:
        raise EstimationError(f"'{recording.name}': without motion nothing tells where the antenna is")
    gnss = settings.gnss.model_copy(update={"lever_arm_sigma": _UNKNOWN})
    settings = settings.model_copy(update={"gnss": gnss})
    problem = pose(recording, settings, frame, aligned.state, aligned.sigma, still, parts_of_noise=True)
    tell("noise")
    problem = with_noise(problem, estimate_noise(problem, aligned.until).noise)
    tell("filter")
    forward = ekf(problem, opening=aligned.until)
    estimate = rts(problem, forward, backward(problem, forward)).parameters["gnss_lever_arm"]
    return Antenna(recording.gnss.lever_arm, estimate.value[-1], estimate.sigma[-1])
