"""Estimation of the antenna's lever arm from the drive, for comparison with the stated one.

A wrong lever arm, or one with a wrong sign, contradicts every turn: the fixes move about the IMU otherwise than stated.
The estimate is that of `gnss.lever_arm_sigma`, from the first part of the drive, with a very wide prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.vehicle import AXLE, Wheels
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.findings import Finding
from graphnav.core.progress import tell
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.contradictions import PRIOR_SIGMA, free
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import estimate_noise
from graphnav.estimation.noise.model import FreedConstant
from graphnav.estimation.noise.words import describe_turned_axes
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.problem import Problem, SolvedProblem, build_problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN, explain_singular
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.passes import SmootherPass, compute_sigmas, estimate_parameters, make_points
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.recording import Recording, take_rows
from graphnav.recording.checks.crosschecks import fit_forward
from graphnav.recording.checks.tilt import CORRELATED
from graphnav.recording.checks.tracks import compute_track

_PRECISE = 0.3  # m, 1-sigma of fixes that are precise enough
_LEAST_PART = 0.25  # m, of a component of an arm whose sign matters, or of its error: tape measures are better
_OPPOSITE = 0.5  # ratio of the distances of the estimate from the opposite sign and from the stated one
_PART = 240.0  # s
_FEWEST_FOR_ARM = 30  # fixes
_SURE_SIGMAS = 8.0  # 4 sigmas, doubled because errors of fixes are correlated for minutes
# Findings by which attitude, times or positions are wrong; lever arms cannot be assessed then.
_MENDED_FIRST = {
    "imu.axes", "imu.clock", "imu.contradicted", "imu.force_sign", "imu.gyro_axis_sign", "imu.gyro_fast",
    "imu.gyro_scale", "imu.gyro_sign", "imu.gyro_unit", "imu.sideways_reversed", "imu.up", "gnss.clock", "gnss.feet",
    "gnss.lat_lon", "gnss.mirrored", "gnss.velocity_axes", "gnss.velocity_down", "gnss.velocity_unit",
}  # fmt: skip


@dataclass(frozen=True)
class Antenna:
    """The position of the antenna relative to the IMU, right, forward, up."""

    stated: Array  # (3,) m
    found: Array  # (3,) m
    sigma: Array  # (3,) m, of `found`

    @property
    def agrees(self) -> bool:
        """Whether the drive is consistent with the stated lever arm."""
        return bool((np.abs(self.found - self.stated) <= _SURE_SIGMAS * self.sigma).all())

    @property
    def finding(self) -> Finding:
        """The comparison in a sentence."""
        found = ", ".join(f"{x:.2f} +- {s:.2f}" for x, s in zip(self.found, self.sigma, strict=True))
        stated = ", ".join(f"{x:.2f}" for x in self.stated)
        if self.agrees:
            return Finding(
                "note",
                f"antenna: the drive finds it at [{found}] m, which agrees with [{stated}] as stated",
                "gnss.lever_arm_agrees",
            )
        return Finding(
            "warning",
            f"antenna: the drive finds it at [{found}] m and not at [{stated}] as stated: look at lever_arm in [gnss] "
            "(right, forward, up of the IMU) and its signs, or let gnss.lever_arm_sigma estimate it",
            "gnss.lever_arm",
        )


def find_antenna(recording: Recording) -> Antenna:
    """Estimate the lever arm of the antenna.

    Raises
    ------
    EstimationError
        Without GNSS, or if the drive cannot be aligned.
    """
    return _estimate_antenna(recording)[0]


def find_wrong_arms(
    recording: Recording, findings: Sequence[Finding] = (), solved: Sequence[Callable[[], object]] = ()
) -> list[Finding]:
    """Findings on lever arms that the drive contradicts: components with the opposite sign; otherwise the antenna's.

    Only for a vehicle with sufficiently precise fixes, from the part of the drive with the most turning, and not
    where one of the `findings` is the cause, or where arms that are open stay at a solution's (`Solution.graphs`).
    """
    gnss = recording.gnss
    if gnss is None or not _tells_of_arms(recording, findings) or np.median(gnss.sd[:, :2]) > _PRECISE:
        return []
    if len(solved) == 1 and isinstance(solved[0], SolvedProblem) and _stay(recording, solved[0]):
        return []
    try:
        antenna, axle = _estimate_antenna(_find_turning(recording))
    except EstimationError:
        return []
    out = []
    for name, stated, found, sigma, parts in (
        ("gnss", antenna.stated, antenna.found, antenna.sigma, ("right", "forward", "up")),
        *((("odometer", *axle, ("forward",)),) if axle is not None else ()),
    ):
        sure = np.abs(found - stated) > _SURE_SIGMAS * sigma
        nearer = np.abs(found + stated) < _OPPOSITE * np.abs(found - stated)
        wrong = sure & (np.abs(stated) > _LEAST_PART) & (found * stated < 0.0) & nearer
        rest = np.abs(np.where(wrong, -stated, stated) - found) - _SURE_SIGMAS * sigma
        if (rest > _LEAST_PART).any():  # more than the signs is wrong
            continue
        for k in np.flatnonzero(wrong):
            out.append(
                Finding(
                    "warning",
                    f"the {parts[k]} part of lever_arm in [{name}] has the wrong sign: the drive finds {found[k]:+.2f} "
                    f"+- {sigma[k]:.2f} m where {stated[k]:+.2f} is stated (from the IMU)",
                    f"{name}.lever_arm_sign",
                )
            )
    if not out and not antenna.agrees and np.abs(antenna.found - antenna.stated).max() > _LEAST_PART:
        out.append(antenna.finding)
    return out


def _stay(recording: Recording, solved: SolvedProblem) -> bool:
    """Whether arms that are unknown stay, in a filter pass at the solution, much closer to what is stated than to
    anything that would be a finding.
    """
    assert recording.gnss is not None
    arm, wide = recording.gnss.lever_arm, PRIOR_SIGMA[LEVER_ARM]
    opened = free(solved.problem, {LEVER_ARM: FreedConstant(tuple(arm.tolist()), (wide,) * 3)})
    axle = Parameter(AXLE, np.zeros(1), np.full(1, wide), "m")
    rows = [_add_axle(one, axle) if isinstance(one, Wheels) else one for one in opened.constraints]
    opened = replace(opened, constraints=tuple(rows))
    asked = {LEVER_ARM: arm} if recording.odometer is None else {LEVER_ARM: arm, AXLE: np.zeros(1)}
    if not asked.keys() <= opened.parameters.keys():
        return False
    chains = [chain for chain in opened.chains if chain.parameter.name in solved.values]
    known = {c.parameter.name: solved.values[c.parameter.name][c.node] for c in chains}
    try:
        found = refilter(opened, make_points(opened, solved.states, known), whole=False).values[-1]
    except BREAKDOWN:
        return False
    off = [found[shift(opened.columns[name])] - stated for name, stated in asked.items()]
    return bool(np.abs(np.concatenate(off)).max() < 0.5 * _LEAST_PART)


def _add_axle(rows: Wheels, axle: Parameter) -> Wheels:
    return replace(rows, parameters=(*(p for p in rows.parameters if p.name != AXLE), axle))


def find_wrong_axes(recording: Recording, findings: Sequence[Finding] = ()) -> list[Finding]:
    """A finding on the IMU's axes where a vehicle accelerates too little to show them, but does not travel along them.

    As `find_wrong_arms`; also of coarse fixes.
    """
    gnss = recording.gnss
    if gnss is None or not _tells_of_arms(recording, findings):
        return []
    track = compute_track(gnss)
    felt = None if track is None else fit_forward(recording.imu, track)
    if felt is not None and felt.correlation > CORRELATED:
        return []  # `graphnav.recording.checks.axes` has looked
    try:
        turned = describe_turned_axes(*_smooth_with_open_arms(_find_turning(recording)))
    except EstimationError:
        return []
    return [] if turned is None else [Finding("unreliable", turned, "imu.axes")]


def find_untold_arm(recording: Recording) -> list[Finding]:
    """A note that the signs of the antenna's lever arm cannot be checked, as the fixes are too coarse for
    `find_wrong_arms`.
    """
    gnss = recording.gnss
    if recording.platform != "vehicle" or gnss is None or np.abs(gnss.lever_arm).max() <= _LEAST_PART:
        return []
    sd = float(np.median(gnss.sd[:, :2])) if len(gnss.t) else 0.0
    if sd <= _PRECISE:
        return []
    sentence = (
        f"the fixes' 1-sigma of {sd:.2g} m is too coarse to tell whether lever_arm in [gnss] and its signs are right: "
        "check them by hand"
    )
    return [Finding("note", sentence, "gnss.lever_arm_untold")]


def _tells_of_arms(recording: Recording, findings: Sequence[Finding]) -> bool:
    """Whether it is a vehicle's with enough fixes, and none of the `findings` comes first."""
    return (
        recording.platform == "vehicle"
        and recording.gnss is not None
        and len(recording.gnss.t) >= _FEWEST_FOR_ARM
        and not any(f.severity != "note" and f.key in _MENDED_FIRST for f in findings)
    )


def _find_turning(recording: Recording) -> Recording:
    """The part of a drive, at most `_PART` s long, that turns most while there are fixes, of which a fix a second."""
    assert recording.gnss is not None
    first = np.concatenate([[True], np.diff(np.floor(recording.gnss.t)) > 0.0])
    recording = replace(recording, gnss=take_rows(recording.gnss, first))
    imu, gnss = recording.imu, recording.gnss
    assert gnss is not None
    if recording.duration <= _PART:
        return recording
    turned = np.zeros(len(imu.t))  # in place: a day's gyro by itself is half a gigabyte
    np.sqrt(np.einsum("ij,ij->i", imu.gyro[1:], imu.gyro[1:], out=turned[1:]), out=turned[1:])
    turned[1:] *= np.diff(imu.t)
    np.cumsum(turned, out=turned)
    starts = np.arange(recording.start, recording.end - _PART, 0.1 * _PART)
    way = np.interp(starts + _PART, imu.t, turned) - np.interp(starts, imu.t, turned)
    fixes = np.searchsorted(gnss.t, starts + _PART) - np.searchsorted(gnss.t, starts)
    best = float(starts[np.argmax(way * fixes)]) - recording.start
    return recording.crop(best, best + _PART)


def _smooth_with_open_arms(recording: Recording) -> tuple[Problem, SmootherPass]:
    """A drive smoothed with lever arms that are unknown."""
    if recording.gnss is None or not len(recording.gnss.t):
        raise EstimationError(
            f"'{recording.name}': there is no GNSS whose antenna could be found", key="antenna.no_gnss"
        )
    settings, frame = Settings(), LocalFrame(choose_origin(recording), recording.start)
    tell("detection")
    still = detect(recording, settings).stationary
    tell("alignment")
    aligned = align(recording, settings, frame)
    if aligned.motion is None:
        raise EstimationError(
            f"'{recording.name}': without motion the position of the antenna is not observable", key="antenna.no_motion"
        )
    wide = PRIOR_SIGMA[LEVER_ARM]
    unknown = {"gnss": {"lever_arm_sigma": wide}, "vehicle": {"axle_sigma": wide}}
    sections = {name: getattr(settings, name).model_copy(update=values) for name, values in unknown.items()}
    settings = settings.model_copy(update=sections)
    base = build_problem(recording, settings, frame, aligned.state, aligned.sigma, still, parts_of_noise=True)
    try:
        tell("noise")
        found = estimate_noise(base, aligned.opening)
    except np.linalg.LinAlgError as error:
        raise explain_singular(error) from None
    problem = apply_noise(base, found.noise)
    return problem, smooth_backward(problem, refilter(problem, found.carry_points(base, problem)))


def _estimate_antenna(recording: Recording) -> tuple[Antenna, tuple[Array, Array, Array] | None]:
    """The antenna, and the forward position of the point that does not slip, (1,) m each: stated, found, sigma."""
    problem, smoothed = _smooth_with_open_arms(recording)
    assert recording.gnss is not None
    parameters = estimate_parameters(problem, smoothed.values, compute_sigmas(smoothed.P))
    arm, axle = parameters[LEVER_ARM], parameters.get(AXLE)
    antenna = Antenna(recording.gnss.lever_arm, arm.value[-1], arm.sigma[-1])
    if axle is None or recording.odometer is None:
        return antenna, None
    stated = recording.odometer.lever_arm[1:2]
    return antenna, (stated, stated + axle.value[-1], axle.sigma[-1])
