"""Work beside other work comes to what it comes to in its place, whatever becomes of the copy that does it."""

from __future__ import annotations

import os
import signal
import sys

import numpy as np
import pytest

from graphnav.core import beside as module
from graphnav.core.beside import allow_beside, beside
from graphnav.core.errors import ConfigError

COPIES = sys.platform == "linux"


@pytest.fixture(autouse=True)
def two_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    if COPIES:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})


def test_result_comes_from_a_copy_where_it_is_allowed() -> None:
    def work() -> tuple[int, np.ndarray]:
        return os.getpid(), np.arange(1e6)

    with allow_beside(), beside(work) as result:
        copy, numbers = result()
    assert (copy != os.getpid()) is COPIES
    np.testing.assert_array_equal(numbers, np.arange(1e6))
    with beside(work) as result:
        assert result()[0] == os.getpid()


def test_its_error_is_raised_with_its_key() -> None:
    def work() -> None:
        raise ConfigError("no such thing", key="option.nothing")

    with allow_beside(), beside(work) as result, pytest.raises(ConfigError) as caught:
        result()
    assert caught.value.key == "option.nothing"


def test_work_is_done_here_where_its_copy_was_ended_or_could_not_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    here = os.getpid()

    def work() -> int:
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    with allow_beside(), beside(work) as result:
        assert result() == here

    def refuse() -> int:
        raise OSError

    monkeypatch.setattr(module.os, "fork", refuse, raising=False)
    with allow_beside(), beside(os.getpid) as result:
        assert result() == here


@pytest.mark.skipif(not COPIES, reason="makes no copies")
def test_copy_ends_with_the_block_when_nobody_asks() -> None:
    read, write = os.pipe()

    def work() -> None:
        os.write(write, str(os.getpid()).encode())
        signal.pause()

    with allow_beside(), beside(work):
        copy = int(os.read(read, 20))
    with pytest.raises(ProcessLookupError):
        os.kill(copy, 0)
