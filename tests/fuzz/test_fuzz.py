"""Five hundred spoilt files: none ends in a traceback, hangs, or is misread; scripts/fuzz.py makes more."""

from __future__ import annotations

import warnings
from pathlib import Path

import cases
import pytest

_CASES, _AT_ONCE = 500, 125


@pytest.mark.parametrize("first", range(0, _CASES, _AT_ONCE))
def test_spoilt_files_are_right_or_refused(tmp_path: Path, first: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of numbers that overflow, which the program does not show either
        results = [cases.play(number, tmp_path) for number in range(first, first + _AT_ONCE)]
    bad = [one for one in results if one.kind not in ("right", "refused")]
    assert not bad, "\n".join(f"case {one.number} ({one.target}): {one.kind}: {one.said[-500:]}" for one in bad)
    assert sum(one.kind == "right" for one in results) > 10  # else nothing much was tried


def test_what_counts_as_wrong_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fuzzer's own eyes: a traceback, an endless loop, two lines for one, and a fix that no file has."""

    def crash(*_: object) -> None:
        raise ZeroDivisionError

    def loop(*_: object) -> None:
        while True:
            pass

    def talk(*_: object) -> None:
        raise cases.GraphnavError("one\ntwo")

    def invent(*_: object) -> None:
        cases.stand_in(cases.np.array([1.0, 2.0]), b"1.0,3.0")

    monkeypatch.setattr(cases, "SECONDS", 0.05)
    found = {}
    for name, what in (("crash", crash), ("loop", loop), ("talk", talk), ("invent", invent)):
        monkeypatch.setitem(cases.TARGETS, name, (what, 1))
        found[name] = cases.play(0, tmp_path, name).kind
    assert found == {"crash": "traceback", "loop": "hang", "talk": "traceback", "invent": "silent wrong"}
