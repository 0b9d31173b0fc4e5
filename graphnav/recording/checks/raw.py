"""Contents of raw GNSS observations: satellites, signals, gaps, cycle slips, signal strengths, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from graphnav.core.findings import Finding, compute_period
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import SYSTEM_NAMES, SYSTEMS, name_satellite, name_signal

_EPOCH_GAP_PERIODS = 2.5  # periods beyond which a step between epochs is a gap
_BASE_ODD = 4.0  # sigmas of its own position by which a base is off its stated one with a probability of 0.1 %
_ALONE = 0.05  # share of epochs without the base, above which a gap of its link does not explain it
_FEWEST_SATELLITES = 5  # satellites, one more than a position with its clock takes


def describe_raw(raw: RawGnss) -> dict[str, Any]:
    """Figures of a series, by name."""
    epochs, _ = raw.epochs
    placed = np.isfinite(raw.p[:, 0])
    by_epoch = _count_satellites(raw, placed)
    system = raw.satellite // 100
    facts: dict[str, Any] = {"epochs": len(epochs)}
    if len(epochs) > 1:
        period, step = compute_period(epochs), np.diff(epochs)
        facts |= {"rate_hz": round(1.0 / period, 3), "span_s": round(float(epochs[-1] - epochs[0]), 3)}
        facts["gaps"] = int((step > _EPOCH_GAP_PERIODS * period).sum())
        facts["longest_step_s"] = round(float(step.max()), 3)
    for k in range(len(SYSTEMS)):
        if (system == k).any():
            facts[f"satellites_{SYSTEM_NAMES[k]}"] = len(np.unique(raw.satellite[system == k]))
    for s, g in np.unique(np.stack([system, raw.signal], -1), axis=0):
        facts[f"observations_{SYSTEM_NAMES[int(s)]}_{name_signal(int(g))}"] = int(
            ((system == s) & (raw.signal == g)).sum()
        )
    facts["satellites_at_once"] = int(np.median(by_epoch))
    carrier = np.isfinite(raw.carrier)
    facts["carriers"] = int(carrier.sum())
    facts["dopplers"] = int(np.isfinite(raw.range_rate).sum())
    if carrier.any():
        facts["slips"] = int((raw.slip & carrier).sum())
        facts["half_cycles"] = int((raw.half & carrier).sum())
    if np.isfinite(raw.cn0).any():
        low, middle, high = np.nanpercentile(raw.cn0, [5.0, 50.0, 95.0])
        facts |= {"cn0_low_dbhz": float(low), "cn0_median_dbhz": float(middle), "cn0_high_dbhz": float(high)}
    missing = sorted({int(s) for s in raw.satellite} - {int(s) for s in raw.satellite[placed]})
    if missing:
        facts["without_ephemeris"] = " ".join(name_satellite(s) for s in missing)
    if raw.differenced:
        facts["with_base"] = int(np.isfinite(raw.difference).sum())
        if raw.base_off:
            off, sigma = raw.base_off
            facts |= {"base_off_m": float(np.linalg.norm(off)), "base_off_sigma_m": float(np.linalg.norm(sigma))}
    return facts


def check_raw(raw: RawGnss) -> Iterator[Finding]:
    """Findings on what degrades a tightly coupled solution."""
    by_epoch = _count_satellites(raw, np.isfinite(raw.p[:, 0]))
    few = float(np.mean(by_epoch < _FEWEST_SATELLITES))
    if few > 0.5:
        yield Finding(
            "warning",
            f"raw GNSS: fewer than {_FEWEST_SATELLITES} satellites have a place in {100.0 * few:.0f} % of the epochs",
            "raw_gnss.few_satellites",
        )
    if raw.base_off:
        off, sigma = np.array(raw.base_off)
        if np.linalg.norm(off / sigma) > _BASE_ODD:
            each = ", ".join(f"{x:.1f} +- {s:.1f}" for x, s in zip(off, sigma, strict=True))
            yield Finding(
                "unreliable",
                f"the base's own codes put it {np.linalg.norm(off):.0f} m from its stated position (east, north, up "
                f"{each} m, 1-sigma): all positions are off by as much as base_position is",
                "raw_gnss.base_off",
            )
    if raw.differenced:
        placed = np.isfinite(raw.p[:, 0]) & np.isfinite(raw.code)
        alone = float(np.mean(_count_satellites(raw, placed & np.isfinite(raw.difference))[by_epoch > 0] == 0))
        if alone > _ALONE:
            yield Finding(
                "warning",
                f"raw GNSS: in {100.0 * alone:.0f} % of the epochs nothing of the base is there, and nothing is used; "
                "give files of it that cover the drive, or leave it out",
                "raw_gnss.base_short",
            )
    if not np.isfinite(raw.range_rate).any():
        yield Finding("note", "raw GNSS: no Doppler shifts, so no velocities", "raw_gnss.no_doppler")


def _count_satellites(raw: RawGnss, which: np.ndarray) -> np.ndarray:
    """(E,) satellites of each epoch with rows of a mask."""
    epochs, of = raw.epochs
    pairs = np.unique(np.stack([of[which], raw.satellite[which].astype(np.intp)], -1), axis=0)
    return np.bincount(pairs[:, 0], minlength=len(epochs))
