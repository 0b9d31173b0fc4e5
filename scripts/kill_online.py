"""Kill the online smoother at random moments and resume it, over and over: does it end with the same trajectory?

    python scripts/kill_online.py ../shared/data/oracle_drive --kills 20

One run goes through undisturbed; then runs are killed with SIGKILL after a random time and resumed, and begin anew once
they come through, until there were as many kills as asked for. Each trajectory must be that of the first run: byte for
byte, and with --engine isam2, whose tree is made again from its rows, to a micrometre.
"""

from __future__ import annotations

import argparse
import io
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

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
        kills = same = runs = 0
        out = Path(folder) / "out"
        while kills < options.kills:
            shutil.rmtree(out, ignore_errors=True)
            resumed, ended = False, False
            while not ended:
                process = start(options.recording, out, resumed)
                try:
                    # the first moments go to Python itself; a run that is resumed has less before it
                    code = process.wait(rng.uniform(0.1, 0.6) * lasts if kills < options.kills else None)
                    if code:
                        raise SystemExit(f"it ended with {code}")
                    ended = True
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                    kills += 1
                    at = written(out)
                    lines = at.count(b"\n")
                    print(f"kill {kills}: {lines} lines were on disk", flush=True)
                    if not alike(at, whole):
                        raise SystemExit("these are not the lines of the undisturbed run") from None
                resumed = (out / "checkpoint").exists()
            runs += 1
            now = written(out)
            same += alike(now, whole) and now.count(b"\n") == whole.count(b"\n")
        print(f"{kills} kills in {runs} runs; {same} of {runs} trajectories are those of the undisturbed run")


def alike(text: bytes, whole: bytes) -> bool:
    """Whether some lines are the first of others."""
    if ENGINE == ["window"]:
        return whole.startswith(text)
    if text.count(b"\n") < 2:
        return True
    rows, others = (np.genfromtxt(io.BytesIO(x), delimiter=",", skip_header=1, ndmin=2) for x in (text, whole))
    return bool(np.all(np.abs(rows - others[: len(rows)])[:, :4] < [1e-9, 1e-11, 1e-11, 1e-6]))


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
