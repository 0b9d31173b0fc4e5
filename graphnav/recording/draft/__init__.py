"""Draft of a recording.toml from arbitrary logs: `draft` inspects them, guesses, and states reasons and confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.timescales import NEAR, UNIX, ClockOffset, compute_clock_offset
from graphnav.recording.checks.imu import is_shaken_as_a_foot
from graphnav.recording.checks.stated import moves_as_a_foot
from graphnav.recording.densities import measure_densities
from graphnav.recording.draft import guesses, motion
from graphnav.recording.draft.agreement import CLEAR, LIKELY, Agreement, compare_with_fixes
from graphnav.recording.draft.document import Document, format_vector
from graphnav.recording.draft.guesses import Guess
from graphnav.recording.draft.raw import RawFound, find_raw, write_raw
from graphnav.recording.draft.references import has_attitude, is_above_sea
from graphnav.recording.draft.sources import (
    find_logs,
    guess_file_pressure_unit,
    guess_fix_speed_unit,
    read_fixes,
)
from graphnav.recording.draft.tables import VELOCITIES, Source
from graphnav.recording.formats.schema import FORCE, RATE_UNITS, SPEED
from graphnav.recording.formats.writer import quote

__all__ = ["Draft", "draft"]

_SMALL = 0.03  # s; smaller clock offsets are left to the smoother, which estimates them
_SD = "[3.3, 3.3, 6.6]"  # m, assumed of fixes that state none (graphnav.recording.formats.repair.DEFAULT_SD)


@dataclass(frozen=True)
class Draft:
    """A recording.toml and the decisions made, in words."""

    text: str
    decisions: tuple[str, ...]
    made: dict[str, dict[str, Array]]  # files to be written beside it: name -> columns


def draft(paths: Sequence[Path], folder: Path, name: str | None = None, topics: Sequence[str] = ()) -> Draft:
    """Describe logs (CSV files, or logs of known programs) in a recording.toml for `folder`.

    Of a folder all logs in it are considered; those without sensor data are left out with a note. `topics` are those to
    use of a ROS bag.

    Raises
    ------
    RecordingError
        If a file cannot be read, holds nothing that is known, or there is no IMU among them.
    """
    found = find_logs(paths, topics)
    file = Document(folder, topics)
    file.decisions += found.notes
    imu = found.sensors["imu"]
    t = imu.t if imu.log is None else imu.log.imu.t  # type: ignore[union-attr]
    raw = find_raw(found.raw, t, imu.gps_zero)
    text = _Writer(file).format(found.sensors, raw, name or folder.resolve().name or "drive")
    return Draft(text, tuple(file.decisions), file.made)


def read_imu_in_si(path: Path) -> tuple[Array, Array, Array, list[str]]:
    """Times (N,), rates and forces (N, 3) of a CSV file in SI, units as `draft` would guess them, and which these are.

    Raises
    ------
    RecordingError
        As `draft`.
    """
    source = find_logs([path]).sensors["imu"]
    gyro, accel = source.stack("gx", "gy", "gz"), source.stack("ax", "ay", "az")
    force = guesses.guess_accel_unit(path, accel, source.find_unit("ax", "accel"))
    rate = guesses.guess_gyro_unit(path, gyro, source.find_unit("gx", "gyro"), None, vehicle=False)
    words = [f"{name} in {guess.value}: {guess.why}" for name, guess in (("gyro", rate), ("accel", force))]
    return source.t, gyro * RATE_UNITS[str(rate.value)], accel * FORCE[str(force.value)], words


class _Writer:
    """Decides on the tables of a file, and writes them."""

    def __init__(self, file: Document) -> None:
        self.file = file
        self.epochs: ClockOffset | None = None  # delays between the clocks of IMU and fixes

    def format(self, found: dict[str, Source], raw: RawFound | None, name: str) -> str:
        moved = "gnss" in found or raw is not None
        stepping = moved and "odometer" not in found and self._walks(found["imu"], found.get("gnss"))
        vehicle = (moved or "odometer" in found) and not stepping
        self.file.lines += [
            "# Drafted by graphnav init. Comments say why each line is what it is; look at those marked CHECK.",
            'format = "graphnav-recording/1"', f"name = {quote(name)}",
        ]  # fmt: skip
        why = (
            "there are fixes, speeds or observations of GNSS"
            if vehicle
            else "CHECK: the fixes walk, and the force changes from step to step as on a shoe"
            if stepping
            else "CHECK: no fixes and no speed, so a walk is assumed"
        )
        self.file.write_key("platform", '"vehicle"' if vehicle else '"foot"', why)
        if raw is not None:
            self._write_clock(found["imu"], raw)
        elif found["imu"].week is not None:
            why = "as a column of the IMU's file says" if found["imu"].week else "the stamps are s since the GPS epoch"
            self.file.write_key("clock", f'"gps week {found["imu"].week}"', why)
        elif found["imu"].log is None and found["imu"].t[0] > UNIX:
            self.file.write_key("clock", '"unix"', "the stamps are dates of this century, s since 1970")
        agreement, felt = self._write_imu(found["imu"], found.get("gnss"), raw, vehicle)
        course = None
        if "gnss" in found:
            course = motion.compute_course(*read_fixes(found["gnss"]))
            self._write_gnss(found["gnss"], agreement)
        if raw is not None:
            self.file.begin("raw_gnss")
            self.file.decisions += raw.notes
            for key, value, why in write_raw(raw, self.file.folder):
                self.file.write_key(key, value, why)
            if "gnss" not in found:
                self._write_time_offset(agreement)
        if "odometer" in found:
            self._write_odometer(found["odometer"], course if course is not None and len(course.t) > 50 else None, felt)
        if "barometer" in found:
            self._write_barometer(found["barometer"])
        if "truth" in found:
            self._write_truth(found["truth"], found["imu"], "gnss" in found)
        return "\n".join(self.file.lines) + "\n"

    def _walks(self, imu: Source, gnss: Source | None) -> bool:
        """Whether the IMU is shaken as one on a foot is, and fixes, if there are any, are as slow."""
        if gnss is not None and not moves_as_a_foot(motion.compute_course(*read_fixes(gnss)).speed):
            return False
        if imu.log is not None:
            assert imu.log.imu is not None
            return is_shaken_as_a_foot(imu.log.imu.t, imu.log.imu.accel)
        accel = imu.stack("ax", "ay", "az")
        unit = guesses.guess_accel_unit(imu.path, accel, imu.find_unit("ax", "accel"))
        return is_shaken_as_a_foot(imu.t, accel * FORCE[str(unit.value)])

    # ---- one table each

    def _write_clock(self, imu: Source, raw: RawFound) -> None:
        """Write what t = 0 of the IMU is, which observations are dated by."""
        if raw.clock.value is not None:
            self.file.write_key("clock", quote(str(raw.clock.value)), raw.clock.why)
        elif imu.log is None:
            words = f'CHECK: state what t = 0 of {imu.path.name} is, as "gps week 2130" or a UTC date'
            self.file.lines.append(f'# clock = "..."                             # {words}')
            self.file.decide(f"clock: {words}; the observations begin at {raw.begin}")

    def _write_imu(
        self, source: Source, gnss: Source | None, raw: RawFound | None, vehicle: bool
    ) -> tuple[Agreement, tuple[Array, Array]]:
        """Write [imu]; returns the comparison with the fixes, and times and forward forces."""
        self.file.begin("imu")
        self.file.write_file(source, "imu")
        if source.log is not None:
            assert source.log.imu is not None
            imu = source.log.imu
            t, gyro, accel = imu.t, imu.gyro @ imu.R_bs, imu.accel @ imu.R_bs  # in the log's own axes
        else:
            t, gyro, accel = source.t, source.stack("gx", "gy", "gz"), source.stack("ax", "ay", "az")
            force = guesses.guess_accel_unit(source.path, accel, source.find_unit("ax", "accel"))
            accel = accel * FORCE[str(force.value)]
        up, up_why = guesses.guess_up(accel)
        agreement = Agreement()
        if gnss is not None:
            self.epochs = _find_epoch(source, gnss)
            agreement = compare_with_fixes(
                t, gyro, accel, up, read_fixes(gnss), self.epochs.offset if self.epochs else 0.0
            )
        elif raw is not None and raw.dated:
            agreement = compare_with_fixes(t, gyro, accel, up, raw.horizontal, 0.0)
        if source.log is None:
            stated = source.find_unit("gx", "gyro")
            rate = guesses.guess_gyro_unit(source.path, gyro, stated, agreement.turn, vehicle)
            gyro = gyro * RATE_UNITS[str(rate.value)]
            self.file.write_units({"t": source.t_unit, "gyro": rate, "accel": force})
            front = self._write_axes(up, up_why, agreement)
        elif source.log.mount_known or agreement.clearest is None:
            assert source.log.imu is not None
            self.file.decide(f"IMU: axes and units are those of {source.path.name}")
            front = source.log.imu.R_bs[1]
        else:
            front = self._write_axes(up, up_why, agreement)
        if source.log is None or (source.log.imu is not None and source.log.imu.noise_assumed):
            self._write_noise(t, gyro, accel, vehicle)
        return agreement, (t, accel @ front)

    def _write_axes(self, up: Array, up_why: str, agreement: Agreement) -> Array:
        forward, words = guesses.choose_forward(up), "CHECK: nothing tells which way is forward"
        lag = agreement.clearest
        if lag is not None and agreement.forward is not None and lag.correlation > 0.3:
            forward = agreement.forward
            sure = "forward" if lag.correlation > LIKELY else "CHECK: forward, not surely,"
            words = (
                f"{sure} is the direction of the accelerations of the fixes (coherence {lag.correlation:.2f}, "
                f"{abs(lag.slope):.2f} of their size)"
            )
        letters, (front, top) = guesses.guess_axes(up, forward)
        if letters is not None:
            self.file.write_key("axes", f'"{letters}"', f"{up_why}; {words}")
        else:
            self.file.write_key("forward", format_vector(front), words)
            self.file.write_key("up", format_vector(top), up_why)
        return front

    def _write_noise(self, t: Array, gyro: Array, accel: Array, vehicle: bool) -> None:
        self.file.lines += ['# model = "..."                             # the IMU, if docs/imu-models.md has it']
        self.file.lines += ["", "[imu.noise]                                 # better: the data sheet's figures"]
        units = {"gyro_noise_density": "rad/s/sqrt(Hz)", "accel_noise_density": "m/s2/sqrt(Hz)"}
        where = "between its quietest and usual state" if vehicle else "in its quietest rest or stance"
        for key, value in measure_densities(t, gyro, accel, walks=not vehicle).items():
            self.file.write_key(key, f"{value:g}", f"{units[key]}, measured, {where}")

    def _write_gnss(self, source: Source, agreement: Agreement) -> None:
        self.file.begin("gnss")
        late = agreement.late_velocity
        numbers = self._choose_type_numbers(source)
        missing = self._list_missing_sigmas(source)
        if source.log is None and has_attitude(source):
            self.file.decide(
                f"CHECK: {source.path.name} has attitude: an INS's estimates, whose errors last, not fixes"
            )
        added = self._choose_geoid(source)
        dropped = (
            *(VELOCITIES if late is not None else ()),
            *(("type",) if numbers is None else ()),
            *(("sd_e", "sd_n", "sd_u") if missing else ()),  # all three or none
            *(() if added else ("geoid",)),
        )
        self.file.write_file(source, "gnss", dropped)
        if source.log is None:
            self._write_fix_units(source, numbers, late)
            if missing:
                none = "none" if len(missing) == 3 else "none of all three"
                why = (
                    f"CHECK: m, 1-sigma east, north, up; the file states {none}, this is a receiver without corrections"
                )
                self.file.write_key("sd", _SD, why)
            height = source.columns.names["h"]
            if is_above_sea(height) and not added:
                self.file.decide(f"heights: '{height}' may be above mean sea level; they are used as they are")
        if late is not None:
            words = f"velocities are not used: they come {late:.2f} s after the positions"
            self.file.lines.append(f"# {words}")
            self.file.decide(words)
        self.file.write_lever_arm(
            source.log.gnss if source.log else None, "from the IMU to the antenna: right, forward, up"
        )
        self._write_time_offset(agreement)

    def _choose_type_numbers(self, source: Source) -> Guess | None:
        """The numbers of the types of fixes; None where a column is not surely of types, or there is none."""
        if "type" not in source.values:
            return None
        numbers = guesses.guess_fix_numbers(source.values["type"], source.values.get("sd_e"))
        theirs = source.columns.names["type"]
        if numbers.value is None and theirs != "type":
            self.file.decide(f"types of fixes: column '{theirs}' is left alone: {numbers.why}")
            return None
        return numbers

    def _list_missing_sigmas(self, source: Source) -> set[str]:
        """The sigmas of positions that are not in the file and do not follow from those that are."""
        missing = {"sd_e", "sd_n", "sd_u"} - source.values.keys()
        if missing != {"sd_u"}:
            return missing
        theirs = source.columns.names["sd_e"]
        self.file.decide(f"sigmas: '{theirs}' is that of each horizontal axis, heights twice as uncertain")
        return set()

    def _choose_geoid(self, source: Source) -> bool:
        """Whether heights of the geoid are added to those above the sea."""
        if "geoid" not in source.values:
            return False
        height = source.columns.names.get("h", "")
        pair = f"'{height}' and '{source.columns.names['geoid']}'"
        of_sea = is_above_sea(height)
        if of_sea and (source.find_unit("h", "length") or "m") == (source.find_unit("geoid", "length") or "m"):
            self.file.decide(f"heights: above the ellipsoid, as {pair} add up")
            return True
        why = "one is not in the other's unit" if of_sea else "a height above the ellipsoid needs none"
        self.file.decide(f"heights: CHECK: {pair} are not added up: {why}")
        return False

    def _write_fix_units(self, source: Source, numbers: Guess | None, late: float | None) -> None:
        """Write the units of a table's columns of fixes, whose velocities come `late` s after the positions, if so.

        Raises
        ------
        RecordingError
            If it has no heights.
        """
        if "h" not in source.values:
            raise RecordingError(
                f"{source.path}: no column of heights beside {source.columns.names['lat']}: add a column h, "
                "in m; one height throughout, that of the place, is given a large sigma",
                key="draft.no_heights",
            )
        units = {"t": source.t_unit}
        if numbers is not None and numbers.value is not None:
            units["type"] = numbers
        units |= _list_place_units(source)
        if {"speed", "course"} <= source.values.keys() and "ve" not in source.values and late is None:
            units["speed"] = guess_fix_speed_unit(source)
        elif stated := source.find_unit("ve", "speed"):
            units["speed"] = Guess(stated, "as the column's name says")
        self.file.write_units(units)

    def _write_time_offset(self, agreement: Agreement) -> None:
        """Write what is to be added to the stamps of the fixes, if that is seen."""
        if agreement.offset is not None:
            seconds, sigma = agreement.offset
            sure = "" if sigma < motion.GRID else "CHECK: "
            why = f"{sure}s, +-{max(sigma, 0.01):.2f}; the accelerations agree best with the IMU's so"
            if self.epochs is not None:
                rest = seconds - self.epochs.offset
                why = f"s; {self.epochs.words}"
                if rest:
                    why += (
                        f"; the rest, {rest:+.2f} +-{max(sigma, 0.01):.2f}, is what the accelerations agree best with"
                    )
            self.file.write_key("time_offset", f"{seconds:.2f}", why)

    def _write_odometer(self, source: Source, course: motion.Course | None, felt: tuple[Array, Array]) -> None:
        self.file.begin("odometer")
        self.file.write_file(source, "odometer")
        if source.log is None:
            speed = guesses.guess_speed_unit(
                source.t, source.values["speed"], course, source.find_unit("speed", "speed")
            )
            self.file.write_units({"t": source.t_unit, "speed": speed})
            lag = motion.find_odometer_lag(source.t, source.values["speed"] * SPEED[str(speed.value)], felt)
            if lag is not None and lag.correlation > LIKELY and abs(lag.seconds) > _SMALL:
                sure = "" if lag.correlation > CLEAR else "CHECK: "
                why = f"the accelerations agree best with the IMU's so (coherence {lag.correlation:.2f})"
                self.file.write_key("time_offset", f"{-lag.seconds:.2f}", f"{sure}s; {why}")
                self.file.write_key("delay_sigma", "0.05", "s, what is left of it; it is estimated")
        self.file.write_lever_arm(
            source.log.odometer if source.log else None, "from the IMU to the middle of the rear axle"
        )

    def _write_barometer(self, source: Source) -> None:
        self.file.begin("barometer")
        self.file.write_file(source, "barometer")
        unit = guess_file_pressure_unit(source)
        assert unit is not None
        self.file.write_units({"t": source.t_unit, "pressure": unit})

    def _write_truth(self, source: Source, imu: Source, fixes: bool) -> None:
        self.file.begin("truth")
        self.file.write_file(source, "truth")
        units = {"t": source.t_unit, **_list_place_units(source)}
        if stated := source.find_unit("ve", "speed"):
            units["speed"] = Guess(stated, "as the column's name says")
        self.file.write_units(units)
        if is_above_sea(height := source.columns.names["h"]):
            self.file.decide(f"heights: '{height}' may be above mean sea level; they are used as they are")
        turns = "roll" in source.values
        other = "or [x, y, z], m right, forward, up of the IMU"
        if turns or not fixes:
            self.file.write_key("of", '"imu"', f'CHECK: its point: "imu", "gnss", "odometer" {other}')
        else:
            self.file.write_key("of", '"gnss"', f'CHECK: its point, here the antenna; else "imu" {other}')
        if (epochs := _find_epoch(imu, source)) is not None and epochs.offset:
            self.file.write_key("time_offset", f"{epochs.offset:.2f}", f"s; {epochs.words}")


def _list_place_units(source: Source) -> dict[str, Guess]:
    """Units of positions other than deg and m."""
    units = {}
    if source.radians:
        units["angle"] = Guess("rad", "lat and lon are all small enough")
    if source.find_unit("h", "length") == "ft":
        units["height"] = Guess("ft", "as the column's name says")
    return units


def _find_epoch(imu: Source, other: Source) -> ClockOffset | None:
    """Offset between the clocks of two logs, where both are known."""
    first = [_read_first(source, sensor) for source, sensor in ((imu, "imu"), (other, "gnss"))]
    found = compute_clock_offset(first[0], imu.gps_zero, first[1], other.gps_zero)
    return found if found is not None and abs(first[1] + found.offset - first[0]) < NEAR else None


def _read_first(source: Source, sensor: str) -> float:
    return float((source.t if source.log is None else getattr(source.log, sensor).t)[0])
