"""What wheels and stops say, against exact motion of another simulator, and on drives with known calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import Array, truth_states

from graphnav.config import Settings, parse_settings
from graphnav.constraints.base import BuildContext, Linearized
from graphnav.constraints.odometer import ODOMETER_DELAY, ODOMETER_SCALE, OdometerSpeed
from graphnav.constraints.standstill import PLACE, HeldPosition, ZeroRate, ZeroVelocity
from graphnav.constraints.vehicle import AXLE, MOUNTING, NonHolonomic
from graphnav.core import rotation
from graphnav.core.earth import EARTH_RATE, LocalFrame
from graphnav.core.rotation import mv
from graphnav.core.state import BLOCKS, DIM, States
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.pipeline import run
from graphnav.estimation.problem import choose_keyframes
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import find_antenna_lever_arm
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Recording
from graphnav.recording.formats import read
from graphnav.simulation import simulate

STOP = (88.0, 104.0)  # s, inside a stop of the lap
MOUNT = np.radians([2.0, -3.0])  # pitch, heading of the IMU against the vehicle


@pytest.fixture(scope="module", params=[-45.0, 70.0])
def exact(request: pytest.FixtureRequest) -> tuple[Recording, Trajectory]:
    """Samples, fixes and wheel speed of python-ins without any error."""
    path = oracle.vehicle_path(180.0, lat=request.param)
    return oracle.drive(path, imu_noise=None, gnss_exact=True, odometer_rate=20.0, odometer_sd=0.0, odometer_scale=0.01)


def scene_of(
    recording: Recording, settings: Settings, ba: Array | None = None, bg: Array | None = None
) -> BuildContext:
    frame = LocalFrame(recording.gnss.llh[40])
    t = choose_keyframes(recording.start, recording.end, np.array(STOP), 1.0)
    zero = np.zeros(3)
    imu = recording.imu
    intervals = preintegrate(bridge_gaps(imu), imu, t, zero if ba is None else ba, zero if bg is None else bg)
    return BuildContext(recording, settings, frame, t, np.array([STOP]), intervals)


def residual(cls: type, recording: Recording, truth: Trajectory, values: dict[str, Array], **biases: Array) -> Array:
    """At the true states; parameters as given, the rest as expected."""
    scene = scene_of(recording, Settings(), **biases)
    rows = cls.build(scene)
    states = truth_states(truth, scene.t[rows.keyframe], scene.frame)
    given = {p.name: np.tile(values.get(p.name, p.initial), (len(rows), 1)) for p in rows.parameters}
    return rows.linearize(states, given, slice(None)).residual


def mounted(recording: Recording, truth: Trajectory) -> tuple[Recording, Trajectory, Array]:
    """The same drive with the IMU turned on its foot: R_vb = Rz(-heading) Rx(pitch)."""
    pitch, heading = MOUNT
    R_vb = rotation.exp(np.array([0.0, 0.0, -heading])) @ rotation.exp(np.array([pitch, 0.0, 0.0]))
    imu = recording.imu
    turned = replace(imu, gyro=imu.gyro @ R_vb, accel=imu.accel @ R_vb)
    rph = rotation.to_rph(rotation.from_rph(truth.rph) @ R_vb)
    odometer = replace(recording.odometer, lever_arm=R_vb.T @ recording.odometer.lever_arm)
    gnss = replace(recording.gnss, lever_arm=R_vb.T @ recording.gnss.lever_arm)
    return replace(recording, imu=turned, odometer=odometer, gnss=gnss), replace(truth, rph=rph), R_vb


def test_the_axle_of_an_exact_drive_moves_straight_ahead(exact: tuple[Recording, Trajectory]) -> None:
    """The mean velocity over a second, seen from its end: frames, lever arm, Earth and gravity are the simulator's.

    Left out, the Earth's turning alone would leave 0.7 mm/s at 20 m/s.
    """
    assert np.abs(residual(NonHolonomic, *exact, {})).max() < 2e-4
    assert np.abs(residual(OdometerSpeed, *exact, {ODOMETER_SCALE: np.array([1.0 / 1.01 - 1.0])})).max() < 2e-3


def test_a_reading_is_expected_as_the_sensor_shows_it(exact: tuple[Recording, Trajectory]) -> None:
    """An IMU across the vehicle and a scale of -100 % explain no reading, though the sideways speed and (1 + k) s agree
    there: in speeds on the road that is the least residual of all."""
    across = {MOUNTING: np.array([0.0, 0.5 * np.pi])}
    true = np.square(residual(OdometerSpeed, *exact, {ODOMETER_SCALE: np.array([1.0 / 1.01 - 1.0])})).mean()
    read = np.square(exact[0].odometer.speed).mean()
    for scale in (-0.999, -0.9, -0.5, 0.0):
        found = np.square(residual(OdometerSpeed, *exact, across | {ODOMETER_SCALE: np.array([scale])})).mean()
        assert found > 0.5 * read > 100.0 * true


@pytest.mark.parametrize("unit", [1.0 / 3.6, 1.0, 3.6])
def test_steps_find_a_scale_far_from_that_stated(exact: tuple[Recording, Trajectory], unit: float) -> None:
    """There the derivative by the scale is the numerical one."""
    recording, truth = exact
    other = replace(recording.odometer, speed=recording.odometer.speed * unit)
    scene = scene_of(replace(recording, odometer=other), Settings())
    rows = OdometerSpeed.build(scene)
    states = truth_states(truth, scene.t[rows.keyframe], scene.frame)

    def linearize(scale: float) -> Linearized:
        given = {p.name: np.tile(p.initial, (len(rows), 1)) for p in rows.parameters}
        given[ODOMETER_SCALE][:] = scale
        return rows.linearize(states, given, slice(None))

    scale = 0.0
    for _ in range(8):
        linear = linearize(scale)
        J = linear.jacobians[ODOMETER_SCALE][:, :, 0]
        scale -= float(np.sum(J * linear.residual) / np.sum(J * J))
    assert scale == pytest.approx(1.0 / (1.01 * unit) - 1.0, abs=1e-4)
    numerical = (linearize(scale + 1e-6).residual - linearize(scale - 1e-6).residual) / 2e-6
    np.testing.assert_allclose(linearize(scale).jacobians[ODOMETER_SCALE][:, :, 0], numerical, atol=1e-5)


def test_late_readings_are_read_later_where_there_are_any(exact: tuple[Recording, Trajectory]) -> None:
    """Its derivative is the numerical one; beside a gap, and at the end, the reading stays that without delay."""
    recording, truth = exact
    odometer, late, h = recording.odometer, 0.3, 1e-3
    kept = (odometer.t < 60.0) | (odometer.t > 65.0)
    delayed = replace(odometer, t=odometer.t[kept] + late, speed=odometer.speed[kept])
    scene = scene_of(replace(recording, odometer=delayed), Settings())
    rows = OdometerSpeed.build(scene).free_delay(np.zeros(1), np.ones(1))
    states = truth_states(truth, scene.t[rows.keyframe], scene.frame)

    def linearize(delay: float) -> Linearized:
        values = {ODOMETER_SCALE: 1.0 / 1.01 - 1.0, ODOMETER_DELAY: delay}
        given = {p.name: np.tile(values.get(p.name, p.initial), (len(rows), 1)) for p in rows.parameters}
        return rows.linearize(states, given, slice(None))

    read = (rows.end + late <= delayed.t[-1]) & ((rows.end < 60.0) | (rows.begin > 65.0))
    assert 0 < np.sum(~read) < 10
    right, stated = linearize(late), linearize(0.0)
    assert np.abs(right.residual[read]).max() < 2e-3
    assert np.abs(stated.residual[read]).max() > 0.1  # or it would show nothing
    np.testing.assert_array_equal(right.residual[~read], stated.residual[~read])
    numerical = (linearize(late + h).residual - linearize(late - h).residual)[read, 0] / (2.0 * h)
    np.testing.assert_allclose(right.jacobians[ODOMETER_DELAY][read, 0, 0], numerical, atol=0.02)
    assert not right.jacobians[ODOMETER_DELAY][~read].any()


def test_mounting_angles_are_those_of_a_turned_imu(exact: tuple[Recording, Trajectory]) -> None:
    recording, truth, _ = mounted(*exact)
    assert np.abs(residual(NonHolonomic, recording, truth, {MOUNTING: MOUNT})).max() < 2e-4
    assert np.abs(residual(NonHolonomic, recording, truth, {})).max() > 0.5  # or it would show nothing


def test_the_axle_is_found_where_it_is(exact: tuple[Recording, Trajectory]) -> None:
    recording, truth = exact
    wrong = replace(recording.odometer, lever_arm=np.add(recording.odometer.lever_arm, [0.0, 0.7, 0.0]))
    moved = replace(recording, odometer=wrong)
    assert np.abs(residual(NonHolonomic, moved, truth, {AXLE: np.array([-0.7])})).max() < 2e-4
    assert np.abs(residual(NonHolonomic, moved, truth, {})).max() > 0.1


def test_biases_expected_wrong_are_made_good(exact: tuple[Recording, Trajectory]) -> None:
    """Integrated with biases that the states do not have; first order is enough for what is left to estimate."""
    biases = {"ba": np.array([0.05, -0.04, 0.06]), "bg": np.array([3e-4, -2e-4, 4e-4])}
    assert np.abs(residual(NonHolonomic, *exact, {}, **biases)).max() < 1e-3
    recording, truth = exact
    scene = scene_of(recording, Settings(), **biases)
    rows = NonHolonomic.build(scene)
    states = truth_states(truth, scene.t[rows.keyframe], scene.frame)
    wrong = States(states.R_nb, states.p, states.v, states.ba + biases["ba"], states.bg + biases["bg"])
    given = {p.name: np.tile(p.initial, (len(rows), 1)) for p in rows.parameters}
    assert np.abs(rows.linearize(wrong, given, slice(None)).residual).max() > 1e-2


def test_a_stop_is_a_stop(exact: tuple[Recording, Trajectory]) -> None:
    recording, truth = exact
    assert np.abs(residual(ZeroVelocity, recording, truth, {})).max() < 1e-9
    assert np.abs(residual(ZeroRate, recording, truth, {})).max() < 1e-9  # the Earth's rate is 7e-5
    scene = scene_of(recording, Settings())
    rows = HeldPosition.build(scene)
    states = truth_states(truth, scene.t[rows.keyframe], scene.frame)
    place = np.tile(states.p[0], (len(rows), 1))
    assert np.abs(rows.linearize(states, {PLACE: place}, slice(None)).residual).max() < 1e-6
    assert scene.t[rows.keyframe[0] - 1] == pytest.approx(STOP[0])
    assert scene.t[rows.keyframe[-1]] == pytest.approx(STOP[1])
    np.testing.assert_array_equal(rows.keyframe, ZeroVelocity.build(scene).keyframe)


def test_a_stop_with_a_speed_left_over_tells_no_heading(exact: tuple[Recording, Trajectory]) -> None:
    """A turn of attitude and velocity about the vertical changes no row of its first keyframe, whatever the speed."""
    recording, truth = exact
    scene = scene_of(recording, Settings())
    made = [cls.build(scene) for cls in (ZeroVelocity, ZeroRate, HeldPosition)]
    first = min(int(rows.keyframe[0]) for rows in made)
    still = truth_states(truth, scene.t[[first]], scene.frame)
    rolling = replace(still, v=mv(still.R_nb, np.array([[0.0, 1.7, 0.0]])))
    turn = np.zeros((1, DIM))
    turn[0, BLOCKS["theta"]] = still.R_nb[0, 2]
    turn[0, BLOCKS["v"]] = np.cross([0.0, 0.0, 1.0], rolling.v[0])
    for rows in made:
        assert rows.keyframe[0] == first
        linear = rows.linearize(rolling, {PLACE: rolling.p}, slice(0, 1))
        change = sum(mv(J, turn[:, BLOCKS[name]]) for name, J in linear.jacobians.items() if name in BLOCKS)
        assert np.abs(change).max() < 2.0 * EARTH_RATE  # the Earth's, turned


def test_a_restless_stop_is_believed_less(exact: tuple[Recording, Trajectory]) -> None:
    recording, _ = exact
    imu = recording.imu
    rocked = (imu.t > 94.0) & (imu.t < 97.0)
    accel = imu.accel + np.where(rocked[:, None], [0.0, 0.3, 0.0], 0.0) * np.sin(2.0 * imu.t)[:, None]
    calm, restless = (
        ZeroVelocity.build(scene_of(replace(recording, imu=replace(imu, accel=a)), Settings()))
        for a in (imu.accel, accel)
    )
    t = scene_of(recording, Settings()).t[calm.keyframe]
    near = (t > 94.0) & (t < 98.0)
    assert np.all(restless.sigma[near] > 0.005)
    np.testing.assert_allclose(restless.sigma[t < 91.0], calm.sigma[t < 91.0])


STATED = {"noise": {"mode": "stated"}}  # where what is asked has nothing to do with how good the sensors are


def estimated(recording: Recording, **settings: dict[str, object]) -> Solution:
    return run(recording, parse_settings(settings), ("batch",))["batch"]


def test_calibration_is_recovered() -> None:
    """Simulated after Zhu 2020: mounting within 0.1 deg, scale within 0.1 %, and as sure as the sigmas say."""
    made = simulate("zhu2020", 0, unplugged=False, after_s=90.0)
    found = estimated(made.recording).parameters
    true = made.facts["mounting_deg"]
    off = np.degrees(found["mounting"].value[-1]) - [true["pitch"], true["heading"]]
    scale = found["odometer_scale"].value[-1, 0] - (1.0 / (1.0 + made.facts["odometer_scale_error"]) - 1.0)
    assert np.abs(off).max() < 0.1
    assert abs(scale) < 1e-3
    assert np.all(np.abs(off) < 3.5 * np.degrees(found["mounting"].sigma[-1]))
    assert abs(scale) < 3.5 * found["odometer_scale"].sigma[-1, 0]
    assert found["mounting"].observable.all()


def test_a_late_odometer_is_found_out(shared_data: Path) -> None:
    recording = oracle.oracle_drive(shared_data, 3, rate=50.0)[0].crop(0.0, 300.0)
    late = replace(recording.odometer, t=recording.odometer.t + 0.35, delay_sigma=0.3)
    delay = estimated(replace(recording, odometer=late), **STATED).parameters[ODOMETER_DELAY]
    assert delay.value[0, 0] == pytest.approx(0.35, abs=0.02)
    assert abs(delay.value[0, 0] - 0.35) < 4.0 * delay.sigma[0, 0]


def test_an_unsigned_odometer_backs_up() -> None:
    """Parking backwards in a simulated town, GNSS withheld there: the odometer's sign is the motion's."""
    made = simulate("urban", 1, duration=300.0, tunnels=0)
    backs = made.truth.t[np.sum(made.truth.v * heading(made.truth), axis=1) < -0.3]
    assert len(backs) > 100
    recording = made.recording.crop(backs[0] - 120.0 - made.recording.start)
    odometer = recording.odometer
    begin, end = backs[0] - 5.0 - recording.start, backs[-1] + 1.0 - recording.start
    way = None if odometer.counted is None else np.r_[0.0, np.cumsum(np.abs(np.diff(odometer.counted)))]
    blind = replace(odometer, speed=np.abs(odometer.speed), counted=way, signed=False)
    far = {}
    for name, sensor in (("signed", odometer), ("unsigned", blind)):
        solution = estimated(replace(recording, odometer=sensor).without("gnss", (begin, end)), **STATED)
        truth = made.recording.truth
        p = solution.frame.from_llh(truth.llh)
        inside = (solution.t > backs[0]) & (solution.t < backs[-1])
        true = np.stack([np.interp(solution.t[inside], truth.t, x) for x in p.T], -1)
        far[name] = np.linalg.norm((solution.states.p[inside] - true)[:, :2], axis=1).max()
    assert far["signed"] < 0.3
    assert far["unsigned"] < 0.3


def heading(truth: Trajectory) -> Array:
    """(N, 3) the forward axis."""
    return rotation.from_rph(truth.rph)[:, :, 1]


def test_an_odometer_stuck_at_zero_is_not_believed(shared_data: Path) -> None:
    recording = oracle.oracle_drive(shared_data, 4, rate=50.0)[0].crop(300.0, 560.0)  # with the outage
    odometer = recording.odometer
    stuck = (odometer.t > 440.0) & (odometer.t < 460.0)  # in the outage, at speed
    broken = replace(recording, odometer=replace(odometer, speed=np.where(stuck, 0.0, odometer.speed)))
    good, bad = (estimated(r, **STATED) for r in (recording, broken))
    t = good.t[(good.t > 415.0) & (good.t < 475.0)]
    gap = [s.frame.to_llh(s.states.p[np.searchsorted(s.t, t)]) for s in (good, bad)]
    assert np.abs((gap[0] - gap[1]) * [6.4e6, 6.4e6, 1.0]).max() < 0.2
    assert bad.counts["odometer"] == pytest.approx(good.counts["odometer"] - 20, abs=3)


# -------------------------------------------------------------------------------------------------- real recordings
def largest(
    recording: Recording, span: tuple[float, float], *solvers: str, **settings: dict[str, object]
) -> list[float]:
    """Largest horizontal distance from the withheld fixes that are known to be good, m, of each solver."""
    found = run(recording.without("gnss", span), parse_settings(settings), solvers)
    return [distance(found[name], recording, span) for name in solvers]


def distance(solution: Solution, recording: Recording, span: tuple[float, float]) -> float:
    truth = recording.truth
    t = truth.t - recording.start
    rows = np.flatnonzero((t > span[0]) & (t < span[1]))
    states, _ = solution.between[0](truth.t[rows])
    lever = find_antenna_lever_arm(recording, solution) if truth.of == "gnss" else np.zeros(3)
    p = states.p + states.R_nb @ lever
    return float(np.linalg.norm((p - solution.frame.from_llh(truth.llh[rows]))[:, :2], axis=1).max())


def test_the_outage_of_the_oracle_drive_stays_below_a_decimetre(shared_data: Path) -> None:
    """Measured: 5 cm (batch), 13 cm (filter); without wheels 13 cm and 3 m."""
    shipped = read(shared_data / "oracle_drive" / "recording.toml").crop(260.0, 560.0)
    found = run(shipped, None, ("ekf", "batch"))
    truth = shipped.truth
    for name, most in (("batch", 0.10), ("ekf", 0.30)):
        solution = found[name]
        inside = (truth.t > 415.0) & (truth.t < 475.0)
        states, _ = solution.between[0](truth.t[inside])
        off = states.p - solution.frame.from_llh(truth.llh[inside])
        assert np.linalg.norm(off[:, :2], axis=1).max() < most


def test_a_minute_in_tokyo_without_gnss(shared_data: Path) -> None:
    """Real streets, 2020: measured 0.3 m (batch) and 0.8 m (filter); inertial alone 0.9 m and 40 m."""
    recording = read(shared_data / "tokyo_20201105").crop(1100.0, 1290.0)
    span = (1169.0 - 1100.0, 1229.0 - 1100.0)
    smoothed, filtered = largest(recording, span, "batch", "ekf")
    assert smoothed < 0.6
    assert filtered < 3.0


def test_the_last_half_minute_of_a_motorway(shared_data: Path) -> None:
    """Phone-grade IMU, straight road, no GNSS after 30 s: with wheels within a metre or so, without 19 m."""
    recording = read(shared_data / "comma_highway_20180802")
    assert largest(recording, (30.0, 60.0), "batch")[0] < 1.6
    assert largest(recording, (30.0, 60.0), "batch", vehicle={"nhc": False, "odometer": False})[0] > 5.0


def test_sigma_survives_long_stops_in_the_dark(shared_data: Path) -> None:
    """Eight minutes with nothing but stops: metres on the Earth, millimetres against the place of a stop."""
    recording, _ = oracle.oracle_drive(shared_data, 5, rtk=False, odometer=False, rate=50.0)
    inertial = parse_settings({"vehicle": {"nhc": False}, **STATED})
    found = run(recording.without("gnss", (135.0, 600.0)), inertial)
    for name, solution in found.items():
        variance = np.diagonal(solution.covariance, axis1=1, axis2=2)
        assert np.isfinite(variance).all(), name
        assert variance.min() > 0.0, name
    # at the end a smoother knows no more than the filter
    end = {name: np.sqrt(np.diagonal(s.covariance[-1])[3:5]) for name, s in found.items()}
    assert end["ekf"].max() > 3.0
    np.testing.assert_allclose(end["rts"], end["ekf"], rtol=1e-6)
    np.testing.assert_allclose(end["batch"], end["ekf"], rtol=0.3)  # linearised elsewhere
