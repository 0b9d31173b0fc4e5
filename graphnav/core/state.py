"""Navigation states as a struct of arrays, and the error state every solver works in.

Error state of one keyframe, 15 numbers in this order::

    theta (3)  rad     right perturbation, R_nb <- R_nb Exp(theta)
    p     (3)  m       additive, navigation frame
    v     (3)  m/s     additive, navigation frame
    ba    (3)  m/s^2   additive, accelerometer bias
    bg    (3)  rad/s   additive, gyro bias
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core import rotation
from graphnav.core.rotation import Array

BLOCKS = {
    "theta": slice(0, 3),
    "p": slice(3, 6),
    "v": slice(6, 9),
    "ba": slice(9, 12),
    "bg": slice(12, 15),
}
DIM = 15
MOVING = BLOCKS["v"].stop  # attitude, position and velocity come first; biases stay from step to step
SECONDS = 3.0  # s, initial correlation time of errors that last for seconds: multipath, tyre slip
NODE_SPACING = 5.0  # s between the nodes of slow random walks: mounting angles, odometer scale


@dataclass(frozen=True)
class Parameter:
    """A quantity estimated beside the states: a constant, a random walk, a stationary Gauss-Markov process, or a
    constant that is reset at given times.
    """

    name: str
    initial: Array  # (k,), or (n, k) for one that is reset
    sigma: Array  # the same shape, 1-sigma of the initial value
    unit: str
    walk: float | Array = 0.0  # unit/sqrt(s) of a random walk, (k,) or one for all; 0 = constant
    correlation_time: float | None = None  # s; if given, a Gauss-Markov process about zero with `sigma` at all times
    # of such a process: (n,) s, from when on it is in units of each of (n,) sizes
    sizes: tuple[Array, Array] | None = None
    spacing: float = NODE_SPACING  # s, at least, between two nodes
    begins: Array | None = None  # (n,) s; if given, `initial` and `sigma` apply anew from each of these times on
    reported: bool = False  # whether a solution reports its values
    # (k,) of a process: name of the variance component (`graphnav.estimation.noise`) of each number
    noise_groups: tuple[str, ...] = ()

    @classmethod
    def centred(cls, name: str, size: int, sigma: float, unit: str, walk: float = 0.0, **more: Any) -> Parameter:
        """One of `size` components about zero, with one sigma for all of them."""
        return cls(name, np.zeros(size), np.full(size, sigma), unit, walk, **more)

    @property
    def size(self) -> int:
        """Number of components, k."""
        return int(np.shape(self.initial)[-1])

    @property
    def listed(self) -> bool:
        """Whether a solution reports its values; the positions of stops are not calibration."""
        return self.begins is None or self.reported

    @property
    def prior_sigma(self) -> Array:
        """(k,) 1-sigma before any measurement; of a parameter that is reset, the last."""
        return np.atleast_2d(self.sigma)[-1]

    @cached_property
    def constant(self) -> bool:
        """Whether one value holds for the whole recording."""
        return self.begins is None and self.correlation_time is None and not np.any(self.walk)

    def step(self, begin: Array, end: Array) -> tuple[Array, Array]:
        """Decay (n,) and 1-sigma (n, k) of the process noise from times `begin` to times `end` (n,), s."""
        dt = end - begin
        if self.correlation_time is None:
            return np.ones_like(dt), np.sqrt(dt)[:, None] * np.broadcast_to(self.walk, self.sigma.shape)
        decay = np.exp(-dt / self.correlation_time) * self.compare_sizes(begin, end)
        return decay, np.sqrt(1.0 - decay**2)[:, None] * self.sigma

    def compare_sizes(self, begin: Array, end: Array) -> Array:
        """(n,) the smaller over the larger of the sizes at two times (n,): the correlation that is left of the process
        where the larger error is the smaller one and an independent one beside it.
        """
        if self.sizes is None:
            return np.ones(len(begin))
        t, size = self.sizes
        a, b = (size[np.maximum(np.searchsorted(t, x + 1e-6, side="right") - 1, 0)] for x in (begin, end))
        return np.asarray(np.minimum(a, b) / np.maximum(a, b))


def split_covariance(P: Array) -> dict[str, Array]:
    """Covariances (6, K) of position, velocity and attitude, each by itself: xx, yy, zz, xy, xz, yz."""
    i, j = np.array([[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    first = {name: BLOCKS[name].start for name in ("p", "v", "theta")}
    return {name: np.ascontiguousarray(P[:, at + i, at + j].T) for name, at in first.items()}


@dataclass(frozen=True)
class States:
    """K states; ``states[index]`` takes rows by a slice or an index array, so that the row axis stays."""

    R_nb: Array  # (K, 3, 3)
    p: Array  # (K, 3)
    v: Array  # (K, 3)
    ba: Array  # (K, 3)
    bg: Array  # (K, 3)

    def __len__(self) -> int:
        return len(self.p)

    def __repr__(self) -> str:
        return f"States of {len(self)} epochs"

    def __getitem__(self, index: slice | NDArray[Any]) -> States:
        if isinstance(index, slice) or index.dtype == bool:
            return States(self.R_nb[index], self.p[index], self.v[index], self.ba[index], self.bg[index])
        # several times faster than by brackets
        return States(*(x.take(index, axis=0) for x in (self.R_nb, self.p, self.v, self.ba, self.bg)))

    def plus(self, delta: Array) -> States:
        """Retract by error states: ``R_nb Exp(theta)``, the rest added.

        Parameters
        ----------
        delta
            (K, 15) theta (rad, body), p (m), v (m/s) in n, b_a (m/s^2), b_g (rad/s).

        Returns
        -------
        States
            K states.
        """
        return States(
            self.R_nb @ rotation.exp(delta[:, 0:3]),
            self.p + delta[:, 3:6],
            self.v + delta[:, 6:9],
            self.ba + delta[:, 9:12],
            self.bg + delta[:, 12:15],
        )

    def minus(self, other: States) -> Array:
        """The error states between two sets of states.

        Parameters
        ----------
        other
            K states.

        Returns
        -------
        array
            (K, 15) with ``other.plus(d) == self``, in the order and units of `plus`.
        """
        return np.concatenate(
            [
                rotation.log(np.swapaxes(other.R_nb, -1, -2) @ self.R_nb),
                self.p - other.p,
                self.v - other.v,
                self.ba - other.ba,
                self.bg - other.bg,
            ],
            axis=-1,
        )

    @staticmethod
    def stack(rows: list[States]) -> States:
        """Stack states.

        Parameters
        ----------
        rows
            Of one keyframe or several each.

        Returns
        -------
        States
            One struct of arrays.
        """
        return States(*(np.concatenate([getattr(s, f) for s in rows]) for f in ("R_nb", "p", "v", "ba", "bg")))
