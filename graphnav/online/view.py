"""Status of a running smoother in a few lines of text."""

from __future__ import annotations

import numpy as np

from graphnav.core.notes import format_count
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.solution import make_trajectory
from graphnav.online.session import Session


def view(session: Session, silent: float = 0.0) -> list[tuple[str, str]]:
    """Label and value of each line; `silent` is for how many seconds the source has sent nothing."""
    online = session.online
    if online is None:
        return [("status", "waiting for the first line")]
    sensors, tracker = online.sensors, online.tracker
    status = "done" if session.done else online.status
    lines = [("status", status + (f", the source is silent for {silent:.0f} s" if silent > 1.0 else ""))]
    lines += [(f.severity, f.sentence) for f in online.findings[:1]]
    if tracker is None or online.frame is None:
        since = sensors.imu.newest - float(sensors.imu.t[0]) if len(sensors.imu) else 0.0
        fixes = len(sensors.gnss)
        lines.append(
            (
                "rows so far",
                f"{since:.0f} s of IMU, {format_count(fixes, 'fix', 'fixes')}: "
                "needs motion and fixes to find its attitude",
            )
        )
    else:
        now = tracker.live(sensors)
        P = now.covariance[None]
        track = make_trajectory("live", online.frame, np.array([now.t]), now.state, P)
        assert track.v is not None
        assert track.rph is not None
        assert track.sd_p is not None
        assert track.sd_v is not None
        assert track.sd_rph is not None
        lat, lon = np.degrees(track.llh[0, :2])
        roll, pitch, heading = np.degrees(track.rph[0])
        sd = [*track.sd_p[0], float(np.degrees(track.sd_rph[0, 2]))]
        speed, climb = float(np.hypot(*track.v[0, :2])), float(track.v[0, 2])
        lines += [
            ("time", f"{now.t:.2f} s, {now.t - now.keyframe:.2f} s after the newest keyframe"),
            (
                "position",
                f"{lat:.8f} {lon:.8f} {track.llh[0, 2]:.2f} m   1-sigma {sd[0]:.3f} {sd[1]:.3f} {sd[2]:.3f} m",
            ),
            ("speed", f"{speed:.2f} m/s, up {climb:+.2f} m/s   1-sigma {track.sd_v[0].max():.3f} m/s"),
            ("attitude", f"roll {roll:.2f} pitch {pitch:.2f} heading {heading:.2f} deg   1-sigma {sd[3]:.3f} deg"),
            ("in force", ", ".join(tracker.in_force) or "nothing but the IMU"),
            ("last fix", f"{max(now.t - sensors.gnss.newest, 0.0):.1f} s ago" if len(sensors.gnss) else "none yet"),
            ("window", f"{len(tracker.window)} keyframes, {tracker.newest - tracker.head:.0f} s"),
            ("update", ", ".join(f"{name} {1e3 * s:.1f} ms" for name, s in tracker.seconds.items())),
        ]
    late, wrong = sum(online.late.values()), sum(fault.count for fault in online.excluded if fault.kind in FIXES)
    odd = {k: n for k, n in sensors.counts.items() if ":" in k}
    lines.append(("settled", f"{session.rows_settled} keyframes"))
    if late or wrong or odd or session.bad:
        remarks = [f"{late} late rows used"] * bool(late) + [f"{n} {k}" for k, n in sorted(odd.items())]
        remarks += [f"{format_count(wrong, 'wrong fix', 'wrong fixes')} left out"] * bool(wrong)
        remarks += [f"{format_count(session.bad, 'bad line')} ({session.complaints[0]})"] if session.complaints else []
        lines.append(("odd", ", ".join(remarks)))
    if online.failures:
        lines.append(("failed", f"{len(online.failures)} pieces, the last {online.failures[-1]}"))
    if notes := [note for note in online.notes if note not in [f.sentence for f in online.findings]]:
        lines.append(("note", notes[-1]))
    return lines
