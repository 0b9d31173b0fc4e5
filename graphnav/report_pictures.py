"""The pictures that `graphnav.report` puts together, each from plain data to a captioned figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from graphnav import page, plots
from graphnav.against import own
from graphnav.detectors.base import Detection
from graphnav.interpolation import fit_yaw, yaw_matrix
from graphnav.page import Raw
from graphnav.panels.drawing import Spans
from graphnav.plots import Series
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import Solution
from graphnav.trajectory import Trajectory

if TYPE_CHECKING:
    from graphnav.metrics import Errors

Shades = Mapping[str, Spans]

ENU = ("east", "north", "up")
RPH = ("roll", "pitch", "heading")
XYZ = ("x right", "y forward", "z up")
DEG = float(np.degrees(1.0))
DEG_H = float(np.degrees(3600.0))


def trajectory_picture(recording: Recording, solutions: Mapping[str, Solution], spans: Shades) -> Raw:
    """The way from above, with what was and what was not used of the fixes."""
    start = recording.start
    first = next(iter(solutions.values()))
    frame = first.frame
    truth = None
    if recording.truth is not None and recording.truth.llh is not None:
        truth = frame.from_llh(recording.truth.llh)[:, :2]
    elif recording.truth is not None and recording.truth.xyz is not None:
        truth = _laid_on(recording.truth.t, recording.truth.xyz, list(own(solutions).values())[-1])
    drawing = plots.trajectory(
        {name: (s.t - start, s.states.p[:, :2]) for name, s in solutions.items()},
        fixes=_fixes(recording, first),
        truth=truth,
        spans=spans,
        stops=[(a - start, b - start) for a, b in first.stationary],
        standing="step" if recording.platform == "foot" else "stop",
    )
    lat, lon = np.degrees(frame.origin[:2])
    where = f"North is up; the origin is latitude {lat:.6f}, longitude {lon:.6f} deg."
    if recording.gnss is None:
        where = "Nothing says where on the Earth this is: place and heading count from the start."
    return page.picture(drawing, "Seen from above", where, kind="map")


def _fixes(recording: Recording, solution: Solution) -> plots.Fixes | None:
    """The fixes in metres, and which of them the solver did not use though nobody withheld them."""
    if recording.gnss is None:
        return None
    t = recording.gnss.t
    out = np.zeros(len(t), dtype=bool)
    record = solution.records.get("gnss_position")
    if record is not None and len(record.t):
        gone = record.t[record.weight <= 1e-9]
        out |= np.isin(np.round(t, 3), np.round(gone, 3))
    for part in getattr(solution, "excluded", ()):
        if part.kind in ("gnss", "gnss_position"):
            out |= (t >= part.t_start) & (t <= part.t_end)
    return plots.Fixes(t - recording.start, solution.frame.from_llh(recording.gnss.llh)[:, :2], out)


def _laid_on(t: Array, xyz: Array, solution: Solution) -> Array:
    """A truth (M, 2 or 3) in a frame of its own, turned and moved onto a solution, (N, 2)."""
    shared = (t >= solution.t[0]) & (t <= solution.t[-1]) & np.isfinite(xyz).all(axis=1)
    p = solution.at(t[shared])[1].p
    flat = np.column_stack([xyz[shared, :2], np.zeros(len(p))])
    yaw, offset = fit_yaw(flat, p)
    return np.asarray((flat @ yaw_matrix(yaw).T + offset)[:, :2])


def error_series(errors: Errors, start: float) -> dict[str, Series]:
    """Errors as things to draw: position (m), velocity (m/s), attitude (deg), where there are any."""
    t = errors.t - start
    out = {}
    for kind, value, sigma, scale in (
        ("position", errors.p, errors.sd_p, 1.0),
        ("velocity", errors.v, errors.sd_v, 1.0),
        ("attitude", errors.rph, errors.sd_rph, DEG),
    ):
        if np.isfinite(value).any():
            out[kind] = Series(t, scale * value, scale * sigma if np.isfinite(sigma).any() else None)
    return out


def error_pictures(errors: Mapping[str, Errors], start: float, spans: Shades) -> list[Raw]:
    """Position, velocity and attitude errors with 3 sigma."""
    series = {name: error_series(e, start) for name, e in errors.items()}
    out = []
    for kind, parts, unit in (("position", ENU, "m"), ("velocity", ENU, "m/s"), ("attitude", RPH, "deg")):
        chosen = {name: s[kind] for name, s in series.items() if kind in s}
        if chosen:
            banded = len(chosen) < 3 and any(s.sigma is not None for s in chosen.values())
            note = "The line belongs inside the band." if banded else ""
            drawing = plots.bands(chosen, parts, unit, spans=spans)
            out.append(page.picture(drawing, f"{kind.capitalize()} error", note))
    return out


def nees_pictures(errors: Mapping[str, Errors], start: float, spans: Shades) -> list[Raw]:
    """Squared errors over their covariance."""
    series, names, dofs = {}, ["position", "velocity", "attitude"], [3, 3, 3]
    for name, e in errors.items():
        series[name] = Series(e.t - start, np.column_stack([e.nees_p, e.nees_v, e.nees_rph]))
        dofs[0] = e.dof_p
    known = [k for k in range(3) if any(np.isfinite(s.value[:, k]).any() for s in series.values())]
    if not known:
        return []
    cut = {name: Series(s.t, s.value[:, known]) for name, s in series.items()}
    drawing = plots.nees(cut, [names[k] for k in known], [dofs[k] for k in known], spans=spans)
    note = (
        "Squared error over its covariance, divided by its degrees of freedom: about 1 where sigma is true, above the "
        "band where it is too small."
    )
    return [page.picture(drawing, "NEES over time", note)]


def sigma_pictures(tracks: Mapping[str, Trajectory], start: float, spans: Shades) -> list[Raw]:
    """What the solvers themselves say of their uncertainty."""
    out = []
    wanted = (
        ("Position", "sd_p", ENU, "m", 1.0),
        ("Velocity", "sd_v", ENU, "m/s", 1.0),
        ("Attitude", "sd_rph", RPH, "deg", DEG),
    )  # fmt: skip
    for kind, key, parts, unit, scale in wanted:
        series = {
            name: Series(track.t - start, getattr(track, key) * scale)
            for name, track in tracks.items()
            if getattr(track, key) is not None
        }
        if series:
            drawing = plots.sigmas(series, parts, unit, spans=spans)
            out.append(page.picture(drawing, f"{kind}, 1 sigma as stated"))
    return out


def motion_pictures(track: Trajectory, name: str, start: float, spans: Shades) -> list[Raw]:
    """Velocity and attitude as estimated, with 3 sigma."""
    out, t = [], track.t - start
    if track.v is not None:
        drawing = plots.bands({name: Series(t, track.v, track.sd_v)}, ENU, "m/s", spans=spans, about_zero=False)
        out.append(page.picture(drawing, "Velocity and 3 sigma"))
    if track.rph is not None:
        rph = np.degrees(track.rph)
        rph[:, 2] %= 360.0
        rph[np.flatnonzero(np.abs(np.diff(rph[:, 2])) > 180.0) + 1, 2] = np.nan  # no line from 360 back to 0
        sigma = None if track.sd_rph is None else DEG * track.sd_rph
        drawing = plots.bands({name: Series(t, rph, sigma)}, RPH, "deg", spans=spans, about_zero=False)
        out.append(page.picture(drawing, "Attitude and 3 sigma"))
    return out


def bias_pictures(solution: Solution, start: float, spans: Shades) -> list[Raw]:
    """Gyro and accelerometer biases with 3 sigma."""
    sd = np.sqrt(np.maximum(np.diagonal(solution.covariance, axis1=1, axis2=2), 0.0))
    t = solution.t - start
    out = []
    for words, value, sigma, unit, scale in (
        ("Gyro bias", solution.states.bg, sd[:, 12:15], "deg/h", DEG_H),
        ("Accelerometer bias", solution.states.ba, sd[:, 9:12], "mm/s²", 1000.0),
    ):
        series = {solution.solver: Series(t, value * scale, sigma * scale)}
        drawing = plots.bands(series, XYZ, unit, spans=spans, about_zero=False)
        out.append(page.picture(drawing, f"{words} and 3 sigma"))
    return out


def parameter_pictures(solution: Solution, start: float, spans: Shades) -> list[Raw]:
    """Slow parameters over time with 3 sigma, where the data told anything of them."""
    out = []
    for name, p in solution.parameters.items():
        if len(p.t) > 2 and np.any(p.sigma < 0.5 * p.prior_sigma):
            size = p.value.shape[1]
            parts = [name] if size == 1 else [f"{name} [{k}]" for k in range(size)]
            scale, unit = (DEG, "deg") if p.unit == "rad" else (1.0, p.unit or "1")
            series = {solution.solver: Series(p.t - start, scale * p.value, scale * p.sigma)}
            drawing = plots.bands(series, parts, unit, spans=spans, about_zero=False)
            out.append(page.picture(drawing, f"{name} and 3 sigma"))
    return out


def zoom_pictures(errors: Mapping[str, Errors], start: float, spans: Spans, what: str = "withheld") -> list[Raw]:
    """Horizontal error in and around each span."""
    if not spans or not errors:
        return []
    series = {}
    for name, e in errors.items():
        s = error_series(e, start)["position"]
        series[name] = Series(s.t, np.hypot(s.value[:, 0], s.value[:, 1])[:, None])
    drawing = plots.span_zoom(series, spans, what=what)
    return [page.picture(drawing, "Horizontal error in and around each span", kind="large" if len(spans) > 1 else "")]


def difference_pictures(solutions: Mapping[str, Solution], start: float, spans: Shades) -> list[Raw]:
    """How far the solvers are from the last of them, at the keyframes they share."""
    name, reference = list(own(solutions).items())[-1]
    series = {}
    for key, s in solutions.items():
        if key == name:
            continue
        _, mine, its = np.intersect1d(s.t, reference.t, return_indices=True)
        if len(mine) > 1:
            series[key] = Series(s.t[mine] - start, s.states.p[mine] - reference.states.p[its])
    if not series:
        return []
    drawing = plots.bands(series, ENU, "m", spans=spans)
    return [page.picture(drawing, f"Position less that of {name}")]


def record_pictures(solution: Solution, start: float, spans: Shades) -> list[Raw]:
    """Whitened residuals and NIS of every constraint."""
    out = []
    for kind, record in solution.records.items():
        if not len(record.t):
            continue
        drawing = plots.residuals(record, start, solution.solver, spans=spans)
        dof = record.residual.shape[1]
        note = f"The lines are at 3 sigma; NIS is chi-square with {dof} degree{'s' if dof > 1 else ''} of freedom"
        note += "." if record.kind == "innovation" else " at most, as a fit takes up part of the noise."
        out.append(page.picture(drawing, f"{kind}: {record.kind}s over their sigma", note))
    return out


def timeline_picture(solution: Solution, recording: Recording, spans: Shades) -> list[Raw]:
    """Which constraint was used when."""
    records = {kind: record for kind, record in solution.records.items() if len(record.t)}
    if not records:
        return []
    drawing = plots.timeline(records, recording.start, recording.end, solution.solver, spans=spans)
    return [page.picture(drawing, "What was used when", kind="large")]


def detection_pictures(recording: Recording, found: Sequence[Detection]) -> list[Raw]:
    """What the detectors saw."""
    if not found:
        return []
    drawing = plots.detections(recording, found)
    note = "Tinted: the intervals in which it stands, all detectors together."
    if any("spectrogram" in d.details for d in found):
        note += " In the spectrogram, a strip along the lower edge."
    return [page.picture(drawing, "What the detectors saw", note, kind="large")]
