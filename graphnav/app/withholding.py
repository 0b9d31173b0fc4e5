"""What a run withholds from the solvers, to compare with it: `--without`."""

from __future__ import annotations

import re

import numpy as np

from graphnav.app.scores import Withheld
from graphnav.core.complaints import suggest_nearest
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.notes import Notes
from graphnav.recording import Recording, list_sources


def parse_withheld(text: str) -> Withheld:
    """Parse ``gnss:600-660`` or ``odometer`` into (source, span in s or None).

    Raises
    ------
    ConfigError
        If it is not of that form, or no source of that name can be withheld.
    """
    found = re.fullmatch(r"([^:]*)(?::([^-]+)-([^-]+))?", text.strip())
    if re.fullmatch(r"[\d.]+-[\d.]+", text.strip()):
        first, *others = list_sources()
        words = f"{first}:{text.strip()}, or the same of {' or '.join(others)}"
        raise ConfigError(f"--without {text}: name the sensor: {words}", key="option.withheld")
    usage = "write SOURCE or SOURCE:FROM-TO in seconds from the start, such as gnss:600-660"
    if found is None:
        raise ConfigError(f"--without {text}: not a source and a span; {usage}", key="option.withheld")
    source, first, last = found.groups()
    if source not in list_sources():
        raise ConfigError(
            f"--without {text}: no source '{source}' can be withheld; {suggest_nearest(source, list_sources())}",
            key="option.withheld",
        )
    if first is None:
        return source, None
    try:
        span = float(first), float(last)
    except ValueError:
        raise ConfigError(
            f"--without {text}: '{first}-{last}' is not a span of two numbers; {usage}", key="option.withheld"
        ) from None
    if not (np.isfinite(span).all() and span[0] < span[1]):
        raise ConfigError(f"--without {text}: the span must end after it begins; {usage}", key="option.withheld")
    return source, span


def shift_spans(withheld: tuple[Withheld, ...], by: float) -> tuple[Withheld, ...]:
    """The same spans, from a start that is later by so many s."""
    return tuple((source, span and (span[0] - by, span[1] - by)) for source, span in withheld)


def withhold(recording: Recording, withheld: tuple[Withheld, ...], zero: float) -> tuple[Recording, list[str]]:
    """The recording without what is withheld (s from its start), and notes where that changed nothing."""
    used = recording
    notes = Notes()
    for source, span in withheld:
        name = source if span is None else f"{source}:{span[0] + zero:g}-{span[1] + zero:g}"
        if span is not None and (span[1] <= 0.0 or span[0] >= recording.duration):
            raise RecordingError(
                f"--without {name}: lies outside '{recording.name}', which runs from {zero:.0f} to "
                f"{zero + recording.duration:.1f} s",
                key="option.span_outside",
            )
        if source in recording.aiding and source not in used.aiding:
            continue  # already removed
        before = used
        used = used.without(source, span)
        if span is not None and len(used.aiding[source].t) == len(before.aiding[source].t):
            notes.add("withheld.nothing", f"--without {name}: there was no {source} row in that span anyway")
    return used, notes
