"""Checks of the IMU's axes, signs and scale against the drive."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from graphnav.core.findings import Finding
from graphnav.core.rotation import Array
from graphnav.recording import Imu
from graphnav.recording.checks import crosschecks, tilt
from graphnav.recording.checks.crosschecks import Fit
from graphnav.recording.checks.tilt import CORRELATED
from graphnav.recording.checks.tracks import Track
from graphnav.recording.formats import schema

_NO_BETTER = 0.05  # of a correlation
_ALIKE = 0.8  # correlation above which course and gyro show the same turns


def check_imu_axes(imu: Imu, forward: Fit | None, track: Track | None) -> Iterator[Finding]:
    """Axes that the drive contradicts: by the mean force, or by a forward force that fits another axis better."""
    up = crosschecks.find_up(imu)
    if up[2] > 0.8 and (forward is None or forward.correlation < CORRELATED):
        return
    if forward is None or forward.correlation < CORRELATED:
        yield Finding(
            "warning", f"the mean force points {_describe_direction(up)}, not up: are the axes right?", "imu.up"
        )
        return
    ahead = forward.coefficients / np.linalg.norm(forward.coefficients)
    if up[2] > 0.8 and ahead[1] > CORRELATED:
        return
    along = crosschecks.fit_along(imu, track) if up[2] > 0.8 and track is not None else None
    # the proposed axes explain no more than the stated ones: without changes of speed and turns no direction is
    # observable
    if along is not None and along.coefficients[0] > 0.5 and along.correlation > forward.correlation - _NO_BETTER:
        return
    letters = write_letters(imu.R_bs, ahead, up)
    hint = f'; axes = "{letters}" would agree' if letters else ""
    yield Finding(
        "warning",
        f"the axes disagree with the motion: forward by GNSS speed is {_describe_direction(ahead)}, up by gravity is "
        f"{_describe_direction(up)} in the axes stated{hint}",
        "imu.axes",
    )


def _describe_direction(v: Array) -> str:
    names = (("left", "right"), ("backward", "forward"), ("down", "up"))
    k = int(np.argmax(np.abs(v)))
    return names[k][int(v[k] > 0)]


def _name_column(imu: Imu, axis: int) -> str:
    """The file's column of which an axis of the body mostly consists: x, y or z."""
    return "xyz"[int(np.argmax(np.abs(imu.R_bs[axis])))]


def write_letters(R_bs: Array, forward: Array, up: Array) -> str | None:
    """The three letters of the axes with `forward` and `up` (body axes as loaded); None if none clearly fit."""
    f, u = R_bs.T @ forward, R_bs.T @ up  # in the file's axes
    if np.abs(f).max() < 0.8 or np.abs(u).max() < 0.8 or np.argmax(np.abs(f)) == np.argmax(np.abs(u)):
        return None
    unit = [np.sign(x) * (np.abs(x) == np.abs(x).max()) for x in (f, u)]
    rows = np.stack([np.cross(*unit), *unit])  # right, forward, up
    return "".join(
        "LBD"[k] if rows[k, axis] < 0 else "RFU"[k] for axis in range(3) for k in [np.argmax(np.abs(rows[:, axis]))]
    )


def check_forward_sign(imu: Imu, track: Track | None, forward: Fit | None) -> Iterator[Finding]:
    """The forward force decreases when the speed increases: one axis of the accelerometer is reversed, or all of the
    IMU.
    """
    up = crosschecks.find_up(imu)
    if track is None or forward is None or forward.correlation < CORRELATED or up[2] < 0.8:
        return
    ahead = forward.coefficients / np.linalg.norm(forward.coefficients)
    if ahead[1] > -CORRELATED:
        return
    along = f"the forward force falls when the speed rises (correlation {-forward.correlation:.2f})"
    if tilt.measure_sideways(imu, track) > 0.0:  # then this is no rotation: the other axes are right
        column = f"a{_name_column(imu, 1)}"
        yield Finding(
            "refused",
            f"{along} while the sideways force is right: the accelerometer's forward axis is reversed, which axes "
            f"in [imu] cannot express: negate {column} in the file",
            "imu.forward_reversed",
        )
        return
    for finding in check_imu_axes(imu, forward, track):
        yield Finding("refused", f"{along}: {finding.sentence}", "imu.axes_turned")


def turns_against(yaw: Fit | None) -> bool:
    """Whether the course turns as much as the gyro, and surely the other way.

    Courses of a few fixes, some of them wrong, are hardly correlated, but by their number they may show the sign.
    """
    if yaw is None or not yaw.coefficients[0] < 0.0:
        return False
    alike = tilt.NEAR_ONE[0] < -yaw.coefficients[0] < tilt.NEAR_ONE[1]
    return yaw.correlation > _ALIKE or (alike and tilt.SIGMAS * yaw.relative_sigma < 1.0)


def describe_reversal(imu: Imu) -> str:
    """That the accelerometer may be reversed, as those of some phones, and what to set then."""
    letters = write_letters(imu.R_bs, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    axes = f'axes = "{letters}"' if letters else "forward and up negated"
    return f"the accelerometer is reversed, as some phones': set {schema.REVERSED} in [imu], and {axes}"


def check_gyro_sign(imu: Imu, track: Track) -> Iterator[Finding]:
    """The gyro about the mean force turns opposite to the course: no choice of axes explains that.

    A vehicle that leans into its curves has no lateral force, so which of the two is mirrored remains open.
    """
    if crosschecks.find_up(imu)[2] < 0:
        alone = tilt.measure_sideways(imu, track) > 0.0  # its other axes agree with the gyro
        which = "accelerometer's vertical axis" if alone else "accelerometer's sign"
        what = f"the {which} is reversed (gyro and course contradict it), it must read +9.8 upward at rest"
        mend = "negate it in the file" if alone else f"set {schema.REVERSED} in [imu]"
        yield Finding("warning", f"{what}; {mend}", "imu.force_sign")
    elif not tilt.measure_sideways(imu, track):
        what = "the gyro turns against the GNSS course: its sign is reversed, or latitudes or longitudes have the wrong"
        mend = f"negate it, or them, in the file; or {describe_reversal(imu)}"
        yield Finding("warning", f"{what} sign (south and west are negative); {mend}", "imu.gyro_sign")
    else:
        what = "the gyro's sign is reversed: it turns against the GNSS course while gravity points as stated"
        yield Finding("warning", f"{what}; negate it in the file", "imu.gyro_sign")


def check_yaw_scale(yaw: Fit | None) -> Iterator[Finding]:
    """The course turns by another ratio than the gyro; that of a unit, with the interval of the fit, is refused."""
    if yaw is None or not yaw.correlation:
        return
    scale, least, most = abs(float(yaw.coefficients[0])), *tilt.NEAR_FACTOR
    spread = tilt.SIGMAS * yaw.relative_sigma
    for unit, words in (
        (np.degrees(1.0), "small for the GNSS course: it is in rad/s already, leave out units.gyro"),
        (np.radians(1.0), 'large for the GNSS course: set units = { gyro = "deg/s" }'),
    ):
        ratio = scale / unit
        sure = ratio * (1.0 - spread) > least and ratio * (1.0 + spread) < most
        if least < ratio < most and (sure or abs(yaw.correlation) > _ALIKE):
            yield Finding("refused" if sure else "warning", f"the gyro is 57 times too {words}", "imu.gyro_unit")
            return
    if abs(yaw.correlation) > _ALIKE and abs(scale - 1.0) > max(0.1, spread * scale):
        yield Finding(
            "warning", f"the course turns {scale:.2f} times as much as the gyro about the vertical", "imu.gyro_scale"
        )


def check_sideways(imu: Imu, forward: Fit | None, track: Track, yaw: Fit | None) -> Iterator[Finding]:
    """The force sideways points out of the curves that the gyro and, where `yaw` could be fitted, the course show."""
    side = tilt.measure_sideways(imu, track)
    if side >= 0.0:
        return
    if yaw is not None and (yaw.correlation < CORRELATED or yaw.coefficients[0] < 0.0):
        return
    up = crosschecks.find_up(imu)
    out = f"the force sideways is {side:.2f} times that which turn rate and speed require"
    if forward is not None and forward.correlation > CORRELATED and forward.coefficients[1] > 0.0:
        column = f"a{_name_column(imu, 0)}"
        yield Finding(
            "unreliable",
            f"{out} while the force forward is right: the accelerometer's right axis is reversed, which axes in "
            f"[imu] cannot express: negate {column} in the file",
            "imu.sideways_reversed",
        )
        return
    letters = write_letters(imu.R_bs, np.array([0.0, -1.0, 0.0]), up)
    hint = f' (axes = "{letters}" would agree)' if letters else ""
    yield Finding(
        "warning",
        f"{out}, and changes of speed do not show which: the IMU is mounted the other way round{hint}, an axis is "
        "reversed, or the vehicle drives backward",
        "imu.sideways_reversed",
    )


def check_gyro_tilt(imu: Imu, track: Track) -> Iterator[Finding]:
    """A gyro that pitches or rolls against the tilt that gravity shows, on a vehicle whose other axes are right.

    One that leans into its curves is not judged: its level turns are about all three axes.
    """
    if tilt.measure_sideways(imu, track) <= 0.0:
        return
    for axis, ((slope, sigma), turn) in enumerate(zip(tilt.fit_tilt(imu, track), ("pitches", "rolls"), strict=False)):
        if tilt.NEAR_ONE[0] < -slope < tilt.NEAR_ONE[1] and slope < -tilt.SIGMAS * sigma:
            column = f"g{_name_column(imu, axis)}"
            yield Finding(
                "unreliable",
                f"the gyro {turn} against the tilt that the accelerometer shows ({slope:.2f} +- {sigma:.2f} of it, not "
                f"1), while its turns are right: one axis is reversed; axes in [imu] cannot express that: negate "
                f"{column} in the file",
                "imu.gyro_axis_sign",
            )
