"""Conversion of other programs' logs into a recording folder, and of trajectories into other formats."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.app.workflow import Outcome
from graphnav.core.complaints import split_names
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.files import parse_json, read_text
from graphnav.core.interpolation import interpolate
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.core.staging import resolve_final_path, stage_results
from graphnav.core.timescales import gps_to_utc, parse_clock
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.solution import Solution, make_trajectory
from graphnav.evaluation.against import find_antenna_lever_arm, select_own
from graphnav.recording.exporters import FORMATS, write_parts
from graphnav.recording.formats import list_formats, load
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.trajectories import read_trajectory
from graphnav.recording.formats.writer import write_recording

_TRAJECTORY = "trajectory.csv"
SUMMARY = "summary.json"  # of the run that wrote a trajectory: has its clock and its points
_DENSE_RATE = 20.0  # Hz
_ROWS_AT_ONCE = 4096  # rows processed at once
_CONTEXT_ROWS = 8  # rows on either side from which rates and velocities of a part are computed
_MOST_ROWS = 2e7
_MAX_GAP = 3.0  # s; wider gaps of a trajectory are not interpolated


def is_export(source: Path, out: Path) -> bool:
    """Whether a trajectory is to be exported, rather than a log read."""
    return out.suffix[1:] in FORMATS and not out.is_dir() and not source.is_dir()


def check_rate(rate: float | None) -> None:
    """Refuse an invalid output rate (Hz).

    Raises
    ------
    ConfigError
        Naming the option.
    """
    if rate is not None and not 0.0 < rate <= 10_000.0:
        raise ConfigError(f"--rate {rate:g}: must be above 0 and at most 10000 Hz", key="option.value")


def convert_log(
    source: str,
    out: Path,
    name: str | None,
    topics: Sequence[str] = (),
    force: bool = False,
    allow_outside: bool = False,
) -> tuple[Log, list[Path]]:
    """Read a log of any known kind and write it as a recording folder.

    Raises
    ------
    RecordingError
        If it cannot be read.
    ConfigError
        If it would be written over itself, or without `force` over another recording.
    """
    log = _add_measured_noise(load(source, name, topics, allow_outside))
    if any(file.resolve().parent == out.resolve() and file.name.endswith((".toml", ".csv.gz")) for file in log.files):
        raise ConfigError(f"-o {out}: the recording is read from there; name another folder", key="output.is_input")
    with stage_results(out) as part:
        files = write_recording(log, part)
        described = out / "recording.toml"
        if not force and described.exists() and described.read_bytes() != (part / described.name).read_bytes():
            raise ConfigError(f"{described}: is another recording's; use --force to write over it", key="output.exists")
    return log, resolve_final_path(files, part, out)


def _add_measured_noise(log: Log) -> Log:
    """The log with the noise densities measured from its IMU, where it states none."""
    imu = log.imu
    if imu is None or not imu.noise_assumed:
        return log
    from graphnav.recording.densities import measure_densities

    found = measure_densities(imu.t, imu.gyro, imu.accel, log.platform == "foot")
    if not found:
        return log
    figures = ", ".join(f"{key} = {value:g}" for key, value in found.items())
    where = "in its quietest rest or stance" if log.platform == "foot" else "between its quietest and usual state"
    remark = Note(
        "imu.noise_measured",
        f"noise: {figures} measured {where}; the other figures are of a consumer IMU",
    )
    noise = replace(imu.noise, **found)
    return replace(log, imu=replace(imu, noise=noise, noise_assumed=False), remarks=(*log.remarks, remark))


def parse_point(text: str | None, option: str = "--point") -> str | Array:
    """Parse ``imu``, ``antenna``, or a lever arm ``x,y,z`` (m; right, forward, up of the IMU).

    Raises
    ------
    ConfigError
        If it is none of these.
    """
    if text in (None, "imu", "antenna"):
        return text or "imu"
    assert text is not None
    return parse_arm(text, option, "imu, antenna, or ")


def parse_arm(text: str, option: str, else_: str = "") -> Array:
    """Parse a lever arm ``x,y,z`` (m; right, forward, up); `else_` is what else may be written.

    Raises
    ------
    ConfigError
        If it is none.
    """
    try:
        arm = np.array([float(x) for x in text.split(",")])
    except ValueError:
        arm = np.empty(0)
    if arm.shape != (3,) or not np.isfinite(arm).all():
        raise ConfigError(
            f"{option} {text}: write {else_}x,y,z in m: right, forward, up of the IMU", key="option.point"
        )
    return arm


def export_file(
    source: str, out: Path, name: str | None, point: str | None, rate: float | None, clock: str | None
) -> tuple[list[Path], list[str]]:
    """Write a trajectory for other programs: to the file `out`, or into the folder `out` under its own name.

    The source is a file, or the folder of a run.

    Returns
    -------
    files, notes
        What was written, and sentences about what was not known.

    Raises
    ------
    RecordingError
        If the trajectory cannot be read, moved to the point or held by the format.
    ConfigError
        For options that cannot be used.
    """
    file = _find_trajectory_file(source)
    trajectory = read_trajectory(file)
    if out.suffix[1:] in FORMATS and not out.is_dir():
        if name is not None and name != out.suffix[1:]:
            raise ConfigError(f"--export {name}: but {out.name} is to be written", key="option.not_here")
        targets = {out.suffix[1:]: out}
    else:
        assert name is not None
        targets = {one: out / f"{file.stem}.{one}" for one in split_names(name, FORMATS, "--export", "format to write")}
    run = _read_summary(file)
    arm = parse_point(point)
    if isinstance(arm, str) and arm == "antenna":
        stated = run.get("antenna_lever_arm")
        if stated is None:
            raise ConfigError(
                f"--point antenna: no {SUMMARY} beside {file.name} says where it is; give x,y,z", key="option.point"
            )
        arm = np.array(stated, dtype=float)
    gps_zero = run.get("gps_zero")
    if clock is not None:
        try:
            gps_zero = parse_clock(clock, float(trajectory.t[0]))
        except ValueError as error:
            raise ConfigError(f"--clock {clock}: {error}", key="option.clock") from None
    notes = list(trajectory.notes)
    if gps_zero is None and trajectory.t[0] > 1e9:
        gps_zero = parse_clock("unix", float(trajectory.t[0]))
        notes.append("t is taken as Unix time: it is above 1e9")
    if gps_zero is None and {"gpx", "nav"} & set(targets):
        notes.append(
            "the zero of t is not known: GPX is written without times, .nav with week 0; state it with --clock"
        )
    parts = move_to_point(trajectory, None if isinstance(arm, str) else arm, rate)
    return _write_tracks(parts, targets, gps_zero, trajectory.name), notes


def _find_trajectory_file(source: str) -> Path:
    """The trajectory file: the source itself, or the one in a run's folder."""
    path = Path(source)
    if (path / _TRAJECTORY).is_file():
        return path / _TRAJECTORY
    if any(known.builtin and known.recognises(source) for known in list_formats().values()) or path.is_dir():
        raise ConfigError(
            f"{source}: is no trajectory; name a file of one, or solve: graphnav smooth {source} --export ... -o OUT",
            key="trajectory.none",
        )
    return path


def move_to_point(trajectory: Trajectory, arm: Array | None, rate: float | None = None) -> Iterator[Trajectory]:
    """The trajectory of the point at the end of a lever arm, at its own times or at `rate` (Hz), in parts.

    Raises
    ------
    RecordingError
        If there is a lever arm and no attitude to turn it.
    ConfigError
        If the rate leaves no row, or too many.
    """
    if arm is not None and not np.any(arm):
        arm = None
    if arm is not None and trajectory.rph is None:
        raise RecordingError(
            "--point: the trajectory has no attitude, so no other point of the body can be placed",
            key="trajectory.no_attitude",
        )
    begin, end = trajectory.t[[0, -1]]
    if rate is not None and (end - begin) * rate > _MOST_ROWS:
        raise ConfigError(
            f"--rate {rate:g}: makes {(end - begin) * rate:.3g} rows, more than {_MOST_ROWS:g}", key="option.value"
        )
    return iter([trajectory]) if arm is None and rate is None else _interpolate_parts(trajectory, arm, rate)


def _interpolate_parts(trajectory: Trajectory, arm: Array | None, rate: float | None) -> Iterator[Trajectory]:
    t = trajectory.t
    wanted = t if rate is None else np.arange(np.ceil(t[0] * rate - 1e-6), np.floor(t[-1] * rate + 1e-6) + 1) / rate
    found = 0
    for k in range(0, len(wanted), _ROWS_AT_ONCE):
        part = wanted[k : k + _ROWS_AT_ONCE]
        around = slice(
            max(np.searchsorted(t, part[0]) - _CONTEXT_ROWS, 0),
            np.searchsorted(t, part[-1], side="right") + _CONTEXT_ROWS,
        )
        moved, _ = interpolate(trajectory.take(around), part, max_gap=_MAX_GAP, lever_arm=arm)
        found += len(moved)
        if len(moved):
            yield moved
    if not found:
        raise ConfigError(f"--rate {rate:g}: leaves no row of this trajectory; give a higher one", key="output.no_row")


def export_run(
    outcome: Outcome, folder: Path, names: Sequence[str], point: str | None, alone: bool = True
) -> list[Path]:
    """Write the solutions of a run in some formats, in files named after the point: trajectory.gpx, antenna.gpx.

    A single solution (`alone`) is written into `folder`, otherwise each into a folder of its name in it.

    Raises
    ------
    ConfigError
        If the antenna is asked for and there is none.
    """
    rate = outcome.request.rate
    arm = parse_point(point)
    name = "trajectory" if point in (None, "imu") else "antenna" if point == "antenna" else "point"
    files: list[Path] = []
    for solver, solution in select_own(outcome.solutions).items():
        lever_arm = arm
        if isinstance(arm, str) and arm == "antenna":
            found = find_antenna_lever_arm(outcome.recording, solution)
            if found is None:
                raise ConfigError("--point antenna: the recording has no GNSS", key="option.point")
            lever_arm = found
        blocks = solution.blocks(rate)
        if not isinstance(lever_arm, str) and np.any(lever_arm):
            blocks = _move_parts(solution, rate, lever_arm)
        title = f"{outcome.recording.name}, {solver}" + (f", {name}" if name != "trajectory" else "")
        place = folder if alone else folder / solver
        files += _write_tracks(
            blocks, {one: place / f"{name}.{one}" for one in names}, outcome.recording.gps_zero, title
        )
    return files


def _move_parts(solution: Solution, rate: float | None, arm: Array) -> Iterator[Trajectory]:
    """The trajectory of the point at the end of a lever arm, in parts."""
    # between keyframes a second apart the turn rate, and with it the point's velocity, would be uncertain
    dense = max(rate or 0.0, _DENSE_RATE)
    there = [piece.list_times(dense) for piece in solution.between]
    wanted = solution.t if rate is None else np.concatenate([piece.list_times(rate) for piece in solution.between])
    for t in np.split(wanted, np.flatnonzero(np.diff(np.floor(wanted * (dense / _ROWS_AT_ONCE)))) + 1):
        # one row on each side for the position, two for the turn rate, and one to spare
        around = [
            times[max(np.searchsorted(times, t[0]) - 3, 0) : np.searchsorted(times, t[-1], side="right") + 3]
            for times in there
        ]
        rows = make_trajectory(solution.solver, solution.frame, *solution.at(np.concatenate(around)))
        yield interpolate(rows, t, max_gap=_MAX_GAP, lever_arm=arm)[0]


def _write_tracks(
    blocks: Iterable[Trajectory], targets: dict[str, Path], gps_zero: float | None, name: str
) -> list[Path]:
    for path in targets.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    write_parts(blocks, targets, name, None if gps_zero is None else lambda t: gps_to_utc(t + gps_zero))
    return list(targets.values())


def _read_summary(source: Path) -> dict[str, Any]:
    """The summary beside a trajectory, which states its points and its clock."""
    path = source.parent / SUMMARY
    try:
        values = parse_json(read_text(path))
    except (RecordingError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def log_values(log: Log) -> dict[str, Any]:
    """The converted log for JSON: what was read and what was assumed."""
    sensors = {name: getattr(log, name) for name in ("imu", "gnss", "odometer", "truth")}
    rows = {name: len(sensor.t) for name, sensor in {**sensors, **log.sensors}.items() if sensor is not None}
    return {"name": log.name, "platform": log.platform, "rows": rows, "assumed": log.remarks}


def log_text(log: Log, files: Sequence[Path]) -> str:
    """The converted log for people: what was read, what was assumed, and what was written."""
    held = []
    sensors = {"IMU": log.imu, "GNSS": log.gnss, "odometer": log.odometer, **log.sensors, "truth": log.truth}
    for label, sensor in sensors.items():
        if sensor is not None and len(sensor.t):
            span = f"{sensor.t[0]:.3f} to {sensor.t[-1]:.3f} s"
            held.append(f"  {label:<9} {format_count(len(sensor.t), 'row')}, {span}")
    lines = [f"{log.name} ({log.platform})", *held, *(f"  assumed: {remark}" for remark in log.remarks)]
    if log.imu is None:
        lines.append("  warning: no IMU in it: put its rows into imu.csv beside recording.toml, or use 'graphnav init'")
    return "\n".join([*lines, *(f"wrote {file}" for file in files)])
