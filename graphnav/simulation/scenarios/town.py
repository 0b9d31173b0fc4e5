"""Streets: the parts of the town scenarios, and of the drives between stops in others."""

from __future__ import annotations

import numpy as np

from graphnav.simulation.motion import Manoeuvre


def choose_manoeuvres(
    duration: float, rng: np.random.Generator, *, fast: tuple[float, float] = (8.0, 15.0), hills: float = 0.03,
    pause: float = 0.3,
) -> list[Manoeuvre]:  # fmt: skip
    """Manoeuvres filling `duration` s from a standstill to a standstill: straights, bends, corners, lights, slopes.

    `fast` is the range of speeds, m/s, `hills` the largest grade, `pause` the chance of a light at each corner.
    The last ten seconds and a half brake from 11 m/s, the first ten pull away to it.
    """
    pull_away, brake = Manoeuvre(10.0, 11.0), Manoeuvre(10.5, 0.0, grade=0.0)
    plan, left, v = [pull_away], duration - pull_away.duration - brake.duration, 11.0
    if left < 4.0:
        raise ValueError("streets take at least 25 s")
    settle = 20.0  # kept to come back to 11 m/s

    def add(length: float, speed: float, turn: float = 0.0, grade: float | None = None) -> None:
        nonlocal left, v
        plan.append(Manoeuvre(length, speed, turn, grade))
        left, v = left - length, speed

    while left > 75.0 + settle:
        speed = rng.uniform(*fast)
        add(max(5.0, abs(speed - v) / 1.2), speed, 0.0, rng.uniform(-hills, hills))
        add(rng.uniform(8.0, 20.0), speed, rng.uniform(-35.0, 35.0), rng.uniform(-hills, hills))
        if rng.random() < pause:
            add(max(4.0, v / 1.5), 0.0)
            add(rng.uniform(6.0, 22.0), 0.0)
            add(5.0, 6.0)
        else:
            add(max(4.0, (v - 6.0) / 1.3), 6.0)
        add(8.0, 6.0, rng.choice([-1.0, 1.0]) * rng.uniform(70.0, 110.0))
    if left > settle:
        add(left - settle, max(v, 8.0), rng.uniform(-20.0, 20.0))
    add(left, 11.0, 0.0, 0.0)
    return [*plan, brake]
