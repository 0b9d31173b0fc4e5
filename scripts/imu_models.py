"""The table of docs/experiments/imu-models.md, read off the code.

python scripts/imu_models.py
"""

from __future__ import annotations

from graphnav.imu.preintegration import NOISE_FIGURES
from graphnav.recording.formats.imu_models import MODELS

HEAD = """\
| model | gyro noise, rad/s/sqrt(Hz) | accelerometer noise, m/s2/sqrt(Hz) | gyro walk, rad/s/sqrt(s) | \
accelerometer walk, m/s2/sqrt(s) | source |
| --- | ---: | ---: | ---: | ---: | --- |
"""


def table() -> str:
    """A row per model: its figures in SI, blank where its source states none, and the source."""
    rows = []
    for name, model in MODELS.items():
        figures = (f"{model.noise[one]:.2g}" if one in model.noise else "" for one in NOISE_FIGURES)
        rows.append(f"| `{name}` | {' | '.join(figures)} | {model.source} |\n")
    return HEAD + "".join(rows)


if __name__ == "__main__":
    print(table(), end="")
