"""Output of `graphnav allan`: the deviations as CSV, the lines for recording.toml, and a page with a figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording.allan import Allan, AllanFigures
from graphnav.report import page
from graphnav.report.plots import Figure

_COLOURS = ("batch", "ekf", "incremental")  # of x, y, z
_PICTURE_HEIGHT = 300  # pixels


def write_allan(result: Allan, folder: Path) -> list[Path]:
    """Write allan.html, allan.csv and noise.toml into `folder`, which is made if need be; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("allan.html", "allan.csv", "noise.toml")]
    table = np.column_stack([result.tau, result.gyro, result.accel])
    np.savetxt(paths[1], table, "%.9g", ",", header="tau,gx,gy,gz,ax,ay,az", comments="")
    title = f"Allan variance of {result.duration:.0f} s at rest, {result.rate:.4g} Hz; root mean square of the axes"
    lines = "\n".join(["[imu.noise]", *result.format_lines()])
    paths[2].write_text(f"# {title}\n{lines}\n", encoding="utf-8")
    lead = [page.paragraph(title), page.code(lines, "noise")]
    pictures = [
        page.place_picture(_draw_deviations(result.tau, result.gyro, result.gyro_noise, "rad/s"), "Gyro"),
        page.place_picture(_draw_deviations(result.tau, result.accel, result.accel_noise, "m/s2"), "Accelerometer"),
    ]
    html = page.make_page("Allan deviations", lead, [("Deviations", [page.gallery(pictures)])])
    paths[0].write_text(html, encoding="utf-8")
    return paths


def _draw_deviations(tau: Array, deviations: Array, noise: AllanFigures, unit: str) -> Figure:
    """Deviations (M, 3) over averaging times (M,) s, and the model fitted to them."""
    fit = _compute_model(tau, noise)
    low, high = np.log10([min(deviations.min(), fit.min()), max(deviations.max(), fit.max())])
    figure = Figure(
        [f"Allan deviation, {unit}"], tuple(np.log10(tau[[0, -1]])), [(low - 0.1, high + 0.1)], units=[unit], log=True,
        x_log=True, height=_PICTURE_HEIGHT, x="averaging time [s]",
    )  # fmt: skip
    (panel,) = figure.panels
    for k, name in enumerate(_COLOURS):
        panel.draw_line(tau, deviations[:, k], name, "xyz"[k])
    panel.draw_line(tau, fit, "truth", "fit", dash=True)
    return figure


def _compute_model(tau: Array, noise: AllanFigures) -> Array:
    """Deviation of the fitted model, of the root mean square over the axes."""
    N2, B2, K2 = (np.mean(np.square(x)) for x in (noise.white, noise.instability, noise.walk))
    return np.asarray(np.sqrt(N2 / tau + B2 * 2.0 / np.pi * np.log(2.0) + K2 * tau / 3.0))
