"""Observations from a numerical table: L1 C/A of GPS, and of QZSS where a column marks it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.gnss.series import Observations, drop_repeated
from graphnav.gnss.signals import GPS, L1, QZSS, C, number_signal

REQUIRED = ("t", "prn", "code")
OPTIONAL = ("qzss", "carrier", "doppler", "range_rate", "cn0")


def make_observations(columns: Mapping[str, Array], zero: float, name: str) -> Observations:
    """Make observations from columns (N,).

    Parameters
    ----------
    columns : t (s), prn, code (m); optional qzss (0 or 1), carrier (cycles), doppler (Hz) or range_rate (m/s), cn0
        (dB-Hz).
    zero : s since the GPS epoch at t = 0.
    """
    t, n = columns["t"], len(columns["t"])
    nothing = np.full(n, np.nan)
    doppler = columns.get("doppler", nothing)
    if "range_rate" in columns:
        doppler = np.where(np.isnan(doppler), -columns["range_rate"] * L1 / C, doppler)
    prn = columns["prn"]
    with np.errstate(invalid="ignore"):
        known = (prn >= 1) & (prn <= 99) & (prn == np.floor(prn))
    whole = np.isfinite(t) & known & np.isfinite(columns["code"])
    system, prn = np.where(columns.get("qzss", np.zeros(n)) > 0, QZSS, GPS), np.where(known, prn, 0.0)
    obs = Observations(
        zero=zero, t=t, satellite=(100 * system + prn).astype(np.int16),
        signal=np.full(n, number_signal("1C"), dtype=np.int16), code=columns["code"],
        carrier=columns.get("carrier", nothing), doppler=doppler, cn0=columns.get("cn0", nothing),
        slip=np.zeros(n, dtype=bool), half=np.zeros(n, dtype=bool), lock=nothing, files=(name,),
    )  # fmt: skip
    if not whole.all():
        obs = replace(
            obs.take(whole),
            remarks=(
                Note(
                    "raw.rows_left_out",
                    f"{name}: {format_count(int((~whole).sum()), 'row')} without time, prn (1 to 99) or code left out",
                ),
            ),
        )
    return drop_repeated(obs)
