"""Two hours of a car and of a foot as live sessions that go wrong all the time, against the same that go well.

    python scripts/live_sessions.py car --hours 2
    python scripts/live_sessions.py foot --hours 2

Both sessions have the same drop-outs and the same steps of the clock. One has besides an absurd row every minute, rows
that are late and rows that come twice, and is killed (SIGKILL) five times and resumed, the sender beginning again a
little before where it was cut off. Each is `graphnav online` fed through a pipe, one after the other. Told are the
distance of what has settled at the same times, what was counted, and the memory of the process as it goes on.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import oracle  # noqa: E402

from graphnav.online import Row, list_rows  # noqa: E402
from graphnav.online.lines import END, format_head, format_line  # noqa: E402
from graphnav.recording import Recording  # noqa: E402
from graphnav.recording.formats.trajectories import read_trajectory  # noqa: E402
from graphnav.simulation import simulate  # noqa: E402

RATE = {"car": 50.0, "foot": 100.0}  # Hz
LAP = 600.0  # s
AGAIN = 4000  # lines that a sender begins earlier after it was cut off: what a pipe and a chunk hold at most
KILLS = 5
PORTION = 2000  # lines fed at once


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("who", choices=RATE)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lag", type=float, default=120.0, help="s (%(default)s)")
    parser.add_argument("-o", "--out", type=Path, help="folder to keep both sessions in")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    recording = made(options.who, 3600.0 * options.hours)
    rows = interrupted(list_rows(recording)[1], recording)
    plain = [format_line(row) for row in rows]
    hostile = [format_line(row) for row in spoilt(rows, rng)]
    head = format_head(recording)
    print(f"{options.who}: {len(plain)} rows, {len(hostile)} with those that are absurd or come twice", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        out = options.out or Path(folder)
        session(head, plain, out / "plain", [], options.lag)
        step = len(hostile) / (KILLS + 1)
        kills = sorted(int(step * (k - 1 + rng.uniform(0.7, 1.3))) for k in range(1, KILLS + 1))
        session(head, hostile, out / "hostile", kills, options.lag)
        return compare(out / "plain", out / "hostile")


def made(who: str, seconds: float) -> Recording:
    if who == "car":
        laps = max(1, round(seconds / LAP))
        path = oracle.vehicle_path(LAP, RATE[who]).tiled(laps)
        return oracle.drive(path, seed=1, odometer_rate=5.0)[0]
    return simulate("gait", 1, duration=seconds, rate=RATE[who]).recording


def interrupted(rows: list[Row], recording: Recording) -> list[Row]:
    """Fixes away for half a minute of every ten, the odometer too, and a clock set back at a third, ahead at two.

    Of an IMU that is alone a tenth of a second is away every ten minutes.
    """
    start, whole, out = recording.start, recording.duration, []
    alone = recording.gnss is None and recording.odometer is None
    for sensor, t, values in rows:
        since = t - start
        if 300.0 < since % 600.0 < (300.1 if alone else 330.0) and (alone or sensor != "imu"):
            continue
        step = 0.0 if since < whole / 3 else -1000.0 if since < 2 * whole / 3 else 2600.0
        out.append((sensor, t + step, values))
    return out


def spoilt(rows: list[Row], rng: random.Random) -> list[Row]:
    """An absurd row every minute, one that is late every 20 s and at steps of the clock, one twice every 10 s."""
    out: list[Row] = []
    late: list[tuple[int, Row]] = []
    minute, twenty, ten = 0.0, 0.0, 0.0
    fix = next((values for sensor, _, values in rows if sensor == "gnss"), None)
    slow = "imu" if fix is None else "gnss"  # whose rows are late
    blank, since, before = (float("nan"),) * 6, 0.0, rows[0][1]
    for k, row in enumerate(rows):
        sensor, t, _ = row
        since += min(max(t - before, 0.0), 1.0)
        if abs(t - before) > 60.0:
            twenty = since
        before = t
        if since >= minute:
            minute += 60.0
            imu = rng.choice((1e6, 1e300, -1e300, 80.0))
            wild: list[Row] = [("imu", t + 0.003, (0.0, 0.0, imu, 0.0, 0.0, 9.8)), ("imu", t + 1e6, (0.0,) * 6)]
            wild.append(("odometer", t, (rng.choice((1e300, -1e300, 200.0)), *blank[:5])))
            if fix is not None:
                wild.append(("gnss", t, (fix[0] + 0.1, *fix[1:])))
                wild.append(("gnss", t, (*fix[:3], rng.choice((1e-9, 1e300)), 1.0, 1.0, *blank)))
            out.append(rng.choice(wild))
        while late and late[0][0] <= k:
            out.append(late.pop(0)[1])
        if since >= twenty and sensor == slow:
            twenty = since + 20.0
            late.append((k + 60, row))
            continue
        out.append(row)
        if since >= ten:
            ten = since + 10.0
            out.append(row)
    return [*out, *(row for _, row in late)]


def session(head: str, lines: list[str], out: Path, kills: list[int], lag: float) -> None:
    """Feed a session, ended by hand after so many lines, and resumed."""
    began, at, seen = time.monotonic(), 0, []
    for number, end in enumerate([*kills, len(lines)]):
        process = start(out, number > 0, lag)
        assert process.stdin is not None
        if number == 0:
            process.stdin.write(head.encode() + b"\n")
        k = max(0, at - AGAIN)
        while k < end:
            block = lines[k : min(k + PORTION, end)]
            process.stdin.write("".join(line + "\n" for line in block).encode())
            k += len(block)
            seen.append(memory(process.pid))
        at = end
        if end < len(lines):
            process.stdin.flush()
            process.kill()
        else:
            process.stdin.write(END.encode() + b"\n")
            process.stdin.close()
        code = process.wait()
        if code != (-9 if end < len(lines) else 0):
            raise SystemExit(f"it ended with {code}")
        print(f"{out.name}: {'killed' if end < len(lines) else 'ended'} after {end} lines", flush=True)
    spread = [f"{seen[int(q * (len(seen) - 1))]:.0f}" for q in (0.1, 0.25, 0.5, 0.75, 0.9, 1.0)]
    print(f"{out.name}: {time.monotonic() - began:.0f} s, memory {' '.join(spread)} MB as it went on")
    print(f"{out.name}: {(out / 'summary.json').read_text()}")


def start(out: Path, resumed: bool, lag: float) -> subprocess.Popen[bytes]:
    more = ["--resume"] if resumed else []
    program = [sys.executable, "-m", "graphnav", "online", "-", "-o", str(out), "--quiet", "--lag", str(lag)]
    return subprocess.Popen([*program, *more], stdin=subprocess.PIPE)


def memory(pid: int) -> float:
    """Resident set of a process, MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return 0.0


def compare(plain: Path, hostile: Path) -> int:
    """Distances of what has settled at the same times, and 1 if some are more than a centimetre."""
    most, names = 0.0, sorted(path.name for path in plain.glob("trajectory*.csv"))
    if names != sorted(path.name for path in hostile.glob("trajectory*.csv")):
        print(f"files differ: {names}")
        return 1
    for name in names:
        one, other = read_trajectory(plain / name), read_trajectory(hostile / name)
        _, i, j = np.intersect1d(np.round(one.t, 4), np.round(other.t, 4), return_indices=True)
        scale = np.array([6.378e6, 6.378e6 * np.cos(one.llh[0, 0]), 1.0])
        away = np.linalg.norm((one.llh[i] - other.llh[j]) * scale, axis=1)
        most = max(most, float(away.max()))
        print(
            f"{name}: {len(one)} and {len(other)} states, {len(i)} at the same times; apart {np.median(away):.2g} m in "
            f"the median, {np.quantile(away, 0.99):.2g} in 99 %, {away.max():.2g} at most"
        )
    return int(most > 0.01)


if __name__ == "__main__":
    sys.exit(main())
