"""Signals of the detectors: force, rate, speed, the statistics with their thresholds, the spectrogram."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphnav.core.interpolation import pick_nearest
from graphnav.core.rotation import Array
from graphnav.detectors.base import Detection
from graphnav.recording import Imu, Recording
from graphnav.report.plots.figure import Figure, Panel, find_axis_limits
from graphnav.report.plots.thinning import BINS, thin

_DECADES = 2.5  # decades of amplitude in the spectrogram
_LOWEST = 1e-6  # lower limit of a statistic on its logarithmic axis
_FUSED = "fused"
_SHOWN_STATISTICS = (
    "low_band_glrt",
    "glrt",
    "fft",
)  # of more than `_MAX_STATISTICS`; the others are in statistics.csv.gz
_MAX_STATISTICS = 4


def plot_detections(recording: Recording, found: Sequence[Detection]) -> Figure:
    """Stationary intervals tinted over the signals and statistics they come from; times from the recording's start.

    Parameters
    ----------
    found : of all detectors; those of one name are of pieces of the recording. The fused answer is called "fused".
    """
    t0, imu = recording.start, recording.imu
    stands = [(float(a) - t0, float(b) - t0) for d in found if d.name == _FUSED for a, b in d.intervals]
    by_name: dict[str, list[Detection]] = {}
    for d in found:
        if d.name != _FUSED and np.isfinite(d.statistic).any():
            by_name.setdefault(d.name, []).append(d)
    if len(by_name) > _MAX_STATISTICS:
        by_name = {name: every for name, every in by_name.items() if name in _SHOWN_STATISTICS}
    shown = select_drawn_rows(imu)
    t = imu.t[shown] - t0
    force, rate = _compute_norms(imu.accel[shown]), np.degrees(_compute_norms(imu.gyro[shown]))
    speeds = _collect_speeds(recording)
    rows: list[tuple[str, str, tuple[float, float], bool]] = [
        ("magnitude of the specific force [m/s²]", "m/s²", find_axis_limits([force]), False),
        ("magnitude of the angular rate [deg/s]", "deg/s", find_axis_limits([rate]), False),
    ]
    if speeds:
        rows.append(("speed [m/s]", "m/s", find_axis_limits([y for _, _, y, _ in speeds]), False))
    rows += [(f"{name}: statistic", "", _find_axis_limits(every), True) for name, every in by_name.items()]
    pictured = [d for d in found if "spectrogram" in d.details and len(d.details["spectrogram_t"]) > 1]
    if pictured:
        f = pictured[0].details["spectrogram_frequency"]
        rows.append(("spectrogram of the force along z [Hz]", "Hz", (float(f[0]), float(f[-1])), False))
    figure = Figure(
        [title for title, _, _, _ in rows], (0.0, recording.duration), [ylim for _, _, ylim, _ in rows],
        units=[unit for _, unit, _, _ in rows], log=[log for _, _, _, log in rows], height=76,
    )  # fmt: skip
    stood = {"stationary": stands}
    for panel in figure.panels[: len(rows) - bool(pictured)]:
        panel.shade(stood)
    panels = iter(figure.panels)
    for y in (force, rate):
        panel = next(panels)
        panel.draw_line(t, y, "truth", width=1.0)
    if speeds:
        panel = next(panels)
        for words, at, y, name in speeds:
            panel.draw_line(at, y, name, words)
    for every in by_name.values():
        panel = next(panels)
        for d in every:
            _plot_statistic(panel, d, t0)
    if pictured:
        _plot_spectrogram(next(panels), pictured, t0)
    return figure


def select_drawn_rows(imu: Imu) -> NDArray[np.intp]:
    """The rows of an IMU that the figure shows, independent of other rows."""
    return np.union1d(*(thin(imu.t, _compute_norms(x)) for x in (imu.accel, imu.gyro)))


def _compute_norms(x: Array) -> Array:
    """(N,) lengths of vectors (N, 3), computed without their squares in memory: for a day these take 400 MB."""
    squared = np.einsum("ij,ij->i", x, x)
    return np.sqrt(squared, out=squared)


def _collect_speeds(recording: Recording) -> list[tuple[str, Array, Array, str]]:
    """(name, s from the start, m/s, colour) of every sensor that measures a speed."""
    out = []
    gnss, odometer = recording.gnss, recording.odometer
    if gnss is not None and gnss.v is not None and np.isfinite(gnss.v).any():
        out.append(("GNSS speed", gnss.t - recording.start, np.hypot(gnss.v[:, 0], gnss.v[:, 1]), "batch"))
    if odometer is not None and len(odometer.t):
        out.append(("odometer", odometer.t - recording.start, np.abs(odometer.speed), "ekf"))
    return out


def _find_axis_limits(every: Sequence[Detection]) -> tuple[float, float]:
    values = [np.log10(np.maximum(v, _LOWEST)) for d in every for v in (d.statistic, np.atleast_1d(d.threshold))]
    return find_axis_limits(values, floor=0.5, always=values[1::2])


def _plot_statistic(panel: Panel, d: Detection, t0: float) -> None:
    panel.draw_line(d.t - t0, np.maximum(d.statistic, _LOWEST), "batch", "statistic", width=1.1)
    threshold = np.broadcast_to(d.threshold, d.t.shape)
    panel.draw_line(d.t - t0, threshold, "alert", "threshold: stationary below", dash=True)


def _plot_spectrogram(panel: Panel, pictured: Sequence[Detection], t0: float) -> None:
    for d in pictured:
        t, f = d.details["spectrogram_t"] - t0, d.details["spectrogram_frequency"]
        level = np.log10(np.maximum(d.details["spectrogram"], 1e-9)).T
        top = float(np.nanquantile(level, 0.999))
        even = np.linspace(t[0], t[-1], min(len(t), BINS))
        nearest = pick_nearest(t, even)
        panel.draw_map(even, f, np.clip(np.nan_to_num(level[:, nearest], nan=top - _DECADES), top - _DECADES, top))
        if "idle_line" in d.details:
            line = float(d.details["idle_line"][0])
            for k, words in ((1, f"idle line {line:.1f} Hz"), (2, "")):
                if k * line < f[-1]:
                    panel.draw_line(t[[0, -1]], np.full(2, k * line), "paper", width=1.1, dash=True, quiet=True)
                    if words:
                        shift = (3, -16 if k * line > 0.8 * f[-1] else 1)
                        panel.write_words(float(t[0]), k * line, words, shift=shift, name="paper")
