from dataclasses import dataclass, field

import numpy as np

import graphnav
from graphnav.constraints.base import Constraint
from graphnav.detectors.base import NONE, Detection, drop_short, find_spans
from graphnav.detectors.scene import Detector


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


class Steady(Detector):
    """Seconds in which the force, below 2 Hz, keeps its size."""

    name, edge = "steady", 1.0

    @classmethod
    def detect(cls, scene, labels=None, shown=True):
        low, n = scene.low, round(1.0 / scene.low.period)
        whole = len(low.t) // n * n
        if not whole:
            return Detection(cls.name, np.empty(0), np.empty(0), 0.02, np.empty(0, bool), NONE, ("steady: too short",))
        t = low.t[:whole].reshape(-1, n).mean(axis=1)
        statistic = np.linalg.norm(low.rows[:whole, :3], axis=1).reshape(-1, n).std(axis=1)
        mask = statistic < 0.02
        return Detection(cls.name, t, statistic, 0.02, mask, drop_short(find_spans(mask, t, 0.5), 2.0))


recording = graphnav.load("data/tokyo").crop(0.0, 60.0)
solution = graphnav.run(recording, solvers=("rts",), constraints=[NotSteep], detectors=[Steady])["rts"]
print(solution.counts["not_steep"], "rows;", [(d.name, len(d.intervals)) for d in solution.detections])
