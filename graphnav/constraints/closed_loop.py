"""The drive ends where it starts, if the recording states so: p_K - p_0, with p_0 at the origin of the frame.

Only for recordings whose positions count from their start (no GNSS), and never where the loop closure error itself is
evaluated.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import BuildContext, Constraint, Linearized
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.recording import Recording


@dataclass(frozen=True)
class ClosedLoop(Constraint):
    """One row at the last keyframe."""

    name: ClassVar[str] = "closed_loop"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    unit: ClassVar[str] = "m"

    sigma: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # there always is a last keyframe

    @classmethod
    def build(cls, scene: BuildContext) -> ClosedLoop | None:
        sigma, gnss = scene.settings.foot.closed_loop, scene.recording.gnss
        if sigma is None or scene.recording.platform != "foot" or (gnss is not None and len(gnss.t)):
            return None
        note = Note(
            "closed_loop.set",
            f"the end is constrained to the start, to {sigma:g} m (closed_loop): "
            "the closure error is no measure of accuracy",
        )
        return cls(keyframe=np.array([len(scene.t) - 1]), sigma=np.full((1, 3), sigma), notes=(note,))

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        return Linearized(states.p, {"p": np.broadcast_to(np.eye(3), (len(states), 3, 3))}, self.sigma[rows])
