"""Run the commands of a page of docs/experiments again, and write what they print and the commit into it.

    python scripts/experiments.py outage benchmark

What a command printed stands between its block and the next heading. Recordings are looked for in ../shared/data, as
the commands say; GRAPHNAV_DATA=../shared/data is set for scripts that ask for it.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "experiments"
RUN = re.compile(r"^```sh\npython (?P<command>[^\n]+)\n```\n(?P<printed>.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", choices=sorted(path.stem for path in FOLDER.glob("*.md")))
    for name in parser.parse_args().pages:
        path = FOLDER / f"{name}.md"
        path.write_text(RUN.sub(renewed, path.read_text(encoding="utf-8")).rstrip() + "\n", encoding="utf-8")


def renewed(found: re.Match[str]) -> str:
    """A block with its command, the commit, and what the command prints now."""
    command = found["command"]
    print(command, file=sys.stderr)
    environment = {"GRAPHNAV_DATA": str(ROOT.parent / "shared" / "data"), **os.environ}
    run = subprocess.run(
        [sys.executable, *shlex.split(command)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    commit, date = git("log", "-1", "--format=%h %as").split()
    changed = " with changes that are not committed" if git("status", "--porcelain", "graphnav", "scripts") else ""
    printed = run.stdout.strip().replace("\n\n\n", "\n\n")
    return f"```sh\npython {command}\n```\n\nPrinted by commit `{commit}` of {date}{changed}.\n\n{printed}\n\n"


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
