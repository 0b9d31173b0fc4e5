"""The packages of graphnav: their modules, lines and imports, and the longest way up; of two commits side by side.

    python scripts/packages.py
    python scripts/packages.py --before f6b2e2d^ --after f6b2e2d

Arrows are counted from module to module of another package: what its `import` statements name, at the top or within
functions. A package's floor is the longest way down to one that imports from none. A tree of an older commit may have
packages that import from each other; they share a floor and are named.
"""

from __future__ import annotations

import argparse
import ast
import io
import subprocess
import tarfile
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LONG = 400  # lines of a module


@dataclass(frozen=True)
class House:
    """What is counted of one tree."""

    modules: Counter[str]  # by package
    lines: Counter[str]
    long: list[tuple[str, int]]  # modules above `LONG` lines
    arrows: Counter[tuple[str, str]]  # (from, to): imports


def survey(package: Path) -> House:
    """Count what is below the folder of the package."""
    modules, lines, long, arrows = Counter[str](), Counter[str](), [], Counter[tuple[str, str]]()
    files = sorted(package.rglob("*.py"))
    rooms = {path.relative_to(package).parts[0].removesuffix(".py") for path in files}
    for path in files:
        room = path.relative_to(package).parts[0].removesuffix(".py")
        text = path.read_text(encoding="utf-8")
        count = text.count("\n")
        modules[room] += 1
        lines[room] += count
        if count > LONG:
            long.append((str(path.relative_to(package)), count))
        named = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                whole = {f"{node.module}.{alias.name}" for alias in node.names}
                named |= whole if node.module == package.name else {node.module}
        used = {name.split(".")[1] for name in named if name.startswith(f"{package.name}.")}
        arrows.update((room, other) for other in used & rooms - {room})
    return House(modules, lines, sorted(long, key=lambda one: -one[1]), arrows)


def floors(house: House) -> dict[str, int]:
    """How many packages are on the longest way down from each; of a ring, all are on one floor."""
    below = {room: {b for a, b in house.arrows if a == room} for room in house.modules}

    def reach(room: str) -> set[str]:
        found, todo = set(), [room]
        while todo:
            new = below[todo.pop()] - found
            found |= new
            todo += new
        return found

    reached = {room: reach(room) for room in below}
    ring = {room: frozenset({room} | {o for o in reached[room] if room in reached[o]}) for room in below}
    height: dict[frozenset[str], int] = {}
    # of two rings of which one is below the other, that one reaches less
    for room in sorted(below, key=lambda room: len(reached[room] | {room})):
        down = {ring[o] for member in ring[room] for o in below[member]} - {ring[room]}
        height[ring[room]] = 1 + max((height[one] for one in down), default=-1)
    return {room: height[ring[room]] for room in below}


def rings(house: House) -> list[tuple[str, str]]:
    """Pairs of packages that import from each other."""
    return sorted((a, b) for a, b in house.arrows if a < b and (b, a) in house.arrows)


def describe(house: House) -> str:
    """A table of its packages, lowest first, and the sums."""
    floor = floors(house)
    rows = ["| package | floor | modules | lines | imports from |", "| --- | ---: | ---: | ---: | --- |"]
    for room in sorted(house.modules, key=lambda room: (floor[room], room)):
        others = sorted(b for a, b in house.arrows if a == room)
        rows.append(f"| `{room}` | {floor[room]} | {house.modules[room]} | {house.lines[room]} | {', '.join(others)} |")
    sums = (
        f"{len(house.modules)} packages, {sum(house.modules.values())} modules, {sum(house.lines.values())} lines; "
        f"{len(house.arrows)} arrows between packages, {sum(house.arrows.values())} imports; "
        f"the longest way up has {max(floor.values()) + 1} floors"
    )
    long = ", ".join(f"{name} {count}" for name, count in house.long) or "none"
    mutual = ", ".join(f"{a} and {b}" for a, b in rings(house)) or "none"
    return "\n".join([*rows, "", sums, f"modules above {LONG} lines: {long}", f"import from each other: {mutual}"])


def at_commit(commit: str) -> House:
    """What is counted of the tree of a commit."""
    packed = subprocess.run(["git", "archive", commit, "graphnav"], cwd=ROOT, capture_output=True, check=True).stdout
    with tempfile.TemporaryDirectory() as scratch:
        with tarfile.open(fileobj=io.BytesIO(packed)) as tree:
            tree.extractall(scratch, filter="data")
        return survey(Path(scratch) / "graphnav")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", metavar="COMMIT", help="print this commit's first")
    parser.add_argument("--after", metavar="COMMIT", help="and this one's in place of the working tree's")
    options = parser.parse_args()
    if options.before:
        print(f"Before ({options.before}):\n\n{describe(at_commit(options.before))}\n\nAfter:\n")
    print(describe(at_commit(options.after) if options.after else survey(ROOT / "graphnav")))


if __name__ == "__main__":
    main()
