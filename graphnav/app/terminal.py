"""Output on the terminal: summaries as plain text, and progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path

import numpy as np

from graphnav.app.summary import compute_median_sigmas
from graphnav.app.workflow import Outcome
from graphnav.constraints.lasting import LASTING
from graphnav.core.notes import format_count, get_key
from graphnav.core.progress import Progress
from graphnav.core.staging import defer_interrupts
from graphnav.estimation.names import name_rows
from graphnav.estimation.noise.model import TABULATED
from graphnav.estimation.solution import Solution
from graphnav.evaluation.metrics import SpanErrors

_OF_IMU = {
    "imu.gyro_noise_density": "gyro", "imu.accel_noise_density": "accelerometer",
    "imu.gyro_bias_walk": "gyro bias walk", "imu.accel_bias_walk": "accelerometer bias walk",
}  # fmt: skip
_ERRORS = (
    ("hor. rms", "h", "rms", "m"), ("hor. max", "h", "max", "m"), ("up rms", "up", "rms", "m"),
    ("roll rms", "roll", "rms", "deg"), ("pitch rms", "pitch", "rms", "deg"), ("head. rms", "heading", "rms", "deg"),
)  # fmt: skip


_WIDEST_TABLE = 1000  # characters of a table


def run_text(outcome: Outcome, files: Sequence[Path]) -> str:
    """Summary of a run: what was read, findings, errors, and files to look at."""
    lines = [*describe_doubts(outcome), _describe_recording(outcome)]
    lines += [f"  {source} withheld{'' if span is None else f' {span[0]:g}-{span[1]:g} s'}"
              for source, span in outcome.request.withheld]  # fmt: skip
    notes = [note for s in outcome.solutions.values() for note in s.notes]
    lines += [f"  {line}" for line in _describe_noise(outcome)]
    severity = {f.sentence: f.severity for f in outcome.checks}
    for note in dict.fromkeys([*outcome.findings, *notes]):
        if get_key(note) in TABULATED or get_key(note).startswith("doubt.") or note in outcome.defects:
            continue  # doubts and unreliable findings come first
        lines.append(f"  {severity.get(note, 'note')}: {note}")
    lines.append("")
    lines += _tabulate_errors(outcome)
    lines += _tabulate_spans(outcome)
    lines += ["", _describe_stops(outcome), "", "look at"]
    return "\n".join([*lines, *(f"  {file}" for file in files)])


def describe_doubts(outcome: Outcome) -> list[str]:
    """A line for each reason why the result cannot be trusted."""
    from graphnav.report.doubts import list_doubts

    errors = {name: m.errors for name, m in outcome.metrics.items() if m.errors is not None}
    lines = [f"warning: {doubt[0].lower()}{doubt[1:]}" for doubt in list_doubts(outcome.solutions, errors)]
    return lines + [f"unreliable: {sentence}" for sentence in outcome.defects]


def _describe_noise(outcome: Outcome) -> list[str]:
    """The noise model in one line: figures that differ from the stated ones."""
    from graphnav.estimation.noise.table import compute_whole_ratio

    noise = next(iter(outcome.solutions.values())).noise
    if not noise.figures:
        return ["noise as stated"]
    estimated = {words: noise.figures[group].log_factor for group, words in _OF_IMU.items() if group in noise.figures}
    parts = [f"{words} x {format_short(float(np.exp(0.5 * factor)))}" for words, factor in estimated.items()]
    for source in dict.fromkeys(group.rpartition(".")[0] for group in noise.figures if group.startswith("gnss_")):
        if source.rpartition(".")[2] in LASTING:
            continue
        name, _, kind = source.partition(".")
        ratios = [(axis, compute_whole_ratio(noise, source, axis)) for axis in ("horizontal", "up")]
        factors = " and ".join(f"x {format_short(ratio)} {axis}" for axis, ratio in ratios if ratio is not None)
        if factors:  # no common figure where each type has its own
            parts.append(f"{name_rows(name)}{f' ({kind})' if kind else ''} {factors}")
    given = outcome.request.noise
    how = "estimated" if given is None else "as given" if given.file is None else f"from {given.file}"
    return [f"noise {how}, in stated sigmas: {', '.join(parts)}"]


def _describe_stops(outcome: Outcome) -> str:
    spans = next(iter(outcome.solutions.values())).stationary
    kind = "stop" if outcome.recording.platform == "vehicle" else "stance"
    if not len(spans):
        return f"no {kind}s"
    return f"{format_count(len(spans), kind)}, {np.diff(spans).sum():.1f} s in all: detections.csv"


def _describe_recording(outcome: Outcome) -> str:
    recording = outcome.recording
    rate = 1.0 / float(np.median(np.diff(recording.imu.t)))
    parts = [f"{recording.duration:.1f} s", f"IMU {format_count(len(recording.imu.t), 'row')} at {rate:.4g} Hz"]
    if recording.gnss is not None:
        parts.append(f"GNSS {format_count(len(recording.gnss.t), 'fix', 'fixes')}")
    if recording.odometer is not None:
        parts.append(f"odometer {format_count(len(recording.odometer.t), 'row')}")
    parts += [f"{name} {format_count(len(series), 'row')}" for name, series in recording.sensors.items()]
    if recording.truth is not None:
        parts.append("truth")
    return f"{recording.name} ({recording.platform}): {', '.join(parts)}"


def _tabulate_errors(outcome: Outcome) -> list[str]:
    """A row per solver: its errors, or its stated sigmas if there is no truth."""
    if not outcome.metrics:
        head = ["solver", "keyframes", "sd hor. (m)", "sd up (m)", "sd head. (deg)", "seconds"]
        rows = [
            [name, str(len(s.t)), *(format_short(x) for x in _list_sigmas(s)), _format_seconds(s)]
            for name, s in outcome.solutions.items()
        ]
        return ["no truth to compare with; medians of the sigmas stated:", *format_table(head, rows)]
    if all(m.closure is not None for m in outcome.metrics.values()):
        rows = [
            [
                name,
                format_short(m.closure.horizontal),
                format_short(m.closure.vertical),
                format_short(m.closure.percent),
            ]
            for name, m in outcome.metrics.items()
            if m.closure is not None
        ]
        return [
            f"errors against {outcome.against}:",
            *format_table(["solver", "hor. (m)", "up (m)", "% of path"], rows),
        ]
    shown = [one for one in _ERRORS if any(one[1] in m.components for m in outcome.metrics.values())]
    head = ["solver", *(f"{title} ({unit})" for title, _, _, unit in shown), "NEES pos.", "seconds"]
    rows = []
    for name, m in outcome.metrics.items():
        row = [
            format_short(getattr(m.components[key], what)) if key in m.components else "-" for _, key, what, _ in shown
        ]
        nees = format_short(m.nees["p"].mean) if "p" in m.nees else "-"
        rows.append([name, *row, nees, _format_seconds(outcome.solutions[name])])
    return [f"errors against {outcome.against}:", *format_table(head, rows)]


def _list_sigmas(solution: Solution) -> list[float]:
    """The sigmas of `summary.compute_median_sigmas`, NaN where there are none."""
    found = compute_median_sigmas(solution)
    return [found.get(key, float("nan")) for key in ("sd_h_median_m", "sd_u_median_m", "sd_heading_median_deg")]


def _format_seconds(solution: Solution) -> str:
    return f"{sum(solution.timings.values()):.2f}" if solution.timings else "-"


def _tabulate_spans(outcome: Outcome) -> list[str]:
    """For every withheld span, a row per solver."""
    lines: list[str] = []
    for k, missing in enumerate(outcome.span_names):
        every = {name: m.spans[k] for name, m in outcome.metrics.items()}
        first = next(iter(every.values()))
        lines += ["", f"{missing} {first.start + outcome.zero:.1f}-{first.end + outcome.zero:.1f} s:"]
        if not any(s.n for s in every.values()):
            lines.append("  nothing to compare with in it")
            continue
        head = ["solver", "hor. end (m)", "hor. max (m)", "up max (m)", "% of path", "NEES pos."]
        lines += format_table(
            head,
            [
                [name, *(format_short(x) for x in (s.end_h, s.max_h, s.max_up)), _share(s), format_short(s.nees)]
                for name, s in every.items()
            ],
        )
    return lines


def _share(span: SpanErrors) -> str:
    """Drift as a share of the distance travelled; undefined for a stationary vehicle."""
    return format_short(span.drift_percent) if span.distance >= 1.0 else "-"


def format_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column left-aligned and numbers right-aligned; not wrapped."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    grid = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="")
    for k, title in enumerate(head):
        grid.add_column(Text(title), justify="left" if k == 0 else "right", no_wrap=True)
    for row in rows:
        grid.add_row(*map(Text, row))
    console = Console(file=StringIO(), color_system=None, width=_WIDEST_TABLE)
    console.print(grid)
    return [f"  {line.rstrip()}" for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def format_short(x: float) -> str:
    """Three significant digits, '-' for no number."""
    if not np.isfinite(x):
        return "-"
    return f"{x:.0f}" if abs(x) >= 1000 else f"{x:.3g}" if abs(x) >= 1e-3 or x == 0 else f"{x:.1e}"


# relative weights of the stages for the time left: seconds for an hour's drive at 200 Hz
_STAGES = {
    "reading": 0.5, "checks": 0.6, "driving": 5.0, "detection": 0.2, "alignment": 0.1, "preintegration": 0.7,
    "noise": 12.0, "filter": 2.5, "smoother": 0.4, "batch": 0.9, "covariances": 0.2, "incremental": 4.8,
    "isam2": 44.0, "evaluation": 0.1, "writing": 0.7,
}  # fmt: skip
_COMMON_STAGES = ("reading", "checks", "detection", "alignment", "preintegration", "noise", "filter", "smoother")
_WORK = {
    "info": ("reading", "checks"), "detect": ("reading", "detection", "writing"), "evaluate": ("reading",),
    "simulate": ("driving", "writing"), "convert": ("reading", "writing"), "init": ("reading", "writing"),
    "ekf": (*_COMMON_STAGES, "evaluation", "writing"), "rts": (*_COMMON_STAGES, "evaluation", "writing"),
    "batch": (*_COMMON_STAGES, "batch", "covariances", "evaluation", "writing"),
    "incremental": (*_COMMON_STAGES, "incremental", "evaluation", "writing"),
    "isam2": (*_COMMON_STAGES, "isam2", "evaluation", "writing"),
}  # fmt: skip


class StagePace:
    """Progress of some work by the shares of its stages, and the time left."""

    def __init__(self, work: Sequence[str]) -> None:
        wanted = {stage for one in work for stage in _WORK.get(one, ())}
        self._stages = [stage for stage in _STAGES if stage in wanted]
        self._total = sum(_STAGES[stage] for stage in self._stages) or 1.0
        self.done = 0.0

    def reach(self, stage: str, share: float) -> None:
        """Record the share of a stage; repeated stages never reduce the progress."""
        name = stage.split()[0]
        if name in self._stages:
            before = self._stages[: self._stages.index(name)]
            self.done = max(self.done, (sum(_STAGES[s] for s in before) + share * _STAGES[name]) / self._total)

    def estimate_left(self, elapsed: float) -> float | None:
        """Estimated time left, s; None where it is too early to tell."""
        return elapsed * (1.0 / self.done - 1.0) if self.done > 0.03 and elapsed > 1.0 else None


@contextmanager
def show_progress_bar(quiet: bool, work: Sequence[str]) -> Iterator[Progress | None]:
    """A progress bar with stage and time left, on stderr if that is a terminal, for work of more than half a second."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    began, pace = time.monotonic(), StagePace(work)
    bar = Bar(
        TextColumn("{task.description:<14}"), BarColumn(), TextColumn("{task.fields[left]}"),
        console=Console(stderr=True), transient=True,
    )  # fmt: skip
    task = bar.add_task("", total=1.0, left="")

    def update(stage: str, share: float) -> None:
        elapsed = time.monotonic() - began
        pace.reach(stage, share)
        left = pace.estimate_left(elapsed)
        remaining = "" if left is None else f"{left:.0f} s left" if left < 90 else f"{left / 60:.0f} min left"
        bar.update(task, description=stage, completed=pace.done, left=remaining)
        if elapsed > 0.5 and not bar.live.is_started:
            with defer_interrupts():
                bar.start()

    try:
        yield update
    finally:
        with defer_interrupts():
            bar.stop()
