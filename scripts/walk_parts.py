"""What each part of the model of a foot brings on real walks: all as it is, and without one part at a time.

    GRAPHNAV_DATA=... python scripts/walk_parts.py

Medians over each set, m: errors over the floor and in height as `scripts/walks.py` has them, of batch unless a column
says filter; and the median stride over the true one.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from walks import SETS

from graphnav import dynamics, load
from graphnav.config import settings_from
from graphnav.pipeline import run
from graphnav.recording import Recording
from graphnav.strides import walk_errors

_square = dynamics._scale_parameter

# settings, and what is put in the place of a function or a constant
CASES: dict[str, tuple[Mapping[str, Any], dict[str, Any]]] = {
    "as it is": ({}, {}),
    "nothing comes back": ({"foot": {"pattern": 0.0}}, {}),
    "no travel of the pivot": ({"foot": {"travel_sigma": 1e-6}}, {}),
    "zero velocity of the IMU instead": ({"foot": {"pivot_sigma": 1e-6, "travel_sigma": 1e-6, "pattern": 0.0}}, {}),
    "no zero rate": ({"standstill": {"zero_rate": False}}, {}),
    "noise as stated": ({"noise": {"mode": "stated"}}, {}),
    "offset as the unit left it": ({"imu": {"onboard_offset": False}}, {}),
    "no noise of heel strikes": ({}, {"graphnav.problem.with_unresolved_motion": lambda samples, noise: samples}),
    "axes taken as square": ({}, {"graphnav.dynamics._scale_parameter": lambda noise, _: _square(noise, 3)}),
    "peaks left cut off": ({}, {"graphnav.problem.with_whole_peaks": lambda samples, *_: (samples, ())}),
    "no coning": ({"imu": {"coning": False}}, {}),
    "no row doubted": ({"foot": {"robust": "none"}}, {}),
    "sliding taken for stance": ({}, {"graphnav.detectors.stance._without_sliding": lambda spans, *_: spans}),
    "first steps filtered once": ({}, {"graphnav.alignment.rest._OPENING": 1}),
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
    found = run(recording, settings_from(settings), ("ekf", "batch"))
    filtered, batch = (walk_errors(recording, found[name]) for name in ("ekf", "batch"))
    return [batch.horizontal, filtered.horizontal, abs(batch.up), batch.stride]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="comma separated (%(default)s)")
    options = parser.parse_args()
    folder = Path(os.environ["GRAPHNAV_DATA"])
    walks = {name: [load(path) for path in sorted((folder / name).glob("*.toml"))] for name in SETS}
    columns = "openshoe | filter | up | vicon | up | gcp | filter | stride | xio | filter | up"
    print(f"| | {columns} |\n|{' --- |' * 12}")
    for case in options.cases.split(","):
        settings, parts = CASES[case]
        with replaced(parts):
            o, v, g, x = (np.median([errors(one, settings) for one in walks[name]], axis=0) for name in SETS)
        print(f"| {case} | " + " | ".join(f"{y:.3f}" for y in (*o[:3], v[0], v[2], g[0], g[1], g[3], *x[:3])) + " |",
              flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
