"""The graph of a running walk: the work of a step is distributed over IMU rows.

A step has some twenty keyframes, and its detector uses half a minute of rows. All at one row would take several periods
of an IMU and delay its rows. So one row detects steps, one builds the keyframes of completed steps, and a few keyframes
enter at each of the next. Until all have entered, the live state is predicted from the keyframe before them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.solvers.stages import Message, Place
from graphnav.online.ahead import Live, live, predict_since
from graphnav.online.around import ROWS_AFTER
from graphnav.online.chain import BuiltKeyframes
from graphnav.online.looks import CONTEXT, SURE
from graphnav.online.sanity import CERTAIN_SPAN
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording

_ENTERING = 4  # keyframes that enter per row: half of the 4 ms between rows of an IMU at 250 Hz
_AGAIN = 8  # keyframes relinearised per row, by the same limit
_RENEWED = 64  # built again at once for that: those around them, which come with them, are twelve


@dataclass(frozen=True)
class _Work:
    """Remaining work of a step: first building keyframes, then letting them enter."""

    new: Array  # (K,) s
    dirty: float  # s, from where on keyframes are redone
    shown: tuple[Message, float]  # the keyframe, and its time, from which the live state is predicted meanwhile
    built: BuiltKeyframes | None = None
    entered: int = 0  # of the problem's keyframes, including those before


@dataclass(frozen=True)
class _Renewal:
    """Stages built again, by their times, valid as long as the stops are these."""

    stops: Array = field(default_factory=lambda: np.empty((0, 2)))
    places: dict[float, Place] = field(default_factory=dict)


@dataclass(frozen=True)
class _Look:
    """A detection of steps: what was known before, and what it found."""

    limit: float  # s, up to where
    newest: float  # s, the newest keyframe then
    before: tuple[Array, float, float | None]
    after: tuple[Array, float, float | None]
    times: Array  # s, keyframes to be made


class Walker(Tracker):
    """Keyframes of a walk."""

    at_a_row = _AGAIN
    at_every_row = True
    _work: _Work | None = None
    _renewal = _Renewal()
    _looks: tuple[_Look, ...] = ()  # to which late rows may have belonged

    @property
    def busy(self) -> bool:
        """Whether keyframes are entering."""
        return self._work is not None

    def take_steps(self, sensors: Sensors, limit: float, last: bool, fixes: list[float], dirty: float) -> float:
        """Let the keyframes of steps that are over by `limit` (s) enter at the next rows, or now.

        Parameters
        ----------
        last : no more rows will come.
        fixes : s, which may be late.
        dirty : s, from where on keyframes are to be redone.

        Returns
        -------
        Up to when there will be keyframes, s; -inf where nothing is to be done.
        """
        self.finish_entering(sensors)
        shown, started = (self.window.newest, self.newest), bool(len(self.window)) or self.opened
        times = self._list_steps_until(sensors, limit, last)
        late = [t for t in fixes if t <= self.newest + SAME_TIME]
        if not len(times) and not (late and len(self.window)):
            return -np.inf
        self._work = _Work(np.union1d(times, late), min([dirty, self._dirty, *late]), shown)
        self._dirty = np.inf
        newest = max([self.newest, *times.tolist()])
        if last or not started:
            self.finish_entering(sensors)
        return newest

    def _list_steps_until(self, sensors: Sensors, limit: float, last: bool) -> Array:
        """Keyframes of a walk that can be made by now, and their effect on those before."""
        before, newest = self._save_cut, self.newest
        found = times = self._steps.list_until(sensors, self.settings, self._standing, self.newest, limit, last)
        after = self._save_cut
        if (stood := self._steps.over) is not None:  # the sway of a foot is estimated from all of its standing
            self._keep(len(self.window) - len(self.window.select_since(stood + SAME_TIME)))
            times = self._steps.list_until(sensors, self.settings, self._standing, self.newest, limit, last)
        looks = [one for one in self._looks if one.limit > limit - CERTAIN_SPAN - SURE]
        self._looks = (*looks, _Look(limit, newest, before, after, found))
        self._standing.forget(self.head - CONTEXT)
        dirty = self._steps.find_change(sensors, self.head)
        self.note_late_row("imu", dirty)
        self._dirty = min(self._dirty, dirty)
        return times[1:] if len(self.window) or self.opened else times

    @property
    def _save_cut(self) -> tuple[Array, float, float | None]:
        """The state from which the next detection continues."""
        return self._standing.spans, self._standing.looked, self._steps.pieces

    def _restore_cut(self, known: tuple[Array, float, float | None]) -> None:
        self._standing.spans, self._standing.looked, self._steps.pieces = known

    def look_again(self, sensors: Sensors, t: float) -> None:
        """A row of the IMU arrived late, at a time (s): redo the steps that it changes."""
        looks, now = [one for one in self._looks if one.limit + SURE >= t - SAME_TIME], self._save_cut
        for one in looks:
            self._restore_cut(one.before)
            found = self._steps.list_until(sensors, self.settings, self._standing, one.newest, one.limit, False)
            if not _are_same((found, self._standing.spans), (one.times, one.after[0])):
                break
        else:
            self._restore_cut(now)
            return
        self._restore_cut(now)
        self.finish_entering(sensors)
        if one.newest < self._oldest:
            return  # already settled
        self._restore_cut(one.before)
        self._keep(len(self.window) - len(self.window.select_since(one.newest + SAME_TIME)))
        self._motions = {end: motion for end, motion in self._motions.items() if end <= one.newest}
        self._looks, self._renewal = tuple(x for x in self._looks if x.limit < one.limit), _Renewal()
        for again in (x for x in looks if x.limit >= one.limit):
            self.take_steps(sensors, again.limit, False, [], np.inf)
        self.finish_entering(sensors)

    def go_on(self, sensors: Sensors) -> None:
        """Do a portion of the work."""
        work = self._work
        assert work is not None
        built = work.built
        if built is None:
            if work.dirty < np.inf:
                self._motions = {t: one for t, one in self._motions.items() if t < work.dirty}
                self._renewal = _Renewal()
            built = self._begin(sensors, work.new, work.dirty)
            self._work = None if built is None else replace(work, built=built, entered=built.first)
            return
        end = min(work.entered + _ENTERING, len(built.problem.t))
        back = self._add(built.problem, built.first, None, work.entered, end)
        self._work = replace(work, entered=end)
        if back is not None or end == len(built.problem.t):
            self._work = None
            self._finish_keyframes()
        if back is not None:
            self._renewal = _Renewal()
            self._go_back(sensors, built, back)

    def finish_entering(self, sensors: Sensors) -> None:
        """Do all remaining work at once."""
        while self._work is not None:
            self.go_on(sensors)

    def note_missed_row(self, sensors: Sensors, sensor: str, t: float) -> bool:
        missed = sensor != "imu" or self._have_missed(t)
        if sensor == "imu":
            self.look_again(sensors, t)
        if missed:
            self.finish_entering(sensors)
        return missed

    def _have_missed(self, t: float) -> bool:
        """Whether keyframes were made that would have used a row of the IMU at a time, s."""
        self._steps.read_again(t)
        work, newest = self._work, self.newest
        if work is not None and work.built is not None:
            newest = max(newest, float(work.built.times[-1]))
        return t <= newest + ROWS_AFTER

    def note_late_row(self, sensor: str, t: float) -> None:
        super().note_late_row(sensor, t)
        if np.isfinite(t):
            self._renewal = _Renewal()

    def restart_settled(self, noise: NoiseModel, setup: Recording, judged: float = -np.inf) -> Tracker:
        other = super().restart_settled(noise, setup, judged)
        assert isinstance(other, Walker)
        other._work, other._renewal = None, _Renewal()
        return other

    def live(self, sensors: Sensors) -> Live:
        """The state at the newest IMU row, predicted from the newest keyframe before those that are entering."""
        return live(*self._shown, self.frame, sensors, self.noise)

    def predict_since(self, sensors: Sensors) -> tuple[Array, States, Array]:
        """Times (M,), states and covariances (M, 15, 15) at every IMU row since that keyframe."""
        return predict_since(*self._shown, self.frame, sensors, self.noise)

    @property
    def _shown(self) -> tuple[Message, float]:
        return (self.window.newest, self.newest) if self._work is None else self._work.shown

    def _renew(self, sensors: Sensors, first: int, end: int) -> list[Place] | None:
        before = self._renewal
        places = self._build_again(sensors, first, end)
        return places if self._renewal is before else None

    def _build_again(self, sensors: Sensors, first: int, end: int) -> list[Place]:
        """As in `Tracker`; what is built for some stages is kept for those that follow."""
        stages, known = self.window.stages[first:end], self._renewal
        if known.stops is not self.stops or not {stage.place.t for stage in stages} <= known.places.keys():
            until = max(end, min(first + _RENEWED, len(self.window)))
            places = super()._build_again(sensors, first, until)
            known = self._renewal = _Renewal(self.stops, {place.t: place for place in places})
        fresh = [known.places[stage.place.t] for stage in stages]
        return [replace(stage.place, problem=one.problem, k=one.k) for stage, one in zip(stages, fresh, strict=True)]


def _are_same(found: tuple[Array, Array], known: tuple[Array, Array]) -> bool:
    """Whether keyframes and stances are the same."""
    return all(np.array_equal(a, b) for a, b in zip(found, known, strict=True))
