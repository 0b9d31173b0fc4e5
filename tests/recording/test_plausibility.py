"""What cannot be right is masked or refused before anything is solved, and nothing of that is said of sound drives."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import refused
from mistakes import ROOT

from graphnav import run
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes
from graphnav.estimation.solution import make_trajectory
from graphnav.evaluation.evaluate import evaluate_recording
from graphnav.recording import Recording, take_rows
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import read
from graphnav.recording.formats.repair import choose_sigmas
from graphnav.recording.formats.table import Table
from graphnav.recording.plausibility.fixes import find_out_of_reach
from graphnav.recording.plausibility.screening import screen, screen_recording

Change = Callable[[Recording], Recording]
METRE = 1.0 / 6.37e6  # rad of latitude


@functools.cache
def load(source: str) -> Recording:
    """A recording, read once for all tests; it is frozen."""
    return read(source)


@pytest.fixture
def tokyo() -> Recording:
    return load(str(ROOT / "data" / "tokyo"))


@pytest.fixture
def oracle(shared_data: Path) -> Recording:
    """From where it begins to drive."""
    return load(str(shared_data / "oracle_drive")).crop(60.0, 200.0)


def change(recording: Recording, sensor: str, **how: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """A recording with arrays of a sensor changed; each function gets a copy."""
    old = getattr(recording, sensor)
    new = replace(old, **{key: f(getattr(old, key).copy()) for key, f in how.items()})
    return replace(recording, **{sensor: new})


def put(at: object, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """One value, or several that become alike."""

    def how(x: np.ndarray) -> np.ndarray:
        x[at] = value
        return x

    return how


def found(recording: Recording) -> dict[str, str]:
    """Key -> severity of what is graver than a note."""
    return {f.key: f.severity for f in screen(recording).findings if f.severity != "note"}


# ---- sound recordings

KITTI = 18374  # a row whose turn rate is 0.338 rad/s between 0.294 and 0.308, where those around go on evenly
# rows of its eight stretches of a second and a half that are straight lines on all six axes
KITTI_FILLED = [(3451, 3609), (19685, 19839), (20120, 20273), (21779, 21937), (23438, 23596), (27709, 27863),
                (30373, 30537), (30591, 30749)]  # fmt: skip

SOUND = [
    "oracle_drive/recording.toml",
    "boulder_drive_20250708/recording.toml",
    "comma_highway_20180802/recording.toml",
    "canada_rover/recording.toml",
    "car_circles_boston_20241021/recording.toml",
    "car_circles_boston_20251119/recording.toml",
    "motorbike_dresden_20160809/recording.toml",
    "dresden_car_20140326/recording.toml",
    "tokyo_20201105/recording.toml",
    "tokyo_20201105/recording_spp.toml",
]


def same(a: Recording, b: Recording) -> bool:
    """Whether nothing was changed."""
    return all(
        getattr(a, name) is None or all(
            np.array_equal(value, getattr(getattr(b, name), key), equal_nan=True)
            for key, value in getattr(a, name).__dict__.items()
            if isinstance(value, np.ndarray)
        )
        for name in ("imu", "gnss", "odometer")
    )  # fmt: skip


@pytest.mark.parametrize("name", SOUND)
def test_nothing_is_said_of_a_sound_drive(shared_data: Path, name: str) -> None:
    recording = load(str(shared_data / name))
    assert found(recording) == {}
    assert same(recording, screen(recording).recording)


@pytest.mark.parametrize("name", ["kitti", str(ROOT / "data" / "tokyo")])
def test_nothing_is_said_of_what_comes_with_the_program(name: str) -> None:
    recording = load(name)
    assert found(recording) == ({"imu.filled": "warning"} if name == "kitti" else {})
    left = np.ones(len(recording.imu.t), dtype=bool)
    if name == "kitti":
        left[KITTI] = False
        for first, last in KITTI_FILLED:
            left[first:last] = False
    assert same(replace(recording, imu=take_rows(recording.imu, left)), screen(recording).recording)


@pytest.mark.parametrize("share", [0.05, 0.4])
def test_a_sensor_that_is_stuck_is_found_however_much_of_a_recording_it_is(tokyo: Recording, share: float) -> None:
    imu = tokyo.imu
    stuck = slice(n := len(imu.t) // 2, n + round(share * len(imu.t)))
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    gyro[stuck], accel[stuck] = gyro[n], accel[n]
    left = screen(replace(tokyo, imu=replace(imu, gyro=gyro, accel=accel)))
    assert "imu.filled" in {f.key for f in left.findings}
    assert not np.isin(imu.t[n + 1 : stuck.stop], left.recording.imu.t).any()
    assert np.isin(np.delete(imu.t, stuck), left.recording.imu.t).all()


def test_nothing_is_said_of_a_walk(shared_data: Path) -> None:
    folders = ("gcp_walks", "openshoe_loops", "pyshoe_vicon", "xio_loops")
    walks = [f for folder in folders for f in (shared_data / folder).glob("*.toml")]
    assert len(walks) == 22
    for walk in walks:
        assert found(load(str(walk))) == {}, walk


def test_a_recording_is_screened_once(tokyo: Recording) -> None:
    wild = change(tokyo, "imu", accel=put((3000, 0), 1e4))
    first = screen(wild)
    assert len(first.findings) == 1
    again = screen(first.recording)
    assert again.findings == ()
    assert again.recording is first.recording


# ---- the IMU


@pytest.mark.parametrize("sensor", ["accel", "gyro"])
@pytest.mark.parametrize("value", [1e4, -1e6, 1e300])
def test_a_row_that_no_sensor_can_read_is_left_out(tokyo: Recording, sensor: str, value: float) -> None:
    wild = change(tokyo, "imu", **{sensor: put((3000, 1), value)})
    assert found(wild) == {"imu.spike": "warning"}
    left = screen(wild).recording.imu.t
    assert np.array_equal(left, np.delete(tokyo.imu.t, 3000))


def test_a_spike_does_not_move_the_answer(oracle: Recording) -> None:
    short = oracle.crop(0.0, 60.0)

    def error(recording: Recording) -> float:
        s = run(recording, solvers=("ekf", "rts"))["rts"]
        metrics = evaluate_recording(make_trajectory("rts", s.frame, s.t, s.states, s.covariance), short)
        assert metrics is not None
        return metrics.components["h"].rms

    spiked = error(change(short, "imu", accel=put((8000, 0), 1e4)))  # at 40 s, on the way
    assert spiked < 1.5 * error(short) + 0.01


@pytest.mark.parametrize(("sensor", "value"), [("gyro", -5.0), ("accel", 100.0)])
def test_a_reading_that_those_around_contradict_is_left_out(tokyo: Recording, sensor: str, value: float) -> None:
    """Whichever row it is, and whether there is one or one every few seconds; but not where they come together."""
    for rows in ([3000], list(range(500, len(tokyo.imu.t) - 500, 150))):
        left = screen(change(tokyo, "imu", **{sensor: put((rows, 1), value)}))
        assert [f.key for f in left.findings] == ["imu.contradicted"]
        assert np.array_equal(left.recording.imu.t, np.delete(tokyo.imu.t, rows))
    near = change(tokyo, "imu", **{sensor: put(([3000, 3010, 3020], 1), value)})
    assert same(near, screen(near).recording)


def test_a_bump_is_no_fault(tokyo: Recording) -> None:
    """Where it bumps as much now and then, one bump more is one of them."""
    rng = np.random.default_rng(1)
    rows = rng.integers(10, len(tokyo.imu.t) - 10, 200)
    height = 0.1 * rng.pareto(1.5, 200)

    def bump(x: np.ndarray) -> np.ndarray:
        x[rows, 1] += height
        return x

    rough = change(tokyo, "imu", gyro=bump)
    assert height.max() > 1.0
    assert same(rough, screen(rough).recording)


def test_what_a_foot_hits_is_no_spike(shared_data: Path) -> None:
    walk = load(str(shared_data / "xio_loops" / "short.toml"))
    hard = change(walk, "imu", accel=put((2000, 2), 300.0))  # 30 g
    assert same(hard, screen(hard).recording)
    assert found(change(walk, "imu", accel=put((2000, 2), 3000.0))) == {"imu.spike": "warning"}


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sensor", ["accel", "gyro"])
def test_a_dead_axis_is_refused(tokyo: Recording, oracle: Recording, sensor: str, axis: int) -> None:
    for recording in (tokyo, oracle):  # the oracle's axes are not those of the body
        file_axes = getattr(recording.imu, sensor) @ recording.imu.R_bs
        file_axes[:, axis] = np.median(file_axes[:, axis])
        dead = replace(recording, imu=replace(recording.imu, **{sensor: file_axes @ recording.imu.R_bs.T}))
        assert found(dead)["imu.dead_axis"] == "refused"
        (finding,) = (f for f in screen(dead).findings if f.key == "imu.dead_axis")
        name = {"accel": "accelerometer", "gyro": "gyro"}[sensor]
        assert finding.sentence.startswith(f"{name} {'xyz'[axis]} ")
        with refused("imu.dead_axis", RecordingError, name):
            run(dead)


def test_a_dead_axis_on_a_foot_is_refused(shared_data: Path) -> None:
    walk = load(str(shared_data / "openshoe_loops" / "run02.toml"))
    R_bs, half = walk.imu.R_bs, len(walk.imu.t) // 2

    def from_row(first: int) -> Recording:
        return change(walk, "imu", gyro=lambda x: put((slice(first, None), 1), 0.01)(x @ R_bs) @ R_bs.T)

    assert found(from_row(0)) == {"imu.dead_axis": "refused"}
    late = from_row(half)
    assert found(late) == {"imu.dead_axis": "refused"}
    assert found(late.crop(0.0, 0.45 * walk.duration)) == {}  # which the sentence proposes


@pytest.mark.parametrize("sensor", ["accel", "gyro"])
def test_a_dead_sensor_is_refused(tokyo: Recording, sensor: str) -> None:
    def still(x: np.ndarray) -> np.ndarray:
        return np.tile([0.0, 0.0, 9.8] if sensor == "accel" else np.zeros(3), (len(x), 1))

    assert found(change(tokyo, "imu", **{sensor: still}))["imu.dead_axis"] == "refused"
    stands = replace(tokyo.crop(26.0, 48.0), odometer=None, gnss=None)  # where a coarse one may read nothing
    assert "imu.dead_axis" not in found(change(stands, "imu", **{sensor: still}))


def test_an_axis_that_rests_with_the_others_is_not_dead(tokyo: Recording) -> None:
    coarse = change(tokyo, "imu", gyro=lambda x: np.round(x / 0.02) * 0.02)  # it then stands still for half a minute
    still = np.diff(coarse.imu.gyro[:, 0]) == 0.0
    assert still[1200:2500].all()
    assert "imu.dead_axis" not in found(coarse)


def test_an_axis_of_a_simulation_without_noise_may_be_constant(tokyo: Recording) -> None:
    t = tokyo.imu.t[:, None]
    smooth = replace(tokyo, odometer=None, gnss=None)
    smooth = change(
        smooth,
        "imu",
        accel=lambda x: np.sin(0.3 * t) * [0.5, 1.0, 0.0] + [0.0, 0.0, 9.8],
        gyro=lambda x: np.sin(0.2 * t) * [0.0, 0.0, 0.1],
    )
    assert found(smooth) == {}


SCALES = [
    (1.0 / 0.3048, "ft/s2"),
    (1.0 / 9.80665, "g"),
    (1e3 / 9.80665, "mg"),
    (9.80665, "leave out units.accel"),
    (0.5, "2 times too small"),
    (0.25, "4 times too small"),
    (2.0, "2 times too large"),
    (1.53, "scale"),
]


@pytest.mark.parametrize(("factor", "named"), SCALES)
def test_a_force_at_rest_that_is_not_gravity_is_refused(tokyo: Recording, factor: float, named: str) -> None:
    scaled = change(tokyo, "imu", accel=lambda x: factor * x)
    assert found(scaled)["imu.force_scale"] == "refused"
    with refused("imu.force_scale", RecordingError, named):
        screen_recording(scaled)


@pytest.mark.parametrize("factor", [0.9, 0.96, 1.04, 1.1])
def test_a_force_that_is_some_per_cent_off_is_not(tokyo: Recording, factor: float) -> None:
    assert found(change(tokyo, "imu", accel=lambda x: factor * x)) == {}


def test_feet_per_second_squared_are_read(tmp_path: Path, tokyo: Recording) -> None:
    rows = np.column_stack([tokyo.imu.t, tokyo.imu.gyro, tokyo.imu.accel / 0.3048])
    np.savetxt(tmp_path / "imu.csv", rows, delimiter=",", header="t,gx,gy,gz,ax,ay,az", comments="")
    (tmp_path / "recording.toml").write_text(
        'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.csv"\naxes = "RFU"\n'
        'units = { accel = "ft/s2" }\n'
    )
    np.testing.assert_allclose(read(tmp_path).imu.accel, tokyo.imu.accel, rtol=1e-9)


@pytest.mark.parametrize("without", [None, "gnss"])
def test_a_reversed_forward_axis_is_refused(tokyo: Recording, without: str | None) -> None:
    recording = tokyo if without is None else tokyo.without(without)  # the odometer knows it, too
    one = change(recording, "imu", accel=lambda x: x * [1.0, -1.0, 1.0])
    assert found(one) == {"imu.forward_reversed": "refused"}
    both = change(
        recording, "imu", accel=lambda x: x * [-1.0, -1.0, 1.0], gyro=lambda x: x * [-1.0, -1.0, 1.0]
    )  # fmt: skip
    assert found(both) == {"imu.axes_turned": "refused"}
    with refused("imu.axes_turned", RecordingError, '"LBU"'):
        screen_recording(both)


# ---- GNSS


@pytest.mark.parametrize("rows", [[0], [100], [648], [0, 1, 2], [5, 200, 201, 500]])
def test_fixes_out_of_reach_are_left_out(tokyo: Recording, rows: list[int]) -> None:
    def away(llh: np.ndarray) -> np.ndarray:
        llh[rows, 1] -= 1.6
        return llh

    far = change(tokyo, "gnss", llh=away)
    assert found(far) == {"gnss.out_of_reach": "warning"}
    gnss = screen(far).recording.gnss
    assert np.array_equal(gnss.t, np.delete(tokyo.gnss.t, rows))
    assert np.array_equal(gnss.llh, np.delete(tokyo.gnss.llh, rows, axis=0))


def test_reach_grows_with_the_time_between_fixes() -> None:
    t = np.array([0.0, 1.0, 2.0, 3.0, 60.0, 61.0, 62.0])
    p = np.zeros((7, 3))
    p[4:, 0] = 3000.0  # after a minute's outage: 53 m/s
    assert not find_out_of_reach(t, p).any()
    p[2, 1] = 3000.0  # within a second
    assert np.flatnonzero(find_out_of_reach(t, p)).tolist() == [2]


@pytest.mark.parametrize("sigma", [100.0, 200.0, 300.0])
def test_noise_is_no_fix_out_of_reach(sigma: float) -> None:
    """However far it scatters; and what lies beyond it still is."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        t = 0.2 * np.arange(660)
        p = np.outer(t, [10.0, 5.0, 0.0]) + rng.normal(0.0, sigma, (660, 3))
        assert not find_out_of_reach(t, p).any()
        wrong = rng.choice(np.arange(5, 655), 60, replace=False)
        p[wrong] += 1e5
        assert np.array_equal(np.flatnonzero(find_out_of_reach(t, p)), np.sort(wrong))


def test_fixes_of_two_places_are_not_trusted(tokyo: Recording) -> None:
    def thirds(llh: np.ndarray) -> np.ndarray:
        llh[:200, 1] -= 1.0
        llh[200:400, 1] += 1.0
        return llh

    assert found(change(tokyo, "gnss", llh=thirds)) == {"gnss.out_of_reach": "unreliable"}


@pytest.mark.parametrize("value", [None, 0.0])
def test_frozen_heights_have_no_weight(tokyo: Recording, value: float | None) -> None:
    rows = slice(150, 600)

    def freeze(llh: np.ndarray) -> np.ndarray:
        llh[rows, 2] = llh[150, 2] if value is None else value
        return llh

    frozen = change(tokyo, "gnss", llh=freeze)
    assert found(frozen) == {"gnss.height_frozen": "warning"}
    sd = screen(frozen).recording.gnss.sd
    assert (sd[rows, 2] > 20.0).all()
    assert np.array_equal(np.delete(sd, range(150, 600), axis=0), np.delete(tokyo.gnss.sd, range(150, 600), axis=0))
    assert np.array_equal(sd[:, :2], tokyo.gnss.sd[:, :2])


def test_heights_that_stay_while_standing_are_not_frozen(oracle: Recording, shared_data: Path) -> None:
    standing = load(str(shared_data / "oracle_drive")).crop(0.0, 80.0)
    assert found(change(standing, "gnss", llh=put((slice(None), 2), 30.0))) == {}
    assert found(change(oracle, "gnss", llh=put((slice(None), 2), 30.0))) == {"gnss.height_frozen": "warning"}


@pytest.mark.parametrize("seconds", [1.0, -1.0])
def test_fixes_of_another_clock_make_the_result_unreliable(tokyo: Recording, oracle: Recording, seconds: float) -> None:
    for recording, within in ((tokyo, 0.08), (oracle, 0.12)):
        late = change(recording, "gnss", t=lambda t: t + seconds)
        assert found(late) == {"imu.clock": "unreliable"}
        inspection = inspect(late)
        assert not inspection.trusted
        assert inspection.findings[0].key == "imu.clock"
        # IMU and odometer agree: it is the receiver's clock that has to be mended, by what it is off
        sentence = inspection.findings[0].sentence
        assert "in [gnss]" in sentence
        mend = float(sentence.split(": add ")[1].split(" to ")[0])
        assert mend == pytest.approx(-seconds, abs=within)
        alone = screen(replace(late, odometer=None)).findings[0].sentence
        assert "in [imu]" in alone
    assert inspect(tokyo).trusted


def test_sigmas_that_cannot_be_are_said_and_left(tokyo: Recording) -> None:
    for factor, key in ((1e-3, "gnss.sigma_small"), (100.0, "gnss.sigma_large")):
        changed = change(tokyo, "gnss", sd=lambda x, factor=factor: factor * x)
        assert found(changed) == {key: "warning"}
        assert np.array_equal(screen(changed).recording.gnss.sd, changed.gnss.sd)


def test_a_small_sigma_is_denied_by_the_scatter(shared_data: Path) -> None:
    single = load(str(shared_data / "tokyo_20201105" / "recording_spp.toml")).crop(0.0, 600.0)
    small = change(single, "gnss", sd=lambda x: 1e-3 * x)  # 3 mm, which a carrier's phase would allow
    assert "gnss.sigma_small" in found(small)
    fixed = replace(single, gnss=replace(single.gnss, type=np.ones(len(single.gnss.t), dtype=np.intp)))
    assert "gnss.sigma_large" in found(fixed)  # a fixed solution of 3 m


def table(tmp_path: Path, *sd: float) -> Table:
    columns = {name: np.array(sd) for name in ("sd_e", "sd_n", "sd_u")}
    file = tmp_path / "gnss.csv"
    file.write_text("sd_e,sd_n,sd_u\n" + "".join(f"{x},{x},{x}\n" for x in sd))
    return Table(file, columns, {k: k for k in columns}, np.arange(len(sd)))


@pytest.mark.parametrize(
    ("sd", "floor"),
    [
        ((0.00, 0.01, 0.12), 0.005),  # half of the last digit printed
        ((0.0, 0.1, 1.5), 0.05),
        ((0.0, 0.0123456789, 0.5), 0.0123456789),  # not rounded: the smallest there is
    ],
)
def test_a_sigma_printed_as_zero_is_floored_and_said(tmp_path: Path, sd: tuple[float, ...], floor: float) -> None:
    rows, remarks = table(tmp_path, *sd), Notes()
    every = np.ones(len(sd), dtype=bool)
    got = choose_sigmas(rows, ("sd_e", "sd_n", "sd_u"), None, (1.0, 1.0, 1.0), "GNSS position", every, remarks)
    np.testing.assert_allclose(got[0], floor)
    np.testing.assert_array_equal(got[1:, 0], sd[1:])
    assert len(remarks) == 3


@pytest.mark.parametrize("sd", [(0.0, 0.0), (0.1, -0.1)])
def test_sigmas_that_are_all_zero_or_below_it_are_refused(tmp_path: Path, sd: tuple[float, ...]) -> None:
    every = np.ones(len(sd), dtype=bool)
    with refused("table.sigma", RecordingError):
        choose_sigmas(
            table(tmp_path, *sd), ("sd_e", "sd_n", "sd_u"), None, (1.0, 1.0, 1.0), "GNSS position", every, Notes()
        )


@pytest.mark.parametrize("value", [0.0, 7.0])
def test_velocities_that_were_not_logged_are_not_used(tokyo: Recording, value: float) -> None:
    same = change(tokyo, "gnss", v=lambda v: np.full_like(v, value))
    assert found(same)["gnss.velocity_constant"] == "warning"
    assert screen(same).recording.gnss.v is None
    stands = change(tokyo.crop(26.0, 48.0), "gnss", v=np.zeros_like)
    assert "gnss.velocity_constant" not in found(stands)


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_an_odometer_that_never_changes_is_not_used(tokyo: Recording, value: float) -> None:
    same = change(tokyo, "odometer", speed=lambda x: np.full_like(x, value))
    assert found(same)["odometer.constant"] == "warning"
    assert screen(same).recording.odometer is None
    assert "odometer.constant" not in found(change(tokyo.crop(30.0, 48.0), "odometer", speed=np.zeros_like))


def test_a_place_that_is_held_is_no_group(tokyo: Recording) -> None:
    """Ten seconds of one place while the car drives, and then the stop."""
    drive = tokyo.crop(0.0, 60.0)

    def hold(llh: np.ndarray) -> np.ndarray:
        llh[50:100] = llh[50]
        return llh

    assert "gnss.two_groups" not in found(change(drive, "gnss", llh=hold))


@pytest.mark.parametrize("which", ["mixed", "block"])
@pytest.mark.parametrize("velocities", [True, False])
def test_fixes_of_two_groups_are_not_trusted(tokyo: Recording, oracle: Recording, which: str, velocities: bool) -> None:
    for recording in (tokyo, oracle):
        n = len(recording.gnss.t)
        off = np.random.default_rng(3).random(n) < 0.48 if which == "mixed" else np.arange(n) < 0.48 * n

        def north(llh: np.ndarray, off: np.ndarray = off) -> np.ndarray:
            llh[off, 0] += 50.0 * METRE
            return llh

        changed = change(recording, "gnss", llh=north)
        if not velocities:
            changed = replace(changed, gnss=replace(changed.gnss, v=None, sd_v=None))
        assert found(changed)["gnss.two_groups"] == "unreliable"


def test_some_fixes_that_are_off_are_outvoted(tokyo: Recording) -> None:
    few = np.random.default_rng(4).random(len(tokyo.gnss.t)) < 0.1

    def north(llh: np.ndarray) -> np.ndarray:
        llh[few, 0] += 50.0 * METRE
        return llh

    assert found(change(tokyo, "gnss", llh=north)) == {}


@pytest.mark.parametrize("queued", [True, False])
def test_stamps_of_the_arrival_are_told(tokyo: Recording, oracle: Recording, queued: bool) -> None:
    for recording in (tokyo, oracle):
        gnss = recording.gnss
        t = gnss.t + np.random.default_rng(5).uniform(0.0, 0.6, len(gnss.t))
        order = np.arange(len(t)) if queued else np.argsort(t)
        t = np.maximum.accumulate(t) + 1e-4 * np.arange(len(t)) if queued else t[order]
        v, sd_v = (None, None) if gnss.v is None else (gnss.v[order], gnss.sd_v[order])
        late = replace(recording, gnss=replace(gnss, t=t, llh=gnss.llh[order], v=v, sd_v=sd_v))
        assert found(late) == {"gnss.stamped_on_arrival": "warning"}


def test_fixes_that_are_taken_at_uneven_times_are_not(oracle: Recording) -> None:
    # the same jitter, with positions that are where the vehicle was then
    gnss = oracle.gnss
    t = gnss.t + np.random.default_rng(5).uniform(0.0, 0.6, len(gnss.t))
    t = t[t < gnss.t[-1]]
    llh = np.stack([np.interp(t, gnss.t, x) for x in gnss.llh.T], -1)
    assert found(replace(oracle, gnss=replace(gnss, t=t, llh=llh, sd=gnss.sd[: len(t)]))) == {}


# ---- odometer


@pytest.mark.parametrize("value", [1e300, -500.0, np.inf, np.nan])
def test_a_reading_beyond_any_speed_is_left_out(tokyo: Recording, value: float) -> None:
    wild = change(tokyo, "odometer", speed=put(2000, value))
    assert found(wild) == {"odometer.beyond": "warning"}
    left = screen(wild).recording.odometer
    assert np.array_equal(left.t, np.delete(tokyo.odometer.t, 2000))


def test_an_odometer_of_nothing_but_nonsense_is_left_out(tokyo: Recording) -> None:
    assert screen(change(tokyo, "odometer", speed=lambda v: v + 1e6)).recording.odometer is None


@pytest.mark.parametrize("after", [True, False])
def test_a_jump_of_the_odometers_clock_is_found(tokyo: Recording, oracle: Recording, after: bool) -> None:
    for recording, at in ((tokyo, 65.0), (oracle, 80.0)):
        middle = recording.start + at

        def jump(t: np.ndarray, middle: float = middle) -> np.ndarray:
            return t + 18.0 * (t > middle) if after else t - 18.0 * (t <= middle)

        jumped = change(recording, "odometer", t=jump)
        assert found(jumped) == {"odometer.clock_jump": "warning"}
        left = screen(jumped).recording.odometer.t
        right = recording.odometer.t[(recording.odometer.t <= middle) == after]
        assert np.array_equal(left, right)


def test_readings_that_are_missing_are_no_jump(tokyo: Recording) -> None:
    assert found(tokyo.without("odometer", (60.0, 78.0))) == {}


@pytest.mark.parametrize("hertz", [1, 5])
def test_fixes_of_a_clock_that_is_set_back_by_a_second_are_refused(
    tmp_path: Path, tokyo: Recording, hertz: int
) -> None:
    """As where a receiver learns of a leap second: of one that moves, whose stamps alone are back."""
    folder = copy_with_stamps(tmp_path, tokyo, "gnss", lambda t: t)
    text = (folder / "gnss.csv").read_text().splitlines()
    own = [row for row in text[1:] if abs(float(row.split(",")[0]) * hertz % 1.0 - 0.5) > 0.45]
    t = np.array([float(row.split(",")[0]) for row in own])
    moving = (
        np.flatnonzero(np.linalg.norm(np.nan_to_num(tokyo.gnss.v), axis=1) > 8.0) if tokyo.gnss.v is not None else []
    )
    middle = tokyo.gnss.t[moving[len(moving) // 2]]

    def write(stamps: np.ndarray, order: np.ndarray | None = None) -> None:
        rows = [f"{x:.6f},{row.split(',', 1)[1]}" for x, row in zip(stamps, own, strict=True)]
        rows = rows if order is None else [rows[k] for k in order]
        (folder / "gnss.csv").write_text("\n".join([text[0], *rows]) + "\n")

    write(t)
    assert len(read(folder).gnss.t) == len(own)
    write(t - 1.0 * (t > middle))
    with refused("table.clock_back", RecordingError, "gnss.csv", "1.00 s"):
        read(folder)
    k = int(np.searchsorted(t, middle))
    write(t, np.r_[0 : k - 3, k : k + 3, k - 3 : k, k + 3 : len(t)])  # written late
    assert len(read(folder).gnss.t) == len(own)


@pytest.mark.parametrize("wrong", [lambda t: 1000.0 * t, lambda t: 0.0 * t])
def test_a_single_stamp_in_another_unit_is_taken_to_be_between_its_neighbours(
    tmp_path: Path, tokyo: Recording, wrong: Callable[[np.ndarray], np.ndarray]
) -> None:
    t = tokyo.imu.t
    k = len(t) // 2

    def change(stamps: np.ndarray) -> np.ndarray:
        return np.where(np.arange(len(t)) == k, wrong(stamps), stamps)

    found = read(copy_with_stamps(tmp_path, tokyo, "imu", change))
    assert len(found.imu.t) == len(t)
    np.testing.assert_allclose(found.imu.t[k], 0.5 * (t[k - 1] + t[k + 1]), atol=1e-5)
    np.testing.assert_allclose(found.imu.gyro[k], tokyo.imu.gyro[k], atol=1e-6)


def test_stamps_in_days_of_a_spreadsheet_are_told(tmp_path: Path, tokyo: Recording) -> None:
    with refused("table.days", RecordingError, "imu.csv", "1899-12-30"):
        read(copy_with_stamps(tmp_path, tokyo, "imu", lambda t: 46000.5 + t / 86400.0))
    with refused("table.days", RecordingError, "gnss.csv", 't = "d"'):
        read(copy_with_stamps(tmp_path, tokyo, "gnss", lambda t: 46000.5 + t / 86400.0))
    seconds_of_a_day = read(copy_with_stamps(tmp_path, tokyo, "imu", lambda t: 46000.5 + t))
    assert len(seconds_of_a_day.imu.t) == len(tokyo.imu.t)


def copy_with_stamps(
    folder: Path, recording: Recording, sensor: str, change: Callable[[np.ndarray], np.ndarray]
) -> Path:
    """A folder with the IMU and the fixes, stamps of one of them changed."""
    (folder / "recording.toml").write_text(
        'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.csv"\naxes = "RFU"\n'
        '[gnss]\nfile = "gnss.csv"\n'
    )
    imu, gnss = recording.imu, recording.gnss
    deg = np.degrees(gnss.llh[:, :2])
    tables = {
        "imu": (imu.t, np.column_stack([imu.gyro, imu.accel]), "t,gx,gy,gz,ax,ay,az"),
        "gnss": (gnss.t, np.column_stack([deg, gnss.llh[:, 2], gnss.sd]), "t,lat,lon,h,sd_e,sd_n,sd_u"),
    }
    for name, (t, values, head) in tables.items():
        table = np.column_stack([change(t) if name == sensor else t, values])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=head, comments="", fmt="%.11f")
    return folder


def test_a_clock_that_is_set_back_is_refused(tmp_path: Path, tokyo: Recording) -> None:
    t, v = tokyo.odometer.t, tokyo.odometer.speed
    rest = (
        'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.csv"\naxes = "RFU"\n'
        '[odometer]\nfile = "o.csv"\n'
    )
    (tmp_path / "recording.toml").write_text(rest)
    rows = np.column_stack([tokyo.imu.t, tokyo.imu.gyro, tokyo.imu.accel])
    np.savetxt(tmp_path / "imu.csv", rows, delimiter=",", header="t,gx,gy,gz,ax,ay,az", comments="")

    def write(t: np.ndarray, v: np.ndarray) -> None:
        np.savetxt(tmp_path / "o.csv", np.column_stack([t, v]), delimiter=",", header="t,speed", comments="")

    write(t - 18.0 * (t > t[3000]), v)
    with refused("table.clock_back", RecordingError, "o.csv", "18.0"):
        read(tmp_path)
    # twenty rows, of 0.4 s
    write(t - (t[20] - t[0]) * (t > t[3000]), v)
    with refused("table.clock_back", RecordingError, "o.csv"):
        read(tmp_path)
    # the same rows sent again are dropped
    order = np.r_[0:3000, 2960 : len(t)]
    write(t[order], v[order])
    assert len(read(tmp_path).odometer.t) == len(t)
    # a block that was written late is sorted: no time is there twice
    order = np.r_[0:2000, 2500:3000, 2000:2500, 3000 : len(t)]
    write(t[order], v[order])
    assert np.array_equal(read(tmp_path).odometer.t, np.sort(read(tmp_path).odometer.t))
    assert len(read(tmp_path).odometer.t) == len(t)


def test_a_span_of_another_scale_is_left_out(shared_data: Path) -> None:
    for name in ("tokyo_20201105", "oracle_drive"):
        recording = load(str(shared_data / name)).crop(60.0, 460.0)
        t = recording.odometer.t - recording.start
        double = (t > 100.0) & (t < 220.0)
        changed = change(recording, "odometer", speed=lambda v, double=double: np.where(double, 2.0 * v, v))
        assert found(changed) == {"odometer.other_scale": "warning"}
        left = np.isin(recording.odometer.t, screen(changed).recording.odometer.t)
        moving = recording.odometer.speed > 5.0
        assert left[double & moving].mean() < 0.1
        assert left[~double].mean() > 0.9


def test_another_scale_throughout_is_not_a_span(tokyo: Recording) -> None:
    # what it is in is said by the check of its unit, and nothing is left out
    assert found(change(tokyo, "odometer", speed=lambda v: 3.6 * v)) == {}


# ---- what callers get


def test_findings_have_keys_and_the_gravest_are_first(tokyo: Recording) -> None:
    wild = change(change(tokyo, "imu", accel=put((3000, 0), 1e4)), "gnss", t=lambda t: t + 1.0)
    wild = change(wild, "imu", gyro=put((slice(None), 0), 0.0))
    values = inspect(wild).to_dict()["findings"]
    assert values[0]["key"] == "imu.dead_axis"
    assert values[0]["severity"] == "refused"
    ranks = [("refused", "unreliable", "warning", "note").index(one["severity"]) for one in values]
    assert ranks == sorted(ranks)
    with pytest.raises(RecordingError):
        inspect(wild).refuse()
