"""The figures of `graphnav.report.documents`, each from plain data to a figure with a caption."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.detectors.base import Detection
from graphnav.estimation.names import name_components, name_rows
from graphnav.estimation.solution import ParameterEstimate, Solution
from graphnav.evaluation.against import select_own
from graphnav.recording import Recording
from graphnav.report import page, plots
from graphnav.report.beside import has_place, locate_truth, select_fixes
from graphnav.report.plots import Curve, Shades, Tinted
from graphnav.report.plots.paths import draw_fixes

if TYPE_CHECKING:
    from graphnav.evaluation.metrics import Errors

ENU = ("east", "north", "up")
RPH = ("roll", "pitch", "heading")
XYZ = ("x right", "y forward", "z up")
TO_DEG = float(np.degrees(1.0))
TO_DEG_H = float(np.degrees(3600.0))


def draw_trajectory(recording: Recording, solutions: Mapping[str, Solution], spans: Shades) -> Markup:
    """The track from above, with the fixes that were and were not used."""
    start = recording.start
    first = next(iter(solutions.values()))
    truth = locate_truth(recording, solutions)
    figure = plots.plot_trajectory(
        {name: (s.t - start, s.states.p[:, :2]) for name, s in solutions.items()},
        fixes=select_fixes(recording, first),
        truth=None if truth is None else truth[1][:, :2],
        spans=spans,
        stops=[(a - start, b - start) for a, b in first.stationary],
        standing="step" if recording.platform == "foot" else "stop",
    )
    lat, lon = np.degrees(first.frame.origin[:2])
    where = f"North is up; the origin is latitude {lat:.6f}, longitude {lon:.6f} deg."
    if not has_place(first):
        where = "The place on the Earth is unknown: position and heading count from the start."
    return page.place_picture(figure, "Plan view", where, kind="large")


def draw_profile(recording: Recording, solutions: Mapping[str, Solution]) -> Markup:
    """Heights over the distance travelled."""
    start, first = recording.start, next(iter(solutions.values()))
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(first.states.p[:, :2], axis=0), axis=1))])

    def interpolate_over_distance(t: Array, h: Array) -> tuple[Array, Array]:
        return np.interp(t, first.t, distance), h

    lines, points = {}, {}
    truth, fixes = locate_truth(recording, solutions), select_fixes(recording, first)
    base = float(first.frame.origin[2]) if has_place(first) else 0.0
    if truth is not None and truth[1].shape[1] > 2:
        lines["truth"] = interpolate_over_distance(truth[0], base + truth[1][:, 2])
    lines |= {name: interpolate_over_distance(s.t, base + s.states.p[:, 2]) for name, s in solutions.items()}
    if fixes is not None:
        for kind, of_it in fixes.kinds.items():
            rows = of_it & ~fixes.excluded
            points[kind] = interpolate_over_distance(fixes.t[rows] + start, base + fixes.enu[rows, 2])
    antenna = "truth and fixes" if "truth" in lines and recording.truth and recording.truth.of == "gnss" else "fixes"
    note = f"Heights above the ellipsoid; {antenna} are of the antenna."
    if not has_place(first):
        note = "Heights count from the start."
    return page.place_picture(plots.plot_profile(lines, points), "Height profile", note, kind="large")


def collect_error_series(errors: Errors, start: float) -> dict[str, Curve]:
    """Error series to draw: position (m), velocity (m/s), attitude (deg), as far as present."""
    t = errors.t - start
    out = {}
    for kind, value, sigma, scale in (
        ("position", errors.p, errors.sd_p, 1.0),
        ("velocity", errors.v, errors.sd_v, 1.0),
        ("attitude", errors.rph, errors.sd_rph, TO_DEG),
    ):
        if np.isfinite(value).any():
            out[kind] = Curve(t, scale * value, scale * sigma if np.isfinite(sigma).any() else None)
    return out


def draw_errors(errors: Mapping[str, Errors], start: float, end: float, spans: Shades) -> list[Markup]:
    """Position, velocity and attitude errors with 3 sigma."""
    series = {name: collect_error_series(e, start) for name, e in errors.items()}
    out = []
    for kind, parts, unit in (("position", ENU, "m"), ("velocity", ENU, "m/s"), ("attitude", RPH, "deg")):
        chosen = {name: s[kind] for name, s in series.items() if kind in s}
        if chosen:
            banded = len(chosen) < 3 and any(s.sigma is not None for s in chosen.values())
            note = "The line should lie within the band." if banded else ""
            known = _find_known(chosen)
            cut = {name: s.take(known) for name, s in chosen.items()}
            figure = plots.plot_bands(cut, [parts[k] for k in known], unit, end, spans=spans)
            out.append(page.place_picture(figure, f"{kind.capitalize()} error", note))
    return out


def _find_known(series: Mapping[str, Curve]) -> list[int]:
    """The components that any of the series has values of: a truth may have no heights."""
    return [k for k in range(3) if any(np.isfinite(s.value[:, k]).any() for s in series.values())]


def draw_nees(errors: Mapping[str, Errors], start: float, end: float, spans: Shades) -> list[Markup]:
    """Squared errors over their covariance."""
    series, names, dofs = {}, ["position", "velocity", "attitude"], [3, 3, 3]
    for name, e in errors.items():
        values = np.column_stack([e.nees_p, e.nees_v, e.nees_rph])
        if np.isfinite(values).any():  # another program's file may have no sigmas
            series[name] = Curve(e.t - start, values)
            dofs[0] = e.dof_p
    known = _find_known(series)
    if not known:
        return []
    cut = {name: s.take(known) for name, s in series.items()}
    figure = plots.plot_nees(cut, [names[k] for k in known], [dofs[k] for k in known], end, spans=spans)
    note = (
        "Squared error over its covariance, divided by its degrees of freedom: about 1 where sigma is true, above the "
        "band where it is too small."
    )
    return [page.place_picture(figure, "NEES over time", note)]


def draw_sigmas(tracks: Mapping[str, Trajectory], start: float, end: float, spans: Shades) -> list[Markup]:
    """The sigmas stated by the solvers."""
    out = []
    wanted = (
        ("Position", "sd_p", ENU, "m", 1.0),
        ("Velocity", "sd_v", ENU, "m/s", 1.0),
        ("Attitude", "sd_rph", RPH, "deg", TO_DEG),
    )  # fmt: skip
    for kind, key, parts, unit, scale in wanted:
        series = {
            name: Curve(track.t - start, getattr(track, key) * scale)
            for name, track in tracks.items()
            if getattr(track, key) is not None
        }
        if series:
            figure = plots.plot_sigmas(series, parts, unit, end, spans=spans)
            out.append(page.place_picture(figure, f"{kind}, 1 sigma as stated"))
    return out


def draw_motion(recording: Recording, solutions: Mapping[str, Solution], spans: Shades) -> list[Markup]:
    """Estimated position, velocity and attitude with 3 sigma, and the fixes' and the receiver's measurements of
    them.
    """
    start, end = recording.start, recording.duration
    first = next(iter(solutions.values()))
    tracks = {name: s.trajectory(joint=False) for name, s in solutions.items()}
    fixes, gnss = select_fixes(recording, first), recording.gnss
    base = np.array([0.0, 0.0, float(first.frame.origin[2]) if has_place(first) else 0.0])

    def draw_measured(panel: plots.Panel, k: int) -> None:
        if fixes is not None:
            draw_fixes(panel, replace(fixes, enu=fixes.enu + base), k)

    def draw_doppler(panel: plots.Panel, k: int) -> None:
        if gnss is not None and gnss.v is not None and np.isfinite(gnss.v[:, k]).any():
            panel.draw_dots(gnss.t - start, gnss.v[:, k], "ink", "GNSS velocity", 2.5, alpha=0.5)

    place = {name: Curve(s.t - start, s.states.p + base, tracks[name].sd_p) for name, s in solutions.items()}
    speed = {name: Curve(t.t - start, t.v, t.sd_v) for name, t in tracks.items() if t.v is not None}
    turned = {
        name: Curve(t.t - start, _convert_angles(t.rph), None if t.sd_rph is None else TO_DEG * t.sd_rph)
        for name, t in tracks.items() if t.rph is not None
    }  # fmt: skip
    out = []
    for title, series, parts, unit, under in (
        ("Position", place, ("east", "north", "height"), "m", draw_measured),
        ("Velocity", speed, ENU, "m/s", draw_doppler),
        ("Attitude", turned, RPH, "deg", None),
    ):
        if series:
            figure = plots.plot_bands(series, parts, unit, end, spans=spans, about_zero=False, under=under)
            note = "The fixes are of the antenna." if title == "Position" and fixes is not None else ""
            if title == "Attitude" and any(np.nanmax(s.value[:, 2], initial=0.0) > 360.0 for s in series.values()):
                note = "The heading is continued beyond 360 deg."
            out.append(page.place_picture(figure, f"{title} and 3 sigma" if len(series) < 3 else title, note))
    return out


def draw_separation(solution: Solution, start: float, end: float, spans: Shades) -> list[Markup]:
    """Forward filter minus the information after each keyframe."""
    found = solution.separation
    if found is None or not np.isfinite(found.value).any():
        return []
    series = {"ekf": Curve(found.t - start, found.value, found.sigma)}
    note = "Position by the forward filter minus that by later measurements alone; it should lie within the band."
    return [
        page.place_picture(
            plots.plot_bands(series, ENU, "m", end, spans=spans), "Combined separation and 3 sigma", note
        )
    ]


def draw_quality(recording: Recording, solution: Solution, spans: Shades) -> list[Markup]:
    """Quality stated by the fixes: 1-sigma, horizontal and up, and satellites."""
    gnss, fixes = recording.gnss, select_fixes(recording, solution)
    if gnss is None or fixes is None or not len(gnss.t):
        return []
    seen = gnss.satellites is not None
    shown = np.column_stack([np.hypot(gnss.sd[:, 0], gnss.sd[:, 1]), gnss.sd[:, 2]])
    titles, units, log = ["horizontal 1-sigma [m]", "up 1-sigma [m]"], ["m", "m"], [True, True]
    limits = [plots.find_axis_limits([np.log10(shown[:, k])], floor=0.5) for k in range(2)]
    if gnss.satellites is not None:
        shown = np.column_stack([shown, gnss.satellites])
        titles, units, log = [*titles, "satellites"], [*units, ""], [*log, False]
        limits.append(plots.find_axis_limits([np.append(gnss.satellites, 0.0)], floor=1.0))
    figure = plots.Figure(titles, (0.0, recording.duration), limits, units=units, log=log)
    for k, panel in enumerate(figure.panels):
        panel.shade(spans)
        draw_fixes(panel, replace(fixes, enu=shown), k)
    return [page.place_picture(figure, "Fixes: stated accuracy" + (" and satellites" if seen else ""))]


def _convert_angles(rph: Array) -> Array:
    """Roll, pitch, heading (N, 3) in deg; the heading starts within 0 to 360 and has no jumps."""
    out = np.degrees(rph)
    known = np.isfinite(out[:, 2])
    heading = np.unwrap(out[known, 2], period=360.0)
    out[known, 2] = heading - 360.0 * np.floor(heading[0] / 360.0) if len(heading) else heading
    return np.asarray(out)


def draw_biases(solution: Solution, start: float, end: float, spans: Shades) -> list[Markup]:
    """Gyro and accelerometer biases with 3 sigma."""
    sd = np.sqrt(np.maximum(np.diagonal(solution.covariance, axis1=1, axis2=2), 0.0))
    t = solution.t - start
    out = []
    for words, value, sigma, unit, scale in (
        ("Gyro bias", solution.states.bg, sd[:, 12:15], "deg/h", TO_DEG_H),
        ("Accelerometer bias", solution.states.ba, sd[:, 9:12], "mm/s²", 1000.0),
    ):
        series = {solution.solver: Curve(t, value * scale, sigma * scale)}
        figure = plots.plot_bands(series, XYZ, unit, end, spans=spans, about_zero=False)
        out.append(page.place_picture(figure, f"{words} and 3 sigma"))
    return out


def draw_parameters(
    parameters: Mapping[str, ParameterEstimate], solver: str, start: float, end: float, spans: Shades
) -> list[Markup]:
    """Time-varying parameters with 3 sigma, where the data determined them."""
    out = []
    for name, p in parameters.items():
        if len(p.t) > 2 and np.any(p.sigma < 0.5 * p.prior_sigma):
            told = np.any(p.sigma < 0.5 * p.prior_sigma, axis=0)
            shown = [
                one for one, drawn in zip(name_components(name, p.value.shape[1], p.unit), told, strict=True) if drawn
            ]
            scale = np.array([one.scale for one in shown])
            series = {solver: Curve(p.t - start, scale * p.value[:, told], scale * p.sigma[:, told])}
            titles, units = [one.words for one in shown], [one.unit for one in shown]
            figure = plots.plot_bands(series, titles, units, end, spans=spans, about_zero=False)
            words = " ".join(one.upper() if one in ("gnss", "imu") else one for one in name.split("_"))
            out.append(page.place_picture(figure, f"{words[:1].upper()}{words[1:]} and 3 sigma"))
    return out


def zoom_pictures(errors: Mapping[str, Errors], start: float, spans: Tinted, what: str = "withheld") -> list[Markup]:
    """Horizontal error in and around each span."""
    if not spans or not errors:
        return []
    series = {}
    for name, e in errors.items():
        s = collect_error_series(e, start)["position"]
        series[name] = Curve(s.t, np.hypot(s.value[:, 0], s.value[:, 1])[:, None])
    figure = plots.plot_span_zoom(series, spans, what)
    return [
        page.place_picture(figure, "Horizontal error in and around each span", kind="large" if len(spans) > 1 else "")
    ]


def draw_differences(solutions: Mapping[str, Solution], start: float, end: float, spans: Shades) -> list[Markup]:
    """Differences between the solvers and the last of them, at their common keyframes."""
    name, reference = list(select_own(solutions).items())[-1]
    series = {}
    for key, s in solutions.items():
        if key == name:
            continue
        _, mine, its = np.intersect1d(s.t, reference.t, return_indices=True)
        if len(mine) > 1:
            series[key] = Curve(s.t[mine] - start, s.states.p[mine] - reference.states.p[its])
    if not series:
        return []
    figure = plots.plot_bands(series, ENU, "m", end, spans=spans)
    return [page.place_picture(figure, f"Position less that of {name}")]


def record_pictures(solution: Solution, start: float, end: float, spans: Shades) -> list[Markup]:
    """Whitened residuals and NIS of every constraint."""
    out = []
    for kind, record in solution.records.items():
        if not len(record.t):
            continue
        figure = plots.plot_residuals(record, start, end, solution.solver, spans=spans)
        dof = record.residual.shape[1]
        note = f"The lines are at 3 sigma; NIS is chi-square with {dof} degree{'s' if dof > 1 else ''} of freedom"
        note += "." if record.kind == "innovation" else " at most, as a fit takes up part of the noise."
        out.append(page.place_picture(figure, f"{name_rows(kind)}: {record.kind}s over their sigma", note))
    return out


def draw_timeline(solution: Solution, recording: Recording, spans: Shades) -> list[Markup]:
    """Times at which each constraint was used."""
    records = {name_rows(kind): record for kind, record in solution.records.items() if len(record.t)}
    if not records:
        return []
    figure = plots.plot_timeline(records, recording.start, recording.duration, solution.solver, spans=spans)
    return [page.place_picture(figure, "Use of constraints over time", kind="large")]


def draw_detections(recording: Recording, found: Sequence[Detection]) -> list[Markup]:
    """Signals and statistics of the detectors."""
    if not found:
        return []
    note = "Tinted: stationary, by all detectors together."
    return [
        page.place_picture(
            plots.plot_detections(recording, found), "Signals, statistics and thresholds", note, kind="large"
        )
    ]
