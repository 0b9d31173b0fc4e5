"""Footprints of a walker's foot along a route of straights and corners: places and times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array

_ROUTE_STEP = 0.005  # m, between the points at which a route is integrated


@dataclass(frozen=True)
class Route:
    """The middle line of a walk, by arc length."""

    s: Array  # (G,) m
    xy: Array  # (G, 2) m, east and north of the start
    heading: Array  # (G,) rad, clockwise from north, unwrapped

    @property
    def length(self) -> float:
        return float(self.s[-1])

    def locate(self, s: Array) -> tuple[Array, Array]:
        """(places (K, 2), headings (K,)) at arc lengths (K,)."""
        xy = np.stack([np.interp(s, self.s, self.xy[:, k]) for k in (0, 1)], -1)
        return xy, np.interp(s, self.s, self.heading)


def make_route(parts: Sequence[tuple[float, float]], heading: float = 0.0) -> Route:
    """From parts (m, deg): each so long, and turning evenly by so much, to the right positive; `heading` in deg."""
    edges = np.concatenate([[0.0], np.cumsum([length for length, _ in parts])])
    turned = heading + np.concatenate([[0.0], np.cumsum([turn for _, turn in parts])])
    s = np.linspace(0.0, edges[-1], int(np.ceil(edges[-1] / _ROUTE_STEP)) + 1)
    psi = np.deg2rad(np.interp(s, edges, turned))
    step = np.column_stack([np.sin(psi), np.cos(psi)])
    moved = np.cumsum(0.5 * (step[1:] + step[:-1]), axis=0) * (s[1] - s[0])
    return Route(s, np.concatenate([np.zeros((1, 2)), moved]), psi)


def list_rectangle(perimeter: float, laps: int, corner: float = 0.6, ratio: float = 0.55) -> list[tuple[float, float]]:
    """Parts of a route `laps` times around, to the left, that ends where it began, just after a corner.

    `perimeter` counts the arcs of radius `corner`, m; `ratio` is the short side's over the long one's.
    """
    arc = 0.5 * np.pi * corner
    straight = 0.5 * perimeter - 2.0 * arc  # of a long and a short side together
    # sides with their corners: long + 2 corner and short + 2 corner
    long = (straight + 2.0 * corner * (1.0 - ratio)) / (1.0 + ratio)
    sides = [long, straight - long]
    return [part for _ in range(laps) for side in sides + sides for part in ((side, 0.0), (arc, -90.0))]


@dataclass(frozen=True)
class Footprints:
    """K footprints of one foot; the first begins before the walk, the last does not end."""

    place: Array  # (K, 2) m, east and north: the ball of the foot on the floor
    land: Array  # (K,) rad, heading when it comes down
    leave: Array  # (K,) rad, heading when it takes off
    strike: Array  # (K,) s, the heel comes down; the first is the start of the recording
    off: Array  # (K,) s, the toes take off; the last is the end of the recording

    def __len__(self) -> int:
        return len(self.place)


@dataclass(frozen=True)
class Cadence:
    """Stride of a walker at some speed, and its variation."""

    speed: float  # m/s
    length: float  # m, of a stride
    stance: float  # share of a stride's time for which the foot touches the floor
    length_jitter: float = 0.03  # 1-sigma, of the length
    time_jitter: float = 0.02
    side_jitter: float = 0.012  # m
    heading_jitter: float = 2.0  # deg

    @classmethod
    def of(cls, speed: float) -> Cadence:
        """Length and rate of strides both grow as the root of the speed (walk ratio; Sekiya and Nagasaki 1998).

        1.43 m and 0.91 Hz at 1.3 m/s; the share of stance falls from 65 to 58 % (Murray 1966).
        """
        return cls(speed, 1.25 * float(np.sqrt(speed)), float(np.clip(0.71 - 0.075 * speed, 0.52, 0.68)))


def make_footsteps(
    along: Route, cadence: Cadence, start: float, walked: float, end: float, rng: np.random.Generator, *,
    side: float = 0.08, toe_out: float = 6.0, closed: bool = False,
) -> Footprints:  # fmt: skip
    """Footprints of a foot `side` m right of the route, which walks from `start` for `walked` s to `end`.

    It begins and ends with strides of some two thirds, standing beside the other foot; strides are shorter in corners.
    A third of a foot's turning takes place on the floor, about its ball. `toe_out` in deg; `closed` puts the last
    footprint on the first.
    """
    count = max(3, round(along.length / cadence.length + 0.7))
    # the route's curvature over a stride, from equal strides
    even = np.linspace(0.0, along.length, count + 1)
    turn = np.abs(np.diff(along.locate(even)[1]))
    part = 1.0 + cadence.length_jitter * rng.standard_normal(count) - 0.2 * np.minimum(turn / 1.57, 1.0)
    part[[0, -1]] *= 0.65
    s = np.concatenate([[0.0], np.cumsum(part)]) * along.length / part.sum()
    # a short stride takes nearly as long as a long one
    took = (part / part.mean()) ** 0.3 * (1.0 + cadence.time_jitter * rng.standard_normal(count))
    took *= walked / took.sum()
    swing = (1.0 - cadence.stance) * took * (1.0 + 0.5 * cadence.time_jitter * rng.standard_normal(count))
    lift = start + np.concatenate([[0.0], np.cumsum(took[:-1])]) + 0.4 * took  # of a stride's toes
    xy, psi = along.locate(s)
    beside = side + cadence.side_jitter * rng.standard_normal(count + 1)
    place = xy + beside[:, None] * np.column_stack([np.cos(psi), -np.sin(psi)])
    psi = psi + np.deg2rad(toe_out + cadence.heading_jitter * rng.standard_normal(count + 1))
    if closed:
        place[-1] = place[0]
        psi[-1] = psi[0] + along.heading[-1] - along.heading[0]
    onward = np.diff(psi, append=psi[-1])
    return Footprints(
        place, psi, psi + 0.33 * onward, np.concatenate([[0.0], lift + swing]), np.concatenate([lift, [end]])
    )
