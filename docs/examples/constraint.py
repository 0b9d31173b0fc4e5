from dataclasses import dataclass, field

import numpy as np

import graphnav
from graphnav.constraints.base import Constraint


@dataclass(frozen=True)
class NotSteep(Constraint):
    """A vehicle on a road hardly climbs: 0.5 m/s, 1-sigma."""

    name, axes, unit, depends_on = "not_steep", ("up",), "m/s", ("v",)
    sigma: np.ndarray = field(default_factory=lambda: np.empty((0, 1)))

    @classmethod
    def build(cls, scene):
        return cls(keyframe=np.arange(len(scene.t)), sigma=np.full((len(scene.t), 1), 0.5))

    def residual(self, states, parameters, rows):
        return states.v[:, 2:]


recording = graphnav.load("data/tokyo").crop(0.0, 60.0)
solution = graphnav.run(recording, solvers=("rts",), constraints=[NotSteep])["rts"]
print(solution.counts["not_steep"], "rows")
