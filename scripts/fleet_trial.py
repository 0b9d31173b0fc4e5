"""A fleet that something happens to: `graphnav fleet` on simulated drives while its processes are ended.

Forty drives through simulated towns, each with five sets of sensors and faults: as it is, without odometer, with one
that reads double, with an antenna half a metre from where it is said to be, with fixes that are 20 m off for twenty
seconds. One recording is poisoned (a cell that is no number) and one is absurd (forces of 1e300). The program is ended
after a fifth of the drives and run again; then a process that solves is ended in the middle of a drive, and later one
is stopped, which is a drive that hangs. The third run has only the drives to solve that were lost.

With `--also` the recordings of a folder are solved among them.

With `--undisturbed` nothing happens to it: it is run with one process and again with two. What a second process costs
is in the processor time of both, which other programs on the machine change less than the wall time.

    python scripts/fleet_trial.py --keep build/fleet
    python scripts/fleet_trial.py --keep build/fleet --dask 2
    python scripts/fleet_trial.py --keep build/long --ways 12 --length 600 --options "" --also ../shared/data \
        --undisturbed
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import gzip
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.app.fleet.manifest import DriveOptions, read_drives
from graphnav.recording import Recording
from graphnav.recording.formats.writer import write_folder
from graphnav.simulation import simulate

WAYS = 40  # different drives, each with every one of
VARIANTS = ("as it is", "no odometer", "doubled odometer", "wrong arm", "wrong fixes")
LENGTH = 240.0  # s, the shortest town there is
# share of the drives that are done when the program is ended, when a process is, and when one is stopped
ENDED_AFTER, STOPPED_AFTER = (0.2, 0.6), 0.8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ways", type=int, default=WAYS, help="different drives; five times as many are solved")
    parser.add_argument("--length", type=float, default=LENGTH, help="s, of each drive (%(default)s)")
    parser.add_argument("--limit", type=float, default=60.0, help="s, that a drive may take (%(default)s)")
    parser.add_argument("--keep", type=Path, required=True, metavar="DIR", help="drives and results go here")
    parser.add_argument("--also", type=Path, metavar="DIR", help="recordings that are copied among the drives")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--dask", type=int, default=0, metavar="N", help="over a cluster of N workers on this machine")
    parser.add_argument("--options", default="--solver ekf --noise stated --end 60 --no-report", help="(%(default)s)")
    parser.add_argument("--undisturbed", action="store_true", help="on one process, then on two, and nothing else")
    options = parser.parse_args()
    drives = build(options.keep, options.ways, options.length)
    if options.also:
        shutil.copytree(options.also, drives / "also", dirs_exist_ok=True)
    out = options.keep / f"out-{options.processes}-{options.dask}"
    if out.exists():
        shutil.rmtree(out)
    command = [str(Path(sys.executable).with_name("graphnav")), "fleet", str(drives), "-o", str(out)]
    command += [*options.options.split(), "--limit", str(options.limit)]
    if options.undisturbed:
        runs = {n: run([*command, "--again", "--processes", str(n)], out) for n in (1, 2)}
        print(json.dumps({"processes": runs, **figures(out)}, indent=1))
        return
    count = len(read_drives(drives, DriveOptions()))
    with cluster(options.dask) as address:
        command += ["--scheduler", address] if address else ["--processes", str(options.processes)]
        first = run(command, out, {int(ENDED_AFTER[0] * count): end_all})
        second = run(command, out, {int(ENDED_AFTER[1] * count): end_one, int(STOPPED_AFTER * count): stop_one})
        third = run(command, out)
    print(json.dumps({"ended": first, "goes on": second, "again": third, **figures(out)}, indent=1))


# ------------------------------------------------------------------------------------------------------------ drives
def build(room: Path, ways: int, length: float) -> Path:
    """The folder of all recordings; one that is there already is used again."""
    drives = room / "drives"
    for seed in range(ways):
        if (drives / f"{seed:03d}-{VARIANTS[-1].replace(' ', '-')}" / "recording.toml").exists():
            continue
        town = "urban" if seed % 2 else "electric"
        gnss = "rtk" if seed % 4 < 2 else "single"
        one = simulate(
            town, seed, duration=length, tunnels=0, gnss=gnss, barometer=seed % 3 == 0, antennas=seed % 5 == 0
        )
        for name in VARIANTS:
            write_folder(vary(one.recording, name), drives / f"{seed:03d}-{name.replace(' ', '-')}")
    for name, column, text in (("poisoned", 1, "north"), ("absurd", 4, "1e300")):
        shutil.copytree(drives / "000-as-it-is", drives / name, dirs_exist_ok=True)
        spoil(drives / name, column, text)
    return drives


def vary(recording: Recording, name: str) -> Recording:
    """The recording with one of the sets of sensors and faults."""
    gnss, odometer = recording.gnss, recording.odometer
    assert gnss is not None
    assert odometer is not None
    if name == "no odometer":
        return recording.without("odometer")
    if name == "doubled odometer":
        speed = replace(odometer, speed=2.0 * odometer.speed, counted=None, pulse=None)
        return replace(recording, odometer=speed)
    if name == "wrong arm":
        return replace(recording, gnss=replace(gnss, lever_arm=gnss.lever_arm + np.array([0.0, 0.5, 0.0])))
    if name == "wrong fixes":
        llh = gnss.llh.copy()
        llh[np.abs(gnss.t - gnss.t[0] - 45.0) < 10.0, 0] += 20.0 / 6.37e6
        return replace(recording, gnss=replace(gnss, llh=llh))
    return recording


def spoil(folder: Path, column: int, text: str) -> None:
    """Every cell of a column of the IMU's file from the thousandth row on."""
    file = folder / "imu.csv.gz"
    lines = gzip.decompress(file.read_bytes()).decode().splitlines()
    for k in range(1000, len(lines)):
        cells = lines[k].split(",")
        cells[column] = text
        lines[k] = ",".join(cells)
    file.write_bytes(gzip.compress("\n".join(lines).encode()))


# ----------------------------------------------------------------------------------------------------------- running
def run(command: list[str], out: Path, events: dict[int, Callable[[Any], None]] | None = None) -> dict[str, Any]:
    """Run the program, and when so many drives have a row do something to it; what it took."""
    waiting = sorted((events or {}).items(), key=lambda event: event[0])
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    program = subprocess.Popen([*command, "--quiet"], stderr=subprocess.PIPE)
    while waiting and program.poll() is None:
        if len(list(out.glob("drives/*/drive.json"))) >= waiting[0][0]:
            waiting.pop(0)[1](program)
        time.sleep(0.2)
    error = program.stderr.read().decode() if program.stderr else ""
    program.wait()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = [json.loads(file.read_text(encoding="utf-8"))["row"] for file in out.glob("drives/*/drive.json")]
    return {
        "wall_s": round(time.perf_counter() - began, 1),
        "processor_s": round(used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime, 1),
        "ended_with": program.returncode,
        "error": error.strip(),
        "rows": dict(Counter(row["status"] for row in rows)),
    }


def end_all(program: subprocess.Popen[bytes]) -> None:
    """End the program as the system would that is out of memory."""
    program.kill()


def end_one(program: subprocess.Popen[bytes]) -> None:
    """End one of the processes that solve, of the program or of Dask's workers."""
    _signal_worker(program, signal.SIGKILL)


def stop_one(program: subprocess.Popen[bytes]) -> None:
    """Let one of them stand still in the middle of its drive."""
    _signal_worker(program, signal.SIGSTOP)


def _signal_worker(program: subprocess.Popen[bytes], what: signal.Signals) -> None:
    own = [int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit() and _is_worker(p, program.pid)]
    if own:
        os.kill(own[-1], what)


def _is_worker(process: Path, parent: int) -> bool:
    try:
        words = (process / "cmdline").read_bytes().split(b"\0")
        above = int((process / "stat").read_text().rsplit(")", 1)[1].split()[1])
        mine = above == parent or _is_below(above, os.getpid())
    except (OSError, IndexError):
        return False
    return mine and b"graphnav.app.fleet.worker" in words


def _is_below(process: int, ancestor: int) -> bool:
    while process > 1 and process != ancestor:
        process = int(Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[1])
    return process == ancestor


@contextlib.contextmanager
def cluster(workers: int) -> Any:
    """The address of a Dask cluster on the loopback; None where none is asked for."""
    if not workers:
        yield None
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)]
    work = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1", "--nthreads", "1"]
    quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = [subprocess.Popen([*dask, "--no-dashboard", "--no-show"], **quiet)]
    running += [subprocess.Popen([*work, "--no-dashboard"], **quiet) for _ in range(workers)]
    try:
        time.sleep(10.0)
        yield address
    finally:
        for process in running[::-1]:
            process.terminate()
        for process in running:
            process.wait()


# ----------------------------------------------------------------------------------------------------------- figures
def figures(out: Path) -> dict[str, Any]:
    """What the table of the fleet says, in short."""
    with (out / "fleet.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    done = [row for row in rows if row["status"] == "done"]
    times = [float(row["time_s"]) for row in done]
    size = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
    return {
        "drives": len(rows),
        "status": dict(Counter(row["status"] for row in rows)),
        "verdict": dict(Counter(f"{row['drive'].partition('-')[2]}: {row['verdict']}" for row in done)),
        "not_done": {row["drive"]: row["error"] for row in rows if row["status"] != "done"},
        "s_a_drive": {"median": float(np.median(times)), "sum": round(sum(times), 1)},
        "memory_mb": max(float(row["memory_mb"]) for row in done),
        "mb_of_results_a_drive": round(size / 1e6 / len(rows), 2),
    }


if __name__ == "__main__":
    main()
