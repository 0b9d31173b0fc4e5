"""The pieces of a recording between gaps of its IMU that are too long to bridge, each aligned and solved by itself."""

from __future__ import annotations

import itertools

import numpy as np

from graphnav.config import Settings
from graphnav.core.notes import Notes
from graphnav.recording import Recording

_SHORTEST_PIECE = 5.0  # s; a shorter piece between two cuts cannot be aligned


def split_pieces(recording: Recording, settings: Settings) -> tuple[list[Recording], Notes]:
    """The recording split at IMU gaps too long to bridge, and a note on each cut."""
    t = recording.imu.t
    cuts = np.flatnonzero(np.diff(t) > settings.keyframes.bridge)
    if not len(cuts):
        return [recording], Notes()
    notes = Notes()
    for i in cuts:
        gap = f"IMU gap of {t[i + 1] - t[i]:.1f} s at {t[i] - recording.start:.1f} s"
        notes.add("pieces.cut", f"{gap}: divided there, each part is solved by itself")
    edges = np.concatenate([[-1], cuts, [len(t) - 1]])
    pieces = []
    for lo, hi in itertools.pairwise(edges):
        begin, end = t[lo + 1] - recording.start, t[hi] - recording.start
        if end - begin < _SHORTEST_PIECE:
            notes.add(
                "pieces.too_short", f"{begin:.1f} to {end:.1f} s left out: too short between two gaps to be aligned"
            )
        else:
            pieces.append(recording.crop(begin - 1e-9, end + 1e-9))
    if len(pieces) > 1 and not recording.placed:
        sentence = "without fixes, position and heading count from zero again behind each gap of the IMU"
        notes.add("doubt.pieces", f"These {len(pieces)} parts are no single trajectory: {sentence}")
    return pieces, notes


def describe_span(recording: Recording, piece: Recording) -> str:
    """When a piece of a recording begins and ends, from its start."""
    return f"{piece.start - recording.start:.0f} to {piece.end - recording.start:.0f} s"
