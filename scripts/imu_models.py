"""The table of docs/experiments/imu-models.md, read off the code: python scripts/imu_models.py writes it anew."""

from __future__ import annotations

import re
from pathlib import Path

from graphnav.imu.preintegration import NOISE_FIGURES
from graphnav.recording.formats.imu_models import MODELS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "experiments" / "imu-models.md"
TABLE = re.compile(r"(?<=\| --- \| ---: \| ---: \| ---: \| ---: \| --- \|\n)(\|.*\n)+")


def table() -> str:
    """A row per model: its figures in SI, blank where its source states none, and the source."""
    rows = []
    for name, model in MODELS.items():
        figures = (f"{model.noise[one]:.2g}" if one in model.noise else "" for one in NOISE_FIGURES)
        rows.append(f"| `{name}` | {' | '.join(figures)} | {model.source} |\n")
    return "".join(rows)


if __name__ == "__main__":
    PAGE.write_text(TABLE.sub(lambda _: table(), PAGE.read_text(encoding="utf-8")), encoding="utf-8")
