"""Alignment of a recording and construction of its problem; repeated where wrong measurements affect its start and
stops.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.ambiguities import CarrierRows
from graphnav.constraints.raw_phase import GnssPhase
from graphnav.core.beside import Beside, Later
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.notes import Note
from graphnav.core.progress import tell
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS
from graphnav.detectors import Detections, detect
from graphnav.detectors.base import NONE
from graphnav.estimation.alignment import Alignment, align, use_known_heading
from graphnav.estimation.contradictions import use_freed
from graphnav.estimation.fixing import split_carriers
from graphnav.estimation.noise.left_out import drop_excluded
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.spacing import space_fixes
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.unknown_heading import choose_heading
from graphnav.recording import Recording
from graphnav.recording.odometer import MeanSpeed

_DIVERGED_BY = 0.5  # rad between the stated and the found initial attitude, beyond which a filter diverges for a while
_FAR_AWAY = 100.0  # m, error of single fixes in a city


@dataclass
class Clock:
    """Time used by each stage, s, and passes of filter and smoother that are counted nowhere else."""

    seconds: dict[str, float] = field(default_factory=dict)
    passes: Counter[str] = field(default_factory=Counter)

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add the time of stages that was counted elsewhere."""
        for stage, more in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + more

    @contextmanager
    def count_time(self, stage: str) -> Iterator[None]:
        """Count the time within this context for a stage."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.add({stage: time.perf_counter() - began})


@dataclass(frozen=True)
class BuiltProblem:
    """A problem and what it was built from."""

    problem: Problem
    carriers: CarrierRows | None  # carrier phases, which are not part of the problem until they have integers
    aligned: Alignment
    detections: Detections


@dataclass(frozen=True)
class ProblemBuilder:
    """Aligns a recording and builds its problem.

    `used` is the recording with the fixes that the problem uses; alignment and detectors use all of them.
    """

    recording: Recording
    used: Recording
    settings: Settings
    frame: LocalFrame
    clock: Clock
    averaging: Beside[MeanSpeed | None] | Later[MeanSpeed | None]  # the odometer's
    false_stops: Array = field(
        default_factory=lambda: NONE
    )  # (n, 2) s, in which the platform moves, whatever the detectors say
    notes: tuple[str, ...] = ()  # of its problems

    def use_spaced(self, recording: Recording, spacing: float) -> ProblemBuilder:
        """The same with the fixes of a recording, thinned to one in `spacing` (s); as they are where that is 0."""
        used = space_fixes(recording, spacing) if spacing else recording
        notes: tuple[str, ...] = ()
        if used.gnss is not None and recording.gnss is not None and len(used.gnss.t) < len(recording.gnss.t):
            few, all_ = len(used.gnss.t), len(recording.gnss.t)
            notes = (
                Note(
                    "gnss.spaced", f"gnss: {few} of {all_} fixes used, the best of every {spacing:g} s (noise.spacing)"
                ),
            )
        return replace(self, used=used, notes=notes)

    def align(self, recording: Recording, stationary: Array, before: Alignment | None = None) -> Alignment:
        """The first state of the recording, or of a part of it, near that found before, if any."""
        # an alignment needs no carrier phases, and solves dozens of problems
        codes_alone = self.settings.raw_gnss.model_copy(update={"differences": False})
        settings = self.settings.model_copy(update={"raw_gnss": codes_alone})
        tell("alignment")
        with self.clock.count_time("alignment"):
            return align(recording, settings, self.frame, stationary, before)

    def build(self, aligned: Alignment, detections: Detections, parts: bool) -> BuiltProblem:
        """Build the problem; with the contribution of each noise figure to its intervals, if these are to change."""
        tell("preintegration")
        with self.clock.count_time("preintegration"):
            stated = use_known_heading(aligned, self.settings)
            start = aligned if has_diverged(aligned, stated) else stated
            problem = build_problem(
                self.used, self.settings, self.frame, start.state, start_sigma(start), detections.stationary,
                speed=self.averaging.get_result(), parts_of_noise=parts,
            )  # fmt: skip
        if start.heading_unknown:
            with self.clock.count_time("alignment"):
                problem, unknown = choose_heading(problem, self.clock.passes)
            mean = problem.prior.mean
            assert mean is not None
            aligned = replace(aligned, state=mean, sigma=problem.prior.sigma[0], heading_unknown=unknown)
        problem = replace(problem, notes=(*self.notes, *problem.notes))
        problem, carriers = split_carriers(problem, GnssPhase)  # the noise model depends on the codes
        return BuiltProblem(problem, carriers, aligned, detections)

    def build_every(self, built: BuiltProblem) -> BuiltProblem:
        """The problem with every stop but the false ones, whichever it was built without before, aligned again."""
        detections = detect(self.recording, self.settings).without(self.false_stops)
        return self.build(self.align(self.recording, detections.stationary), detections, parts=True)

    def build_moving(self, built: BuiltProblem) -> BuiltProblem:
        """The problem without the false stops, aligned again."""
        detections = built.detections.without(self.false_stops)
        return self.build(self.align(self.recording, detections.stationary), detections, parts=True)

    def build_without(self, built: BuiltProblem, noise: NoiseModel, parts: bool, anew: bool = False) -> BuiltProblem:
        """The problem with a start and stops that depend on no fix that a noise model excludes, and on no constant as
        stated that it frees.

        Returns the same object where these are unchanged.

        Parameters
        ----------
        anew : whether the start is sought again even if it depends on no excluded fix, and used even if the present one
            does not contradict it.
        """
        if not (noise.excluded or anew) or self.recording.gnss is None:
            return built
        aligned, detections = built.aligned, built.detections
        fixes = drop_excluded(self.recording, noise)
        stops = detect(fixes, self.settings).without(self.false_stops)
        changed = _differ(stops.stationary, detections.stationary)
        stops = stops if changed else detections
        seen = self.recording.end if aligned.until is None else aligned.until
        if anew or any(begin <= seen for spans in noise.excluded.values() for begin, _ in spans):
            try:
                # wrong fixes may have led the search anywhere, a constant a little off has not
                before = None if noise.excluded else built.aligned
                found = self.align(use_freed(fixes, noise.freed, self.frame.epoch), stops.stationary, before)
            except EstimationError:
                found = aligned
            if found.motion is not None and (anew or found.contradicts(aligned)):
                aligned, changed = found, True
        return self.build(aligned, stops, parts) if changed else built


def has_diverged(found: Alignment, stated: Alignment) -> bool:
    """Whether a filter from the stated start would diverge for a while."""
    turn = found.state.minus(stated.state)[0, :3]
    return found.motion is not None and bool(np.linalg.norm(turn) > _DIVERGED_BY)


def start_sigma(start: Alignment) -> Array:
    """(15,) 1-sigma of the start, with an unknown position where there are fixes.

    The alignment took its position from fixes that the problem uses too, with sigmas that may be wrong; without fixes
    it is the stated start.
    """
    sigma = start.sigma.copy()
    if start.motion is None:
        return sigma
    sigma[BLOCKS["p"]] = np.hypot(sigma[BLOCKS["p"]], _FAR_AWAY)
    return sigma


def _differ(a: Array, b: Array) -> bool:
    """Whether one has a stop that does not overlap any of the other."""
    return any(
        not np.any((other[:, 0] < end) & (other[:, 1] > begin)) for one, other in ((a, b), (b, a)) for begin, end in one
    )
