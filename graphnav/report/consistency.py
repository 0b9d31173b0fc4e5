"""Comparison of a constraint's residuals or innovations with their sigma, in numbers and one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.estimation.solution import ConstraintRecord
from graphnav.report.wording import Quantity


@dataclass(frozen=True)
class Consistency:
    """Statistics of one constraint's residuals over their sigma."""

    count: int
    rejected: int
    reduced: int
    mean_nis: float  # over rows that were not rejected
    dof: int
    outside: float  # share of components beyond 3 sigma, over rows that were not rejected
    kind: str

    @property
    def verdict(self) -> Note:
        """One sentence on the consistency of sigma."""
        if self.count - self.rejected < 10 or not np.isfinite(self.mean_nis):
            return Note("consistency.few", "too few to assess")
        ratio = self.mean_nis / self.dof
        if self.kind == "residual":
            # a fit absorbs part of the noise, so a smoother's residuals may be below their sigma, never above
            if ratio > 1.3:
                return Note(
                    "consistency.residuals_large",
                    "residuals larger than sigma allows: sigma is too small, or something is unmodelled",
                )
            return Note("consistency.residuals_within", "residuals within their sigma")
        if ratio > 1.5:
            return Note("consistency.overconfident", "innovations larger than predicted: the filter is overconfident")
        if ratio < 0.5:
            return Note("consistency.cautious", "innovations smaller than predicted: sigma is wider than it need be")
        return Note("consistency.as_predicted", "innovations as large as predicted: sigma is consistent")


def summarise_record(record: ConstraintRecord) -> Consistency:
    """Summarise a record.

    A residual of weight w is divided by the sigma it was used with, larger by 1 / sqrt(w); the normalised square of an
    innovation includes that already.
    """
    used = record.weight > 1e-9
    weight = record.weight[used] if record.kind == "residual" else np.ones(int(used.sum()))
    white = np.abs(record.residual[used] / record.sigma[used]) * np.sqrt(weight)[:, None]
    white = white[np.isfinite(white)]
    return Consistency(
        count=len(record.t),
        rejected=int(np.sum(~used)),
        reduced=int(np.sum(used & (record.weight < 0.5))),
        mean_nis=compute_mean(weight * record.nis[used]),
        dof=record.residual.shape[1],
        outside=compute_mean((white > 3.0).astype(float)),
        kind=record.kind,
    )


CONSISTENCY_HEAD = ("used", "rejected", "weight < 0.5", "mean NIS", "components", "outside 3 sigma", "what it says")


def tabulate_record(c: Consistency) -> list[Any]:
    """The cells under `CONSISTENCY_HEAD`."""
    outside = f"{100 * c.outside:.2f} %" if np.isfinite(c.outside) else "-"
    return [c.count - c.rejected, c.rejected, c.reduced, float(c.mean_nis), c.dof, Quantity(outside), c.verdict]


def compute_mean(x: Array) -> float:
    x = x[np.isfinite(x)]
    return float(np.mean(x)) if x.size else float("nan")
