"""The order in which fixes and IMU are judged: the first part of a drive, smoothed again with what was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav import faults
from graphnav.alignment import Alignment
from graphnav.config import Settings
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.judgement.chance import CLEARLY
from graphnav.judgement.fixes import LONG, FixQuality, judge_fixes, judge_lasting, outliers, stretch, suspicious
from graphnav.judgement.imu import calmer, exhausted, imu_notes, judge_imu, noisiest
from graphnav.judgement.speeds import contradiction
from graphnav.judgement.types import reaching
from graphnav.problem import Problem, pose
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solvers.ekf import ekf
from graphnav.solvers.near import near
from graphnav.solvers.passes import Forward, Smoothed, points_of, values_of
from graphnav.solvers.rts import backward
from graphnav.state import States

_ROUNDS = 4  # of raising the IMU's figures


def judged(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    aligned: Alignment,
    stationary: Array,
    wrong: tuple[faults.Fault, ...] = (),
    witnesses: bool = False,
    doubted: bool = False,
) -> tuple[Recording, Settings, tuple[str, ...]]:
    """Recording and settings with the figures of IMU and fixes judged by the first part of the drive, and sentences.

    Parameters
    ----------
    stationary : (N, 2) s, intervals at rest.
    wrong : spans of fixes to judge without.
    witnesses : whether wheels may say that it is not the IMU that is noisy, but errors of the fixes that last.
    doubted : whether that is thought of as well where a figure of the IMU was raised as far as any is.

    Raises
    ------
    EstimationError
        If that part does not determine a trajectory.
    """
    if aligned.motion is None or not settings.gnss.position:
        return recording, settings, ()
    rounds = _Rounds(recording, settings, frame, aligned, stationary, wrong)
    fixes = rounds.first()
    if fixes is not None:
        fixes = rounds.lasting(fixes, witnesses, doubted)
        settings = fixes.applied(settings)
    noise = rounds.noise
    notes = imu_notes(recording.imu.noise, noise) + (() if fixes is None else fixes.notes)
    return replace(recording, imu=replace(recording.imu, noise=noise)), settings, notes


class _Rounds:
    """What is known of the figures so far: `noise` of the IMU, and weights of fixes that are outliers."""

    def __init__(
        self,
        recording: Recording,
        settings: Settings,
        frame: LocalFrame,
        aligned: Alignment,
        stationary: Array,
        wrong: tuple[faults.Fault, ...],
    ) -> None:
        assert aligned.motion is not None
        self._recording, self._settings, self._frame = recording, settings, frame
        self._aligned, self._stationary, self._wrong = aligned, stationary, wrong
        self._moved = aligned.motion
        self._part = stretch(recording, self._moved)
        self._stated = self.noise = recording.imu.noise
        self._weight: dict[str, Array] = {}
        self._free = settings.without_wheels()  # wheels are judged by what comes of this: they have no say in it
        as_stated = {"sd_factor": 1.0, "slow_share": 0.0, "fast_time": 0.0, "adaptive": "off"}
        self._plain = self._free.model_copy(update={"gnss": settings.gnss.model_copy(update=as_stated)})
        self._near: tuple[States, dict[str, Array]] | None = None  # the latest smoothed states and parameter values
        self._first: FixQuality | None = None  # of errors that last, where they were looked for

    def first(self) -> FixQuality | None:
        """Judge fixes, and the IMU where it is noisier than stated; None where there are too few fixes."""
        gnss, part = self._settings.gnss, self._part
        self._part = reaching(self._recording, self._moved, part)
        problem, forward, back = self._checked()
        fixes = judge_fixes(problem, back)
        if fixes is not None and fixes.types:
            problem, forward, back, fixes = self._by_type(problem, forward, back, fixes)
        elif self._part is not part:  # types do not differ: what is judged on is as long as ever
            self._part, self._near = part, None
            problem, forward, back = self._checked()
            fixes = judge_fixes(problem, back, together=True)
        plain, together = self._plain, fixes is not None and not fixes.types
        if fixes is not None and gnss.fast_time != 0.0:
            self._first = judge_lasting(problem, back, fixes)
        if not self._settings.imu.as_stated and judge_imu(problem, forward, back).clear:
            # fixes that wander would pass for noise of the IMU: it is judged with their wandering in the problem
            self._improve(plain if fixes is None else fixes.applied(self._free))
            if self.noise != self._stated:
                problem, _, back = self._smoothed(plain)
                fixes = judge_fixes(problem, back, together)
        return fixes

    def _checked(self) -> tuple[Problem, Forward, Smoothed]:
        """The part smoothed with all errors as white, outliers weighed as such."""
        plain, self._weight = self._plain, {}
        try:
            problem, forward, back = self._smoothed(plain)
            doubtful = suspicious(problem, back)
        except EstimationError:
            doubtful = True
        if doubtful:
            self.noise = noisiest(self._stated)
            self._weight = ekf(self._posed(plain), opening=self._aligned.until, watch=True).weights
            self.noise, self._near = self._stated, None  # outliers may have led it anywhere
            problem, forward, back = self._smoothed(plain)
            self._weight = outliers(problem, back)
            problem, forward, back = self._smoothed(plain)
        return problem, forward, back

    def _by_type(
        self, problem: Problem, forward: Forward, back: Smoothed, fixes: FixQuality
    ) -> tuple[Problem, Forward, Smoothed, FixQuality]:
        """The part smoothed with a factor for each type, and what it says of them, in rounds.

        What is far better than the rest is seen for what it is only once the rest has less weight.
        """
        for _ in range(_ROUNDS):
            factors = {name: one.sd_factor for name, one in fixes.types.items()}
            self._plain = self._plain.model_copy(
                update={"gnss": self._plain.gnss.model_copy(update={"sd_factor": factors})}
            )
            problem, forward, back = self._checked()
            found = judge_fixes(problem, back)
            if found is None or not found.types:
                break
            before, fixes = fixes, found
            if all(abs(np.log(one.sd_factor / before.types[n].sd_factor)) < 0.1 for n, one in fixes.types.items()):
                break
        return problem, forward, back, fixes

    def lasting(self, fixes: FixQuality, witnesses: bool, doubted: bool) -> FixQuality:
        """The fixes as they are, or as errors that last explain better.

        The IMU may be as bad as it was found, or errors of the fixes last for seconds: wheels, without a say so far,
        are witnesses; and so is an IMU that no figure that it may have explains.
        """
        found, raised = self._first, self.noise
        larger, spent = fixes.worst > CLEARLY, doubted and exhausted(raised, self._stated)
        if found is None or not found.lasts or not (larger or spent or (witnesses and raised != self._stated)):
            return fixes
        part = stretch(self._recording, self._moved, LONG)
        self._part, self._weight = reaching(self._recording, self._moved, part) if fixes.types else part, {}
        try:
            if spent:
                self._smoothed(fixes.applied(self._free))
            against, chance = contradiction(*self._both(fixes.applied(self._settings)))
            if larger or spent or against > chance:
                self.noise = self._stated
                if spent:
                    # wheels come second: beside fixes that are believed too much they are turned round, not heard
                    self._near = None
                    self._smoothed(found.applied(self._free))
                found = judge_lasting(*self._both(found.applied(self._settings)), fixes)
                if not self._settings.imu.as_stated:
                    basis = found.applied(self._free)
                    self._weight = outliers(*self._both(basis))
                    self._improve(basis)
                    self._weight = {}
                left = contradiction(*self._both(found.applied(self._settings)))[0]
                agreed = left <= max(chance, against - chance)
                # with no wheels to say so, it has to leave an IMU that is no longer as bad as any
                shown = against > chance or not exhausted(self.noise, self._stated)
                if larger or (agreed and shown and calmer(self.noise, raised)):
                    fixes, raised = found, self.noise
        except EstimationError:
            pass  # as it was judged before
        self.noise = raised
        return fixes

    def _improve(self, basis: Settings) -> None:
        """Raise the noise figures of the IMU as it asks for."""
        for _ in range(_ROUNDS):
            imu = judge_imu(*self._smoothed(basis))
            better = imu.applied(self.noise, self._stated)
            if (self.noise == self._stated and not imu.clear) or imu.settled or better == self.noise:
                break
            self.noise = better

    def _posed(self, how: Settings) -> Problem:
        noisy = replace(self._part, imu=replace(self._part.imu, noise=self.noise))
        problem = pose(noisy, how, self._frame, self._aligned.state, self._aligned.sigma, self._stationary)
        return faults.without(faults.weighted(problem, self._weight), self._wrong)

    def _smoothed(self, how: Settings) -> tuple[Problem, Forward, Smoothed]:
        problem = self._posed(how)
        if self._near is None or len(self._near[0]) != len(problem.t):
            forward: Forward = ekf(problem, opening=self._aligned.until)
            back = backward(problem, forward)
        else:
            forward, back = near(problem, points_of(problem, *self._near), self._aligned.until)
        self._near = back.states, values_of(problem, back)
        return problem, forward, back

    def _both(self, how: Settings) -> tuple[Problem, Smoothed]:
        problem, _, back = self._smoothed(how)
        return problem, back
