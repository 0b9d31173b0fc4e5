"""What settled keyframes say of the sigmas of wheels and of the receiver's velocities, as the drive goes.

The judgement is that of a whole drive (`graphnav.judgement.raised_by`): sums of whitened residuals over blocks of time,
against what white noise of the sigmas used would sum up to. Residuals of keyframes that have settled know the lag's
future, and what they say is used for the keyframes that follow.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from graphnav.constraints.gnss import GnssVelocity
from graphnav.constraints.vehicle import NonHolonomic, OdometerSpeed
from graphnav.judgement import BLOCK, raised_by
from graphnav.rotation import Array
from graphnav.solvers.window import Residual, Smoothed

SPEEDS = (NonHolonomic, OdometerSpeed, GnssVelocity)
_KEPT = 1000  # blocks: about three hours
_CLEARLY = 0.1  # of a factor
_MORE = 1.2  # times the blocks of the last judgement, for the next


@dataclass
class _Blocks:
    """One constraint's: the block that is being filled, and what the full ones say of the stated sigmas."""

    number: float = -np.inf
    total: Array = field(default_factory=lambda: np.zeros(1))  # (m,)
    variance: Array = field(default_factory=lambda: np.zeros(1))
    squared: deque[Array] = field(default_factory=lambda: deque(maxlen=_KEPT))  # (m,) each
    judged: int = 0

    def close(self, factor: Array | float) -> None:
        """The block is full; its residuals were whitened with sigmas `factor` times the stated ones."""
        if np.any(self.variance):
            self.squared.append(np.asarray(factor**2 * self.total**2 / self.variance))
        self.total = self.variance = np.zeros(1)


class Evidence:
    """Factors on the sigmas of `SPEEDS`, from the residuals of what has settled."""

    def __init__(self) -> None:
        self.factors: dict[str, Array] = {}  # (m,) by constraint
        self.revised = False  # whether they have become clearly others
        self._blocks: dict[str, _Blocks] = {kind.name: _Blocks() for kind in SPEEDS}

    def add(self, part: Smoothed) -> None:
        """Take in what has settled."""
        for t, residuals in zip(part.t.tolist(), part.residuals, strict=True):
            for one in residuals:
                if one.name in self._blocks:
                    self._add(self._blocks[one.name], np.floor(t / BLOCK), one)
        for name, blocks in self._blocks.items():
            if len(blocks.squared) >= max(1.0, _MORE * blocks.judged):
                blocks.judged = len(blocks.squared)
                found = np.array([raised_by(axis) for axis in np.array(blocks.squared).T])
                if np.any(found > 1.0) or name in self.factors:
                    before = self.factors.get(name, 1.0)
                    self.revised |= bool(np.any(np.abs(found - before) > _CLEARLY * np.maximum(found, before)))
                    self.factors[name] = found

    def _add(self, blocks: _Blocks, number: float, rows: Residual) -> None:
        if number != blocks.number:
            blocks.close(self.factors.get(rows.name, 1.0))
            blocks.number = number
        usable = np.all(rows.variance > 0.2, axis=1)
        blocks.total = blocks.total + np.sum(rows.left[usable] / rows.sigma[usable], axis=0)
        blocks.variance = blocks.variance + np.sum(rows.variance[usable] / rows.sigma[usable] ** 2, axis=0)
