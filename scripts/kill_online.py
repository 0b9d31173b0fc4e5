"""Kill the online smoother at random moments and resume it, over and over: does it end with the same trajectory?

    python scripts/kill_online.py ../shared/data/oracle_drive --kills 20

One run goes through undisturbed; then runs are killed with SIGKILL and resumed, and begin anew once they come through,
until there were as many kills as asked for. A kill comes when a random number of rows have settled since the start or
the last kill, and up to a second after that; what was on disk must be the beginning of the first run, and each
trajectory the whole of it: byte for byte, and with --engine isam2, whose tree is made again from its rows, to the last
digit of a position.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

LAST_DIGIT = np.array([1e-11, 1e-11, 1e-5])  # deg, deg, m: a micrometre on the ground, ten in height
ENGINE: list[str] = []
MORE: list[str] = []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engine", choices=["window", "isam2"], default="window")
    parser.add_argument("--lag", type=float, help="s; a short one has rows settle on the way")
    options = parser.parse_args()
    ENGINE.append(options.engine)
    MORE.extend([] if options.lag is None else ["--lag", str(options.lag)])
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        whole = trajectory(options.recording, Path(folder) / "whole")
        lasts = time.monotonic() - began
        rows = whole.count(b"\n") - 1
        print(f"undisturbed: {rows} rows in {lasts:.1f} s", flush=True)
        allowed = 0.0 if options.engine == "window" else 1.0  # last digits
        kills = same = runs = 0
        apart, most, out = 0.0, 0, Path(folder) / "out"
        while kills < options.kills:
            shutil.rmtree(out, ignore_errors=True)
            resumed, settled, ended = False, 0, False
            while not ended:
                process = start(options.recording, out, resumed)
                left = rows - settled
                again = kills < options.kills and left > 0.1 * rows
                wanted = settled + rng.uniform(0.05, 0.3) * left if again else np.inf
                while process.poll() is None and written(out).count(b"\n") - 1 < wanted:
                    time.sleep(0.02)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    code = process.wait(rng.uniform(0.0, 1.0) if again else None)
                    if code:
                        raise SystemExit(f"it ended with {code}")
                    ended = True
                if not ended:
                    process.kill()
                    process.wait()
                    kills += 1
                at = written(out)
                settled = at.count(b"\n") - 1
                far, differ = difference(at, whole)
                apart, most = max(apart, far), max(most, differ)
                if not ended:
                    print(f"kill {kills}: {settled} rows were on disk, {differ} differ", flush=True)
                resumed = (out / "checkpoint").exists()
            runs += 1
            same += settled == rows and far <= allowed
        print(f"{kills} kills in {runs} runs; {same} of {runs} trajectories are those of the undisturbed run; ", end="")
        print(f"at most {most} rows of one differ, by {apart:.0f} of the last digits")
        if same < runs or apart > allowed:
            raise SystemExit(1)


def difference(text: bytes, whole: bytes) -> tuple[float, int]:
    """By how many last digits positions differ at most from the first ones of a run, and how many rows do at all.

    Infinitely many where times differ, or with the window a single byte; a last row may be torn.
    """
    if whole.startswith(text):
        return 0.0, 0
    rows, others = (
        np.genfromtxt(io.BytesIO(x[: x.rfind(b"\n")]), delimiter=",", skip_header=1, ndmin=2) for x in (text, whole)
    )
    if ENGINE == ["window"] or len(rows) > len(others) or np.any(rows[:, 0] != others[: len(rows), 0]):
        return np.inf, len(rows)
    digits = np.rint(np.abs(rows - others[: len(rows)])[:, 1:4] / LAST_DIGIT)
    return float(digits.max()), int(np.sum(digits.any(axis=1)))


def start(recording: str, out: Path, resumed: bool) -> subprocess.Popen[bytes]:
    more = ["--resume"] if resumed else []
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "graphnav",
            "online",
            recording,
            "-o",
            str(out),
            "--quiet",
            "--engine",
            *ENGINE,
            *MORE,
            *more,
        ]
    )


def trajectory(recording: str, out: Path) -> bytes:
    if start(recording, out, False).wait():
        raise SystemExit("it does not come through undisturbed")
    return written(out)


def written(out: Path) -> bytes:
    path = out / "trajectory.csv"
    return path.read_bytes() if path.exists() else b""


if __name__ == "__main__":
    main()
