"""Where the program begins: ``graphnav`` and ``python -m graphnav``."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; Ctrl-C ends it in one line from the first import on."""
    try:
        from graphnav.app.cli import main as program
    except KeyboardInterrupt:
        sys.stderr.write("graphnav: interrupted\n")
        sys.exit(130)
    program()


if __name__ == "__main__":
    main()
