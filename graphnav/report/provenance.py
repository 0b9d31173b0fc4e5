"""Inputs, versions, settings and command of a result: enough to reproduce it."""

from __future__ import annotations

import base64
import json
import shlex
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from graphnav.report import page, wording
from graphnav.report.wording import join_words

SETTINGS = "settings.toml"


def tabulate_provenance(settings: Mapping[str, Any], provenance: Mapping[str, Any] | None) -> list[Markup]:
    """The command and settings that reproduce the result; versions and inputs."""
    provenance = dict(provenance or {})
    out = []
    options = provenance.pop("options", None)
    toml = format_toml(settings)
    if options:
        saved = f"save the settings below as {SETTINGS}, " if toml else ""
        out.append(page.paragraph(f"To repeat this run, {saved}take the inputs and versions listed, and call"))
        out.append(page.code(format_command(options, bool(toml)), "command"))
    if toml:
        data = base64.b64encode(toml.encode()).decode("ascii")
        out.append(page.fold("Settings as resolved", [page.download(SETTINGS, data), page.code(toml, "settings")]))
    inputs = provenance.pop("inputs", {})
    if provenance:
        noise = provenance.pop("noise", None)
        listed = [f"{key} {wording.format_value(value)}" for key, value in page.flatten(provenance).items()]
        words = [*([join_words(listed)] if listed else []), *([f"noise figures: {noise}"] if noise else [])]
        out += [page.heading("Versions"), page.paragraph("; ".join(words))]
    if inputs:
        rows = [[name, page.digest(digest)] for name, digest in inputs.items()]
        out += [page.heading("Inputs"), page.make_table(["file", "sha256"], rows)]
    return out


def format_command(options: Mapping[str, Any], settings: bool = True) -> str:
    """The command line for options as `app.workflow.Request` stores them, with `SETTINGS` if given."""
    given = dict(options)
    name = "compare" if "solvers" in given else "smooth"
    words = ["graphnav", name, str(given.pop("recording", "RECORDING"))]
    given.pop("config", None)
    for key, value in given.items():
        if value is None or value is False:
            continue
        for one in value if isinstance(value, list | tuple) else [value]:
            words += [f"--{key.replace('_', '-')}"] if one is True else [f"--{key.replace('_', '-')}", str(one)]
    words += ["--config", SETTINGS] if settings else []
    return shlex.join([*words, "-o", "again"])


def format_toml(values: Mapping[str, Any], table: str = "") -> str:
    """Nested plain values as TOML; None is omitted, as TOML cannot express it."""
    plain = [f"{key} = {_format_toml(value)}" for key, value in values.items()
             if value is not None and not isinstance(value, Mapping)]  # fmt: skip
    head = [f"[{table}]"] if table and (plain or not values) else []
    parts = ["\n".join([*head, *plain])] if head or plain else []
    for key, value in values.items():
        if isinstance(value, Mapping):
            parts.append(format_toml(value, f"{table}.{key}" if table else key).rstrip("\n"))
    return "\n\n".join(part for part in parts if part) + "\n" if any(parts) else ""


def _format_toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(_format_toml(one) for one in value)}]"
    # JSON's numbers, booleans and strings are valid TOML
    return json.dumps(value, ensure_ascii=False)
