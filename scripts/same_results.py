"""Whether this code gives the same trajectories as that of another commit, bit for bit, as it must after a move.

    python scripts/same_results.py b95d345 kitti data/tokyo data/kamakura_rtk
    python scripts/same_results.py f6b2e2d^ --with f6b2e2d kitti data/tokyo --end 60

Each recording is solved by the filter, the smoother and batch with the program of either commit, in processes of their
own, by `graphnav compare`; and trajectory.csv of every solver is compared byte by byte. Leaves with 1 if any differs.
"""

from __future__ import annotations

import argparse
import io
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOLVERS = ("ekf", "rts", "batch")


def unpack(commit: str, folder: Path) -> Path:
    """The package of a commit, in a folder to be put on PYTHONPATH."""
    packed = subprocess.run(["git", "archive", commit, "graphnav"], cwd=ROOT, capture_output=True, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as tree:
        tree.extractall(folder, filter="data")
    return folder


def solve(code: Path, source: str, more: list[str], out: Path) -> dict[str, bytes]:
    """The trajectory of each solver as one tree's code writes it."""
    # -P: the folder it runs in, which is this tree, would come before PYTHONPATH
    command = [
        sys.executable,
        "-P",
        "-m",
        "graphnav",
        "compare",
        source,
        "--solvers",
        ",".join(SOLVERS),
        "-o",
        str(out),
    ]
    environment = {**os.environ, "PYTHONPATH": str(code), "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([*command, "--quiet", *more], check=True, env=environment, cwd=ROOT)
    return {name: (out / name / "trajectory.csv").read_bytes() for name in SOLVERS}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="the code to compare with")
    parser.add_argument("recordings", nargs="+", help="as graphnav compare takes them")
    parser.add_argument("--with", dest="other", metavar="COMMIT", help="in place of the working tree")
    parser.add_argument("--end", help="s: only so much of each recording")
    options = parser.parse_args()
    more = ["--end", options.end] if options.end else []
    differ = 0
    with tempfile.TemporaryDirectory() as scratch:
        before = unpack(options.commit, Path(scratch) / "before")
        after = unpack(options.other, Path(scratch) / "after") if options.other else ROOT
        for k, source in enumerate(options.recordings):
            one, other = (
                solve(code, source, more, Path(scratch) / f"{name}-{k}")
                for name, code in (("before", before), ("after", after))
            )
            said = {name: "same" if one[name] == other[name] else "differs" for name in SOLVERS}
            differ += sum(one[name] != other[name] for name in SOLVERS)
            print(f"{source}: {', '.join(f'{name} {word}' for name, word in said.items())}", flush=True)
    return int(differ > 0)


if __name__ == "__main__":
    sys.exit(main())
