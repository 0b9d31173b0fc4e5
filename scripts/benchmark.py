"""How run time and memory grow with the length of a drive: graphnav compare on drives of several lengths.

The drives are exact laps of python-ins (see tests/oracle_path.py; the package's `dev` extra has it) with the errors
of a MEMS unit, fixes of 2 cm at 1 Hz with three 60-s outages an hour, and wheel speed. They are real recording
folders, so reading them counts. Those of more than three hours are solved in parts
(`graphnav.estimation.long_drives`). Every run is a process of its own, and its time and memory are what the operating
system says they were.

    python scripts/benchmark.py --hours 0.1667,1,4,12,24 --keep build/benchmark

With `--reading` the IMU's file of the first of them is read instead, plain and gzip-compressed, beside NumPy's reader,
which was in use before, and pyarrow's: processor time, and MB of text a second of it.

    python scripts/benchmark.py --hours 1 --reading
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle

from graphnav.recording.formats.decimals import read_decimals

RATE = 200.0  # Hz, of the IMU
LAP = 3600.0  # s; longer drives repeat a lap of this length


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", default="0.1667,1,4,12,24", help="lengths of the drives (%(default)s)")
    parser.add_argument("--solvers", default="ekf,rts,batch", help="as in graphnav compare (%(default)s)")
    parser.add_argument("--repeat", type=int, default=1, metavar="N", help="runs of each length; the fastest counts")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep drives and results here and use them again")
    parser.add_argument("--no-odometer", action="store_true", help="leave the wheel speed out of the drives")
    parser.add_argument("--reading", action="store_true", help="how long the IMU's file takes to be read")
    options = parser.parse_args()
    hours = [float(h) for h in options.hours.split(",")]
    with tempfile.TemporaryDirectory() as scratch:
        room = options.keep or Path(scratch)
        if options.reading:
            print(reading(build(room, hours[0], odometer=not options.no_odometer) / "imu.csv"))
            return
        runs = []
        for h in hours:
            folder = build(room, h, odometer=not options.no_odometer)
            print(f"{folder.name}: ready", file=sys.stderr)
            tries = [measure(folder, room / f"{folder.name}-out", h, options.solvers) for _ in range(options.repeat)]
            runs.append(min(tries, key=lambda run: run.wall))
            print(f"{folder.name}: {runs[-1].wall:.1f} s, {runs[-1].peak_mb:.0f} MB", file=sys.stderr)
    print(table(runs))


# ------------------------------------------------------------------------------------------------------------ drives
def build(room: Path, hours: float, odometer: bool = True) -> Path:
    """The recording folder of a drive of this length; one that is there already is used again."""
    seconds = 2 * round(hours * 1800)  # even, for the two halves of a lap
    folder = room / f"drive-{seconds}s{'' if odometer else '-no-odometer'}"
    if (folder / "recording.toml").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    laps = max(1, round(seconds / LAP))
    lap = oracle.vehicle_path(seconds / laps, RATE)
    path = lap.tiled(laps)
    spans = oracle.moving_spans(path, 60.0, max(1, round(3 * seconds / 3600)))
    recording, truth = oracle.drive(path, seed=1, outages=spans, odometer_rate=20.0 if odometer else None)
    imu, gnss = recording.imu, recording.gnss
    assert gnss is not None
    write(folder / "imu.csv", "t,gx,gy,gz,ax,ay,az", "%.3f" + 3 * ",%.8f" + 3 * ",%.6f", imu.t, imu.gyro, imu.accel)
    place = "%.3f,%.10f,%.10f,%.4f"
    write(folder / "gnss.csv", "t,lat,lon,h,sd_e,sd_n,sd_u", place + 3 * ",%.4f", gnss.t, degrees(gnss.llh), gnss.sd)
    if recording.odometer is not None:
        write(
            folder / "odometer.csv",
            "t,speed",
            "%.3f,%.4f",
            recording.odometer.t,
            np.round(recording.odometer.speed, 4) + 0.0,
        )
    tenth = truth.take(slice(None, None, round(RATE / 10)))
    assert tenth.v is not None
    assert tenth.rph is not None
    write(
        folder / "truth.csv",
        "t,lat,lon,h,ve,vn,vu,roll,pitch,heading",
        place + 3 * ",%.5f" + 3 * ",%.6f",
        tenth.t,
        degrees(tenth.llh),
        tenth.v,
        np.rad2deg(tenth.rph),
    )
    (folder / "recording.toml").write_text(description(recording), encoding="utf-8")  # last: the folder is complete
    return folder


def degrees(llh: oracle.Array) -> oracle.Array:
    return np.column_stack([np.rad2deg(llh[:, :2]), llh[:, 2]])


def write(path: Path, header: str, row: str, *columns: oracle.Array) -> None:
    """Rows by one format string for many at once, which is several times quicker than row by row."""
    values = np.column_stack(columns)
    with path.open("w", encoding="ascii") as file:
        file.write(header + "\n")
        for block in np.array_split(values, max(1, len(values) // 20_000)):
            file.write((row + "\n") * len(block) % tuple(block.ravel().tolist()))


def description(recording: oracle.Recording) -> str:
    noise = recording.imu.noise
    lines = ['format = "graphnav-recording/1"', f'name = "{recording.name}"', 'platform = "vehicle"', "", "[imu]"]
    lines += ['file = "imu.csv"', 'axes = "RFU"', "", "[imu.noise]"]
    lines += [f"{field.name} = {getattr(noise, field.name):.6e}" for field in fields(noise)]
    lines += ["", "[gnss]", 'file = "gnss.csv"', f"lever_arm = {list(oracle.LEVER_ARM)}"]
    if recording.odometer is not None:
        lines += ["", "[odometer]", 'file = "odometer.csv"', f"lever_arm = {list(oracle.AXLE)}", "scale_sigma = 0.02"]
    return "\n".join([*lines, "", "[truth]", 'file = "truth.csv"', ""])


# --------------------------------------------------------------------------------------------------------- measuring
# Linux counts the memory of the process that forked into a program's peak (getrusage(2): it survives execve), so a
# small interpreter of its own starts the program, not this one that has built the drives.
WATCH = """
import json, os, subprocess, sys, time
start = time.perf_counter()
process = subprocess.Popen(sys.argv[1:])
_, status, usage = os.wait4(process.pid, 0)
wall = time.perf_counter() - start
print(json.dumps([wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss]), flush=True)
sys.exit(0 if status == 0 else 1)
"""


def reading(plain: Path) -> str:
    """Markdown: a row per reader, for a file of numbers as it is and compressed."""
    packed = plain.with_suffix(".csv.gz")
    text = plain.read_bytes()
    packed.write_bytes(gzip.compress(text))
    head, _, _ = text.partition(b"\n")
    width = head.count(b",") + 1

    def whole_arrays(opened: Any) -> None:
        opened.readline()
        read_decimals(opened, width, range(width))

    def numpy_reader(opened: Any) -> None:
        np.loadtxt(io.StringIO(opened.read().decode()), delimiter=",", skiprows=1)

    def arrow(opened: Any) -> None:
        from pyarrow import csv

        csv.read_csv(io.BytesIO(opened.read()), read_options=csv.ReadOptions(use_threads=False))

    lines = ["| reader | .csv: s | MB/s | .csv.gz: s | MB/s |", "| --- | ---: | ---: | ---: | ---: |"]
    readers: dict[str, Callable[[Any], None]] = {"whole arrays": whole_arrays, "NumPy's": numpy_reader}
    readers |= {"pyarrow's": arrow} if find_spec("pyarrow") else {}
    for name, read in readers.items():
        seconds = []
        for path, opener in ((plain, open), (packed, gzip.open)):
            tries = []
            for _ in range(3):
                began = time.process_time()
                with opener(path, "rb") as opened:
                    read(opened)
                tries.append(time.process_time() - began)
            seconds.append(min(tries))
        cells = " | ".join(f"{s:.2f} | {len(text) / 1e6 / s:.0f}" for s in seconds)
        lines.append(f"| {name} | {cells} |")
    return "\n".join(lines)


@dataclass(frozen=True)
class Run:
    """One run of the program on one drive."""

    hours: float
    wall: float  # s
    cpu: float  # s, user and system
    peak_mb: float
    summaries: dict[str, dict[str, Any]]  # by solver, as the program wrote them


def measure(folder: Path, out: Path, hours: float, solvers: str) -> Run:
    """Run the program and wait for it; its own times by stage are read from what it wrote."""
    program = Path(sys.executable).with_name("graphnav")  # the one installed beside this interpreter
    command = [str(program), "compare", str(folder), "-o", str(out), "--solvers", solvers, "--quiet"]
    watched = subprocess.run([sys.executable, "-I", "-c", WATCH, *command], capture_output=True, text=True, check=False)
    if watched.returncode != 0:
        sys.exit(f"{' '.join(command)} failed: {(watched.stdout + watched.stderr)[-2000:]}")
    wall, cpu, maxrss = json.loads(watched.stdout.splitlines()[-1])
    summaries = {
        solver: json.loads((out / solver / "summary.json").read_text(encoding="utf-8")) for solver in solvers.split(",")
    }
    per_mb = 1024.0**2 if sys.platform == "darwin" else 1024.0  # ru_maxrss is in bytes there, in KiB elsewhere
    return Run(hours, wall, cpu, maxrss / per_mb, summaries)


def table(runs: list[Run]) -> str:
    """Markdown: a row per stage, a column per length; in brackets the cost per hour of data over that of the first."""
    rows = [["stage", *(f"{run.hours:g} h" for run in runs)], ["---", *("---:" for _ in runs)]]

    def add(name: str, values: list[float | None], unit: str) -> None:
        first = values[0] / runs[0].hours if values[0] else None
        cells = []
        for run, value in zip(runs, values, strict=True):
            ratio = "" if not first or value is None else f" ({value / run.hours / first:.2f})"
            cells.append(
                "" if value is None else f"{value:.2f} {unit}{ratio}" if unit == "s" else f"{value:.0f} {unit}"
            )
        rows.append([name, *cells])

    add("whole process, wall", [run.wall for run in runs], "s")
    add("whole process, CPU", [run.cpu for run in runs], "s")
    add("peak memory", [run.peak_mb for run in runs], "MB")
    for solver in runs[0].summaries:
        stages = list(dict.fromkeys(s for run in runs for s in run.summaries[solver].get("timings", {})))
        for stage in stages:
            times = [run.summaries[solver].get("timings", {}).get(stage) for run in runs]
            add(f"{solver}: {stage}", times, "s")
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


if __name__ == "__main__":
    main()
