"""Kill the online smoother at random moments and resume it, over and over: does it end with the same trajectory?

    python scripts/kill_online.py ../shared/data/oracle_drive --kills 20

One run goes through undisturbed; then runs are killed with SIGKILL after a random time and resumed, and begin anew once
they come through, until there were as many kills as asked for. Each trajectory must be that of the first run, byte for
byte.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
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
                    if not whole.startswith(at):
                        raise SystemExit("these are not the lines of the undisturbed run") from None
                resumed = (out / "checkpoint").exists()
            runs += 1
            same += written(out) == whole
        print(f"{kills} kills in {runs} runs; {same} of {runs} trajectories are those of the undisturbed run")


def start(recording: str, out: Path, resumed: bool) -> subprocess.Popen[bytes]:
    more = ["--resume"] if resumed else []
    return subprocess.Popen([sys.executable, "-m", "graphnav", "online", recording, "-o", str(out), "--quiet", *more])


def trajectory(recording: str, out: Path) -> bytes:
    if start(recording, out, False).wait():
        raise SystemExit("it does not come through undisturbed")
    return written(out)


def written(out: Path) -> bytes:
    path = out / "trajectory.csv"
    return path.read_bytes() if path.exists() else b""


if __name__ == "__main__":
    main()
