"""Distribution of drives to processes, here or on the machines of a Dask cluster; a crash affects one drive only.

Each process solves one drive after the other. One that dies loses only its drive and is replaced; so is one that
exceeds its time limit, which is killed. They are separate processes (`graphnav.app.fleet.worker`), not forks, on a
cluster as well, where a crash in compiled code would end Dask's worker.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import graphnav
from graphnav.app.fleet.drive import CRASHED, HUNG, FleetRow, make_lost_row
from graphnav.app.fleet.manifest import Task
from graphnav.core.errors import ConfigError

_SUBMITTED_AHEAD = 10  # drives submitted ahead to a scheduler, per thread of its workers


@dataclass(frozen=True)
class Limits:
    """Limits for one drive."""

    seconds: float
    memory_mb: float | None = None


def share_of_memory(processes: int) -> float | None:
    """This machine's memory in MB divided by the number of processes; None where it is unknown."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20 / processes
    except (AttributeError, ValueError, OSError):
        return None


class Worker:
    """A process that solves drives, started when there is one to solve."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._process: subprocess.Popen[str] | None = None

    def solve(self, task: Task) -> FleetRow:
        """The row of a drive, whatever happens to the process."""
        began = time.monotonic()
        process = self._ensure_process()
        assert process.stdin is not None
        assert process.stdout is not None
        late = threading.Event()

        def end() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self._limits.seconds, end)
        timer.start()
        try:
            process.stdin.write(json.dumps(asdict(task)) + "\n")
            process.stdin.flush()
            answer = process.stdout.readline()
        except OSError:  # it ended before reading the task
            answer = ""
        finally:
            timer.cancel()
        if answer.endswith("\n"):
            return dict(json.loads(answer))
        code = process.wait()
        self._process = None
        elapsed = time.monotonic() - began
        if late.is_set():
            return make_lost_row(
                task, HUNG, f"ended after {self._limits.seconds:g} s, the --limit of one drive", elapsed
            )
        return make_lost_row(task, CRASHED, f"the process that solved it {_describe_end(code)}", elapsed)

    def close(self) -> None:
        """End the process at once."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _ensure_process(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            package = str(Path(graphnav.__file__).parents[1])
            path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
            self._process = subprocess.Popen(
                [sys.executable, "-m", "graphnav.app.fleet.worker", f"{self._limits.memory_mb or 0:.0f}"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                # signals of the terminal go to the main program, which ends its workers
                start_new_session=True, env={**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
        return self._process


def _describe_end(code: int) -> str:
    if code >= 0:
        return f"ended with {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"was ended by {name}{' (out of memory, perhaps)' if name == 'SIGKILL' else ''}"


def solve_here(tasks: Sequence[Task], processes: int, limits: Limits) -> Iterator[FleetRow]:
    """Rows of drives as they are solved by a number of processes."""
    own = threading.local()
    workers: list[Worker] = []

    def solve(task: Task) -> FleetRow:
        if not hasattr(own, "worker"):
            own.worker = Worker(limits)
            workers.append(own.worker)
        return own.worker.solve(task)

    pool = ThreadPoolExecutor(processes)
    futures: list[Future[FleetRow]] = []
    try:
        futures = [pool.submit(solve, task) for task in tasks]
        for future in as_completed(futures):
            yield future.result()
    finally:
        for future in futures:
            future.cancel()
        for worker in workers:
            worker.close()
        pool.shutdown()


_OF_THREAD = threading.local()  # one process per thread of a Dask worker


def solve_apart(task: Task, limits: Limits) -> FleetRow:
    """The row of a drive, solved by this thread's own process."""
    if getattr(_OF_THREAD, "limits", None) != limits:
        _OF_THREAD.worker, _OF_THREAD.limits = Worker(limits), limits
    return _OF_THREAD.worker.solve(task)


def solve_on_cluster(tasks: Sequence[Task], scheduler: str, limits: Limits) -> Iterator[FleetRow]:
    """Rows of drives as they are solved by the workers of a Dask cluster that see the same files.

    Raises
    ------
    ConfigError
        If there is no such cluster, or no Dask to ask for one.
    """
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError:
        raise ConfigError(
            "--scheduler: needs Dask; pip install -e '.[fleet]' in the clone", key="package.missing"
        ) from None
    try:
        client = Client(scheduler, timeout=10)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"--scheduler {scheduler}: no cluster answers there ({error or 'too late'})", key="fleet.no_cluster"
        ) from None
    with client:
        waiting = iter(tasks)
        of: dict[str, Task] = {}

        def take_next(count: int) -> list[Any]:
            few = list(islice(waiting, count))
            futures = client.map(solve_apart, few, limits=limits, pure=False)
            of.update((future.key, task) for future, task in zip(futures, few, strict=True))
            return list(futures)

        # a scheduler that is given all drives at once keeps them all in memory
        under_way = completed(take_next(max(_SUBMITTED_AHEAD, _SUBMITTED_AHEAD * sum(client.nthreads().values()))))
        try:
            for future in under_way:
                task = of.pop(future.key)
                if future.status == "finished":
                    yield future.result()
                else:
                    why = future.exception() if future.status == "error" else future.status
                    yield make_lost_row(task, CRASHED, f"the cluster: {type(why).__name__}: {why}", 0.0)
                under_way.update(take_next(1))
        finally:
            client.cancel([*under_way.futures])
