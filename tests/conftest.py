"""What several test modules share."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest

# programs that tests start keep their bytecode: without it each takes three times as long until it runs
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# a worker has a processor of its own: where each has two, second processes are begun that only wait for the others
if (worker := os.environ.get("PYTEST_XDIST_WORKER", "")) and hasattr(os, "sched_setaffinity"):
    processors = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {processors[int(worker.removeprefix("gw")) % len(processors)]})

# what is imported and kept for many tests is no garbage, and looking through it every 700 objects costs a few per cent
gc.set_threshold(50_000, 20, 50)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings: GRAPHNAV_DATA, or shared/data beside the repository.

    Without it the test is skipped, except in CI, where missing data would hide a failure.
    """
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("GRAPHNAV_DATA", beside))
    if not folder.is_dir():
        reason = f"no recordings at {folder} (set GRAPHNAV_DATA)"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    return folder
