"""Other conventions of a trajectory than graphnav's, seen where it is compared with another of the same drive."""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import fit_yaw, make_yaw_matrix
from graphnav.core.notes import Note
from graphnav.core.rotation import Array

_OTHER_AXES = np.radians(30.0)  # a twelfth of a turn; right, forward and up are a quarter from each other
_TURNED = np.radians(15.0)  # half of that
_LONGEST_ARM = 5.0  # m; a lever arm on a vehicle is shorter, the geoid mostly farther from the ellipsoid
_SCATTER = 0.1  # share of a constant offset below which its scatter shows that it is one
_MENDED = 0.3  # ratio of the residuals of two fits below which the second is the right one


def find_other_axes(theirs: Array, ours: Array, sigma: Array | None = None) -> list[Note]:
    """A note where attitudes `theirs` (N, 3, 3) are those of a body with other axes than `ours`, or no attitudes.

    Both turn vectors of the body into one frame; rows with NaN are unknown. What a heading may be off by its `sigma`
    (N,), rad, tells nothing.
    """
    turn = np.swapaxes(ours, -1, -2) @ theirs
    turn = turn[np.isfinite(turn).all(axis=(1, 2))]
    if not len(turn):
        return []
    angle = float(np.median(np.linalg.norm(rotation.log(turn), axis=1)))
    if angle < max(_OTHER_AXES, 0.0 if sigma is None else 3.0 * float(np.median(sigma))):
        return []
    words = "another unit of angles, sense of the heading, or order of a quaternion"
    nearest = np.round(np.median(turn, axis=0))
    if abs(np.linalg.det(nearest)) == 1.0:
        left = np.linalg.norm(rotation.log(turn @ nearest.T), axis=1)
        if float(np.median(left)) < _TURNED:
            letters = "".join(("RFU" if axis.sum() > 0.0 else "LBD")[int(np.abs(axis).argmax())] for axis in nearest.T)
            words = f"of a body whose axes are {letters}, not RFU"
    return [Note("against.attitude", f"the attitude is {np.degrees(angle):.0f} deg off in the median: {words}")]


def find_other_heights(up: Array) -> list[Note]:
    """A note where height errors (N,) m are one constant, as of heights above the sea beside those of the ellipsoid."""
    up = up[np.isfinite(up)]
    if not len(up):
        return []
    offset = float(np.median(up))
    if abs(offset) < _LONGEST_ARM or float(np.median(np.abs(up - offset))) > _SCATTER * abs(offset):
        return []
    words = "one is above the sea, the other above the ellipsoid"
    return [Note("against.heights", f"the heights are {offset:+.0f} m off throughout: {words}?")]


def require_right_handed(name: str, source: Array, target: Array) -> None:
    """Refuse points (N, 3) of a local frame that fit others (N, 3) only where x and y are exchanged.

    Raises
    ------
    RecordingError
        Saying so.
    """

    def miss(points: Array) -> float:
        yaw, offset = fit_yaw(points, target)
        left = (points @ make_yaw_matrix(yaw).T + offset - target)[:, :2]
        return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))

    as_it_is, exchanged = miss(source), miss(source[:, [1, 0, 2]])
    if exchanged < _MENDED * as_it_is:
        raise RecordingError(
            f"{name}: x and y are exchanged ({as_it_is:.2f} m from the other as they are, {exchanged:.2f} m so): x is "
            "north and y east, as in north-east-down; write x east, y north, z up",
            key="against.left_handed",
        )
