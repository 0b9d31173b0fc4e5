"""The pictures that `graphnav.report` puts together, each from plain data to a captioned SVG."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from graphnav import page, plots
from graphnav.interpolation import fit_yaw, yaw_matrix
from graphnav.page import Raw
from graphnav.panels import svg
from graphnav.plots import Series
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import Solution
from graphnav.trajectory import Trajectory

if TYPE_CHECKING:
    from graphnav.metrics import Errors

ENU = ("east", "north", "up")
RPH = ("roll", "pitch", "heading")
XYZ = ("x right", "y forward", "z up")
DEG_H = float(np.degrees(3600.0))


def error_series(errors: Errors, start: float) -> dict[str, Series]:
    """Errors as things to draw: position (m), velocity (m/s), attitude (deg), where there are any."""
    t = errors.t - start
    deg = float(np.degrees(1.0))
    out = {}
    for kind, value, sigma, scale in (
        ("position", errors.p, errors.sd_p, 1.0),
        ("velocity", errors.v, errors.sd_v, 1.0),
        ("attitude", errors.rph, errors.sd_rph, deg),
    ):
        if np.isfinite(value).any():
            out[kind] = Series(t, scale * value, scale * sigma if np.isfinite(sigma).any() else None)
    return out


def trajectory_picture(
    recording: Recording, solutions: Mapping[str, Solution], spans: list[tuple[float, float]]
) -> Raw:
    """The way from above."""
    start = recording.start
    frame = next(iter(solutions.values())).frame
    fixes = truth = None
    if recording.gnss is not None:
        fixes = frame.from_llh(recording.gnss.llh)[:, :2]
    if recording.truth is not None and recording.truth.llh is not None:
        truth = frame.from_llh(recording.truth.llh)[:, :2]
    elif recording.truth is not None and recording.truth.xyz is not None:
        truth = _laid_on(recording.truth.t, recording.truth.xyz, list(solutions.values())[-1])
    tracks = {name: (s.t - start, s.states.p[:, :2]) for name, s in solutions.items()}
    figure = plots.trajectory(tracks, fixes=fixes, truth=truth, spans=spans)
    lat, lon = np.degrees(frame.origin[:2])
    where = f"origin at latitude {lat:.6f}, longitude {lon:.6f} deg."
    if recording.gnss is None:
        where = "place and heading count from the start, because nothing says where on the Earth that is."
    return page.picture(svg(figure, "trajectory from above", "way"), f"From above; {where}")


def _laid_on(t: Array, xyz: Array, solution: Solution) -> Array:
    """A truth (M, 2 or 3) in a frame of its own, turned and moved onto a solution, (N, 2)."""
    shared = (t >= solution.t[0]) & (t <= solution.t[-1]) & np.isfinite(xyz).all(axis=1)
    p = solution.at(t[shared])[1].p
    flat = np.column_stack([xyz[shared, :2], np.zeros(len(p))])
    yaw, offset = fit_yaw(flat, p)
    return np.asarray((flat @ yaw_matrix(yaw).T + offset)[:, :2])


def error_pictures(errors: Mapping[str, Errors], start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Position, velocity and attitude errors with 3 sigma."""
    series = {name: error_series(e, start) for name, e in errors.items()}
    out = []
    for kind, parts, unit in (("position", ENU, "m"), ("velocity", ENU, "m/s"), ("attitude", RPH, "deg")):
        chosen = {name: s[kind] for name, s in series.items() if kind in s}
        if chosen:
            figure = plots.bands(chosen, parts, unit, spans=spans)
            out.append(
                page.picture(
                    svg(figure, f"{kind} errors", f"e-{kind}"),
                    f"{kind.capitalize()}: error{' and 3 sigma' if len(chosen) < 3 else ''}.",
                )
            )
    return out


def sigma_pictures(tracks: Mapping[str, Trajectory], start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """What the solvers themselves say of their uncertainty."""
    out = []
    wanted = (("position", "sd_p", ENU, "m", 1.0), ("attitude", "sd_rph", RPH, "deg", float(np.degrees(1.0))))
    for kind, key, parts, unit, scale in wanted:
        series = {
            name: Series(track.t - start, getattr(track, key) * scale)
            for name, track in tracks.items()
            if getattr(track, key) is not None
        }
        if series:
            figure = plots.sigmas(series, parts, unit, spans=spans)
            out.append(
                page.picture(svg(figure, f"{kind} sigma", f"sd-{kind}"), f"{kind.capitalize()}: 1 sigma as stated.")
            )
    return out


def bias_pictures(solution: Solution, start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Gyro and accelerometer biases with 3 sigma."""
    sd = np.sqrt(np.maximum(np.diagonal(solution.covariance, axis1=1, axis2=2), 0.0))
    t = solution.t - start
    out = []
    for words, value, sigma, unit, scale in (
        ("Gyro bias", solution.states.bg, sd[:, 12:15], "deg/h", DEG_H),
        ("Accelerometer bias", solution.states.ba, sd[:, 9:12], "mm/s²", 1000.0),
    ):
        series = {solution.solver: Series(t, value * scale, sigma * scale)}
        figure = plots.bands(series, XYZ, unit, spans=spans, about_zero=False)
        out.append(page.picture(svg(figure, words, words.split()[0].lower()), f"{words} and 3 sigma."))
    return out


def zoom_pictures(errors: Mapping[str, Errors], start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Horizontal error in and around each withheld span."""
    if not spans or not errors:
        return []
    series = {}
    for name, e in errors.items():
        s = error_series(e, start)["position"]
        series[name] = Series(s.t, np.hypot(s.value[:, 0], s.value[:, 1])[:, None])
    figure = plots.span_zoom(series, spans)
    return [
        page.picture(
            svg(figure, "horizontal error in withheld spans", "zoom"),
            "Horizontal error in and around each withheld span.",
        )
    ]


def record_pictures(solution: Solution, start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Whitened residuals and NIS of every constraint."""
    out = []
    for kind, record in solution.records.items():
        if not len(record.t):
            continue
        figure = plots.residuals(kind, record, start, solution.solver, spans=spans)
        words = f"{kind}: {record.kind}s over their sigma"
        dof = record.residual.shape[1]
        caption = (
            f"{words}, dashed at 3. NIS with the middle 99 % of the chi-square distribution with {dof} "
            f"degree{'s' if dof > 1 else ''} of freedom, and its histogram beside that density."
        )
        out.append(page.picture(svg(figure, words, f"r-{kind}"), caption))
    return out
