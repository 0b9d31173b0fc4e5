"""Fixes of several types: whether what they state is differently good, and how good each is.

Of every type there is a variance factor with an uncertainty (Helmert's estimate of variance components in Förstner's
simple form of 1979: squared residuals over their redundancies, in rounds; by medians here). Types whose factors may be
the same by chance have the same. Else they are drawn towards each other as far as chance may have parted them: with the
variance between types as DerSimonian and Laird (1986, "Meta-analysis in clinical trials") estimate it, the most likely
factor of a type with few fixes is that of the others, and of one with many its own.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, ndtr

from graphnav.judgement.chance import FEWEST, SIGNIFICANT, independent, median, scatter
from graphnav.recording import FIX_TYPES, Recording
from graphnav.rotation import Array

ENOUGH = 100  # fixes of a type: its sigma to a twentieth

Estimate = tuple[float, float]  # logarithm of a variance factor, its standard deviation


def reaching(recording: Recording, begin: float, part: Recording) -> Recording:
    """`part`, which is from the start, or more of the recording: `ENOUGH` fixes after `begin` (s) of every type."""
    gnss, end = recording.gnss, part.end
    assert gnss is not None
    if gnss.type is None:
        return part
    for kind in np.unique(gnss.type):
        t = gnss.t[(gnss.type == kind) & (gnss.t > begin) & (gnss.t <= recording.end)]
        if len(t) >= FEWEST:
            end = max(end, float(t[min(len(t), ENOUGH) - 1]))
    return part if end <= part.end else recording.crop(0.0, end - recording.start)


def factors(z: Array, squared: Array, kinds: Array) -> dict[str, Estimate]:
    """Of every type, from whitened residuals (N, 3) and their squared norms over redundancies (N,).

    Residuals that are alike in time are worth less than their number.
    """
    found = {}
    for kind in np.unique(kinds):
        own = kinds == kind
        worth = independent(z[own]) if np.count_nonzero(own) > 1 else 3.0
        f = float(np.median(squared[own])) / median(3)
        found[FIX_TYPES[int(kind)]] = float(np.log(f)), scatter(min(3.0 * np.count_nonzero(own), worth))
    return found


def apart(seen: dict[str, Estimate]) -> dict[str, Estimate] | None:
    """Factors drawn towards each other, of every type there is, or None if they may all be the same."""
    if len(seen) < 2:
        return None
    y, s = np.array(list(seen.values())).T
    w = s**-2.0
    Q = float(np.sum(w * (y - np.sum(w * y) / np.sum(w)) ** 2))
    more = len(seen) - 1
    chance = float(chdtri(more, 2.0 * ndtr(-SIGNIFICANT)))
    if chance > Q:
        return None
    between = (Q - more) / float(np.sum(w) - np.sum(w * w) / np.sum(w))
    v = 1.0 / (s**2 + between)
    usual, spread = float(np.sum(v * y) / np.sum(v)), between + 1.0 / float(np.sum(v))
    drawn = {name: (usual, float(np.sqrt(spread))) for name in FIX_TYPES.values()}  # that were not seen
    for name, one, sd in zip(seen, y, s, strict=True):
        own = sd**-2.0 + 1.0 / between
        drawn[name] = float((one * sd**-2.0 + usual / between) / own), float(own**-0.5)
    return drawn
