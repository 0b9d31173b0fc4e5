"""The picture in README.md: the way through a withheld span, and the horizontal error of every solver in it.

python scripts/picture.py data/tokyo --without gnss:40-100 --inertial -o docs/outage.png

The command and the largest errors are kept in the picture, as its description.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from graphnav.app.withholding import parse_withheld
from graphnav.app.workflow import Request, run_request
from graphnav.config import Settings, parse_settings
from graphnav.evaluation.evaluate import find_truth
from graphnav.report.plots import PALETTE

AROUND = 15.0  # s drawn before and after the span
GAP = 2.5  # s; wider gaps of the truth break a line
NAMES = {"ekf": "Kalman filter", "batch": "graph smoother"}


INERTIAL = {
    "vehicle": {"nhc": False, "odometer": False},
    "standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", help="with a truth of the antenna or of the IMU")
    parser.add_argument("--without", required=True, help="such as gnss:600-660")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--inertial", action="store_true", help="nothing of wheels and stops")
    options = parser.parse_args()
    source, span = parse_withheld(options.without)
    assert span is not None, "name a span"
    settings = parse_settings(INERTIAL) if options.inertial else Settings()
    outcome = run_request(Request(options.recording, tuple(NAMES), settings, ((source, span),)))
    recording = outcome.recording
    found = find_truth(recording)
    assert found is not None, "the recording has no truth to draw"
    truth, _ = found
    frame = next(iter(outcome.solutions.values())).frame
    window = (span[0] - AROUND, span[1] + AROUND)

    figure, (way, error) = plt.subplots(1, 2, figsize=(10, 4.2), dpi=110, width_ratios=(1, 1.25), layout="constrained")
    k = inside(truth.t - recording.start, window)
    true = frame.from_llh(truth.llh[k])
    true[np.append(np.diff(truth.t[k]) > GAP, False)] = np.nan  # no line over what is not known
    way.plot(true[:, 0], true[:, 1], color="0.75", lw=6, solid_capstyle="round", label="truth")
    largest = {}
    for name, words in NAMES.items():
        track = outcome.solutions[name].trajectory(rate=10.0)
        p = frame.from_llh(track.llh[inside(track.t - recording.start, window)])
        way.plot(p[:, 0], p[:, 1], color=PALETTE[name][0], lw=1.8, label=words)
        errors = outcome.metrics[name].errors
        assert errors is not None
        t = errors.t - recording.start
        k = inside(t, window)
        size = np.maximum(errors.horizontal[k], 1e-3)
        largest[name] = float(np.nanmax(size))
        size[np.append(np.diff(t[k]) > GAP, False)] = np.nan
        error.semilogy(t[k], size, color=PALETTE[name][0], lw=1.8, label=words)
    way.set_aspect("equal", adjustable="datalim")
    way.set(xlabel="east [m]", ylabel="north [m]")
    way.legend(frameon=False)
    error.axvspan(*span, color="0.92", zorder=0)
    error.text(np.mean(span), 1.02, "no GNSS", ha="center", color="0.4", transform=error.get_xaxis_transform())
    error.set(xlabel="time [s]", ylabel="horizontal error [m]", xlim=window)
    error.legend(frameon=False)
    for axes in (way, error):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.93")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    command = " ".join(["scripts/picture.py", *sys.argv[1:]])
    said = ", ".join(f"{words} {largest[name]:.3g} m" for name, words in NAMES.items())
    figure.savefig(options.out, metadata={"Description": f"{command}: {said}"})


def inside(t: np.ndarray, window: tuple[float, float]) -> np.ndarray:
    return (t >= window[0]) & (t <= window[1])


if __name__ == "__main__":
    main()
