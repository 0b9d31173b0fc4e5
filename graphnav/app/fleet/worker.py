"""A process that solves drives: reads a task in JSON per line, writes a row in JSON per line."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress

from graphnav.app.fleet.drive import solve_drive
from graphnav.app.fleet.manifest import Task
from graphnav.core.jsonable import format_json


def main() -> None:
    """Solve tasks until the input ends; the argument is the memory limit of this process, MB, 0 for none."""
    _limit_memory(float(sys.argv[1]))
    # anything printed, also by compiled code, must not mix with the rows
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        values = json.loads(line)
        row = solve_drive(Task(**{**values, "without": tuple(values["without"])}))
        out.write(json.dumps(json.loads(format_json(row))) + "\n")
        out.flush()


def _limit_memory(megabytes: float) -> None:
    """Limit the memory of this process, so that an allocation fails rather than the system killing some process."""
    if megabytes:
        with suppress(ImportError, OSError, ValueError):
            import resource  # not on Windows

            size = int(megabytes * 2**20)
            resource.setrlimit(resource.RLIMIT_DATA, (size, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main()
