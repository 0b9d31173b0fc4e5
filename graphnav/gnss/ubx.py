"""u-blox logs: raw measurements of RXM-RAWX and navigation messages of RXM-SFRBX.

Layouts are those of u-blox's interface descriptions (M8, F9); `graphnav.gnss.messages` decodes the navigation messages.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.core.timescales import WEEK
from graphnav.gnss.ephemeris import Ephemerides
from graphnav.gnss.files import note_cut
from graphnav.gnss.messages import Decoder
from graphnav.gnss.series import Observations, drop_repeated
from graphnav.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SBAS, number_signal

SYNC = b"\xb5\x62"
_RAWX, _SFRBX = (0x02, 0x15), (0x02, 0x13)
_SYSTEM = {0: GPS, 1: SBAS, 2: GALILEO, 3: BEIDOU, 5: QZSS, 6: GLONASS, 7: NAVIC}  # gnssId
SIGNALS = {  # gnssId and sigId
    (0, 0): "1C", (0, 3): "2L", (0, 4): "2S", (0, 6): "5I", (0, 7): "5Q", (1, 0): "1C",
    (2, 0): "1C", (2, 1): "1B", (2, 3): "5I", (2, 4): "5Q", (2, 5): "7I", (2, 6): "7Q", (2, 8): "6B", (2, 9): "6C",
    (3, 0): "2I", (3, 1): "2I", (3, 2): "7I", (3, 3): "7I", (3, 4): "6I", (3, 5): "1P", (3, 6): "1D", (3, 7): "5P",
    (3, 8): "5D", (3, 10): "6I", (5, 0): "1C", (5, 1): "1Z", (5, 4): "2S", (5, 5): "2L", (5, 8): "5I", (5, 9): "5Q",
    (5, 12): "1E", (6, 0): "1C", (6, 2): "2C", (7, 0): "5A",
}  # fmt: skip
_ROW_TYPE = np.dtype(
    [
        ("code", "<f8"), ("carrier", "<f8"), ("doppler", "<f4"), ("gnss", "u1"), ("sv", "u1"), ("sig", "u1"),
        ("channel", "u1"), ("lock", "<u2"), ("cn0", "u1"), ("sd_code", "u1"), ("sd_carrier", "u1"),
        ("sd_doppler", "u1"), ("status", "u1"), ("reserved", "u1"),
    ]
)  # fmt: skip
_CODE_BIT, _CARRIER_BIT, _HALF_BIT = 1, 2, 4  # bits of the status: code valid, carrier valid, half cycle resolved


@dataclass
class _RawMessages:
    times: list[tuple[float, int]] = field(default_factory=list)  # of the epochs: s of the week, week
    rows: list[np.ndarray] = field(default_factory=list)
    frames: list[tuple[int, bytes]] = field(default_factory=list)  # SFRBX, and the epoch that precedes it
    broken: int = 0
    cut: bool = False


def is_ubx(data: bytes) -> bool:
    """Whether the first bytes of a log contain a frame of raw measurements."""
    head = data[: 1 << 18]
    return any(SYNC + bytes(kind) in head for kind in (_RAWX, _SFRBX))


def parse_ubx(data: bytes, path: Path) -> tuple[Observations, Ephemerides]:
    """Parse the observations of a log, and the broadcast ephemerides if it has any.

    Raises
    ------
    RecordingError
        If no raw measurements are in it.
    """
    found = _find_frames(data)
    if found.times and not any(len(rows) for rows in found.rows):
        raise RecordingError(f"{path}: its RXM-RAWX messages hold no measurements", key="raw.no_measurements")
    if not found.times:
        whole = f" that are whole, and {found.broken} broken" if found.broken else ""
        raise RecordingError(
            f"{path}: no RXM-RAWX messages{whole}; switch them on in the receiver", key="raw.no_messages"
        )
    remarks = Notes()
    if found.broken:
        remarks.add("raw.broken_records", f"{path.name}: {format_count(found.broken, 'broken frame')} skipped")
    if found.cut:
        remarks.append(note_cut(path.name, "message"))
    week0 = found.times[0][1]
    t_of = np.array([tow + WEEK * (week - week0) for tow, week in found.times])
    rows = np.concatenate(found.rows)
    t = np.repeat(t_of, [len(x) for x in found.rows])
    system = np.array([_SYSTEM.get(int(g), -1) for g in range(256)])[rows["gnss"]]
    names = {key: number_signal(name) for key, name in SIGNALS.items()}
    signal = np.full(len(rows), -1, dtype=np.int16)
    for (gnss, sig), one in names.items():
        signal[(rows["gnss"] == gnss) & (rows["sig"] == sig)] = one
    number = np.where(rows["gnss"] == 1, rows["sv"].astype(int) - 100, rows["sv"])
    known = (signal >= 0) & (system >= 0) & (number > 0) & (number < 100)  # 255: a satellite of GLONASS not known yet
    if not known.all():
        sentence = f"{format_count((~known).sum(), 'measurement')} of unknown signals or satellites left out"
        remarks.add("raw.unknown_signals", f"{path.name}: {sentence}")
    satellite = (100 * system + number).astype(np.int16)
    status, lock = rows["status"], rows["lock"] * 1e-3
    has_carrier = (status & _CARRIER_BIT > 0) & (rows["carrier"] != 0.0)
    obs = Observations(
        zero=WEEK * week0, t=t, satellite=satellite, signal=signal,
        code=np.where(status & _CODE_BIT > 0, rows["code"], np.nan),
        carrier=np.where(has_carrier, rows["carrier"], np.nan), doppler=rows["doppler"].astype(float),
        cn0=rows["cn0"].astype(float), slip=_find_lock_losses(t, satellite, signal, lock), half=status & _HALF_BIT == 0,
        lock=lock,
        channels={
            100 * GLONASS + int(r["sv"]): int(r["channel"]) - 7 for r in rows[(rows["gnss"] == 6) & known]
        } if (rows["gnss"] == 6).any() else {},
        files=(str(path),), remarks=tuple(remarks),
    )  # fmt: skip
    decoder = Decoder()
    for after, payload in found.frames:
        tow, week = found.times[max(after, 0)]
        decoder.add(payload, WEEK * week + tow)
    return drop_repeated(obs.take(known)), decoder.ephemerides


def _find_lock_losses(t: np.ndarray, satellite: np.ndarray, signal: np.ndarray, lock: np.ndarray) -> np.ndarray:
    """(N,) whether the lock time is shorter than the time since the previous epoch."""
    order = np.lexsort((t, signal, satellite))
    s, g, x, at = satellite[order], signal[order], lock[order], t[order]
    same = (np.diff(s) == 0) & (np.diff(g) == 0)
    full = x >= 64.5  # s, at which the lock time counter saturates
    lost = np.concatenate([[False], same & ((np.diff(x) < 0.0) | ((x[1:] + 1e-3 < np.diff(at)) & ~full[1:]))])
    out = np.zeros(len(t), dtype=bool)
    out[order] = lost | (x == 0.0)
    return out


def _find_frames(data: bytes) -> _RawMessages:
    """Find all messages in use, with checksums verified."""
    out = _RawMessages()
    at = data.find(SYNC)
    while at >= 0:
        if at + 8 > len(data):
            out.cut = True
            break
        kind = (data[at + 2], data[at + 3])
        size = int.from_bytes(data[at + 4 : at + 6], "little")
        end = at + 8 + size
        if kind not in (_RAWX, _SFRBX):
            # other messages are skipped whole if another frame or non-UBX data follows
            at = data.find(SYNC, end if data[end : end + 2] == SYNC else at + 2)
            continue
        if end > len(data):
            out.cut = True
            break
        if not _check_sums(data[at + 2 : end - 2], data[end - 2 : end]):
            out.broken += 1
            at = data.find(SYNC, at + 2)
            continue
        payload = data[at + 6 : end - 2]
        if kind == _RAWX and size >= 16 and size >= 16 + 32 * payload[11]:
            tow = float(np.frombuffer(payload[:8], "<f8")[0])
            week = int.from_bytes(payload[8:10], "little")
            if np.isfinite(tow) and 0.0 <= tow <= WEEK and week:
                out.times.append((tow, week))
                out.rows.append(np.frombuffer(payload, _ROW_TYPE, count=payload[11], offset=16))
        elif kind == _RAWX:
            out.broken += 1  # shorter than the measurements that it announces
        elif kind == _SFRBX:
            out.frames.append((len(out.times) - 1, payload))
        at = data.find(SYNC, end)
    out.frames = out.frames if out.times else []
    return out


def _check_sums(body: bytes, stated: bytes) -> bool:
    """Verify the Fletcher checksum of a frame."""
    x = np.frombuffer(body, dtype=np.uint8).astype(np.int64)
    return stated == bytes((int(x.sum()) & 0xFF, int(np.sum(x * np.arange(len(x), 0, -1))) & 0xFF))
