"""The plain zero-velocity filter on the trials with motion capture, beside batch, by every measure.

    GRAPHNAV_DATA=... python scripts/plain_filter.py

Nine states (place, velocity, attitude), zero velocity wherever the label that comes with the trial says so, no
biases: what the figures quoted for these trials are of. Horizontal rms in cm after yaw and offset are fitted to the
truth; "stances once": over the means of stances, so that the rests at both ends count no more than a step does.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import os
from pathlib import Path

import numpy as np

from graphnav import load
from graphnav.core import rotation
from graphnav.core.state import States
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.evaluation.strides import compare_shapes, fit_point
from graphnav.recording import Imu, Recording

FORCE, TURN, ZERO = 0.5, 0.03, 0.01  # m/s^2, rad/s of a row; m/s
GRAVITY = 9.804  # m/s^2, where the trials were made
MEASURES = ("all epochs", "in stance", "stances once", "point fitted", "up")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    folder = Path(os.environ["GRAPHNAV_DATA"]) / "pyshoe_vicon"
    print("| trial | " + " | ".join(f"{m}: plain, batch" for m in MEASURES) + " |")
    print("|" + " --- |" * (1 + len(MEASURES)))
    rows = []
    for path in sorted(folder.glob("*.toml")):
        recording = load(path)
        label = labels(folder / f"{recording.name}_truth.csv.gz")
        found = run(recording, None, ("batch",))["batch"]
        stances = spans(recording.imu.t, label)
        pair = [
            measures(recording, stances, *filtered(recording.imu, label)),
            measures(recording, stances, *estimated(found, recording.imu.t)),
        ]
        rows.append(pair)
        print(f"| {recording.name} | {cells(np.array(pair))} |", flush=True)
    print(f"| **median** | {cells(np.median(rows, axis=0))} |")
    print(f"| **mean** | {cells(np.mean(rows, axis=0))} |")


def cells(pair: np.ndarray) -> str:
    return " | ".join(f"{100.0 * a:.1f}, {100.0 * b:.1f}" for a, b in pair.T)


def labels(path: Path) -> np.ndarray:
    """(N,) bool, row by row of the IMU, where the label says that the foot stands."""
    with gzip.open(path, "rt", encoding="utf-8") as file:
        return np.array([float(row["zv_label"]) > 0.5 for row in csv.DictReader(file)])


def spans(t: np.ndarray, label: np.ndarray) -> np.ndarray:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], label, [False]]).astype(int))).reshape(-1, 2)
    return np.column_stack([t[edges[:, 0]], t[edges[:, 1] - 1]])


def filtered(imu: Imu, label: np.ndarray) -> tuple[np.ndarray, States]:
    """Times and states of the plain filter, levelled in the first second."""
    dt = float(np.median(np.diff(imu.t)))
    f = imu.accel[imu.t <= imu.t[0] + 1.0].mean(axis=0)
    R = rotation.from_rph(np.array([np.arctan2(-f[0], f[2]), np.arctan2(f[1], np.hypot(f[0], f[2])), 0.0]))
    p, v, P = np.zeros(3), np.zeros(3), np.diag([1e-10] * 3 + [1e-6] * 3 + [np.deg2rad(0.1) ** 2] * 2 + [1e-10])
    H = np.eye(9)[3:6]
    Q = np.diag([0.0] * 3 + [(FORCE * dt) ** 2] * 3 + [(TURN * dt) ** 2] * 3)
    out = States(*(np.zeros((len(imu.t), *shape)) for shape in ((3, 3), (3,), (3,), (3,), (3,))))
    for k, (rate, force) in enumerate(zip(imu.gyro, imu.accel, strict=True)):
        a = R @ rotation.exp(0.5 * rate * dt) @ force
        R = R @ rotation.exp(rate * dt)
        a_n = a - [0.0, 0.0, GRAVITY]
        p, v = p + v * dt + 0.5 * a_n * dt**2, v + a_n * dt
        F = np.eye(9)
        F[:3, 3:6], F[3:6, 6:] = dt * np.eye(3), -dt * rotation.skew(a)
        P = F @ P @ F.T + Q
        if label[k]:
            K = np.linalg.solve(H @ P @ H.T + ZERO**2 * np.eye(3), H @ P).T
            dx = -K @ v
            p, v, R = p + dx[:3], v + dx[3:6], rotation.exp(dx[6:]) @ R
            P = (np.eye(9) - K @ H) @ P
            P = 0.5 * (P + P.T)
        out.R_nb[k], out.p[k] = R, p
    return imu.t, out


def estimated(solution: Solution, t: np.ndarray) -> tuple[np.ndarray, States]:
    t, states, _ = solution.at(t[(t >= solution.t[0]) & (t <= solution.t[-1])])
    return t, states


def measures(recording: Recording, stances: np.ndarray, t: np.ndarray, states: States) -> tuple[float, ...]:
    truth = recording.truth
    assert truth is not None
    assert truth.xyz is not None
    t, states = t[::5], states[::5]
    X = np.column_stack([np.interp(t, truth.t, x) for x in truth.xyz.T])
    height = states.p[:, 2] - X[:, 2]
    height -= height[t <= t[0] + 1.0].mean()
    of_point, _ = fit_point(states, X * [1.0, 1.0, 0.0])
    return *compare_shapes(t, states.p, X, stances), of_point, float(np.sqrt(np.mean(height**2)))


if __name__ == "__main__":
    main()
