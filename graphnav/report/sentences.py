"""The sentences and key numbers at the top of a report, each from plain data to HTML."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from graphnav.core.notes import Note, format_count
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import select_own
from graphnav.evaluation.segments import compute_rms
from graphnav.recording import Recording
from graphnav.report import page, wording
from graphnav.report.doubts import FEWEST_ROWS, TOO_LARGE, measure_consistency
from graphnav.report.plots import Tinted
from graphnav.report.satellites import select_satellite_records
from graphnav.report.tables import Removed
from graphnav.report.wording import join_words

if TYPE_CHECKING:
    from graphnav.evaluation.metrics import Errors

_MAX_OUTAGES = 6  # outages listed at most


def describe_deciding(recording: Recording, settings: Mapping[str, Any]) -> str:
    """Which detectors decide where the platform stands."""
    fire = settings.get("detectors", {}).get("fire", ("fused",))
    if "fused" not in fire:
        return f"{join_words(list(fire))}, each by itself"
    if recording.platform == "foot":
        return "the stance GLRT"
    return "the fusion: the low-band GLRT, checked against speeds and integrated forces, extended by the FFT detector"


def describe_run(recording: Recording, solutions: Mapping[str, Solution], withheld: Removed, outages: Tinted) -> str:
    """Describe the run in a few sentences."""
    used = recording
    for source, span in withheld:
        if source in used.aiding:
            used = used.without(source, span)
    sources = [f"an IMU at {1.0 / used.imu.period:.4g} Hz"]
    raw = [r.t for s in solutions.values() for r in select_satellite_records(s).values()]
    if raw:
        sources.append(f"raw GNSS of {format_count(len(np.unique(np.concatenate(raw))), 'epoch')}")
    if used.gnss is not None and (not raw or any("gnss_position" in s.records for s in solutions.values())):
        sources.append(format_count(len(used.gnss.t), "GNSS fix", "GNSS fixes"))
    if used.odometer is not None:
        sources.append(format_count(len(used.odometer.t), "odometer row"))
    sources += [f"{format_count(len(series), 'row')} of {name}" for name, series in used.sensors.items()]
    others = [name for name in solutions if name not in select_own(solutions)]
    solutions = select_own(solutions)
    solution = next(iter(solutions.values()))
    several = len(solutions) > 1
    who = f"The solvers {join_words(list(solutions))}" if several else f"The {solution.solver} solver"
    words = (
        f"{who} estimated the trajectory of the {recording.platform} recording '{recording.name}' "
        f"({recording.duration:.1f} s) from {join_words(sources)}, at {format_count(len(solution.t), 'keyframe')}."
    )
    if others:
        words += f" Beside them, of other programs: {join_words(others)}."
    if withheld:
        listed = [f"{source} {span[0]:g} to {span[1]:g} s" if span else f"all of {source}" for source, span in withheld]
        words += f" Withheld: {join_words(listed)} (seconds from the start)."
    spans = solution.stationary
    if len(spans):
        stops = format_count(len(spans), "stop" if recording.platform == "vehicle" else "stance")
        words += f" Found: {stops}, {np.diff(spans).sum():.0f} s in all."
    if outages:
        listed = [f"{a:.0f} to {b:.0f} s" for a, b in outages[:_MAX_OUTAGES]]
        more = [f"{len(outages) - _MAX_OUTAGES} more"] if len(outages) > _MAX_OUTAGES else []
        words += f" There were no GNSS fixes from {join_words([*listed, *more])}."
    excluded = sum(int(part.count) for part in solution.excluded)
    if excluded:
        words += f" Excluded, or used with larger sigmas: {format_count(excluded, 'measurement')}."
    if not several and solution.stopped:
        words += f" {solution.stopped[0].upper()}{solution.stopped[1:].rstrip('.')}."
    return words


def list_tiles(recording: Recording, solutions: Mapping[str, Solution], errors: Mapping[str, Errors]) -> Markup:
    """The key numbers."""
    states = next(iter(solutions.values())).states
    distance = float(np.linalg.norm(np.diff(states.p, axis=0), axis=1).sum())
    out = [
        (f"{recording.duration:.1f} s", "duration"),
        (f"{distance / 1000:.2f} km" if distance >= 1000 else f"{distance:.1f} m", "distance"),
    ]
    spans = next(iter(solutions.values())).stationary
    if len(spans):
        out.append((f"{len(spans)}", "stops" if recording.platform == "vehicle" else "steps"))
    several = len(solutions) > 1
    for name, solution in solutions.items():
        if name in errors:
            value = f"{wording.format_number(compute_rms(errors[name].horizontal), 3)} m"
            out.append((value, f"horizontal error, RMS{', ' + name if several else ''}"))
        else:
            sd = solution.trajectory(joint=False).sd_p
            if sd is not None:
                value = f"{wording.format_number(float(np.median(np.hypot(sd[:, 0], sd[:, 1]))), 3)} m"
                out.append((value, f"horizontal sigma, median{', ' + name if several else ''}"))
    if not several:
        seconds = sum(next(iter(solutions.values())).timings.values())
        out.append((f"{seconds:.2f} s", "run time"))
    return page.tiles(out)


def describe_sigma(name: str, errors: Errors) -> Markup:
    """One sentence that compares errors with their sigma (and the truth's own, if stated)."""
    from graphnav.evaluation.sigmas import judge_sigmas, select_verdict

    verdicts = judge_sigmas(errors)
    if not verdicts:
        words = f"{name}: no epoch has both an error and a sigma, so sigma cannot be assessed."
        return page.paragraph(Note("sigma.not_judged", words), "verdict")
    worst = select_verdict(verdicts, "too small") or select_verdict(verdicts, "unclear")
    shown = worst or verdicts
    measured = join_words(
        [f"{j.block} errors are {j.size:.2f} sigma rms, {100 * j.inside:.1f} % within 3 sigma" for j in shown]
    )
    measured += " (1 and 99.7 % for Gaussian errors)"
    blocks = join_words([j.block for j in shown])
    if worst and worst[0].verdict == "too small":
        when = " at times" if all(j.inside > 0.9 for j in worst) else ""
        words = f"{name}: the stated sigma is too small{when}, of {blocks}: {measured}."
        words += " Errors of the truth itself are included."
        return page.paragraph(Note("sigma.too_small", words), "verdict bad")
    if worst:
        alike = join_words([format_count(round(j.effective), "independent value") for j in worst])
        words = (
            f"{name}: whether sigma of {blocks} is consistent cannot be decided: {measured}, but the errors are "
            f"correlated for so long that they amount to {alike}."
        )
        return page.paragraph(Note("sigma.unclear", words), "verdict")
    seen = {j.block for j in verdicts}
    unseen = [what for what in ("position", "velocity", "attitude") if what not in seen]
    rest = f" Not assessed: {join_words(unseen)}." if unseen else ""
    if all(j.verdict == "cautious" for j in verdicts):
        return page.paragraph(
            Note("sigma.cautious", f"{name}: the stated sigma is cautious: {measured}.{rest}"), "verdict"
        )
    words = f"{name}: the stated sigma is consistent: {measured}.{rest}"
    return page.paragraph(Note("sigma.consistent", words), "verdict good")


def describe_sigma_without_truth(solution: Solution) -> Markup:
    """One sentence on the sigma by innovations or residuals, where there is no truth."""
    kind, size, used = measure_consistency(solution)
    missing = f"{solution.solver}: there is no truth to compare with"
    larger, mark = size > TOO_LARGE[kind], ""
    if used < FEWEST_ROWS:
        note = Note("no_truth.few", f"{missing}, and there are too few measurements to assess sigma.")
    elif kind == "innovation":
        measured = f"they are {size:.2f} times as large as predicted (RMS; 1 where sigma is true)"
        if larger:
            words, mark = f"{missing}, and sigma looks too small for the innovations: {measured}.", "bad"
            note = Note("no_truth.too_small", words)
        elif size < 0.5:
            words = f"{missing}; the stated sigma looks cautious for the innovations: {measured}."
            note = Note("no_truth.cautious", words)
        else:
            words, mark = f"{missing}. The innovations agree with the stated sigma: {measured}.", "good"
            note = Note("no_truth.consistent", words)
    else:
        measured = f"residuals are {size:.2f} times the measurements' sigma"
        measured += " (RMS; 1 or a little less where sigma is true)"
        if larger:
            note, mark = Note("no_truth.residuals_large", f"{missing}, and sigma looks too small: {measured}."), "bad"
        else:
            words = f"{missing}, and the residuals of a fit are a weak test; a filter's innovations are a better one."
            words += f" The {measured}."
            note = Note("no_truth.residuals_only", words)
    return page.paragraph(note, f"verdict {mark}".strip())


def describe_closure(name: str, metrics: Mapping[str, Any] | None) -> list[Markup]:
    """The closure error of a loop, where that is the truth."""
    if not metrics or metrics.get("closure_h_m") is None:
        return []
    h, up, distance, share = (
        wording.format_value(metrics.get(f"closure_{k}")) for k in ("h_m", "up_m", "distance_m", "percent")
    )
    words = f"the loop of {distance} m closes to {h} m horizontally ({share} % of the path) and {up} m in height."
    return [page.paragraph(f"{name}: {words}", "verdict")]
