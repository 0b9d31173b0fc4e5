"""A recording as a live source would have sent it: the setup of its sensors, and their rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.online.raw import RAW
from graphnav.online.raw_lines import drop_epochs, list_epochs
from graphnav.online.sanity import Row
from graphnav.recording import Recording


def drop_rows(recording: Recording) -> Recording:
    """The setup of a recording's sensors."""
    none, rows = np.empty(0), np.empty((0, 3))
    gnss, odometer = recording.gnss, recording.odometer
    return replace(
        recording,
        imu=replace(recording.imu, t=none, gyro=rows, accel=rows),
        gnss=gnss
        and replace(gnss, t=none, llh=rows, sd=rows, v=None, sd_v=None, type=None, satellites=None, residual_rms=None),
        odometer=odometer and replace(odometer, t=none, speed=none, counted=None, wheels=None),
        truth=None,
        raw_gnss=recording.raw_gnss and drop_epochs(recording.raw_gnss),
        sensors={name: replace(s, t=none, values=s.values[:0]) for name, s in recording.sensors.items()},
    )


def list_rows(recording: Recording) -> tuple[Array, list[Row]]:
    """Every row of a recording in the order in which sensors without delay would have sent it, with its time."""
    parts: list[tuple[Array, str, Array]] = []
    if recording.odometer is not None:
        o = recording.odometer
        blank = np.full((len(o.t), 6), np.nan)
        blank[:, 0] = o.speed
        if o.counted is not None:
            blank[:, 1] = o.counted
        if o.wheels is not None:
            blank[:, 2:] = o.wheels
        parts.append((o.t, "odometer", blank))
    if recording.gnss is not None:
        g = recording.gnss
        blank = np.full((len(g.t), 12), np.nan)
        blank[:, :3], blank[:, 3:6] = g.llh, g.sd
        if g.v is not None and g.sd_v is not None:
            blank[:, 6:9], blank[:, 9:] = g.v, g.sd_v
        if g.residual_rms is not None:
            satellites = np.full(len(g.t), np.nan) if g.satellites is None else g.satellites
            blank = np.column_stack([blank, g.residual_rms, satellites])
        parts.append((g.t, "gnss", blank))
    parts += [(series.t, name, series.values) for name, series in recording.sensors.items()]
    parts.append((recording.imu.t, "imu", np.concatenate([recording.imu.gyro, recording.imu.accel], axis=1)))
    every: list[Row] = []
    if recording.raw_gnss is not None:
        every += [(RAW, x, values) for x, values in list_epochs(recording.raw_gnss)]
    every += [
        (name, x, tuple(row))
        for times, name, rows in parts
        for x, row in zip(times.tolist(), rows.tolist(), strict=True)
    ]
    t = np.array([row[1] for row in every])
    order = np.argsort(t, kind="stable")
    return t[order], [every[i] for i in order]
