"""Write what commands print into the pages that show them, and draw the picture of README.md anew.

    python scripts/shown.py

A block of a page that begins with `$ graphnav` is run in the clone; a line of dots in it stands for lines left out.
The tests compare the same blocks with what the commands print (tests/test_docs.py).
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHOWN = re.compile(r"^( *)```text\n *(\$ graphnav .*?)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"`python (scripts/picture\.py [^`]+)`")
DOTS = "  ..."


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT / "data", Path(folder) / "data")
        for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
            text = page.read_text(encoding="utf-8")
            page.write_text(SHOWN.sub(lambda found: renewed(found, folder), text), encoding="utf-8")
    command = PICTURE.search((ROOT / "README.md").read_text(encoding="utf-8"))
    if command is not None:
        subprocess.run([sys.executable, *shlex.split(command[1])], cwd=ROOT, check=True)


def renewed(found: re.Match[str], folder: str) -> str:
    """A block with what its command prints now."""
    indent, command, body = found[1], found[2], found[3]
    arguments = shlex.split(command.removeprefix("$ graphnav "))
    run = subprocess.run(
        [sys.executable, "-m", "graphnav", *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    print(f"{command}", flush=True)
    shown = [line.removeprefix(indent) for line in body.splitlines()]
    printed = run.stdout.splitlines()
    if DOTS in shown:
        before = shown.index(DOTS)
        after = len(shown) - before - 1
        printed = [*printed[:before], DOTS, *printed[len(printed) - after :]]
    return "\n".join(f"{indent}{line}".rstrip() for line in ["```text", command, *printed, "```"])


if __name__ == "__main__":
    main()
