"""The lines of a recording.toml; every decision goes into a comment and into a list."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graphnav.core.files import is_inside
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Odometer
from graphnav.recording.draft.guesses import Guess
from graphnav.recording.draft.sources import JOINED, name_plain_file
from graphnav.recording.draft.tables import Source
from graphnav.recording.formats.schema import GEOID
from graphnav.recording.formats.writer import quote

_SHOWN = 8  # unused columns that are named: covariances of ROS are 27


class Document:
    """A recording.toml as it is written, table by table.

    Parameters
    ----------
    folder : where it is to be.
    asked : topics that were asked for, of a ROS bag.
    """

    def __init__(self, folder: Path, asked: Sequence[str]) -> None:
        self.folder, self.asked = folder, asked
        self.lines: list[str] = []
        self.decisions: list[str] = []
        self.table = ""  # before each decision, as the same keys are in several
        self.made: dict[str, dict[str, Array]] = {}

    def begin(self, table: str) -> None:
        self.lines += ["", f"[{table}]"]
        self.table = f"[{table}] "

    def decide(self, words: str) -> None:
        self.decisions.append(self.table + words)

    def write_key(self, key: str, value: str, why: str) -> None:
        self.lines.append(f"{key} = {value}".ljust(43) + f" # {why}")
        self.decide(f"{key} = {value}: {why}")

    def write_file(self, source: Source, sensor: str, dropped: Sequence[str] = ()) -> None:
        relative = Path(os.path.relpath(source.path.resolve(), self.folder.resolve())).as_posix()
        if source.joined_from is not None:
            relative = JOINED
            self.made[relative] = source.values
            rates, forces = (path.name for path in source.joined_from)
            self.decide(f"{relative}: made of {rates} and {forces}, the forces at the times of the rates")
        elif source.plain is not None:
            relative = name_plain_file(source.path, sensor)
            self.made[relative] = {source.columns.names[ours]: x for ours, x in source.values.items()}
            words = f"made of {source.path.name}: {source.plain.words}"
            self.lines.append(f"# {words}")
            self.decide(f"{relative}: {words}")
        self.lines.append(f"file = {quote(relative)}")
        if source.unused:
            more = len(source.unused) - _SHOWN
            shown = [*source.unused[:_SHOWN], *([f"and {more} more"] if more > 0 else [])]
            self.decide(f"{source.path.name}: columns not used: {', '.join(shown)}")
        if source.second:
            words = f"CHECK: {source.second} may be of another sensor of this kind; to use that, give those in columns"
            self.lines.append(f"# {words}")
            self.decide(f"{relative}: {words}")
        if source.log is not None and (topics := source.log.topics.get(sensor, ())):
            why = "the only one"
            if len(topics) > 1 and topics[0] in self.asked:
                why = "as was asked"
            elif len(topics) > 1:
                why = (
                    f"CHECK: it has the most messages; there is also {', '.join(topics[1:])}: to use it, draft again "
                    f"with --topic {topics[1]} --force"
                ) + (", since axes and noise are of this one" if sensor == "imu" else "")
            self.write_key("topic", quote(topics[0]), why)
        if source.joined_from is None and source.plain is None and not is_inside(source.path, self.folder):
            words = f"{relative}: lies outside the folder of this file; use --allow-outside to read it"
            self.decide(words)
        names = {o: theirs for o, theirs in source.columns.names.items() if o not in dropped}
        names = {o: theirs for o, theirs in names.items() if o != theirs or o == GEOID}
        if names:
            pairs = ", ".join(f"{ours} = {quote(theirs)}" for ours, theirs in names.items())
            self.lines.append(f"columns = {{ {pairs} }}")

    def write_units(self, units: dict[str, Guess]) -> None:
        default = {"type": "rtklib", "t": "s", "gyro": "rad/s", "accel": "m/s2", "angle": "deg", "speed": "m/s"}
        default |= {"height": "m", "pressure": "Pa"}
        for key, guess in units.items():
            self.decide(f"{key} in {guess.value}: {guess.why}")
        other = {key: guess for key, guess in units.items() if guess.value != default[key]}
        if other:
            pairs = ", ".join(f'{key} = "{guess.value}"' for key, guess in other.items())
            why = "; ".join(f"{key}: {guess.why}" for key, guess in other.items())
            self.lines.append(f"units = {{ {pairs} }}".ljust(43) + f" # {why}")

    def write_lever_arm(self, sensor: Gnss | Odometer | None, what: str) -> None:
        """Write the lever arm of a log, if it has one."""
        if sensor is not None and np.any(sensor.lever_arm):
            self.write_key("lever_arm", format_vector(sensor.lever_arm), f"m, {what}; as the log says")
        else:
            self.write_key("lever_arm", "[0.0, 0.0, 0.0]", f"CHECK: m, {what}")


def format_vector(v: Array) -> str:
    return "[" + ", ".join(f"{x:.4f}" for x in v) + "]"
