"""What `graphnav allan` writes: the deviations as CSV, the lines for recording.toml, and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording.allan import Allan, AllanFigures

_COLOURS = ("#0072b2", "#d55e00", "#009e73")  # x, y, z; Okabe and Ito (2008)


def write(result: Allan, folder: Path) -> list[Path]:
    """Write allan.csv, noise.toml and allan.png into `folder`, which is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("allan.png", "allan.csv", "noise.toml")]
    table = np.column_stack([result.tau, result.gyro, result.accel])
    np.savetxt(paths[1], table, "%.9g", ",", header="tau,gx,gy,gz,ax,ay,az", comments="")
    head = f"# Allan variance of {result.duration:.0f} s at rest, {result.rate:.4g} Hz; root mean square of the axes"
    paths[2].write_text("\n".join([head, "[imu.noise]", *result.lines()]) + "\n", encoding="utf-8")
    _picture(result, paths[0])
    return paths


def _picture(result: Allan, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    for k, (deviation, noise, title, unit) in enumerate(
        (
            (result.gyro, result.gyro_noise, "gyro", "rad/s"),
            (result.accel, result.accel_noise, "accelerometer", "m/s$^2$"),
        )
    ):
        axes = figure.add_subplot(1, 2, k + 1)
        for axis, colour in enumerate(_COLOURS):
            axes.loglog(result.tau, deviation[:, axis], color=colour, label="xyz"[axis])
        axes.loglog(result.tau, _model(result.tau, noise), "--", color="#4a4a4b", label="fit")
        axes.set(title=title, xlabel="averaging time, s", ylabel=f"Allan deviation, {unit}")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def _model(tau: Array, noise: AllanFigures) -> Array:
    """The fitted deviation, of the root mean square over the axes."""
    N2, B2, K2 = (np.mean(np.square(x)) for x in (noise.white, noise.instability, noise.walk))
    return np.asarray(np.sqrt(N2 / tau + B2 * 2.0 / np.pi * np.log(2.0) + K2 * tau / 3.0))
