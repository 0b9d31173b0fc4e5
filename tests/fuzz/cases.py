"""Cases of the fuzzer: what is spoilt, what is run on it, and what must hold of an answer.

A case is a target and a number, and is the same whenever it is made. It ends as one of `KINDS`: right; refused in one
sentence; a traceback; no end within `SECONDS`; or an answer that says something else than the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import shutil
import signal
import tempfile
import time
import tomllib
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, reduce
from operator import xor
from pathlib import Path
from typing import Any

import logs
import mutators
import numpy as np
import raw_cases
import test_formats_binary as binary

from graphnav.app import cli
from graphnav.config import format_settings, parse_settings, read_settings
from graphnav.core.errors import GraphnavError
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.pipeline import run
from graphnav.online import Session
from graphnav.online.lines import format_lines
from graphnav.recording import Recording
from graphnav.recording.formats import load, read
from graphnav.recording.formats.schema import read_description
from graphnav.recording.formats.trajectories import read_trajectory
from graphnav.recording.formats.writer import write_recording
from graphnav.recording.plausibility.screening import screen_recording

KINDS = ("right", "refused", "traceback", "hang", "silent wrong")
SECONDS = 10.0  # of a processor
QUICK = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 10.0}})
_LONGEST = 2000  # characters of a sentence


@dataclass(frozen=True)
class Result:
    target: str
    number: int
    kind: str
    said: str
    seconds: float


class _Hang(BaseException):
    pass


class Wrong(AssertionError):
    """An answer that says something else than the file."""


def insist(holds: bool, why: str) -> None:
    if not holds:
        raise Wrong(why)


# -------------------------------------------------------------------------------------------------------- seeds
@cache
def drive() -> tuple[Recording, Trajectory]:
    """Twenty seconds at 25 Hz."""
    recording, truth = logs.simulated(20.0)
    imu = recording.imu
    thin = replace(imu, t=imu.t[1::2], gyro=imu.gyro[1::2], accel=imu.accel[1::2])
    o = recording.odometer
    assert o is not None
    return replace(recording, imu=thin, odometer=replace(o, t=o.t[::5], speed=o.speed[::5])), truth


@cache
def seeds() -> Path:
    """A folder with a file of every kind, made once."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-seeds-"))
    recording, truth = drive()
    write_recording(load_of(recording), folder / "own")
    for packed in (folder / "own").glob("*.csv.gz"):
        import gzip

        packed.with_suffix("").write_bytes(gzip.decompress(packed.read_bytes()))
        packed.unlink()
    text = (folder / "own" / "recording.toml").read_text().replace(".csv.gz", ".csv")
    (folder / "own" / "recording.toml").write_text(text)
    logs.write_kf_gins(folder / "kf", recording, truth)
    logs.write_rtklib(folder / "a.pos", recording)
    logs.write_nmea(folder / "a.nmea", recording)
    binary.write_ubx(folder / "a.ubx", esf=False, hp=False)
    binary.write_ubx(folder / "b.ubx")
    shutil.copytree(logs.write_kitti(folder / "kitti", recording.crop(0.0, 2.0), truth), folder / "raw")
    found = run(recording, QUICK, ("ekf",))["ekf"]
    track = found.trajectory(5.0)
    from graphnav.recording.exporters import write_as

    for name in ("csv", "tum"):
        write_as(name, track, folder / f"t.{name}")
    write_as("nav", track, folder / "t.nav", None)
    write_noise(folder / "noise.json", run(recording, parse_settings({}), ("ekf",))["ekf"].noise)
    (folder / "settings.toml").write_text(format_settings(read_settings()))
    commanded("smooth", folder / "own", "--solver", "ekf", "--noise", "stated", "-o", folder / "out", "--no-report")
    return folder


def load_of(recording: Recording) -> Any:
    from graphnav.recording.formats.registry import Log

    r = recording
    return Log(r.name, r.imu, r.gnss, r.odometer, r.truth, r.platform)


# ------------------------------------------------------------------------------------------------------ targets
Check = Callable[[], None]


def spoilt(path: Path, how: tuple[mutators.Mutator, ...], chance: random.Random) -> None:
    """Spoil a file in one way, seldom in two."""
    data = path.read_bytes()
    for _ in range(chance.choice((1, 1, 1, 2))):
        data = chance.choice(how)(data, chance) or b"\n"
    path.write_bytes(data)


def commanded(*arguments: str | Path) -> str:
    """What a command printed; a refusal, of what is written too, raises, as the library does."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.run([str(a) for a in arguments])
    said = err.getvalue()
    if code in (2, 3):
        if said.count("\n") != 1 or "Traceback" in said:
            raise RuntimeError(f"not one line: {said[-300:]}")
        raise GraphnavError(said.strip())
    if code != 0:
        raise RuntimeError(f"code {code}: {said[-300:]}")
    return out.getvalue()


def of_recording(folder: Path, chance: random.Random) -> None:
    """A table of graphnav's own form: every row that is read stands so in the file, and what is lost is said."""
    shutil.copytree(seeds() / "own", folder / "own")
    name = chance.choice(("imu", "gnss", "odometer", "truth"))
    path = folder / "own" / f"{name}.csv"
    spoilt(path, mutators.TABLE, chance)
    recording = read(folder / "own")
    same_rows(recording, path, name)
    used, said = screen_recording(recording)
    sensor, left = getattr(recording, name), getattr(used, name)
    if sensor is not None and (left is None or len(left.t) < len(sensor.t)):
        insist(bool(said), f"{name}: rows were screened and nothing was said")


_ASKED = {"imu": ("t", "gx", "gy", "gz", "ax", "ay", "az"), "gnss": ("t", "lat", "lon", "h"),
          "odometer": ("t", "speed"), "truth": ("t", "lat", "lon", "h")}  # fmt: skip
_PLAIN = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def table_of(path: Path, asked: tuple[str, ...]) -> dict[float, tuple[float, ...]]:
    """The rows of a CSV file that are plain numbers, by time, read the slow way."""
    text = path.read_bytes().decode("utf-8-sig", "replace")
    lines = [line.split("#")[0].strip() for line in re.split(r"\r\n|\n|\r", text)]
    lines = [line for line in lines if line]
    names = [name.strip().strip('"') for name in lines[0].split(",")]
    at = [names.index(name) for name in asked]
    rows: dict[float, tuple[float, ...]] = {}
    for line in lines[1:]:
        cells = [one.strip().strip('"') for one in line.split(",")]
        if len(cells) == len(names) and all(_PLAIN.fullmatch(cells[k]) for k in at):
            row = tuple(float(cells[k]) for k in at)
            rows.setdefault(row[0], row)
    return rows


def same_rows(recording: Recording, path: Path, name: str) -> None:
    sensor, rows = getattr(recording, name), table_of(path, _ASKED[name])
    if name == "imu":
        values = np.concatenate([sensor.gyro @ sensor.R_bs, sensor.accel @ sensor.R_bs], axis=1)
    elif name == "odometer":
        values = sensor.speed[:, None]
    else:
        values = sensor.llh * [180.0 / np.pi, 180.0 / np.pi, 1.0]
    insist(bool(np.all(np.diff(sensor.t) > 0)), f"{name}: times do not ascend")
    insist(bool(np.isfinite(values).all()), f"{name}: values that are not finite")
    for t, row in zip(sensor.t.tolist(), values.tolist(), strict=True):
        insist(t in rows, f"{name}: a row at {t!r} that the file does not have")
        there = np.array(rows[t][1:])
        if name in ("gnss", "truth"):
            there[1] = (there[1] + 180.0) % 360.0 - 180.0 if abs(there[1] - row[1]) > 180.0 else there[1]
        insist(bool(np.allclose(row, there, rtol=1e-12, atol=1e-12)), f"{name}: {row} at {t!r}, {rows[t]} in the file")
    if len(sensor.t) < len(rows):
        insist(bool(recording.remarks), f"{name}: {len(rows) - len(sensor.t)} rows are lost and nothing is said")


def of_description(folder: Path, chance: random.Random) -> None:
    """recording.toml: what is read is what TOML says."""
    shutil.copytree(seeds() / "own", folder / "own")
    path = folder / "own" / "recording.toml"
    spoilt(path, mutators.WRITTEN, chance)
    d = read_description(path)
    values = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    insist(d.platform == values["platform"], "platform")
    R = d.imu.R_bs
    insist(bool(np.allclose(R @ R.T, np.eye(3), atol=1e-9)), "axes")
    for table in ("gnss", "odometer"):
        arm = values.get(table, {}).get("lever_arm")
        insist(arm is None or list(getattr(d, table).lever_arm) == arm, f"{table}.lever_arm")
    for name, figure in d.imu.figures.items():
        stated = values["imu"].get("noise", {}).get(name)
        insist(np.isfinite(figure) and (not isinstance(stated, int | float) or figure == float(stated)), name)
    read(folder / "own")


def of_info(folder: Path, chance: random.Random) -> None:
    """The whole of `info` on a spoilt table or description."""
    shutil.copytree(seeds() / "own", folder / "own")
    name = chance.choice(("imu.csv", "gnss.csv", "odometer.csv", "truth.csv", "recording.toml"))
    spoilt(folder / "own" / name, mutators.WRITTEN if name.endswith("toml") else mutators.TABLE, chance)
    json.loads(commanded("info", folder / "own", "--json"))


def of_settings(folder: Path, chance: random.Random) -> None:
    """Settings that are read are written and read again as the same."""
    path = Path(shutil.copy(seeds() / "settings.toml", folder))
    spoilt(path, mutators.WRITTEN, chance)
    found = read_settings(path)
    path.write_text(format_settings(found), encoding="utf-8")
    insist(read_settings(path) == found, "settings differ when read again")


def of_noise(folder: Path, chance: random.Random) -> None:
    """A noise model that is read is written and read again as the same."""
    path = Path(shutil.copy(seeds() / "noise.json", folder))
    spoilt(path, mutators.WRITTEN, chance)
    found = read_noise(path)
    write_noise(path, found)
    insist(repr(read_noise(path)) == repr(found), "noise model differs when read again")


def of_kf_gins(folder: Path, chance: random.Random) -> None:
    shutil.copytree(seeds() / "kf", folder / "kf")
    name = chance.choice(("imu.txt", "gnss.txt", "truth.nav", "kf-gins.yaml", "kf-gins.yaml"))
    spoilt(folder / "kf" / name, mutators.YAML if name.endswith("yaml") else mutators.TEXT, chance)
    log = load(folder / "kf" / "kf-gins.yaml", "kf-gins")
    sane(log)
    if name == "gnss.txt" and log.gnss is not None:
        stand_in(np.degrees(log.gnss.llh[:, :2]), folder / "kf" / name)


def of_rtklib(folder: Path, chance: random.Random) -> None:
    path = Path(shutil.copy(seeds() / "a.pos", folder))
    spoilt(path, mutators.TEXT, chance)
    log = load(path, "rtklib")
    sane(log)
    stand_in(np.degrees(log.gnss.llh[:, :2]), path)


def of_nmea(folder: Path, chance: random.Random) -> None:
    path = Path(shutil.copy(seeds() / "a.nmea", folder))
    spoilt(path, mutators.NMEA, chance)
    log = load(path, "nmea")
    sane(log)
    places = set()
    for raw in re.split(rb"[\r\n]+", path.read_bytes()):
        found = re.search(rb"\$(..GGA,[^*$]*)\*([0-9A-Fa-f]{2})", raw)
        if found and reduce(xor, found[1]) == int(found[2], 16):
            cells = found[1].decode("utf-8", "replace").split(",")
            with contextlib.suppress(ValueError, IndexError):
                lat, lon = (float(cells[k]) // 100 + float(cells[k]) % 100 / 60 for k in (2, 4))
                places.add((round(lat if cells[3] == "N" else -lat, 6), round(lon if cells[5] == "E" else -lon, 6)))
    near = {(a + i * 1e-6, b + j * 1e-6) for a, b in places for i in (-1, 0, 1) for j in (-1, 0, 1)}
    near = {(round(a, 6), round(b, 6)) for a, b in near}
    for lat, lon in np.degrees(log.gnss.llh[:, :2]).tolist():
        insist((round(lat, 6), round(lon, 6)) in near, f"a fix at {lat}, {lon} that no sound sentence has")


def of_ubx(folder: Path, chance: random.Random) -> None:
    path = Path(shutil.copy(seeds() / "a.ubx", folder))
    spoilt(path, mutators.UBX, chance)
    log = load(path, "ubx")
    sane(log)
    data, there = path.read_bytes(), set()
    for found in re.finditer(rb"(?=\xb5\x62\x01\x07)", data):
        at = found.start() + 2
        size = int.from_bytes(data[at + 2 : at + 4], "little")
        body, sums = data[at : at + 4 + size], data[at + 4 + size : at + 6 + size]
        a = b = 0
        for byte in body:
            a = (a + byte) & 255
            b = (b + a) & 255
        if sums == bytes([a, b]) and size >= 84:
            lon, lat = np.frombuffer(body[28:36], "<i4").tolist()
            there.add((lat, lon))
    for lat, lon in np.round(np.degrees(log.gnss.llh[:, :2]) * 1e7).astype(int).tolist():
        insist((lat, lon) in there, f"a fix at {lat}, {lon} that no sound message has")


def of_ubx_sensors(folder: Path, chance: random.Random) -> None:
    path = Path(shutil.copy(seeds() / "b.ubx", folder))
    spoilt(path, mutators.UBX, chance)
    sane(load(path, "ubx"))


def of_kitti(folder: Path, chance: random.Random) -> None:
    shutil.copytree(seeds() / "raw", folder / "raw")
    files = sorted((folder / "raw").rglob("*.txt"))
    spoilt(chance.choice([*files[:5], files[-1]]), mutators.TEXT, chance)
    sane(load(folder / "raw", "kitti-raw"))


def of_trajectory(folder: Path, chance: random.Random) -> None:
    """Positions of a trajectory stand in its file, packed or not."""
    name = chance.choice(("t.csv", "t.tum", "t.nav", "a.pos"))
    path = Path(shutil.copy(seeds() / name, folder))
    spoilt(path, mutators.TABLE if name == "t.csv" else mutators.TEXT, chance)
    plain = path.read_bytes()
    if chance.random() < 0.2:
        data = path.read_bytes()
        path = path.with_name(path.name + ".gz")
        path.write_bytes(mutators.packed(data, chance))
    track = read_trajectory(path)
    insist(bool(np.all(np.diff(track.t) > 0)), "times do not ascend")
    usable = np.isfinite(track.llh[:, :2])
    insist(bool(usable.all()), "positions that are not finite")
    scale = 180.0 / np.pi if track.frame == "geodetic" else 1.0
    stand_in(track.llh[:, :2] * scale, plain)


def of_raw_gnss(folder: Path, chance: random.Random) -> None:
    """RINEX, SP3, clocks and raw UBX: codes stand in the file, and places are numbers."""
    raw_cases.of_raw(folder, chance, seeds(), insist, stand_in)


def of_evaluation(folder: Path, chance: random.Random) -> None:
    path = Path(shutil.copy(seeds() / chance.choice(("t.csv", "t.tum", "t.nav")), folder))
    spoilt(path, mutators.TEXT, chance)
    values = json.loads(commanded("evaluate", path, seeds() / "t.csv", "--json"))
    insist(isinstance(values, dict), "no table")


def of_export(folder: Path, chance: random.Random) -> None:
    path = Path(shutil.copy(seeds() / "t.csv", folder))
    spoilt(path, mutators.TABLE, chance)
    kind = chance.choice(("gpx", "nav", "nmea", "tum", "kml", "csv"))
    clock = chance.choice(([], ["--clock", "unix"], ["--clock", "gps week 2313"], ["--clock", nasty_word(chance)]))
    rate = chance.choice(([], [], ["--rate", nasty_word(chance)]))
    commanded("convert", path, "-o", folder / f"out.{kind}", *clock, *rate)


def of_draft(folder: Path, chance: random.Random) -> None:
    """`init` on spoilt tables drafts a description that can be read, or says why not."""
    shutil.copytree(seeds() / "own", folder / "own")
    names = ("imu.csv", "gnss.csv", "odometer.csv")
    spoilt(folder / "own" / chance.choice(names), mutators.TABLE, chance)
    out = folder / "own" / "new.toml"
    commanded("init", *(folder / "own" / name for name in names), "-o", out)
    read_description(out)


def of_solution(folder: Path, chance: random.Random) -> None:
    """Single absurd cells in a drive that is solved: where the answer is off by more than it says, it warns."""
    shutil.copytree(seeds() / "own", folder / "own")
    path = folder / "own" / chance.choice(("imu.csv", "gnss.csv", "odometer.csv"))
    spoilt(path, (mutators.cell, mutators.cell, mutators.lines_moved, mutators.column), chance)
    recording = read(folder / "own")
    found = run(recording, QUICK, ("ekf",))["ekf"]
    truth = drive()[1]
    track = found.trajectory()
    insist(bool(np.isfinite(track.llh).all() and np.isfinite(track.sd_p).all()), "states that are not finite")
    if recording.gnss is None:
        return
    error = off(track, truth)
    most = float(np.max(np.abs(error) / track.sd_p)) if len(error) else 0.0
    insist(most < 20.0 or bool(recording.remarks) or bool(found.notes), f"{most:.0f} sigma off and nothing is said")


def off(track: Trajectory, truth: Trajectory) -> np.ndarray:
    """Errors (K, 3) m, east, north, up."""
    scale = np.array([6.378e6 * np.cos(truth.llh[0, 0]), 6.378e6, 1.0])
    true = np.stack([np.interp(track.t, truth.t, truth.llh[:, k]) for k in (1, 0, 2)], -1)
    return (track.llh[:, [1, 0, 2]] - true) * scale


@cache
def live() -> tuple[str, ...]:
    recording, _ = drive()
    return tuple(line for _, line in format_lines(recording))


def of_stream(folder: Path, chance: random.Random) -> None:
    """A live session: absurd, late, doubled and lost lines neither end it nor move it."""
    session = Session(QUICK, "-", folder / "out")
    lines = mutators.stream(live(), chance)
    if chance.random() < 0.1:
        lines[0] = (
            mutators.value(lines[0].replace(", ", ",\n").encode(), chance).decode("utf-8", "replace").replace("\n", "")
        )
    try:
        session.add_lines(lines)
        session.finish()
    finally:
        session.close()
    if session.online is None:
        return
    insist(not session.online.failures, f"a piece was lost: {session.online.failures[:1]}")
    track = read_trajectory(folder / "out" / "trajectory.csv") if session.rows_settled else None
    if track is not None and session.online.clocks == 1:
        error = off(track, drive()[1])
        insist(float(np.abs(error).max()) < 5.0, f"{np.abs(error).max():.1f} m off")


def of_results(folder: Path, chance: random.Random) -> None:
    """What a run left, spoilt: its pages are drawn again from it, or it is refused."""
    (folder / "out").mkdir()
    path = Path(shutil.copy(seeds() / "out" / "run.npz", folder / "out"))
    path.write_bytes(mutators.results(path.read_bytes(), chance))
    commanded("report", folder / "out", "--quiet")


def of_usage(folder: Path, chance: random.Random) -> None:
    """Options that make no sense."""
    command = chance.choice(
        ("info", "smooth", "compare", "detect", "evaluate", "convert", "allan", "settings", "simulate")
    )
    options = ["--rate", "--start", "--end", "--without", "--solver", "--solvers", "--export", "--point", "--require",
               "--noise", "--profile", "--config", "--clock", "--format", "--set", "--seed", "-o"]  # fmt: skip
    arguments: list[str] = [command, chance.choice((str(seeds() / "absent"), nasty_word(chance)))]
    for one in chance.sample(options, chance.choice((1, 2, 3))):
        arguments += [one, str(folder / "out") if one == "-o" else nasty_word(chance)]
    if command == "simulate":
        arguments += ["--list"]
    commanded(*arguments)


def nasty_word(chance: random.Random) -> str:
    return mutators.nasty(chance) or "x"


def stand_in(values: np.ndarray, source: Path | bytes) -> None:
    """Every value is one of the numbers in a file, but for the rounding of a turn from degrees and back."""
    text = (source if isinstance(source, bytes) else source.read_bytes()).decode("utf-8", "replace")
    there = np.unique([float(one) for one in _PLAIN.findall(text)])
    there = there[np.isfinite(there)]
    x = np.ravel(values)
    k = np.searchsorted(there, x)
    near = np.minimum(np.abs(there[np.clip(k, 0, len(there) - 1)] - x), np.abs(there[np.clip(k - 1, 0, None)] - x))
    wrong = near > 1e-13 * np.maximum(np.abs(x), 1.0)
    insist(not wrong.any(), f"{x[wrong][:1]} does not stand in the file")


def sane(log: Any) -> None:
    """What holds of any log."""
    for name in ("imu", "gnss", "odometer", "truth"):
        sensor = getattr(log, name)
        if sensor is not None and len(sensor.t):
            insist(bool(np.isfinite(sensor.t).all() and (np.diff(sensor.t) > 0).all()), f"{name}: times")
    if log.imu is not None:
        insist(bool(np.isfinite(log.imu.gyro).all() and np.isfinite(log.imu.accel).all()), "IMU not finite")
        insist(all(0 < x < np.inf for x in vars(log.imu.noise).values() if x), "noise figures")
    if log.gnss is not None:
        llh, sd = log.gnss.llh, log.gnss.sd
        insist(bool(np.isfinite(llh).all() and (np.abs(llh[:, 0]) <= np.pi / 2).all()), "positions")
        insist(bool(np.isfinite(sd).all() and (sd > 0).all()), "sigmas")
        insist(bool(np.isfinite(log.gnss.lever_arm).all()), "lever arm")


TARGETS: dict[str, tuple[Callable[[Path, random.Random], None], int]] = {
    "recording": (of_recording, 28), "description": (of_description, 16), "info": (of_info, 3),
    "settings": (of_settings, 28), "noise": (of_noise, 16), "kf-gins": (of_kf_gins, 20), "rtklib": (of_rtklib, 10),
    "nmea": (of_nmea, 16), "ubx": (of_ubx, 16), "ubx sensors": (of_ubx_sensors, 1), "kitti-raw": (of_kitti, 8),
    "trajectory": (of_trajectory, 24), "evaluation": (of_evaluation, 8), "export": (of_export, 8),
    "draft": (of_draft, 2), "usage": (of_usage, 10), "solution": (of_solution, 1), "stream": (of_stream, 1),
    "raw gnss": (of_raw_gnss, 16), "results": (of_results, 8),
}  # fmt: skip


def target_of(number: int) -> str:
    """The target of a case: in turn, each as often as it weighs."""
    every = [name for name, (_, weight) in TARGETS.items() for _ in range(weight)]
    return every[number % len(every)]


def prepare() -> None:
    """Make the seeds, which is no work of the case that happens to be the first."""
    raw_cases.write_seeds(seeds() / "raw-gnss")


def play(number: int, folder: Path, target: str | None = None) -> Result:
    """Run one case in a folder of its own, which is taken away again."""
    target = target or target_of(number)
    at = folder / f"case-{number}"
    at.mkdir()
    chance = random.Random(f"{target} {number}")
    prepare()
    before = [signal.signal(what, _stop) for what in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of work, which other programs do not lengthen
    signal.setitimer(signal.ITIMER_REAL, 10.0 * SECONDS)  # of waiting for what never comes
    began = time.process_time()
    kind, said = "right", ""
    try:
        TARGETS[target][0](at, chance)
    except GraphnavError as error:
        kind, said = "refused", str(error)
        if "\n" in said or len(said) > _LONGEST or not said:
            kind = "traceback"
    except _Hang:
        kind, said = "hang", "".join(traceback.format_stack()[-3:])
    except Wrong as error:
        kind, said = "silent wrong", str(error)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        kind, said = "traceback", "".join(traceback.format_exception(error))[-1500:]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for what, handler in zip((signal.SIGPROF, signal.SIGALRM), before, strict=True):
            signal.signal(what, handler)
        shutil.rmtree(at, ignore_errors=True)
    return Result(target, number, kind, said, time.process_time() - began)


def _stop(*_: object) -> None:
    raise _Hang
