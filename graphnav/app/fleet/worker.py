"""A process that solves drives: a task in JSON on every line of its input, a row on every line of its output."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress

from graphnav.app.fleet.drive import solve_drive
from graphnav.app.fleet.manifest import Task
from graphnav.core.jsonable import json_text


def main() -> None:
    """Solve until there is nothing more to solve; the argument is what this process may hold, MB, 0 for all."""
    _limit_memory(float(sys.argv[1]))
    # whatever prints, also in compiled code, must not mix with the rows
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        values = json.loads(line)
        row = solve_drive(Task(**{**values, "without": tuple(values["without"])}))
        out.write(json.dumps(json.loads(json_text(row))) + "\n")
        out.flush()


def _limit_memory(megabytes: float) -> None:
    """Let what asks for more than its share fail, rather than have the system choose who is to end."""
    if megabytes:
        with suppress(ImportError, OSError, ValueError):
            import resource  # not on Windows

            size = int(megabytes * 2**20)
            resource.setrlimit(resource.RLIMIT_DATA, (size, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main()
