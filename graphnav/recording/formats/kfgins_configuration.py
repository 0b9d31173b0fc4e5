"""The configuration of KF-GINS and OB_GINS: a YAML file that names the data and holds noise figures and lever arms.

arw deg/sqrt(h), vrw m/s/sqrt(h), gbstd deg/h, abstd mGal, gsstd and asstd ppm, corrtime h: bias and scale are
first-order Gauss-Markov processes; lever arms forward-right-down.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.complaints import check_whole_numbers
from graphnav.core.errors import RecordingError
from graphnav.core.files import is_inside, read_text
from graphnav.core.notes import Notes
from graphnav.core.rotation import Array
from graphnav.recording import ImuNoise
from graphnav.recording.formats.axes import parse_axes_letters

DEG_PER_H = np.pi / 180 / 3600  # rad/s
DEG_PER_SQRT_H = np.pi / 180 / 60  # rad/s/sqrt(Hz)
MGAL = 1e-5  # m/s^2
_LEAST, _MOST = 1e-12, 1e12  # limit of a noise figure in the configuration's units: above any sensor
_DEEPEST = 50  # levels of nested tables; two are used
_MAX_LEVER_ARM = 1000.0  # m, of a lever arm


def read_configuration(path: Path) -> dict[str, Any]:
    """The values of a configuration; aliases and deep nesting are refused."""
    import yaml

    text = read_text(path)
    try:
        _check_tokens(path, yaml, text)
        values = yaml.safe_load(text)
        check_whole_numbers(values)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        why = " ".join(str(getattr(error, "problem", None) or error).split())
        raise RecordingError(f"{path}{line}: not valid YAML ({why})", key="yaml.syntax") from None
    except ValueError as error:  # an invalid date, a number of hundreds of digits
        raise RecordingError(f"{path}: not valid YAML ({error})", key="yaml.syntax") from None
    if not isinstance(values, dict):
        raise RecordingError(f"{path}: not a configuration of KF-GINS or OB_GINS", key="log.no_configuration")
    return values


def _check_tokens(path: Path, yaml: Any, text: str) -> None:
    """Refuse aliases, by which a few lines can expand to any amount of values."""
    opening = (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken,
               yaml.BlockSequenceStartToken, yaml.BlockMappingStartToken)  # fmt: skip
    closing = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken, yaml.BlockEndToken)
    depth = 0
    for token in yaml.scan(text):
        depth += isinstance(token, opening) - isinstance(token, closing)
        if isinstance(token, yaml.AliasToken):
            line = token.start_mark.line + 1
            raise RecordingError(
                f"{path}, line {line}: aliases (*name) are not read; write the values out", key="yaml.aliases"
            )
        if depth > _DEEPEST:
            raise RecordingError(
                f"{path}, line {token.start_mark.line + 1}: not valid YAML (nested too deep)", key="yaml.syntax"
            )


def find_file(config_file: Path, config: dict[str, Any], keys: tuple[str, ...], allow_outside: bool) -> Path | None:
    """The file that a key names: as written, below any folder above the configuration, or beside it."""
    key = next((k for k in keys if k in config), None)
    if key is None:
        return None
    if not isinstance(config[key], str):
        raise RecordingError(f"{config_file}, {key}: must be the name of a file", key="yaml.value")
    stated = Path(config[key].replace("\\", "/"))
    folder = config_file.resolve().parent
    for candidate in [
        stated,
        *(above / stated for above in (folder, *folder.parents)),
        config_file.parent / stated.name,
    ]:
        if (allow_outside or is_inside(candidate, folder)) and candidate.is_file():
            return candidate
    raise RecordingError(
        f"{config_file}, {key}: no file {str(stated)[:200]} beside the configuration or below it; elsewhere none is "
        "read without --allow-outside",
        key="file.missing",
    )


def read_lever_arm(where: Path, config: dict[str, Any], key: str) -> Array:
    """A lever arm of the configuration (forward, right, down) in RFU; zero where there is none."""
    value = config.get(key, [0.0, 0.0, 0.0])
    if not (
        isinstance(value, list) and len(value) == 3 and all(_is_number(x) and abs(x) <= _MAX_LEVER_ARM for x in value)
    ):
        raise RecordingError(
            f"{where}, {key}: must be three numbers, forward, right, down in m, of {_MAX_LEVER_ARM:g} m at most",
            key="yaml.value",
        )
    return parse_axes_letters("FRD") @ np.array(value, dtype=float)


def _is_number(value: Any) -> bool:
    """Whether it is a number that a float can represent."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def read_imu_noise(where: Path, config: dict[str, Any], remarks: Notes) -> ImuNoise:
    """The noise figures of the IMU."""
    section = config.get("imunoise", config.get("imumodel"))
    if not isinstance(section, dict):
        raise RecordingError(f"{where}: no table imunoise (KF-GINS) or imumodel (OB_GINS)", key="yaml.table")

    def read_figure(key: str, table: dict[str, Any] = section) -> float:
        value = table.get(key)
        stated: list[Any] = value if isinstance(value, list) else [value]
        numbers = [float(x) for x in stated if _is_number(x) and _LEAST <= x <= _MOST]
        if len(numbers) not in (1, 3) or len(numbers) < len(stated):
            raise RecordingError(
                f"{where}, {key}: must be a number above zero, or three, not {repr(value)[:60]} "
                f"(from {_LEAST:g} to {_MOST:g})",
                key="yaml.value",
            )
        if len(set(numbers)) > 1:
            remarks.add("imu.noise_axes", f"{key} differs between the axes; the root mean square is used for all")
        return float(np.sqrt(np.mean(np.square(numbers))))

    root = np.sqrt(2.0 / (read_figure("corrtime") * 3600.0))
    gyro, accel = read_figure("gbstd") * DEG_PER_H, read_figure("abstd") * MGAL
    scales = {ours: read_figure(theirs) * 1e-6 for ours, theirs in
              (("gyro_scale_sigma", "gsstd"), ("accel_scale_sigma", "asstd")) if theirs in section}  # fmt: skip
    remarks.add(
        "imu.noise_read_as",
        "noise figures: from the configuration; a Gauss-Markov bias of sigma s and correlation time T becomes a random "
        "walk of s sqrt(2/T) that starts from s",
    )
    return ImuNoise(
        gyro_noise_density=read_figure("arw") * DEG_PER_SQRT_H,
        accel_noise_density=read_figure("vrw") / 60.0,
        gyro_bias_walk=float(gyro * root),
        accel_bias_walk=float(accel * root),
        gyro_bias_sigma=read_figure("initbgstd", config) * DEG_PER_H if config.get("initbgstd") else gyro,
        accel_bias_sigma=read_figure("initbastd", config) * MGAL if config.get("initbastd") else accel,
        **scales,
    )


def mention_unused(config: dict[str, Any], remarks: Notes) -> None:
    """Remark on keys of the configuration that have no equivalent in a recording."""
    if any(key in config for key in ("starttime", "endtime")):
        span = f"{str(config.get('starttime', ''))[:30]} to {str(config.get('endtime', ''))[:30]}"
        remarks.add("log.span_not_used", f"starttime and endtime ({span}) are not applied: use --start and --end")
    if any(key in config for key in ("initpos", "initvel", "initatt")):
        remarks.add("log.start_not_used", "the initial state of the configuration is not used: graphnav finds its own")
    body = config.get("bodyangle")
    if isinstance(body, list) and any(body):
        remarks.add(
            "log.body_angle_not_used", f"bodyangle {repr(body)[:60]} deg is not applied: the body axes are the IMU's"
        )
    odometer = config.get("odometer")
    if isinstance(odometer, dict) and odometer.get("isuseodo") is False:
        remarks.add(
            "odometer.not_used_there",
            "the configuration does not use the odometer; withhold it with --without odometer",
        )
