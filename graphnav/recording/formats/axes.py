"""The axes of an IMU as descriptions state them: three letters, or two vectors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphnav.core.rotation import Array

_LETTERS = {"R": (1, 0, 0), "L": (-1, 0, 0), "F": (0, 1, 0), "B": (0, -1, 0), "U": (0, 0, 1), "D": (0, 0, -1)}


def parse_axes_letters(axes: str) -> Array:
    """R_bs of three letters stating the directions of the file's x, y, z; 'BRU': x backward, y right, z up."""
    if len(axes) != 3 or any(letter not in _LETTERS for letter in axes):
        raise ValueError("must be three capitals out of R/L, F/B, U/D, such as RFU, FLU or FRD")
    R_bs = np.array([_LETTERS[letter] for letter in axes], dtype=float).T
    determinant = np.linalg.det(R_bs)
    if abs(determinant) < 0.5:
        raise ValueError("must use one of R/L, one of F/B and one of U/D")
    if determinant < 0:
        flipped = axes[:2] + {"U": "D", "D": "U", "R": "L", "L": "R", "F": "B", "B": "F"}[axes[2]]
        raise ValueError(f"is a left-handed triple, which no sensor has; with z the other way it would be {flipped}")
    return R_bs


def parse_axes_vectors(forward: Sequence[float], up: Sequence[float]) -> Array:
    """R_bs of two vectors in the file's axes: up is kept, forward is made perpendicular to it."""
    f, u = np.asarray(forward, dtype=float), np.asarray(up, dtype=float)
    if np.linalg.norm(f) < 1e-6 or np.linalg.norm(u) < 1e-6:
        raise ValueError("forward and up must not be zero")
    f, u = f / np.linalg.norm(f), u / np.linalg.norm(u)
    square = f - (f @ u) * u
    # closer than 10 degrees, errors of up turn forward into noise
    if np.linalg.norm(square) < np.sin(np.radians(10.0)):
        raise ValueError("forward and up are nearly parallel")
    f = square / np.linalg.norm(square)
    return np.stack([np.cross(f, u), f, u])
