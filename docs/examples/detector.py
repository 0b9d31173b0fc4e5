import numpy as np

import graphnav
from graphnav.detectors.base import NONE, Detection, drop_short, find_spans
from graphnav.detectors.scene import Detector


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
solution = graphnav.run(recording, solvers=("rts",), detectors=[Steady])["rts"]
print([(d.name, len(d.intervals)) for d in solution.detections])
