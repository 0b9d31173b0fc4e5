"""One picture of what the detectors saw: force, rate, speed, the statistics with their thresholds, the spectrogram."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav.detectors import Detection, Detections
from graphnav.panels import colour, thin
from graphnav.recording import Recording
from graphnav.rotation import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = ("sway", "glrt")  # the statistics that get a panel
_BINS = 700
_DYNAMIC = 2.5  # decades of amplitude in the spectrogram


def picture(recording: Recording, found: Detections) -> Figure:
    """Stationary intervals tinted over the signals and statistics they come from; times from the recording's start."""
    from matplotlib.figure import Figure

    t0, imu = recording.start, recording.imu
    names = {d.name: d for d in found.all}
    statistics = [names[name] for name in _SHOWN if name in names]
    spectrum = names.get("fft")
    if spectrum is not None and "spectrogram" not in spectrum.details:
        spectrum = None
    rows = 3 + len(statistics) + (spectrum is not None)
    figure = Figure(figsize=(11.0, 1.7 * rows + 0.8), layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    t = imu.t - t0
    force = np.linalg.norm(imu.accel, axis=1)
    _line(axes[0], t, force, "truth", "|force|\n[m/s²]")
    _line(axes[1], t, np.degrees(np.linalg.norm(imu.gyro, axis=1)), "truth", "|rate|\n[deg/s]")
    _speed(axes[2], recording)
    for axis, detection in zip(axes[3:], statistics, strict=False):
        _statistic(axis, detection, t0)
    for axis in axes[: 3 + len(statistics)]:
        for a, b in found.stationary - t0:
            axis.axvspan(a, b, color=colour("withheld"), alpha=0.25, lw=0)
    if spectrum is not None:
        _spectrogram(axes[-1], spectrum, t0, found.stationary - t0)
    axes[-1].set_xlabel("time from the start [s]")
    axes[0].set_xlim(0.0, recording.duration)
    seconds = float(np.diff(found.stationary).sum())
    axes[0].set_title(
        f"{recording.name}: {len(found.stationary)} stops (tinted), {seconds:.1f} s", fontsize=10, loc="left"
    )
    return figure


def _line(axis: Any, t: Array, y: Array, name: str, label: str, words: str | None = None) -> None:
    keep = thin(t, y, _BINS)
    axis.plot(t[keep], y[keep], color=colour(name), lw=0.7, label=words)
    axis.set_ylabel(label, fontsize=8)
    axis.tick_params(labelsize=8)


def _speed(axis: Any, recording: Recording) -> None:
    t0, any_speed = recording.start, False
    gnss, odometer = recording.gnss, recording.odometer
    if gnss is not None and gnss.v is not None and len(gnss.t):
        _line(axis, gnss.t - t0, np.hypot(gnss.v[:, 0], gnss.v[:, 1]), "batch", "", "GNSS")
        any_speed = True
    if odometer is not None and len(odometer.t):
        _line(axis, odometer.t - t0, np.abs(odometer.speed), "ekf", "", "odometer")
        any_speed = True
    axis.set_ylabel("speed\n[m/s]", fontsize=8)
    if any_speed:
        axis.legend(fontsize=7, loc="upper right", ncols=2)
    else:
        axis.text(0.5, 0.5, "no speed is measured", transform=axis.transAxes, ha="center", va="center", fontsize=8)


def _statistic(axis: Any, d: Detection, t0: float) -> None:
    _line(axis, d.t - t0, np.maximum(d.statistic, 1e-6), "batch", f"{d.name}\nstatistic")
    axis.set_yscale("log")
    threshold = np.broadcast_to(d.threshold, d.t.shape)
    axis.plot(d.t[[0, -1]] - t0, threshold[[0, -1]], color=colour("alert"), lw=1.0, ls="--", label="threshold")
    axis.legend(fontsize=7, loc="upper right")


def _spectrogram(axis: Any, d: Detection, t0: float, spans: Array) -> None:
    rows, f = d.details["spectrogram_rows"], d.details["spectrogram_frequency"]
    level = np.log10(np.maximum(d.details["spectrogram"], 1e-9)).T
    top = float(np.quantile(level, 0.999))
    axis.pcolormesh(
        d.t[rows] - t0, f, level, cmap="viridis", vmin=top - _DYNAMIC, vmax=top, shading="nearest", rasterized=True
    )
    axis.set_ylabel("up force\n[Hz]", fontsize=8)
    axis.tick_params(labelsize=8)
    if "idle_line" in d.details:
        line = float(d.details["idle_line"][0])
        for k, words in ((1, f"idle line {line:.2f} Hz"), (2, "")):
            if k * line < f[-1]:
                axis.axhline(k * line, color="white", lw=0.8, ls=":")
                axis.text(0.0, k * line, words, color="white", fontsize=7, va="bottom")
    for a, b in spans:
        axis.plot([a, b], [0.0, 0.0], color=colour("withheld"), lw=5.0, solid_capstyle="butt", clip_on=False)
