"""Where the program begins: ``graphnav`` and ``python -m graphnav``."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Run the command line; Ctrl-C, and SIGTERM as well, ends it in one line from the first import on.

    Streams that a service has closed are opened to nowhere: files would take their numbers.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    while (spare := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(spare)
    sys.stdin, sys.stdout, sys.stderr = (
        one or open(k, mode, closefd=False)  # noqa: SIM115
        for k, (one, mode) in enumerate(zip((sys.stdin, sys.stdout, sys.stderr), "rww", strict=True))
    )
    try:
        from graphnav.app.cli import main as program
    except KeyboardInterrupt:
        sys.stderr.write("graphnav: interrupted\n")
        sys.exit(130)
    program()


if __name__ == "__main__":
    main()
