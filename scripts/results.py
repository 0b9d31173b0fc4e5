"""The table of docs/experiments/outage.md: `graphnav compare` on drives with a minute of GNSS withheld.

python scripts/results.py ../shared/data
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

from graphnav.app.terminal import format_short

# folder among the recordings (or built-in name), further options, which span of comparison.csv it is about
DRIVES = (
    ("tokyo_20201105", ["--without", "gnss:1140-1200"], 1),
    ("boulder_drive_20250708", ["--without", "gnss:200-260"], 1),
    ("kitti", ["--without", "gnss:400-460"], 1),
    ("oracle_drive", [], 1),
)
SPAN_COLUMNS = (("largest", "max_h_m"), ("at its end", "end_h_m"), ("up, largest", "max_up_m"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="the folder that holds the recordings' folders")
    options = parser.parse_args()
    program = Path(sys.executable).with_name("graphnav")
    with tempfile.TemporaryDirectory() as scratch:
        rows = [["drive", "solver", *(f"{name} (m)" for name, _ in SPAN_COLUMNS), "NEES"]]
        rows.append(["---", "---", *["---:"] * (len(rows[0]) - 2)])
        for name, extra, span in DRIVES:
            source = name if name == "kitti" else str(options.recordings / name)
            out = Path(scratch) / name
            print(f"graphnav compare {source} {' '.join(extra)}".rstrip(), file=sys.stderr)
            subprocess.run([program, "compare", source, *extra, "--quiet", "-o", out], check=True)
            with (out / "comparison.csv").open(newline="", encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    values = [row[f"span{span}_{key}"] for _, key in SPAN_COLUMNS]
                    values.append(row[f"span{span}_nees_p"])
                    rows.append([name, row["solver"], *(format_short(float(x)) if x else "-" for x in values)])
    print("\n".join("| " + " | ".join(row) + " |" for row in rows))


if __name__ == "__main__":
    main()
