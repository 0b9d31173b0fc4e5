"""Colours of all figures, for light pages and for dark ones."""

from __future__ import annotations

import re
from collections.abc import Sequence

# Okabe and Ito, "Color Universal Design" (2008): distinguishable with every common colour vision. The second colour of
# each is for dark pages.
PALETTE = {
    "ekf": ("#d55e00", "#f08a3c"),
    "rts": ("#cc79a7", "#e3a3c6"),
    "incremental": ("#009e73", "#27c79a"),
    "isam2": ("#7d5a3c", "#c9a17e"),
    "batch": ("#0072b2", "#55aef0"),
    "ekf-loose": ("#f0a372", "#a8602a"),
    "rts-loose": ("#e3b9d2", "#966080"),
    "incremental-loose": ("#74c9af", "#1d7f64"),
    "batch-loose": ("#7fb3d8", "#2f719f"),
    "truth": ("#4a4a4b", "#d8d8d9"),
    "other": ("#8a7a00", "#d9cc4a"),
    "other-2": ("#a8006d", "#ff7ac2"),
    "other-3": ("#00767f", "#3fd0d8"),
    "other-4": ("#5a5f8f", "#a3a9e6"),
    "alert": ("#b3261e", "#ff8a80"),
    "withheld": ("#e69f00", "#e6a41a"),
    "outage": ("#71809c", "#8da0c4"),
    "stop": ("#6f42a8", "#c3a1f0"),
    "ink": ("#6a6a6b", "#a9a9aa"),
    "paper": ("#ffffff", "#ffffff"),  # on the spectrogram, for light and dark pages
    "grid": ("#dededf", "#35373b"),
    # of fixes, by type (or stated accuracy), the best first
    "fixed": ("#2f8f4e", "#5fd28a"),
    "float": ("#b7860b", "#f0c040"),
    "ppp": ("#0b7d86", "#4fd0da"),
    "differential": ("#4469c9", "#92aef5"),
    "sbas": ("#9a4fb0", "#d49be6"),
    "single": ("#c04a3a", "#f59080"),
}


_OTHERS = [name for name in PALETTE if name.startswith("other")]


def name_variable(name: str) -> str:
    """The CSS variable with the colour of a solver or another drawn object."""
    return f"--{name}" if name in PALETTE else "--of-" + re.sub(r"[^\w-]", lambda found: f"_{ord(found[0])}", name)


def format_css(others: Sequence[str] = ()) -> str:
    """CSS variables of the palette, for light pages and, where preferred, dark ones, and of other programs."""
    light, dark = ("".join(f"--{name}:{pair[i]};" for name, pair in PALETTE.items()) for i in (0, 1))
    light += "".join(f"{name_variable(name)}:var(--{_OTHERS[k % len(_OTHERS)]});" for k, name in enumerate(others))
    return f":root{{{light}}}\n@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}"
