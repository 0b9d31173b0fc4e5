"""Reading settings from files, and writing them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from graphnav.config.settings import PROFILES, Profile, Settings
from graphnav.core.complaints import describe_invalid, read_toml
from graphnav.core.errors import ConfigError
from graphnav.core.files import parse_json, read_text
from graphnav.sensors import list_sensors


def parse_settings(values: Mapping[str, Any], source: str = "settings", text: str = "") -> Settings:
    """Validate a nested mapping, that of the file whose `text` is given.

    Raises
    ------
    ConfigError
        For an invalid value or key; names the source, line, key, value and unit, and the nearest known key.
    """
    try:
        return Settings.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(describe_invalid(source, error, Settings, text)) from None


def read_settings(path: str | Path | None = None, profile: str | None = None) -> Settings:
    """Settings from a file over those of a profile over the defaults.

    Parameters
    ----------
    path
        TOML, or the summary.json of a run, for its settings; None: no file.
    profile
        One of `PROFILES`; overrides the file's own.

    Returns
    -------
    Settings
        All settings, defaults included.

    Raises
    ------
    ConfigError
        If the file cannot be read or contains invalid settings, or there is no such profile.
    """
    values: Mapping[str, Any] = {}
    text = ""
    if path is not None and Path(path).suffix == ".json":
        values = _take_settings_of_run(Path(path))
    elif path is not None:
        values, text = read_toml(Path(path), ConfigError)
    if profile is not None:
        if profile not in PROFILES:
            raise ConfigError(
                f"--profile {profile}: no such profile; known: {', '.join(get_args(Profile))}", key="option.value"
            )
        values = {**values, "profile": profile}
    return parse_settings(values, "settings" if path is None else str(path), text)


def _take_settings_of_run(path: Path) -> Mapping[str, Any]:
    """The settings that a summary.json holds."""
    try:
        values = parse_json(read_text(path, ConfigError))["settings"]
    except (ValueError, KeyError, TypeError):
        raise ConfigError(
            f"{path}: holds no settings; name a settings file (TOML) or a summary.json", key="settings.none"
        ) from None
    if not isinstance(values, Mapping):
        raise ConfigError(
            f"{path}: holds no settings; name a settings file (TOML) or a summary.json", key="settings.none"
        )
    return values


def format_settings(settings: Settings) -> str:
    """The text of a file that `read_settings` reads: every key with its unit and description, unset keys as
    comments.
    """
    lines: list[str] = []

    def format_table(section: BaseModel, at: str) -> None:
        nested: dict[str, BaseModel] = {}
        for name, field in type(section).model_fields.items():
            value = getattr(section, name)
            if name == "sensors":  # a table for each sensor, whether set or not
                nested |= {f"{name}.{sensor}": settings.get_sensor(sensor) for sensor in list_sensors()}
                continue
            if isinstance(value, BaseModel):
                nested[name] = value
                continue
            setting = f"# {name} =" if value is None else f"{name} = {format_toml_value(value)}"
            lines.append(f"{setting:<30} # {field.description}")
        for name, inner in nested.items():
            place = f"{at}.{name}" if at else name
            if any(not isinstance(getattr(inner, key), BaseModel) for key in type(inner).model_fields):
                lines.extend(["", f"[{place}]"])
            format_table(inner, place)

    format_table(settings, "")
    return "\n".join(lines) + "\n"


def format_toml_value(value: Any) -> str:
    """The TOML text of a value; JSON's numbers, strings and lists are valid TOML."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {format_toml_value(one)}" for key, one in value.items()) + " }"
    return json.dumps(value)
