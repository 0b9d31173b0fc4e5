"""Report sections on raw GNSS, for a solution that has rows by satellite: figures and tables."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from markupsafe import Markup

from graphnav.core.rotation import Array
from graphnav.estimation.names import name_rows
from graphnav.estimation.solution import ConstraintRecord, Solution
from graphnav.report import page
from graphnav.report.plots import Shades
from graphnav.report.plots import satellites as plots
from graphnav.report.wording import Quantity

_ELEVATIONS = (0.0, 15.0, 30.0, 45.0, 60.0, 90.0)  # deg


def make_satellite_parts(solution: Solution, start: float, end: float, spans: Shades) -> list[Markup]:
    """The section on satellites, for a solution that has rows of them; empty otherwise.

    Parameters
    ----------
    start : of the recording, s on its own clock; `end` of the time axis from there.
    """
    records, name = select_satellite_records(solution), solution.solver
    if not records:
        return []
    kind, first = next(iter(records.items()))
    kinds = {r.kind for r in records.values()}
    what = " and ".join(sorted(f"{one}s" for one in kinds)).capitalize()
    seen = [
        page.place_picture(
            plots.plot_sky(first, name), f"Sky, by {name_rows(kind)}", "North is up, the zenith in the middle."
        ),
        page.place_picture(
            plots.plot_used_satellites(records, start, end, name, spans=spans),
            "Rows used, and with less than half weight",
        ),
    ]
    by_satellite = [
        page.place_picture(plots.plot_residuals_by_satellite(one, r, name), f"{name_rows(one)}: {r.kind}s by satellite")
        for one, r in records.items()
    ]
    out = [
        page.gallery(seen),
        page.gallery(
            [
                page.place_picture(
                    plots.plot_satellite_rows(first, start, end, name, spans=spans),
                    f"{name_rows(kind)}: use by satellite",
                ),
                page.place_picture(
                    plots.plot_residuals_by_elevation(records, name),
                    f"{what} by elevation",
                    "What lies beyond a panel is drawn at its edge.",
                ),
                *by_satellite,
            ]
        ),
        *tabulate_satellites(solution),
    ]
    if len(solution.arcs.name):
        note = "An arc ends where the receiver, or the base station's, loses count of the cycles."
        figure = plots.plot_carrier_arcs(solution.arcs, start, end, spans=spans)
        out.append(
            page.gallery([page.place_picture(figure, "Arcs of carriers, by their ambiguities", note, kind="large")])
        )
    return out


def select_satellite_records(solution: Solution) -> dict[str, ConstraintRecord]:
    """The records that have rows of satellites, by constraint."""
    return {kind: r for kind, r in solution.records.items() if len(r.satellite) == len(r.t) > 0}


def tabulate_satellites(solution: Solution) -> list[Markup]:
    """Residuals of satellite rows, in sigmas as weighted, by satellite and by elevation."""
    records = select_satellite_records(solution)
    if not records:
        return []
    names = sorted({name for r in records.values() for name in r.satellite.tolist()})
    which = {kind: np.searchsorted(names, r.satellite) for kind, r in records.items()}
    by_satellite = [
        [name, *(cell for kind, r in records.items() for cell in _tabulate_residuals(r, which[kind] == k))]
        for k, name in enumerate(names)
    ]
    by_elevation = [
        [
            f"{low:.0f} to {high:.0f} deg",
            *(
                cell
                for r in records.values()
                for cell in _tabulate_residuals(r, (np.degrees(r.elevation) >= low) & (np.degrees(r.elevation) < high))
            ),
        ]
        for low, high in itertools.pairwise(_ELEVATIONS)
    ]
    by_elevation = [row for row in by_elevation if any(cell != "-" for cell in row[1:])]
    head = [cell for kind in records for cell in (f"{name_rows(kind)}, rows", "weight < 0.5", "RMS / sigma")]
    return [
        page.make_table(["satellite", *head], by_satellite),
        page.make_table(["elevation", *head], by_elevation),
    ]


def _tabulate_residuals(record: ConstraintRecord, some: Array) -> list[Any]:
    """Number of rows, the share with less than half of their weight, and the RMS of the others in sigmas."""
    count = int(np.count_nonzero(some))
    if not count:
        return ["-", "-", "-"]
    used = some & (record.weight >= plots.HALF)
    nis = record.nis[used] / record.residual.shape[1]
    share = 1.0 - np.count_nonzero(used) / count
    return [count, Quantity(f"{100.0 * share:.1f} %"), float(np.sqrt(np.mean(nis))) if len(nis) else "-"]


def tabulate_epochs(solution: Solution) -> list[Markup]:
    """Epochs with rows of satellites, how many are used, and with carriers against a base the ambiguities' kind."""
    records = select_satellite_records(solution)
    if not records:
        return []
    t, name, weight = (
        np.concatenate([getattr(r, key) for r in records.values()]) for key in ("t", "satellite", "weight")
    )
    (epochs, of), (_, which) = (np.unique(x, return_inverse=True) for x in (t, name))
    pairs = np.unique(np.stack([of, which])[:, weight >= plots.HALF], axis=1)
    many = np.bincount(pairs[0], minlength=len(epochs))
    head = ["epochs", "satellites used, median", "fewest"]
    row: list[Any] = [len(epochs), Quantity(f"{np.median(many):.0f}"), int(many.min())]
    if len(kinds := solution.fixed):
        fixed = int(np.sum(kinds[:, 1] > 0.0))
        head += ["epochs with integers", "epochs without", "share with"]
        row += [fixed, len(kinds) - fixed, Quantity(f"{100.0 * fixed / len(kinds):.1f} %")]
    return [page.heading("Raw GNSS"), page.make_table(head, [row])]
