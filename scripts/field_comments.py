"""For `make docs`: the comment behind a field, which gives its shape and unit, is its entry in the reference."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import griffe

_COMMENT = re.compile(r"\s#\s+(?!type:|noqa)(.+)$")


class FieldComments(griffe.Extension):
    """Reads them; see https://mkdocstrings.github.io/griffe/guide/users/extending."""

    def on_attribute_instance(self, *, node: ast.AST | Any, attr: griffe.Attribute, **_: Any) -> None:
        """Give an attribute without a docstring its comment."""
        if attr.docstring is not None or attr.lineno is None or not isinstance(attr.filepath, Path):
            return
        line = attr.filepath.read_text(encoding="utf-8").splitlines()[(attr.endlineno or attr.lineno) - 1]
        if found := _COMMENT.search(line):
            attr.docstring = griffe.Docstring(found[1], lineno=attr.lineno, endlineno=attr.lineno, parent=attr)
