"""Every mistake gets its one plain line, and docs/mistakes.md holds what is really said."""

from __future__ import annotations

import pytest
from mistakes import HEAD, ROOT, finding, listed, made, said
from mistakes_made import MISTAKES

PAGE = (ROOT / "docs" / "mistakes.md").read_text(encoding="utf-8")
CASES = {one.what: one for some in MISTAKES.values() for one in some}


@pytest.mark.parametrize("mistake", CASES.values(), ids=lambda one: one.what.replace(" ", "-"))
def test_a_mistake_gets_its_line_and_the_page_has_it(mistake, tmp_path):
    code, lines = made(mistake, tmp_path)
    assert code == (2 if mistake.error or any(line.startswith("refused") for line in lines) else 0)
    found = said(mistake, lines)
    assert len(found) == 1, lines
    if mistake.error:
        assert lines == found
        assert not (tmp_path / "out").exists()
        assert finding(mistake, lines) == "error"
    else:
        assert listed(PAGE)[mistake.what] == finding(mistake, lines)


def test_the_recording_without_a_mistake_gives_no_warning(tmp_path):
    from graphnav.recording.checks.overview import inspect
    from graphnav.recording.formats import read

    assert inspect(read(ROOT / "data" / "tokyo")).warnings == ()


def test_the_page_is_made_of_these_mistakes_alone():
    assert listed(PAGE).keys() == {what for what, one in CASES.items() if not one.error}
    assert PAGE.startswith(HEAD)
    assert len(CASES) >= 30
