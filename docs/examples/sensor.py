from dataclasses import dataclass, field, replace

import numpy as np

import graphnav
from graphnav.constraints.base import Constraint
from graphnav.recording.formats.writer import write_folder
from graphnav.sensors import Column, Sensor, register
from graphnav.sensors.tables import Positive, TomlTable


class Figures(TomlTable):
    sigma: Positive = 0.1  # m/s


RADAR = register(
    Sensor(
        "radar",
        "speed over ground",
        (Column("speed", {"m/s": 1.0, "km/h": 1 / 3.6}, 0.0, 100.0),),
        (("speed",),),
        Figures,
    )
)


@dataclass(frozen=True)
class GroundSpeed(Constraint):
    """The body moves as fast as the radar says."""

    name, axes, unit, sensor, depends_on = "ground_speed", ("along",), "m/s", "radar", ("v",)
    speed: np.ndarray = field(default_factory=lambda: np.empty(0))
    sigma: np.ndarray = field(default_factory=lambda: np.empty((0, 1)))

    @classmethod
    def build(cls, scene):
        series = scene.get_series("radar")
        if series is None:
            return None
        speed = np.interp(scene.t, series.t, series["speed"], left=np.nan, right=np.nan)
        rows = np.flatnonzero(speed > 1.0)  # at rest a speed has no direction
        return cls(keyframe=rows, speed=speed[rows], sigma=np.full((len(rows), 1), series.figures.sigma))

    def residual(self, states, parameters, rows):
        return np.linalg.norm(states.v, axis=1, keepdims=True) - self.speed[rows, None]


drive = graphnav.load("data/tokyo").crop(0.0, 60.0)
seen = RADAR.make_series(drive.odometer.t, {"speed": np.abs(drive.odometer.speed)}, sigma=0.2)  # for want of a radar
write_folder(replace(drive, odometer=None, sensors={"radar": seen}), "out/radar")
recording = graphnav.load("out/radar")
solution = graphnav.run(recording, solvers=("rts",), constraints=[GroundSpeed])["rts"]
print(len(recording.sensors["radar"]), "readings,", solution.counts["ground_speed"], "rows")
