"""Spoil files of every kind in thousands of ways: does each end right, or with a sentence, soon and in little memory?

    python scripts/fuzz.py --cases 10000
    python scripts/fuzz.py --target nmea --cases 2000 --first 50000
    python scripts/fuzz.py --only 4711

Cases are those of tests/fuzz; a number is the same case every time. They run in a process of their own, which is
watched: one that does not come to an end is ended, and counts as a hang. Leaves with 1 if any case was a traceback, a
hang, or said something else than its file.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "fuzz"), str(ROOT / "tests" / "recording")]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

PATIENCE = 300.0  # s for a case that does not even hear its alarm


def main() -> int:
    import cases

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--target", choices=cases.TARGETS)
    parser.add_argument("--only", type=int, help="one case, with all that it says")
    options = parser.parse_args()
    if options.only is not None:
        with tempfile.TemporaryDirectory() as folder:
            found = cases.play(options.only, Path(folder), options.target)
            print(f"{found.target}: {found.kind} in {found.seconds:.2f} s\n{found.said}")
        return 0
    cases.prepare()  # which each worker has then
    table: dict[str, Counter[str]] = {}
    slowest, peak, next_case, last = 0.0, 0, options.first, options.first + options.cases
    began = time.monotonic()
    while next_case < last:
        here, there = multiprocessing.Pipe(duplex=False)
        worker = multiprocessing.get_context("fork").Process(target=work, args=(there, next_case, last, options.target))
        worker.start()
        there.close()
        while next_case < last:
            try:
                found, memory = here.recv() if here.poll(PATIENCE) else (None, 0)
            except EOFError:
                found, memory = None, 0
            if found is None:
                target = options.target or cases.target_of(next_case)
                ended = worker.exitcode if not worker.is_alive() else None
                found = cases.Result(target, next_case, "hang", f"ended by hand (exit code {ended})", PATIENCE)
            peak, slowest = max(peak, memory), max(slowest, found.seconds)
            table.setdefault(found.target, Counter())[found.kind] += 1
            if found.kind not in ("right", "refused"):
                print(f"case {found.number} ({found.target}): {found.kind}\n{found.said[-1200:]}\n", flush=True)
            next_case += 1
            if not memory:
                break
        worker.kill()
        worker.join()
    show(table, cases.KINDS)
    spent = time.monotonic() - began
    print(f"{options.cases} cases in {spent:.0f} s, the slowest {slowest:.1f} s, peak memory {peak / 1024:.0f} MB")
    return int(any(row[kind] for row in table.values() for kind in cases.KINDS[2:]))


def work(out: Connection, first: int, last: int, target: str | None) -> None:
    import cases

    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, last):
            found = cases.play(number, Path(folder), target)
            out.send((found, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))


def show(table: dict[str, Counter[str]], kinds: tuple[str, ...]) -> None:
    rows = [*sorted(table.items()), ("all", sum(table.values(), Counter()))]
    print(f"{'':<14}" + "".join(f"{kind:>14}" for kind in kinds))
    for name, row in rows:
        print(f"{name:<14}" + "".join(f"{row[kind]:>14}" for kind in kinds))


if __name__ == "__main__":
    sys.exit(main())
