"""Noise figures of some well-known IMUs, for ``model = "..."`` in a recording's [imu], with where each comes from.

Data sheets state white noise and, mostly, in-run bias stability; the walk of the bias, which a filter needs, they do
not. It is taken as the in-run stability B over the root of the time at which such a sensor's Allan deviation is lowest,
taken as `FLOOR_TIME`. Turn-on biases are the data sheet's where it states them. A car shakes: what the figures turn
out to be while driving is larger, and is judged from the drive.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from graphnav.formats.figures import parse_figure

FLOOR_TIME = 100.0  # s


@dataclass(frozen=True)
class ImuModel:
    """One IMU: figures in SI by their recording.toml names, and their source in words."""

    name: str
    noise: dict[str, float]
    source: str


def _model(
    name: str,
    source: str,
    gyro: str,
    accel: str,
    stability: tuple[str, str] | None = None,
    turn_on: tuple[str, str] | None = None,
    scale: tuple[str, str] | None = None,
) -> ImuModel:
    """A model from figures in the units of its data sheet: of gyro and accelerometer each."""
    noise = {
        "gyro_noise_density": parse_figure("gyro_noise_density", gyro),
        "accel_noise_density": parse_figure("accel_noise_density", accel),
    }
    for k, kind in enumerate(("gyro", "accel")):
        if stability is not None:
            noise[f"{kind}_bias_walk"] = parse_figure(f"{kind}_bias_sigma", stability[k]) / FLOOR_TIME**0.5
        if turn_on is not None:
            noise[f"{kind}_bias_sigma"] = parse_figure(f"{kind}_bias_sigma", turn_on[k])
        if scale is not None:
            noise[f"{kind}_scale_sigma"] = parse_figure(f"{kind}_scale_sigma", scale[k])
    return ImuModel(name, noise, source)


_ALL: tuple[ImuModel, ...] = (
    _model("ADIS16465-1", "Analog Devices data sheet ADIS16465, table 1", "0.15 deg/sqrt(h)", "0.012 m/s/sqrt(h)",
           ("2 deg/h", "3.6 ug"), ("0.14 deg/s", "1.4 mg")),
)  # fmt: skip

MODELS = {model.name: model for model in _ALL}


def find_model(name: str) -> ImuModel | None:
    """A model by its name, however it is spelt: capitals, blanks and dashes do not matter."""
    plain = _plain(name)
    return next((model for model in _ALL if _plain(model.name) == plain), None)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
