"""Passengers who open doors, get in and out, and move on their seats: motion of a standing vehicle's sprung body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from graphnav.core.rotation import Array
from graphnav.simulation.motion import Path
from graphnav.simulation.vibration import UP, Part, compute_sway, make_oscillator, sample_movement, shake_times

# Effect of a passenger of 75 kg on a car's suspension (100 kN/m in heave, some 40 kNm/rad in roll and 100 in pitch; the
# seat 0.4 m to the side and 0.3 m from the middle): the static response, m and rad.
_SINKS, _ROLLS, _PITCHES = 0.0075, 0.0070, 0.0022


@dataclass(frozen=True)
class Boarding:
    """A person gets in (`weight` +1) or out (-1) by a door; 0 is a door opened and shut only."""

    t: float  # s, when the door opens
    weight: float = 1.0
    side: float = 1.0  # right +1, left -1
    end: float = 1.0  # front +1, rear -1


@dataclass(frozen=True)
class Fidget:
    """A person moves on the seat."""

    t: float
    size: float  # share of the weight that moves


def simulate_movement(
    path: Path,
    events: Sequence[Boarding | Fidget],
    pivot_to_imu: tuple[float, float, float],
    rng: np.random.Generator,
) -> Part:
    """Motion of the body under `events`: forces in heave, pitch and roll, each with its spring and damper."""
    t = shake_times(path)
    push = np.zeros((len(t), 3))  # heave, pitch, roll, as static responses
    for event in events:
        if isinstance(event, Fidget):
            there = _make_hump(t, event.t, rng.uniform(0.5, 1.2)) * event.size
            push += there[:, None] * rng.normal(0.0, (0.2, 0.5, 0.6)) * (_SINKS, _PITCHES, _ROLLS)
            continue
        load = np.array([-_SINKS, -event.end * _PITCHES, event.side * _ROLLS])
        if event.weight:
            # holding on and swinging in or out, then the weight is there or gone
            seated = event.t + rng.uniform(1.5, 2.5)
            push += (event.weight * _step(t, seated, rng.uniform(0.6, 1.0)))[:, None] * load
            push += (0.5 * _make_hump(t, seated, rng.uniform(0.4, 0.7)))[:, None] * load * rng.uniform(0.3, 1.0, 3)
            slam = seated + rng.uniform(1.5, 2.5)
        else:
            slam = event.t + rng.uniform(2.0, 4.0)
        for at, size in ((event.t, 0.2), (slam, 0.8)):  # unlatching, shutting
            push += (size * _make_hump(t, at, 0.06))[:, None] * load * (0.3, 0.5, 1.0)
    swung = np.zeros_like(push)
    for k, (hz, damping) in enumerate(((1.4, 0.3), (1.6, 0.3), (1.8, 0.25))):
        swung[:, k] = signal.lfilter(*make_oscillator(hz, damping), push[:, k])
    out = compute_sway(swung[:, 1], swung[:, 2], pivot_to_imu)
    out[:, UP] += swung[:, 0]
    return sample_movement(path, out)


def _step(t: Array, at: float, width: float) -> Array:
    """From 0 to 1 within `width` s around a time, smoothly."""
    u = np.clip((t - at) / width + 0.5, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def _make_hump(t: Array, at: float, width: float) -> Array:
    """A force that rises and falls within some `width` s."""
    return np.exp(-0.5 * ((t - at) / (0.4 * width)) ** 2)
