"""Heading and pitch of the line between two antennas.

With the baseline b in body axes, corrected by the errors of its direction (delta), and d = R_ln R_nb b::

    heading:   atan2(d_east, d_north) - psi + delta_heading + e        from -pi to pi
    pitch:     atan2(d_up, |d_east, d_north|) - theta + delta_pitch + e

e is the part of the errors that lasts for minutes, as reflections do while satellites move: a Gauss-Markov process
whose size and correlation time the noise model estimates.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.constraints.lasting import TIMES, find_fix_period, find_node_spacing
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.recording import Recording
from graphnav.sensors.dual_antenna import SENSOR


@dataclass(frozen=True)
class Baseline(Constraint):
    """The part common to both angles."""

    unit: ClassVar[str] = "rad"
    sensor: ClassVar[str] = SENSOR.name
    words: ClassVar[Mapping[str, tuple[tuple[str, str, float], ...]]] = {
        f"{SENSOR.name}_{angle}_offset": ((f"baseline of the antennas, {angle}", "deg", 57.29577951308232),)
        for angle in ("heading", "pitch")
    }
    column: ClassVar[str] = ""

    measured: Array = field(default_factory=lambda: np.empty((0, 1)))  # rad
    sigma: Array = field(default_factory=lambda: np.empty((0, 1)))
    baseline: Array = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    frame: LocalFrame | None = None

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        series = recording.sensors.get(SENSOR.name)
        if series is None or not settings.get_sensor(SENSOR.name).use:
            return np.empty(0)
        inside = (series.t >= recording.start - SAME_TIME) & (series.t <= recording.end + SAME_TIME)
        return series.t[inside & np.isfinite(series[cls.column])]

    @classmethod
    def build(cls, scene: BuildContext) -> Self | None:
        series, s = scene.get_series(SENSOR.name), scene.settings.get_sensor(SENSOR.name)
        if series is None:
            return None
        keyframe = scene.find_keyframes(series.t)
        used = (keyframe >= 0) & np.isfinite(series[cls.column])
        if not used.any():
            return None
        figures = series.figures
        sigma = series.get_sigma(cls.column, np.radians(figures.sigma))[used, None]
        times = scene.settings.gnss.slow_times
        lasting = Parameter(
            cls.name_lasting(), np.zeros(1), np.median(sigma, axis=0), "rad", correlation_time=times[0],
            spacing=find_node_spacing(times, find_fix_period(series.t[used])),
            noise_groups=(f"{cls.name}.{TIMES[1]}.{cls.column}",),
        )  # fmt: skip
        wrong = Parameter.centred(cls._name_offset(), 1, np.radians(figures.baseline_sigma), "rad")
        return cls(
            keyframe=keyframe[used],
            measured=series[cls.column][used, None],
            sigma=sigma,
            baseline=np.array(figures.baseline),
            frame=scene.frame,
            parameters=(wrong,) if figures.baseline_sigma > 0.0 else (),
            processes=(lasting,),
            **s.outliers,
        )

    @classmethod
    def _name_offset(cls) -> str:
        """Name of the parameter for the error of the baseline's direction."""
        return f"{SENSOR.name}_{cls.column}_offset"

    @classmethod
    def name_lasting(cls) -> str:
        """Name of the process of its lasting error."""
        return f"{cls.name}_error"

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.frame is not None
        C = self.frame.R_ln(states.p) @ states.R_nb
        d = C @ self.baseline
        angle, by_d = self.compute_angle(d)
        residual = angle - self.measured[rows]
        jacobians: dict[str, Any] = {"theta": -by_d[:, None, :] @ C @ rotation.skew(self.baseline)}
        for name in (self._name_offset(), self.name_lasting()):
            if name in parameters:
                residual = residual + parameters[name]
                jacobians[name] = np.ones((len(residual), 1, 1))
        return Linearized((residual + np.pi) % (2.0 * np.pi) - np.pi, jacobians, self.sigma[rows])

    @abstractmethod
    def compute_angle(self, d: Array) -> tuple[Array, Array]:
        """The angle (n, 1) of directions d (n, 3) in local axes, and its derivative by them (n, 3)."""


@dataclass(frozen=True)
class DualHeading(Baseline):
    """Heading of the line from the first antenna to the second."""

    name: ClassVar[str] = "dual_antenna_heading"
    axes: ClassVar[tuple[str, ...]] = ("heading",)
    noise_axes: ClassVar[tuple[str, ...]] = ("heading",)
    column: ClassVar[str] = "heading"

    def compute_angle(self, d: Array) -> tuple[Array, Array]:
        e, n = d[:, 0], d[:, 1]
        level2 = e * e + n * n
        return np.arctan2(e, n)[:, None], np.stack([n / level2, -e / level2, np.zeros_like(e)], -1)


@dataclass(frozen=True)
class DualPitch(Baseline):
    """Pitch of that line."""

    name: ClassVar[str] = "dual_antenna_pitch"
    axes: ClassVar[tuple[str, ...]] = ("pitch",)
    noise_axes: ClassVar[tuple[str, ...]] = ("pitch",)
    column: ClassVar[str] = "pitch"

    def compute_angle(self, d: Array) -> tuple[Array, Array]:
        e, n, u = d.T
        level = np.hypot(e, n)
        whole = level * level + u * u
        return np.arctan2(u, level)[:, None], np.stack([-e * u / level, -n * u / level, level], -1) / whole[:, None]
