"""Height by a barometer, with an offset that is a random walk and a scale.

    h + s (h - h_0) - z - b,   h = h(p) + v_up (t_r - t_k)

z is the mean of the readings since the previous keyframe, t_r the mean of their times and t_k the keyframe: readings at
any rate are used without states of their own. The offset b contains the weather, the geoid and the sensor's place; the
scale s the temperature of the air, relative to the frame's origin (h_0). It scales the height and not the readings,
whose noise times a scale would draw the estimate towards small readings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.core.earth import A, LocalFrame
from graphnav.core.rotation import Array, mv
from graphnav.core.state import Parameter, States
from graphnav.recording import Recording
from graphnav.sensors.barometer import SENSOR, compute_standard_height

OFFSET, SCALE = "barometer_offset", "barometer_scale"


@dataclass(frozen=True)
class BarometricHeight(Constraint):
    """The height that the barometer read."""

    name: ClassVar[str] = "barometer"
    turns: ClassVar[bool] = True
    axes: ClassVar[tuple[str, ...]] = ("up",)
    noise_axes: ClassVar[tuple[str, ...]] = ("up",)
    unit: ClassVar[str] = "m"
    sensor: ClassVar[str] = SENSOR.name
    words: ClassVar[Mapping[str, tuple[tuple[str, str, float], ...]]] = {
        OFFSET: (("barometer above the standard atmosphere, offset", "m", 1.0),),
        SCALE: (("barometer scale, by the temperature of the air", "%", 100.0),),
    }

    height: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, mean of the readings
    late: Array = field(default_factory=lambda: np.empty(0))  # (N,) s, mean of their times relative to the keyframe
    frame: LocalFrame | None = None
    sigma: Array = field(default_factory=lambda: np.empty((0, 1)))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # any keyframe is suitable

    @classmethod
    def build(cls, scene: BuildContext) -> BarometricHeight | None:
        series, s = scene.get_series(SENSOR.name), scene.settings.get_sensor(SENSOR.name)
        if series is None:
            return None
        figures = series.figures
        interval = np.searchsorted(scene.t, series.t - SAME_TIME)  # in the interval that ends at this keyframe
        inside = (interval > 0) & (interval < len(scene.t))
        interval, t, z = interval[inside], series.t[inside], compute_standard_height(series)[inside]
        count = np.bincount(interval, minlength=len(scene.t))
        rows = np.flatnonzero(count)
        if not len(rows):
            return None
        n = count[rows]
        parameters = (
            Parameter.centred(OFFSET, 1, figures.offset_sigma, "m", walk=figures.walk),
            Parameter.centred(SCALE, 1, figures.scale_sigma, "1"),
        )
        return cls(
            keyframe=rows,
            height=np.bincount(interval, z, len(scene.t))[rows] / n,
            late=np.bincount(interval, t, len(scene.t))[rows] / n - scene.t[rows],
            frame=scene.frame,
            sigma=(figures.sigma / np.sqrt(n))[:, None],
            parameters=parameters if figures.scale_sigma > 0.0 else parameters[:1],
            **s.outliers,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.frame is not None
        C = self.frame.R_ln(states.p)
        v, late = mv(C, states.v), self.late[rows, None]
        h = self.frame.to_llh(states.p)[:, 2:] + v[:, 2:] * late
        residual = h - self.height[rows, None] - parameters[OFFSET]
        jacobians = {OFFSET: np.full((len(h), 1, 1), -1.0)}
        gain = np.ones_like(h)
        if SCALE in parameters:
            above = h - self.frame.origin[2]
            residual, gain = residual + parameters[SCALE] * above, gain + parameters[SCALE]
            jacobians[SCALE] = above[..., None]
        # the vertical changes with position on a curved Earth
        level = (late * v[:, :2] / A)[:, None, :] @ C[:, :2]
        jacobians["p"] = gain[..., None] * (C[:, 2:] + level)
        jacobians["v"] = (gain * late)[..., None] * C[:, 2:]
        return Linearized(residual, jacobians, self.sigma[rows])
