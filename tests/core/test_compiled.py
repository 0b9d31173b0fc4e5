"""Compiling is no silence: whoever listens to the progress hears of it."""

from __future__ import annotations

import pytest

from graphnav.core.compiled import can_compile, compile_once
from graphnav.core.progress import send_progress


@pytest.mark.skipif(not can_compile(), reason="Numba is not installed")
def test_compiling_is_a_stage() -> None:
    found: dict[str, object] = {}
    exec("def double(x):\n    return 2.0 * x\n", found)  # of no file, so that nothing is kept on disk
    stages: list[str] = []
    with send_progress(lambda stage, share: stages.append(stage)):
        double = compile_once(found["double"])  # type: ignore[type-var]
        assert not stages
        assert double(2.0) == 4.0  # type: ignore[operator]
        assert set(stages) == {"compiling (once)"}
        stages.clear()
        assert double(3.0) == 6.0  # type: ignore[operator]
    assert not stages
