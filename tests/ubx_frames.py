"""u-blox messages of raw observations, made frame by frame."""

from __future__ import annotations

import struct

WEEK_NUMBER, TOW = 2200, 345678.0
# gnssId, svId, sigId and RINEX' names for them
MEASURED = [
    (0, 7, 0, "G07", "1C"), (0, 7, 3, "G07", "2L"), (2, 11, 0, "E11", "1C"), (2, 11, 6, "E11", "7Q"),
    (3, 23, 0, "C23", "2I"), (5, 2, 0, "J02", "1C"), (6, 5, 0, "R05", "1C"),
]  # fmt: skip


def frame(kind: tuple[int, int], payload: bytes) -> bytes:
    """A UBX message with its check sums."""
    body = bytes(kind) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes((a, b))


def rawx(tow: float, lock: int = 5000, status: int = 0x07) -> bytes:
    rows = b""
    for k, (gnss, sv, sig, _, _) in enumerate(MEASURED):
        rows += struct.pack(
            "<ddfBBBBHBBBBBB", 2.2e7 + 1000.0 * k + tow, 1.15e8 + 3.0 * k, -1234.5 + k, gnss, sv, sig, 9, lock, 40 + k,
            3, 2, 5, status, 0,
        )  # fmt: skip
    return frame((0x02, 0x15), struct.pack("<dHbBBBH", tow, WEEK_NUMBER, 18, len(MEASURED), 1, 1, 0) + rows)
