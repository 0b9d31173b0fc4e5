"""Simulated walks: rolling by its own geometry, samples by two mechanisations, sizes beside real shoes."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import oracle_path
import pandas as pd
import pytest
from helpers import Array, refused, truth_states
from pyins import strapdown, transform, util

from graphnav.core import rotation as ro
from graphnav.core.earth import LocalFrame, gravity
from graphnav.core.errors import ConfigError
from graphnav.core.state import States
from graphnav.imu.dynamics import ImuFactors as Mechanisation
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Imu
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import read
from graphnav.simulation import Simulated, simulate
from graphnav.simulation.footsteps import list_rectangle, make_route
from graphnav.simulation.gait import Sole
from graphnav.simulation.scenarios.ren2021 import WALKS

pytestmark = pytest.mark.filterwarnings("ignore:The copy keyword")  # of pandas, about pyins

DEG = np.pi / 180.0
PACES = ("slow", "normal", "fast")


@lru_cache(maxsize=32)
def made(name: str, seed: int = 1, **options: float | str | bool) -> Simulated:
    return simulate(name, seed, **options)


def spans(made_here: Simulated, what: str) -> Array:
    return np.array(made_here.facts[what])


def within(t: Array, some: Array) -> Array:
    """Mask (N,) of the times inside any of the spans (M, 2)."""
    return np.any((t[:, None] >= some[:, 0]) & (t[:, None] <= some[:, 1]), axis=1)


def shoe_from_imu(made_here: Simulated) -> Array:
    angles = made_here.facts["mounting_deg"]
    return ro.from_rph(np.array([angles["roll"], angles["pitch"], angles["heading"]]) * DEG)


def sole_points(made_here: Simulated, t: Array) -> tuple[Array, Array]:
    """(heights over the floor (P, n), speeds (P, n)) of the sole's points, from the IMU's true motion."""
    motion = made_here.motion
    assert motion is not None
    heights, speeds = [], []
    for forward, up in Sole().points:
        llh, v = motion.point(t, shoe_from_imu(made_here).T @ [0.0, forward, up])
        heights.append(llh[:, 2] - 20.0)
        speeds.append(np.linalg.norm(v, axis=1))
    return np.array(heights), np.array(speeds)


# --------------------------------------------------------------------------------------------------------- rolling
def test_a_sole_rolls_about_the_point_that_touches() -> None:
    """Where one corner carries the shoe, that corner stays where it is, whatever the pitch."""
    sole = Sole(points=((-0.1, -0.09), (0.1, -0.09)), ball=1, softness=1e-4)
    pitch = np.linspace(-60.0, -3.0, 200) * DEG
    forward, up = 0.1, -0.09
    place = sole.compute_forward(pitch) + forward * np.cos(pitch) - up * np.sin(pitch)
    height = sole.compute_height(pitch) + forward * np.sin(pitch) + up * np.cos(pitch)
    assert np.abs(place - place[0]).max() < 1e-6
    assert abs(place[0]) < 1e-3  # under the ball of the flat shoe, but for how soft it is
    assert np.abs(height).max() < 1e-6
    heel = sole.compute_forward(-pitch) - 0.1 * np.cos(pitch) - 0.09 * np.sin(pitch)
    assert np.ptp(heel) < 1e-6
    assert heel[0] == pytest.approx(-0.2, abs=1e-3)


@pytest.mark.parametrize("pace", PACES)
def test_the_shoe_stays_on_the_floor_and_does_not_slide(pace: str) -> None:
    """The lowest point of the sole: on the floor through every stance, above it in the air, and without speed."""
    walk = made("gait", pace=pace, course="straight")
    assert walk.motion is not None
    t = np.arange(0.5, walk.motion.t[-1] - 0.5, 0.004)
    heights, speeds = sole_points(walk, t)
    low, contacts = heights.min(axis=0), spans(walk, "contacts")
    touching = within(t, contacts + np.array([0.03, -0.03]))
    sole = Sole()  # carried by all its points at once it stands highest; and a strike shakes it
    assert np.abs(low[touching]).max() < sole.softness * np.log(len(sole.points)) + 0.002
    assert low.min() > -0.015  # the shoe gives way at the strike
    swings = np.column_stack([contacts[:-1, 1], contacts[1:, 0]])
    middle = within(t, np.column_stack([swings @ [0.75, 0.25], swings @ [0.3, 0.7]]))
    assert low[middle].min() > 0.005
    # Once the strike has died out, until shortly before lift-off, the ball or the toes carry it. Points of the sole
    # are 4 cm apart: at 6 rad/s the nearest one to what touches moves at up to 12 cm/s.
    rising = within(t, np.column_stack([spans(walk, "stances")[:, 1], contacts[:, 1] - 0.06])[:-1])
    assert speeds[:, rising].min(axis=0).max() < 0.15
    assert walk.motion.point(t[rising], np.zeros(3))[1].max() > 0.3  # and yet the IMU moves


@pytest.mark.parametrize("pace", PACES)
def test_stance_is_slow_and_not_still(pace: str) -> None:
    motion = made("gait", pace=pace, course="straight").motion
    assert motion is not None
    inside = within(motion.t, spans(made("gait", pace=pace, course="straight"), "stances")[1:-1])
    speed = np.linalg.norm(motion.v[inside], axis=1)
    # motion capture of real shoes has 2 to 5 cm/s at the quietest moments
    assert 0.01 < np.median(speed) < 0.06
    assert speed.min() < 0.04
    assert speed.max() < 0.35
    turn = np.linalg.norm(motion.omega_eb[inside], axis=1) / DEG
    assert 5.0 < np.median(turn) < 30.0


@pytest.mark.parametrize(("pace", "low", "high"), [("slow", 2.3, 3.2), ("normal", 3.2, 4.5), ("fast", 4.4, 6.0)])
def test_swing_is_as_fast_and_high_as_a_foot(pace: str, low: float, high: float) -> None:
    walk = made("gait", pace=pace, course="straight")
    motion, contacts = walk.motion, spans(walk, "contacts")
    assert motion is not None
    shoe = ro.to_rph(motion.R_lb @ shoe_from_imu(walk).T)[:, 1] / DEG
    for a, b in zip(contacts[1:-2, 1], contacts[2:-1, 0], strict=True):
        inside = (motion.t >= a) & (motion.t <= b)
        assert low < np.linalg.norm(motion.v[inside], axis=1).max() < high
        assert 60.0 < np.ptp(shoe[inside]) < 110.0
        assert 0.09 < motion.llh[inside, 2].max() - 20.093 < 0.16
    stride = np.diff(contacts[1:-1, 0])
    assert stride.std() / stride.mean() == pytest.approx(0.02, abs=0.015)
    share = np.median(np.diff(contacts[1:-1])[:-1, 0] / stride)
    assert 0.55 < share < 0.68


def test_range_is_exceeded_at_a_fast_pace_only() -> None:
    fast, normal = (made("gait", pace=pace, imu="ellipse2", rate=100.0) for pace in ("fast", "normal"))
    assert fast.facts["clipped_samples"]["accel"] > 10
    assert normal.facts["clipped_samples"]["accel"] == 0
    accel, gyro = np.abs(fast.recording.imu.accel), np.abs(fast.recording.imu.gyro)
    assert accel.max() == pytest.approx(160.0)
    assert gyro.max() == pytest.approx(450.0 * DEG, rel=1e-6)


def test_turning_is_shared_by_floor_and_air() -> None:
    walk = made("gait", course="laps")
    motion, contacts = walk.motion, spans(walk, "contacts")
    assert motion is not None
    heading = np.unwrap(motion.rph[:, 2])
    at = np.interp(contacts[1:-1], motion.t, heading) / DEG
    floor, air = np.diff(at)[:, 0], at[1:, 0] - at[:-1, 1]
    assert floor.min() < -12.0  # to the left around corners, within one stance
    assert air.min() < -25.0
    assert np.median(np.abs(floor)) < 3.0
    assert (heading[-1] - heading[0]) / DEG == pytest.approx(-360.0 * 2, abs=0.3)


# ------------------------------------------------------------------------------------------------------- exactness
def inertial_alone(walk: Simulated) -> tuple[float, float]:
    """Largest errors (m, rad) of graphnav's mechanisation from the exact first state and the exact samples."""
    motion = walk.motion
    assert motion is not None
    imu = Imu(motion.t[1:], motion.gyro, motion.accel, walk.recording.imu.noise)
    recording = replace(walk.recording, imu=imu)
    t = np.arange(int(motion.t[-1]) + 1.0)
    frame, zero = LocalFrame(motion.llh[0]), np.zeros(3)
    mechanisation = Mechanisation(preintegrate(bridge_gaps(imu), recording.imu, t, zero, zero), frame)
    chain = [truth_states(walk.truth, t[:1], frame)]
    for k in range(len(t) - 1):
        chain.append(mechanisation.propagate(slice(k, k + 1), chain[-1])[0])
    end, true = States.stack(chain), truth_states(walk.truth, t, frame)
    turned = ro.log(np.swapaxes(true.R_nb, -1, -2) @ end.R_nb)
    return float(np.abs(end.p - true.p).max()), float(np.abs(turned).max())


@pytest.mark.parametrize(("name", "options", "metres"), [
    ("ren2021", {"walk": 10}, 0.01), ("ren2021", {"walk": 5, "rate": 400.0}, 0.003),
    ("gait", {"pace": "fast", "duration": 120.0, "rate": 400.0}, 0.006),
])  # fmt: skip
def test_free_inertial_by_graphnav(name: str, options: dict[str, float | str], metres: float) -> None:
    """Samples that lead from state to state do so through every shock, for minutes."""
    position, attitude = inertial_alone(made(name, exact=True, compensated=True, **options))
    assert position < metres
    assert attitude < 1e-9


def test_means_lose_coning_with_the_square_of_the_period() -> None:
    slow, fast = (inertial_alone(made("ren2021", walk=5, exact=True, rate=rate)) for rate in (100.0, 200.0))
    assert slow[1] / fast[1] == pytest.approx(4.0, rel=0.05)
    assert 0.1 * DEG < slow[1] < 1.0 * DEG


def test_free_inertial_by_pyins() -> None:
    """Another program, which puts coning and sculling back into means, to the second order of a period's turn."""
    walk = made("gait", course="bends", exact=True, rate=2000.0)
    motion = walk.motion
    assert motion is not None
    readings = np.hstack([oracle_path.swap(motion.gyro), oracle_path.swap(motion.accel)]) / 2000.0
    readings = np.vstack([readings[:1], readings])
    readings = pd.DataFrame(readings, index=motion.t, columns=util.GYRO_COLS + util.ACCEL_COLS)
    truth = np.hstack([oracle_path.degrees(motion.llh), oracle_path.swap(motion.v), np.rad2deg(motion.rph)])
    start = pd.Series(truth[0], index=util.TRAJECTORY_COLS, name=motion.t[0])
    increments = strapdown.compute_increments_from_imu(readings, "increment")
    result = strapdown.Integrator(start).integrate(increments).to_numpy()
    assert np.abs(transform.compute_lla_difference(result[:, :3], truth[:, :3])).max() < 0.01
    assert np.abs(result[:, 3:6] - truth[:, 3:6]).max() < 5e-4
    assert np.abs((result[:, 6:9] - truth[:, 6:9] + 180.0) % 360.0 - 180.0).max() < 1e-5


def test_at_rest_it_feels_gravity() -> None:
    walk = made("ren2021", walk=1, exact=True)
    motion, rest = walk.motion, walk.stops
    assert motion is not None
    assert rest.shape == (2, 2)
    for a, b in rest:
        inside = (motion.t[1:] > a + 0.3) & (motion.t[1:] < b - 0.3)
        assert inside.sum() > 100
        force = np.linalg.norm(motion.accel[inside], axis=1)
        assert np.abs(force - gravity(motion.llh[0, 0], 20.0)).max() < 0.02
        assert np.linalg.norm(motion.v[1:][inside], axis=1).max() < 2e-3
        assert np.linalg.norm(motion.gyro[inside], axis=1).max() < 1.0 * DEG


# ------------------------------------------------------------------------------------------------------------ walks
@pytest.mark.parametrize("laps", [1, 3])
def test_a_rectangle_is_as_long_as_it_should_be_and_closes(laps: int) -> None:
    along = make_route(list_rectangle(86.0, laps), 30.0)
    assert along.length == pytest.approx(86.0 * laps)
    assert np.linalg.norm(along.xy[-1]) < 1e-4
    assert (along.heading[-1] - along.heading[0]) / DEG == pytest.approx(-360.0 * laps)
    # about the paper's 15 x 28 m: the extent along the first side and across it, together half the perimeter and
    # what the arcs cut off
    turned = along.xy @ np.array([[0.5, np.sqrt(0.75)], [np.sqrt(0.75), -0.5]])
    assert np.ptp(turned, axis=0) == pytest.approx([28.07, 15.44], abs=0.01)
    assert np.ptp(turned, axis=0).sum() == pytest.approx(43.0 + (4.0 - np.pi) * 0.6, abs=1e-3)


@pytest.mark.parametrize("number", range(1, 14))
def test_walks_of_table_2(number: int) -> None:
    walk = made("ren2021", walk=number)
    perimeter, laps, duration = WALKS[number - 1]
    assert walk.recording.duration == pytest.approx(duration)
    assert walk.facts["distance_m"] == pytest.approx(perimeter * laps)
    ends = walk.truth.llh[[0, -1]]
    assert np.linalg.norm(np.diff(LocalFrame(ends[0]).from_llh(ends), axis=0)) < 0.002
    stances, contacts = spans(walk, "stances"), spans(walk, "contacts")
    assert len(stances) == len(contacts)
    assert np.all(contacts[:, 0] <= stances[:, 0])
    assert np.all(stances[:, 0] < stances[:, 1])
    assert np.all(stances[:, 1] <= contacts[:, 1])
    assert np.all(contacts[1:, 0] > contacts[:-1, 1])
    # strides of 1.1 to 1.5 m, but for the half ones
    p = LocalFrame(ends[0]).from_llh(walk.truth.llh)[np.searchsorted(walk.truth.t, stances.mean(axis=1)[1:-1])]
    assert 1.0 < np.median(np.linalg.norm(np.diff(p, axis=0), axis=1)) < 1.6


def test_seeds() -> None:
    one, same, other = made("ren2021", 3, walk=1), simulate("ren2021", 3, walk=1), made("ren2021", 4, walk=1)
    np.testing.assert_array_equal(one.recording.imu.accel, same.recording.imu.accel)
    assert one.facts == same.facts
    assert one.facts["mounting_deg"] != other.facts["mounting_deg"]
    # the same walk, whatever reads it
    np.testing.assert_array_equal(one.truth.llh, made("ren2021", 3, walk=1, exact=True).truth.llh)
    finer = made("ren2021", 3, walk=1, rate=200.0)
    np.testing.assert_allclose(one.truth.v, finer.truth.v[::2], atol=1e-12)


@pytest.mark.parametrize(("name", "options"), [("ren2021", {"walk": 1}), ("gait", {"duration": 30.0})])
def test_the_folder_holds_the_recording(name: str, options: dict[str, float], tmp_path: Path) -> None:
    walk = made(name, **options)
    walk.write(tmp_path)
    again = read(tmp_path)
    assert again.platform == "foot"
    assert again.gnss is None
    np.testing.assert_array_equal(again.imu.accel, walk.recording.imu.accel)
    facts = json.loads((tmp_path / "simulated.json").read_text())
    np.testing.assert_allclose(facts["stances"], walk.facts["stances"])
    assert inspect(walk.recording).warnings == ()


@pytest.mark.parametrize(("name", "options"), [
    ("ren2021", {"walk": 14}), ("ren2021", {"walk": 2.5}), ("ren2021", {"rate": 5.0}), ("gait", {"pace": "run"}),
    ("gait", {"imu": "phone"}), ("gait", {"course": "zigzag"}), ("gait", {"duration": 5.0}),
    ("urban", {"duration": 9e4}), ("motorway", {"duration": 9e5}),
])  # fmt: skip
def test_bad_options_are_refused(name: str, options: dict[str, float | str]) -> None:
    ((option, value),) = options.items()
    with refused("simulation.value", ConfigError, option, str(value).removesuffix(".0")):
        simulate(name, 0, **options)


# ------------------------------------------------------------------------------------------------- beside real shoes
def figures(imu: Imu) -> dict[str, float]:
    force, turn = np.linalg.norm(imu.accel, axis=1), np.linalg.norm(imu.gyro, axis=1) / DEG
    walking = np.convolve(turn, np.ones(101) / 101, "same") > 60.0
    return {
        "force, 90 %": float(np.percentile(force[walking], 90)),
        "force, 99 %": float(np.percentile(force[walking], 99)),
        "turn, 90 %": float(np.percentile(turn[walking], 90)),
        "turn, 20 %": float(np.percentile(turn[walking], 20)),
        "pitch rate": float(imu.gyro[walking, 0].std() / DEG),
        "quiet": float(np.mean(turn[walking] < 50.0)),
    }


def test_it_is_like_real_walks(shared_data: Path) -> None:
    """Every figure of a walk at a slow or normal pace lies among those of real shoes, or a quarter beyond them."""
    real = [
        figures(read(shared_data / name).imu)
        for name in (
            "openshoe_loops/run02.toml",
            "gcp_walks/walk39.toml",
            "gcp_walks/walk33.toml",
            "xio_loops/long.toml",
        )
    ]
    for mine in (figures(made("gait", pace=pace).recording.imu) for pace in ("slow", "normal")):
        for key, value in mine.items():
            among = [one[key] for one in real]
            assert 0.75 * min(among) < value < 1.25 * max(among), (key, value, among)
