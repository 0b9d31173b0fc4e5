"""The data that detectors share, each derived once, and the interface of a detector."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from graphnav.config.detectors import DetectorSettings
from graphnav.core.earth import STANDARD_GRAVITY, gravity
from graphnav.core.findings import compute_period
from graphnav.core.rotation import Array
from graphnav.detectors.base import Detection
from graphnav.detectors.motion import Speeds, collect_speeds, find_moving
from graphnav.detectors.windows import (
    BlockMeans,
    LowPassed,
    WindowMeans,
    average_blocks,
    compute_window_means,
    low_pass,
)
from graphnav.recording import Recording


@dataclass(frozen=True)
class Scene:
    """A recording, or a window of one, with quantities that several detectors need."""

    recording: Recording
    settings: DetectorSettings

    @cached_property
    def period(self) -> float:
        """s between IMU rows; not positive where there are too few."""
        return compute_period(self.recording.imu.t)

    @cached_property
    def blocks(self) -> BlockMeans:
        """Means over blocks of rows."""
        return average_blocks(self.recording.imu, self.period)

    @cached_property
    def low(self) -> LowPassed:
        """The IMU below about 2 Hz."""
        return low_pass(self.blocks)

    @cached_property
    def means(self) -> WindowMeans | None:
        """Means over the windows of the GLRT and related statistics; None where there is no window."""
        return compute_window_means(self.blocks, self.settings.glrt.window)

    @cached_property
    def known(self) -> list[Speeds]:
        """Speeds by odometer and GNSS."""
        return collect_speeds(self.recording, self.settings.fusion)

    @cached_property
    def certain(self) -> Array:
        """(M, 2) s, spans in which odometer or GNSS show certain motion."""
        return find_moving(self.known)

    @cached_property
    def gravity(self) -> float:
        """Gravity at the first fix, m/s^2."""
        gnss = self.recording.gnss
        if gnss is not None:
            there = np.flatnonzero(np.isfinite(gnss.llh).all(axis=1))
            if len(there):
                return float(gravity(*gnss.llh[there[0], [0, 2]]))
        return STANDARD_GRAVITY


@dataclass(frozen=True)
class Labels:
    """Spans that other detectors call stationary and moving, each (M, 2) s."""

    still: Array
    moving: Array


class Detector(ABC):
    """Interface of a detector of stationary windows. Subclasses in this folder are found automatically.

    A detector never fails: where it cannot work it returns a `Detection` without windows and a note.
    """

    name: ClassVar[str]
    edge: ClassVar[float]  # s by which the ends of a stop may differ between a recording and a part of it

    @classmethod
    @abstractmethod
    def detect(cls, scene: Scene, labels: Labels | None = None, shown: bool = True) -> Detection:
        """Detect stationary windows.

        Parameters
        ----------
        scene : the recording, and what several detectors need of it.
        labels : what the others find still and moving, to learn from; a detector that decides alone has none.
        shown : whether its statistic is wanted where it decides nothing.

        Returns
        -------
        Detection
            Windows, statistic, threshold, mask and intervals.
        """
