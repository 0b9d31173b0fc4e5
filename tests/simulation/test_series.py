"""Simulated barometers and second antennas: errors of the stated sizes."""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.sensors.barometer import compute_standard_height
from graphnav.simulation.kinematics import Mount, move_vehicle
from graphnav.simulation.motion import Manoeuvre, make_path
from graphnav.simulation.series import BarometerModel, DualAntennaModel
from graphnav.simulation.vibration import Shake


def test_errors_of_a_barometer_and_a_second_antenna_have_their_sizes() -> None:
    """Over many drives: what is drawn once has the stated size, what is drawn per reading its own."""
    path = make_path([Manoeuvre(20.0, 0.0), Manoeuvre(20.0, 15.0, 60.0, 0.05), Manoeuvre(20.0, 15.0)])
    motion = move_vehicle(path, (30.5, 114.3, 20.0), Mount(), Shake(), 50.0)
    once: list[list[float]] = []
    for seed in range(60):
        air, put_in = BarometerModel(walk=0.0).read(motion, seed)
        h = motion.point(air.t, np.zeros(3))[0][:, 2]
        z = compute_standard_height(air)
        left = z - h - put_in["scale_error"] * (h - h[0]) - put_in["offset_m"]
        assert 0.9 * 0.5 < left.std() < 1.1 * 0.5
        two, turned = DualAntennaModel().read(motion, seed)
        d = rotation.from_rph(np.stack([np.interp(two.t, motion.t, x) for x in np.unwrap(motion.rph, axis=0).T], -1))
        heading = np.arctan2(d[:, 0, 0], d[:, 1, 0])
        off = np.degrees(rotation.wrap(two["heading"] - heading))
        assert np.all(np.abs(off - turned["heading_deg"]) < 6.0 * np.degrees(two["sd_heading"]))
        once.append([put_in["offset_m"] / 85.0, put_in["scale_error"] / 0.03, *turned.values(),
                     (off[0] - turned["heading_deg"]) / np.degrees(two["sd_heading"][0])])  # fmt: skip
    # chi-square with 60 degrees of freedom: 99.9 % within 0.54 and 1.66 of its mean
    squares = np.mean(np.square(once), axis=0)
    assert np.all((squares > 0.54) & (squares < 1.66)), squares
