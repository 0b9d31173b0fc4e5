"""Raw drives of the KITTI data set: a folder ``oxts`` with timestamps.txt and one file of 30 numbers per sample.

The numbers, in the order and with the meaning of the set's own dataformat.txt (Geiger et al., "Vision meets robotics:
the KITTI dataset", 2013): lat, lon (deg), alt (m), roll, pitch, yaw (rad, of a forward-left-up body, yaw
anticlockwise from east), vn, ve, vf, vl, vu (m/s), ax, ay, az (m/s2, with gravity, forward-left-up), af, al, au,
wx, wy, wz (rad/s), wf, wl, wu, position accuracy (m), velocity accuracy (m/s), and five of status.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import check_inside, parse_number
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Imu, Truth
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.recording.formats.places import is_on_earth
from graphnav.recording.formats.registry import Log, log_format
from graphnav.recording.formats.text import split_lines

_FIX_PERIOD = 1.0  # s; the smoothed positions of an INS, used more often, would count as independent fixes
_FIELDS = 30


def _find_oxts(path: Path) -> Path | None:
    """The folder that holds timestamps.txt and data, at or below `path`."""
    for folder in (path, path / "oxts", *sorted(path.glob("*/oxts"))):
        if (folder / "timestamps.txt").is_file() and (folder / "data").is_dir():
            return folder
    return None


def load(path: Path, allow_outside: bool = False) -> Log:
    """Read the IMU, positions and velocities of the INS once a second as fixes, and its whole solution as the truth.

    Parameters
    ----------
    allow_outside : whether its files may be links to somewhere else.

    Raises
    ------
    RecordingError
        Naming the file that cannot be used.
    """
    folder = _find_oxts(path)
    if folder is None:
        raise RecordingError(f"{path}: no KITTI folder 'oxts' with timestamps.txt and data in it", key="log.no_folder")
    remarks = Notes()
    samples = sorted((folder / "data").glob("*.txt"))
    if not allow_outside:
        check_inside([folder / "timestamps.txt", *samples], path)
    t, zero = _read_times(folder / "timestamps.txt")
    if len(samples) != len(t):
        raise RecordingError(
            f"{folder}: {len(t)} time stamps but {len(samples)} files in data", key="log.files_missing"
        )
    rows = np.array([_parse_row(file) for file in samples])
    for k in np.flatnonzero(~np.isfinite(rows).all(axis=1))[:1]:
        raise RecordingError(f"{samples[k]}, line 1: a number that is not finite", key="table.not_finite")
    for k in np.flatnonzero(~is_on_earth(np.radians(rows[:, 0]), np.radians(rows[:, 1]), rows[:, 2]))[:1]:
        raise RecordingError(
            f"{samples[k]}, line 1: lat, lon, alt of {rows[k, :3]} are nowhere on Earth", key="table.place"
        )
    order = np.argsort(t, kind="stable")
    if (np.diff(order) < 0).any():
        remarks.add(
            "log.rows_unordered", f"{format_count((np.diff(t) < 0).sum(), 'sample')} out of order sorted by time"
        )
    order = order[np.concatenate([[True], np.diff(t[order]) > 0])]
    if len(order) < len(t):
        remarks.add(
            "log.rows_repeated", f"{format_count(len(t) - len(order), 'sample')} with the time of another dropped"
        )
    t, rows = t[order], rows[order]
    R_bs = parse_axes_letters("FLU")
    llh = np.column_stack([np.radians(rows[:, :2]), rows[:, 2]])
    v = np.column_stack([rows[:, 7], rows[:, 6], rows[:, 10]])
    roll, pitch, yaw = rows[:, 3:6].T
    rph = np.column_stack([roll, -pitch, np.mod(0.5 * np.pi - yaw, 2 * np.pi)])
    _, fixes = np.unique(np.floor((t - t[0]) / _FIX_PERIOD + 1e-6), return_index=True)
    sd, sd_v = (np.repeat(rows[fixes, k, None], 3, 1) for k in (23, 24))
    if not ((sd > 0).all() and (sd_v > 0).all()):
        raise RecordingError(
            f"{samples[order[0]]}: accuracies (numbers 24 and 25) must be above zero", key="table.sigma"
        )
    remarks.add(
        "imu.read_as",
        "IMU: ax ay az and wx wy wz, forward-left-up, m/s2 with gravity and rad/s; noise figures are not stated",
    )
    remarks.add(
        "gnss.read_as",
        "GNSS: the position and velocity of the OXTS' own INS once a second, with its stated accuracies; they are of "
        "the IMU, so without a lever arm",
    )
    remarks.add(
        "truth.smoothed",
        "truth: the same INS at every sample, so errors against it at the fixes say little; withhold some",
    )
    remarks.add("odometer.not_a_wheel", "odometer: the INS' forward speed vf is not a wheel's and is left out")
    remarks.add("log.clock", f"clock: seconds since midnight of {zero} as in timestamps.txt")
    name = folder.parent.name if folder.name == "oxts" else folder.name
    return Log(
        name,
        Imu(t, rows[:, 17:20] @ R_bs.T, rows[:, 11:14] @ R_bs.T, R_bs=R_bs, noise_assumed=True),
        Gnss(t[fixes], llh[fixes], sd, v[fixes], sd_v),
        None,
        Truth(t, llh, v=v, rph=rph),
        files=(folder / "timestamps.txt",),
        remarks=tuple(remarks),
    )


def _read_times(path: Path) -> tuple[Array, str]:
    """Seconds since midnight of the first stamp, and that day."""
    stamps = []
    for number, line in enumerate(split_lines(path), 1):
        if line.strip():
            try:
                stamps.append(np.datetime64(line.strip().replace(" ", "T"), "ns"))
            except ValueError:
                raise RecordingError(
                    f"{path}, line {number}: '{line.strip()[:40]}' is not a date and time", key="table.date"
                ) from None
    if len(stamps) < 2:
        raise RecordingError(f"{path}: {len(stamps)} time stamps; a drive needs at least 2", key="table.few_rows")
    day = stamps[0].astype("datetime64[D]")
    return (np.array(stamps) - day) / np.timedelta64(1, "ns") * 1e-9, str(day)


def _parse_row(path: Path) -> list[float]:
    text = " ".join(split_lines(path))
    try:
        values = [parse_number(x) for x in text.split()]
    except ValueError:
        bad = next(x for x in text.split() if not _is_number(x))
        raise RecordingError(f"{path}, line 1: '{bad[:40]}' is not a number", key="table.cell") from None
    if len(values) != _FIELDS:
        raise RecordingError(f"{path}, line 1: {len(values)} numbers where {_FIELDS} were expected", key="table.fields")
    return values


def _is_number(text: str) -> bool:
    try:
        parse_number(text)
    except ValueError:
        return False
    return True


FORMAT = log_format(
    "kitti-raw", "a raw drive of KITTI, the folder with oxts in it", lambda p: _find_oxts(p) is not None, load
)
