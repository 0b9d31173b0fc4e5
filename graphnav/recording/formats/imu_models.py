"""Noise figures of well-known IMUs, for ``model = "..."`` in a recording's [imu], each with its source.

The sources are of three kinds, which mean different things:

- data sheets: white noise, and usually the in-run bias stability B, of a sensor at rest on a bench. They do not state
  the random walk of the bias that a filter needs; it is taken as B over the root of `FLOOR_TIME`, where the Allan
  deviation of such sensors is lowest;
- figures tuned by others on drives: white noise that includes vibration, and a first-order Gauss-Markov bias of sigma s
  and correlation time T, which is a random walk of s sqrt(2/T) starting from s;
- Allan variances, with both random walks measured.

In a car that vibrates the figures are larger than on a bench; they are estimated from the drive.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from graphnav.recording.formats.figures import parse_figure

FLOOR_TIME = 100.0  # s


@dataclass(frozen=True)
class ImuModel:
    """One IMU: figures in SI by their recording.toml names, and their source."""

    name: str
    noise: dict[str, float]
    source: str


def _convert_figures(gyro: dict[str, str], accel: dict[str, str]) -> dict[str, float]:
    """Figures in SI; keys are those of recording.toml without the sensor."""
    sensors = (("gyro", gyro), ("accel", accel))
    return {f"{s}_{k}": parse_figure(f"{s}_{k}", v) for s, figures in sensors for k, v in figures.items()}


def _read_sheet(
    name: str, source: str, white: tuple[str, str], stability: tuple[str, str] | None = None,
    turn_on: tuple[str, str] | None = None, scale: tuple[str, str] | None = None,
) -> ImuModel:  # fmt: skip
    """Figures from a data sheet: gyro and accelerometer each."""
    noise = _convert_figures({"noise_density": white[0]}, {"noise_density": white[1]})
    if stability is not None:
        inside = _convert_figures({"bias_sigma": stability[0]}, {"bias_sigma": stability[1]})
        noise |= {key.replace("sigma", "walk"): value / FLOOR_TIME**0.5 for key, value in inside.items()}
    if turn_on is not None:
        noise |= _convert_figures({"bias_sigma": turn_on[0]}, {"bias_sigma": turn_on[1]})
    if scale is not None:
        noise |= _convert_figures({"scale_sigma": scale[0]}, {"scale_sigma": scale[1]})
    return ImuModel(name, noise, source)


def _read_tuning(
    name: str, source: str, white: tuple[str, str], bias: tuple[str, str], hours: float,
    scale: tuple[str, str] | None = None,
) -> ImuModel:  # fmt: skip
    """Figures from a filter's settings with Gauss-Markov biases of a correlation time in hours."""
    noise = _read_sheet(name, source, white, None, bias, scale).noise
    root = (2.0 / (hours * 3600.0)) ** 0.5
    walks = {f"{s}_bias_walk": noise[f"{s}_bias_sigma"] * root for s in ("gyro", "accel")}
    return ImuModel(name, noise | walks, source)


_GINS = "README of awesome-gins-datasets, section 1: tuned on drives"
_ALL: tuple[ImuModel, ...] = (
    _read_tuning("ICM20602", _GINS, ("0.2 deg/sqrt(h)", "0.2 m/s/sqrt(h)"), ("200 deg/h", "1000 mGal"), 1.0),
    _read_tuning("ADIS16460", _GINS, ("0.2 deg/sqrt(h)", "0.1 m/s/sqrt(h)"), ("20 deg/h", "100 mGal"), 1.0),
    _read_tuning("ADIS16465", _GINS, ("0.1 deg/sqrt(h)", "0.1 m/s/sqrt(h)"), ("25 deg/h", "200 mGal"), 1.0),
    _read_tuning("HGuide-i300", _GINS, ("0.2 deg/sqrt(h)", "0.2 m/s/sqrt(h)"), ("15 deg/h", "150 mGal"), 1.0),
    _read_tuning("Leador-A15", "KF-GINS, dataset/kf-gins.yaml",
           ("0.003 deg/sqrt(h)", "0.03 m/s/sqrt(h)"), ("0.027 deg/h", "15 mGal"), 4.0, ("300 ppm", "300 ppm")),
    ImuModel("ADIS16448",
             _convert_figures({"noise_density": "1.6968e-4 rad/s/sqrt(Hz)", "bias_walk": "1.9393e-5 rad/s/sqrt(s)"},
                      {"noise_density": "2.0e-3 m/s2/sqrt(Hz)", "bias_walk": "3.0e-3 m/s2/sqrt(s)"}),
             "EuRoC data set (Burri et al., 2016), imu0/sensor.yaml: Allan variance"),
    _read_sheet("STIM300", "data sheet of Sensonor (10 g range), by the documentation of NavToolkit",
           ("0.15 deg/sqrt(h)", "0.06 m/s/sqrt(h)"), ("0.5 deg/h", "0.05 mg"), ("4 deg/h", "0.75 mg"),
           ("500 ppm", "300 ppm")),
    _read_sheet("Ellipse2", "data sheet of SBG, by a table of NAVIGATION (ion.org)",
           ("0.15 deg/sqrt(h)", "0.033 m/s/sqrt(h)"), ("7 deg/h", "0.014 mg"),
           ("70 deg/h", "0.14 mg")),
    _read_sheet("MTi-1", "data sheet of Xsens, by Transactions on Aerospace Research, tar-2023-0022",
           ("0.007 deg/s/sqrt(Hz)", "120 ug/sqrt(Hz)"), ("10 deg/h", "0.03 mg")),
    _read_sheet("ICM-42688-P", "data sheet of TDK InvenSense",
           ("2.8 mdps/sqrt(Hz)", "70 ug/sqrt(Hz)")),
    _read_sheet("ICM-42605", "data sheet of TDK InvenSense DS-000292 1.5",
           ("3.8 mdps/sqrt(Hz)", "70 ug/sqrt(Hz)")),
    _read_sheet("LSM6DSV", "data sheet of STMicroelectronics, by the documentation of Luxonis",
           ("2.8 mdps/sqrt(Hz)", "60 ug/sqrt(Hz)")),
)  # fmt: skip

MODELS = {model.name: model for model in _ALL}


def find_model(name: str) -> ImuModel | None:
    """Find a model by name; capitals, blanks and dashes do not matter."""
    plain = _normalise_name(name)
    return next((model for model in _ALL if _normalise_name(model.name) == plain), None)


def _normalise_name(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
