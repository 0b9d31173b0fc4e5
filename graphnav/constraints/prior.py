"""Prior of the first state, before any measurement.

r = x_0 [-] x_hat, the error state of the first keyframe about the result of the alignment
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import BuildContext, Constraint, Linearized
from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.recording import Recording


@dataclass(frozen=True)
class InitialPrior(Constraint):
    """One row of fifteen numbers at the first keyframe: the filter's initial state and covariance, a factor in the
    graph.
    """

    name: ClassVar[str] = "initial_prior"
    axes: ClassVar[tuple[str, ...]] = tuple(
        f"{block}_{axis}" for block in ("theta", "p", "v", "ba", "bg") for axis in "xyz"
    )
    unit: ClassVar[str] = "rad, m, m/s, m/s^2, rad/s"

    mean: States | None = None  # one state
    sigma: Array = field(default_factory=lambda: np.ones((1, 15)))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)

    @classmethod
    def build(cls, scene: BuildContext) -> InitialPrior | None:
        return None  # it comes from the alignment, not from the recording

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.mean is not None
        residual = states.minus(self.mean)
        J = np.zeros((len(states), 15, 15))
        J[:] = np.eye(15)
        J[:, :3, :3] = rotation.right_jacobian_inverse(residual[:, :3])
        blocks = {name: J[:, :, 3 * k : 3 * k + 3] for k, name in enumerate(("theta", "p", "v", "ba", "bg"))}
        return Linearized(residual, blocks, self.sigma[rows])
