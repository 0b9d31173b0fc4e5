"""Work in a second process: its result, its errors, and its end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from graphnav import load, run
from graphnav.app import cli
from graphnav.core import beside
from graphnav.core.beside import Beside, Later, allow_second_process, begin_beside
from graphnav.core.errors import PartlyWrittenError, RecordingError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="a second process is begun on Linux only")


@pytest.fixture(autouse=True)
def two_processors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(beside, "read_peak_memory_mb", lambda: 100.0)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    yield
    with pytest.raises(ChildProcessError):  # none is left
        os.waitpid(-1, os.WNOHANG)


@pytest.fixture
def allowed() -> Iterator[None]:
    with allow_second_process():
        yield


def test_it_is_done_here_unless_allowed() -> None:
    assert begin_beside(os.getpid).get_result() == os.getpid()
    with allow_second_process():
        assert begin_beside(os.getpid).get_result() != os.getpid()
    assert begin_beside(os.getpid).get_result() == os.getpid()


def test_a_command_allows_it_for_itself_alone(tmp_path: Path) -> None:
    tokyo = str(Path(__file__).parents[2] / "data" / "tokyo")
    options = ["--end", "20", "--solver", "ekf", "--noise", "stated", "--quiet"]
    assert cli.run(["smooth", tokyo, *options, "-o", str(tmp_path)]) == 0
    assert not beside.may_begin()


@pytest.mark.parametrize(("processors", "mb"), [({0}, 100.0), ({0, 1}, 5000.0)])
@pytest.mark.usefixtures("allowed")
def test_it_is_done_here_without_a_processor_or_memory(
    processors: set[int], mb: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: processors)
    monkeypatch.setattr(beside, "read_peak_memory_mb", lambda: mb)
    assert isinstance(begin_beside(os.getpid), Later)


@pytest.mark.usefixtures("allowed")
def test_it_is_done_here_where_the_system_has_no_more_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> int:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", fail)
    assert begin_beside(os.getpid).get_result() == os.getpid()


@pytest.mark.usefixtures("allowed")
def test_large_results_come_back() -> None:
    numbers = np.random.default_rng(1).standard_normal(500_000)
    work = begin_beside(lambda: (os.getpid(), 2.0 * numbers))
    process, found = work.get_result()
    assert process != os.getpid()
    np.testing.assert_array_equal(found, 2.0 * numbers)


@pytest.mark.usefixtures("allowed")
def test_an_error_is_raised_where_the_result_is_wanted() -> None:
    def refuse() -> None:
        raise RecordingError("no GNSS", key="gnss.none")

    work = begin_beside(refuse)
    with pytest.raises(RecordingError, match="no GNSS") as caught:
        work.get_result()
    assert caught.value.key == "gnss.none"
    with pytest.raises(RecordingError, match="no GNSS"):
        work.get_result()


@pytest.mark.usefixtures("allowed")
def test_what_is_not_to_be_sent_is_done_here() -> None:
    assert begin_beside(lambda: lambda: 2.0).get_result()() == 2.0
    missing = (Path("a"),)

    def fail() -> None:
        raise PartlyWrittenError("one is missing", key="output.partly_written", missing=missing)

    with pytest.raises(PartlyWrittenError) as caught:
        begin_beside(fail).get_result()
    assert caught.value.missing == missing


@pytest.mark.usefixtures("allowed")
def test_where_the_process_is_killed_the_work_is_done_here() -> None:
    own = os.getpid()

    def work() -> int:
        if os.getpid() != own:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    assert begin_beside(work).get_result() == own


@pytest.mark.usefixtures("allowed")
def test_it_ends_with_what_it_was_begun_for() -> None:
    work = begin_beside(lambda: time.sleep(1000.0))
    assert isinstance(work, Beside)
    del work  # the fixture sees that nothing is left


@pytest.mark.usefixtures("allowed")
def test_what_the_work_was_given_is_not_sent_back() -> None:
    numbers, names = np.arange(10.0), {"inner": [np.ones(3)]}

    def give_back(numbers: np.ndarray, names: dict[str, list[np.ndarray]]) -> tuple[object, ...]:
        return os.getpid(), numbers, names["inner"], names["inner"][0], numbers[:5]

    process, *found = begin_beside(partial(give_back, numbers, names=names)).get_result()
    assert process != os.getpid()
    assert [id(one) for one in found[:3]] == [id(one) for one in (numbers, names["inner"], names["inner"][0])]
    np.testing.assert_array_equal(found[3], numbers[:5])


@pytest.mark.usefixtures("allowed")
def test_what_was_ended_is_done_here_if_it_is_wanted_after_all() -> None:
    work = begin_beside(os.getpid)
    work.end()
    assert work.get_result() == os.getpid()


def test_an_interrupt_at_the_fork_is_not_lost() -> None:
    """What Python calls at a fork, as logging has it do, loses what is raised in it."""
    program = """if True:
        import os, signal
        from graphnav.core.beside import Beside
        signal.signal(signal.SIGINT, signal.default_int_handler)  # where the tests run in the background, it is ignored
        os.register_at_fork(after_in_parent=lambda: os.kill(os.getpid(), signal.SIGINT))
        try:
            Beside(int)
        except KeyboardInterrupt:
            raise SystemExit(7)
        """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (7, "")


def test_a_run_is_the_same_with_a_second_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The filter that is begun beside the search for faults, and used where nothing is wrong, has the same bytes."""
    drive = load(Path(__file__).parents[2] / "data" / "tokyo").crop(0.0, 60.0)
    begun: list[object] = []
    work = Beside.get_result
    monkeypatch.setattr(Beside, "get_result", lambda one: begun.append(one) or work(one))
    alone = run(drive, solvers=("ekf", "rts"))
    assert not begun
    with allow_second_process():
        both = run(drive, solvers=("ekf", "rts"))
    assert begun
    for name, one in alone.items():
        for field in ("R_nb", "p", "v", "ba", "bg"):
            np.testing.assert_array_equal(getattr(one.states, field), getattr(both[name].states, field))
        np.testing.assert_array_equal(one.covariance, both[name].covariance)
