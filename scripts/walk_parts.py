"""What each part of the model of a foot brings on real walks: all as it is, and without one part at a time.

    GRAPHNAV_DATA=... python scripts/walk_parts.py

Medians over each set, m: errors over the floor and in height as `scripts/walks.py` has them, of batch unless a column
says filter; and the median stride over the true one. With --harm, beside the first case and over all walks: how many
are better and worse by more than a centimetre over the floor, and the median and the largest change, m.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from walks import SETS

from graphnav import load
from graphnav.config import parse_settings
from graphnav.core.state import Parameter
from graphnav.estimation.pipeline import run
from graphnav.evaluation.strides import compute_walk_errors
from graphnav.imu import dynamics
from graphnav.recording import ImuNoise, Recording

SAME = 0.01  # m: truths are no better
_whole = dynamics._scale_parameter


def _take_square(noise: ImuNoise) -> tuple[Parameter, ...]:
    return tuple(replace(p, sigma=np.where(np.arange(18) % 9 < 3, p.sigma, 1e-9)) for p in _whole(noise, True))


# settings, and what is put in the place of a function or a constant
CASES: dict[str, tuple[Mapping[str, Any], dict[str, Any]]] = {
    "as it is": ({}, {}),
    "nothing comes back": ({"foot": {"pattern": 0.0}}, {}),
    "no travel of the pivot": ({"foot": {"travel_sigma": 1e-6}}, {}),
    "zero velocity of the IMU instead": ({"foot": {"pivot_sigma": 1e-6, "travel_sigma": 1e-6, "pattern": 0.0}}, {}),
    "no sideways speed in swing": ({"foot": {"lateral": True}}, {}),
    "zero velocity instead and no sideways speed": (
        {"foot": {"pivot_sigma": 1e-6, "travel_sigma": 1e-6, "pattern": 0.0, "lateral": True}}, {}),
    "acceleration_variance alone": ({"detectors": {"fire": ["acceleration_variance"]}}, {}),
    "acceleration_magnitude alone": ({"detectors": {"fire": ["acceleration_magnitude"]}}, {}),
    "angular_rate_energy alone": ({"detectors": {"fire": ["angular_rate_energy"]}}, {}),
    "no zero rate": ({"standstill": {"zero_rate": False}}, {}),
    "noise as stated": ({"noise": {"mode": "stated"}}, {}),
    "offset as the unit left it": ({"imu": {"onboard_offset": False}}, {}),
    "no noise of heel strikes": (
        {}, {"graphnav.estimation.problem.add_unresolved_motion": lambda samples, noise: samples}),
    "axes taken as square": ({}, {"graphnav.imu.dynamics._scale_parameter": lambda noise, _: _take_square(noise)}),
    "peaks left cut off": ({}, {"graphnav.estimation.problem.restore_peaks": lambda samples, *_: (samples, ())}),
    "no coning": ({"imu": {"coning": False}}, {}),
    "no row doubted": ({"foot": {"robust": "none"}}, {}),
    "sliding taken for stance": ({}, {"graphnav.detectors.stance._cut_sliding": lambda spans, *_: spans}),
    "first steps filtered once": ({}, {"graphnav.estimation.alignment.rest._OPENING": 1}),
}  # fmt: skip


@contextmanager
def replaced(parts: Mapping[str, Any]) -> Iterator[None]:
    """With other things in the places named."""
    patches = [patch(name, other) for name, other in parts.items()]
    for one in patches:
        one.start()
    try:
        yield
    finally:
        for one in patches:
            one.stop()


def errors(recording: Recording, settings: Mapping[str, Any]) -> list[float]:
    """Of batch and filter over the floor, of batch in height; the stride."""
    found = run(recording, parse_settings(settings), ("ekf", "batch"))
    filtered, batch = (compute_walk_errors(recording, found[name]) for name in ("ekf", "batch"))
    return [batch.horizontal, filtered.horizontal, abs(batch.up), batch.stride]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="comma separated (%(default)s)")
    parser.add_argument("--harm", action="store_true", help="compare each walk with what the first case has")
    options = parser.parse_args()
    folder = Path(os.environ["GRAPHNAV_DATA"])
    walks = {name: [load(path) for path in sorted((folder / name).glob("*.toml"))] for name in SETS}
    if options.harm:
        return harm(options.cases.split(","), walks)
    columns = "openshoe | filter | up | vicon | up | gcp | filter | stride | xio | filter | up"
    print(f"| | {columns} |\n|{' --- |' * 12}")
    for case in options.cases.split(","):
        settings, parts = CASES[case]
        with replaced(parts):
            o, v, g, x = (np.median([errors(one, settings) for one in walks[name]], axis=0) for name in SETS)
        print(f"| {case} | " + " | ".join(f"{y:.3f}" for y in (*o[:3], v[0], v[2], g[0], g[1], g[3], *x[:3])) + " |",
              flush=True)  # fmt: skip


def harm(cases: list[str], walks: Mapping[str, list[Recording]]) -> None:
    """Better and worse walks, of filter and batch."""
    print(f"| beside '{cases[0]}' | batch better, worse | median, most | filter better, worse | median, most |")
    print("|" + " --- |" * 5)
    rows = {}
    for case in cases:
        settings, parts = CASES[case]
        with replaced(parts):
            rows[case] = np.array([errors(one, settings) for name in SETS for one in walks[name]])
        change = rows[case][:, :2] - rows[cases[0]][:, :2]
        cells = [
            f"{np.sum(x < -SAME)}, {np.sum(x > SAME)} | {np.median(x):+.3f}, {x[np.argmax(np.abs(x))]:+.3f}"
            for x in change.T
        ]
        if case != cases[0]:
            print(f"| {case} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
