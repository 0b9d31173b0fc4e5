"""A recording row by row through the online smoother: what settles, what is known at once, and the antenna of each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET
from graphnav.core.errors import GraphnavError
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.evaluation.evaluate import AntennaCalibration
from graphnav.online import Online, drop_rows, list_rows, live_trajectory
from graphnav.recording import Recording

NAMES = ("t", "llh", "v", "rph", "sd_p", "sd_v", "sd_rph", "covariance")


@dataclass
class Track:
    """Pieces of a trajectory, and the antenna as it is when they come out."""

    pieces: list[Trajectory] = field(default_factory=list)
    antennas: list[Array] = field(default_factory=list)  # (5,) m, s, s/s: arm, offset and rate of the stamps

    def add(self, pieces: list[Trajectory], antenna: Array) -> None:
        self.pieces += pieces
        self.antennas += [antenna] * len(pieces)

    def join(self) -> tuple[Trajectory, AntennaCalibration]:
        """The whole trajectory, and the antenna of each of its N rows."""
        track = Trajectory(**{name: np.concatenate([getattr(one, name) for one in self.pieces]) for name in NAMES})
        of_rows = np.repeat(self.antennas, [len(one.t) for one in self.pieces], axis=0)
        begin = np.concatenate([[-np.inf], track.t[1:]])
        return track, AntennaCalibration(of_rows[:, 3], of_rows[:, :3], of_rows[:, 4], begin)


def run_online(recording: Recording, settings: Settings) -> tuple[Online, dict[str, Track]]:
    """The smoother at the end, and what settled and what was known just after each keyframe."""
    assert recording.gnss is not None
    online, tracks, newest = Online(drop_rows(recording), settings), {"settled": Track(), "at once": Track()}, -np.inf
    antenna = stated = np.concatenate([recording.gnss.lever_arm, np.zeros(2)])
    for row in list_rows(recording)[1]:
        online.add(row)
        if online.tracker is None or online.tracker.newest <= newest:
            continue
        newest, state = online.tracker.newest, online.tracker.window.newest
        antenna = stated.copy()  # what a noise model has freed may be as stated by the next one
        for name, at in ((LEVER_ARM, slice(0, 3)), (TIME_OFFSET, slice(3, 4)), (CLOCK_RATE, slice(4, 5))):
            if name in state.columns:
                antenna[at] = state.get_value(name)
        tracks["settled"].add(online.settled(), antenna)
        if (now := live_trajectory(online)) is not None:
            tracks["at once"].add([now], antenna)
    online.finish()
    tracks["settled"].add(online.settled(), antenna)
    if not tracks["settled"].pieces:
        raise GraphnavError(f"nothing has settled: {online.explain_start()}")
    return online, tracks
