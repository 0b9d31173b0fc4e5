"""The checks find what was broken in a real drive, and nothing in one that is as its README says."""

from __future__ import annotations

import functools
import itertools
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest

from graphnav import run
from graphnav.app import cli
from graphnav.estimation.antenna import find_untold_arm, find_wrong_arms, find_wrong_axes
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Recording, take_rows
from graphnav.recording.checks.crosschecks import fit_yaw_rate
from graphnav.recording.checks.overview import Inspection, inspect
from graphnav.recording.checks.tracks import compute_track
from graphnav.recording.formats import read
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.recording.plausibility.screening import screen
from graphnav.simulation import simulate

TURNS_LITTLE = (100.0, 160.0)  # s of oracle_drive: it stands, and turns once
TURNING = ["boulder_drive_20250708", "tokyo_20201105", "dresden_car_20140326", "oracle_drive", "kitti"]
Change = Callable[[Recording], Recording]


@functools.cache
def load(source: str) -> Recording:
    """A recording, read once for all tests; it is frozen."""
    return read(source)


@pytest.fixture
def drive(shared_data: Path) -> Callable[[str], Recording]:
    """Recordings by name: a folder of the shared data, or kitti."""
    return lambda name: load(name if name == "kitti" else str(shared_data / name))


@pytest.fixture
def part(drive: Callable[[str], Recording]) -> Callable[[str], Recording]:
    """The first ten minutes of each: enough for what is wrong all along."""
    return lambda name: drive(name).crop(0.0, 600.0)


def warned(recording: Recording, key: str, hint: str = "") -> list[str]:
    """The warnings of a key, or one of several, that hold a number, or what to write, as a pattern."""
    found = [f for f in inspect(recording).findings if f.severity != "note" and f.key in key.split()]
    return [f.sentence for f in found if re.search(hint, f.sentence)]


def imu(**changes: Callable[..., np.ndarray]) -> Change:
    """Change arrays of the IMU."""
    return lambda r: replace(r, imu=replace(r.imu, **{k: f(getattr(r.imu, k)) for k, f in changes.items()}))


def odometer(**changes: Callable[..., np.ndarray]) -> Change:
    """Change arrays of the odometer."""
    return lambda r: replace(
        r, odometer=replace(r.odometer, **{k: f(getattr(r.odometer, k)) for k, f in changes.items()})
    )


def declared(axes: str) -> Change:
    """The same file, with other axes stated."""
    R = parse_axes_letters(axes)

    def change(r: Recording) -> Recording:
        turn = R @ r.imu.R_bs.T
        return replace(r, imu=replace(r.imu, gyro=r.imu.gyro @ turn.T, accel=r.imu.accel @ turn.T, R_bs=R))

    return change


# ---- what is as it should be


def test_gaps_that_are_counted_are_those_that_are_filled(drive: Callable[[str], Recording]) -> None:
    """A row of the IMU lost here and there, and a stretch of them."""
    whole = drive("oracle_drive").crop(0.0, 60.0)
    keep = np.ones(len(whole.imu.t), dtype=bool)
    keep[[500, 2000, *range(4000, 4010)]] = False
    cut = replace(whole, imu=take_rows(whole.imu, keep))
    assert inspect(cut).facts["imu"]["gaps"] == len(bridge_gaps(cut.imu).bridged) == 3


@pytest.mark.parametrize(
    "name",
    [
        "boulder_drive_20250708",
        "comma_highway_20180802",
        "dresden_car_20140326",
        "oracle_drive",
        "tokyo_20201105",
        "kitti",
    ],
)
def test_no_false_alarm_on_a_drive(drive: Callable[[str], Recording], name: str) -> None:
    found = {f.key for f in inspect(drive(name)).findings if f.severity != "note"}
    assert found == ({"imu.filled"} if name == "kitti" else set())  # eight stretches of straight lines


def test_no_false_alarm_on_a_walk(shared_data: Path) -> None:
    walks = [
        f
        for folder in ("gcp_walks", "openshoe_loops", "pyshoe_vicon", "xio_loops")
        for f in (shared_data / folder).glob("*.toml")
    ]
    assert len(walks) == 22
    for walk in walks:
        assert inspect(read(walk)).warnings == (), walk


def test_single_point_fixes_are_said_to_jump_and_nothing_else(drive: Callable[[str], Recording]) -> None:
    # real multipath to tens of metres, as the README of the drive says
    found = [f.key for f in inspect(drive("tokyo_20201105/recording_spp.toml")).findings if f.severity != "note"]
    assert found == ["gnss.jump"]


def test_facts_agree_with_what_was_measured_of_the_drives(drive: Callable[[str], Recording]) -> None:
    boulder = inspect(drive("boulder_drive_20250708"))
    assert boulder.facts["gnss"]["distance_m"] == pytest.approx(4050, rel=0.01)
    assert boulder.facts["gnss"]["max_speed_mps"] == pytest.approx(16.3, abs=0.1)
    assert boulder.facts["gnss"]["stops"] == 4
    assert boulder.facts["imu"]["force_at_rest_mps2"] == pytest.approx(9.930, abs=0.01)
    assert any(f.key == "imu.repeats" and "1138" in f.sentence for f in boulder.findings)
    assert any(re.search(r"9\.797 \(\+1\.3 %\)", f.sentence) for f in boulder.findings)
    tokyo = inspect(drive("tokyo_20201105"))
    assert tokyo.facts["imu"]["force_at_rest_mps2"] == pytest.approx(9.60, abs=0.01)
    assert tokyo.facts["odometer"]["true_over_recorded"] == pytest.approx(1.0025, abs=0.001)  # its README's median
    assert abs(tokyo.facts["odometer"]["late_by_s"]) < 0.03  # the description applies the 0.65 s
    comma = inspect(drive("comma_highway_20180802"))
    assert comma.facts["odometer"]["true_over_recorded"] == pytest.approx(1.0088, abs=0.001)
    assert comma.facts["gnss"]["stops"] == 0
    assert "still_s" not in comma.facts["imu"]


# ---- what is broken is found


def test_a_known_clock_error_is_found_when_it_is_not_corrected(drive: Callable[[str], Recording]) -> None:
    # the README of boulder: late by 0.10 +- 0.02 s; its description corrects it
    (warning,) = warned(imu(t=lambda t: t + 0.10)(drive("boulder_drive_20250708")), "imu.clock")
    assert 0.08 <= float(re.search(r"by ([0-9.]+) s", warning)[1]) <= 0.12


@pytest.mark.parametrize(
    ("name", "shift"),
    [("boulder_drive_20250708", 18.0), ("tokyo_20201105", -18.0), ("oracle_drive", 18.0), ("kitti", -18.0)],
)
def test_leap_seconds_are_found(part: Callable[[str], Recording], name: str, shift: float) -> None:
    (warning,) = warned(imu(t=lambda t: t + shift)(part(name)), "imu.clock")
    assert ("late" if shift > 0 else "early") in warning
    assert float(re.search(r"add ([-+0-9.]+) to", warning)[1]) == pytest.approx(-shift, abs=0.1)


@pytest.mark.parametrize(
    ("name", "axes"),
    [
        *(("boulder_drive_20250708", axes) for axes in ("RFU", "FLU", "BRU", "FRD", "LBU")),
        *itertools.product(("tokyo_20201105", "dresden_car_20140326", "oracle_drive", "kitti"), ("RFU", "FLU")),
    ],
)
def test_wrong_axes_are_found_and_the_right_ones_named(part: Callable[[str], Recording], name: str, axes: str) -> None:
    recording = part(name)
    found = warned(declared(axes)(recording), "imu.axes imu.axes_turned")
    right = np.array_equal(parse_axes_letters(axes), recording.imu.R_bs)
    assert len(found) == (0 if right else 1)
    if found:
        named = re.search(r'axes = "([A-Z]{3})" would agree', found[0])[1]
        assert np.array_equal(parse_axes_letters(named), recording.imu.R_bs)


DEG = np.degrees(1.0)
BROKEN: dict[str, tuple[Change, str, str]] = {
    "gyro in deg/s": (imu(gyro=lambda x: x * DEG), "imu.gyro_unit", r'gyro = "deg/s"'),
    "gyro taken as deg/s": (imu(gyro=lambda x: x / DEG), "imu.gyro_unit", r"leave out units\.gyro"),
    "gyro scale": (imu(gyro=lambda x: x / 1.3), "imu.gyro_scale", r" 1\.[23]\d times"),
    "accelerometer in g": (imu(accel=lambda x: x / 9.80665), "imu.force_scale", r'accel = "g"'),
    "accelerometer taken as g": (imu(accel=lambda x: x * 9.80665), "imu.force_scale", r"leave out units\.accel"),
    "gravity removed": (imu(accel=lambda x: x - [0, 0, 9.8]), "imu.force_scale", ""),
    "constant gravity removed": (imu(accel=lambda x: x - [0.9, 0.4, 9.6]), "imu.force_scale", ""),
    "gyro reversed": (imu(gyro=lambda x: -x), "imu.gyro_sign", ""),
    "accelerometer reversed": (imu(accel=lambda x: -x), "imu.force_sign", ""),
    "no overlap": (imu(t=lambda t: t + 1e6), "gnss.clock", "time_offset"),
    "gyro of a swing clipped": (
        imu(gyro=lambda x: np.clip(x + 2.0 * np.sin(np.arange(len(x)) / 8.0)[:, None] * [0, 1, 0], -1.5, 1.5)),
        "imu.saturated",
        "gyro y ",
    ),
    "gyro clipped": (imu(gyro=lambda x: np.clip(x, -0.5, 0.5)), "imu.saturated", "gyro z "),
    "stuck": (
        imu(gyro=lambda x: _stick(x), accel=lambda x: _stick(x)),
        "imu.filled",
        r" of 2\.9. s, at 40",
    ),
    "gap": (lambda r: r.without("odometer") and _gap(r), "imu.gap", r" of (3|2\.9\d) s at 50\.\d s"),
}


def _stick(x: np.ndarray) -> np.ndarray:
    x = x.copy()
    x[2000:2150] = x[2000]  # 3 s at 50 Hz
    return x


def _gap(r: Recording) -> Recording:
    away = (r.imu.t > r.imu.t[0] + 50) & (r.imu.t < r.imu.t[0] + 53)
    keep = ~away
    return replace(r, imu=replace(r.imu, t=r.imu.t[keep], gyro=r.imu.gyro[keep], accel=r.imu.accel[keep]))


@pytest.mark.parametrize("case", BROKEN, ids=lambda name: name.replace(" ", "-"))
def test_a_broken_imu_is_found(drive: Callable[[str], Recording], case: str) -> None:
    change, key, hint = BROKEN[case]
    # ten minutes in motion of a drive that gets no warning at all: test_no_false_alarm_on_a_drive
    assert len(warned(change(drive("tokyo_20201105").crop(900.0, 1500.0)), key, hint)) >= 1


@pytest.mark.parametrize(("name", "sure"), [("dresden_car_20140326", True), ("oracle_drive/recording_spp.toml", False)])
@pytest.mark.parametrize("factor", [DEG, 1.0 / DEG])
def test_a_unit_of_the_gyro_is_refused_where_the_courses_determine_it(
    drive: Callable[[str], Recording], name: str, sure: bool, factor: float
) -> None:
    """Single-point fixes show the turns to a factor of two and no better."""
    recording = drive(name)
    assert not {f.key for f in screen(recording).findings} & {"imu.gyro_unit"}
    found = screen(imu(gyro=lambda x: x * factor)(recording)).findings
    assert [f.severity for f in found if f.key == "imu.gyro_unit"] == ["refused"] * sure


@pytest.mark.parametrize("name", ["openshoe_loops/run02.toml", "pyshoe_vicon/2017-11-22-11-23-25.toml"])
def test_a_walk_is_not_solved_as_a_drive_without_a_word(drive: Callable[[str], Recording], name: str) -> None:
    recording = drive(name)
    assert not warned(recording, "recording.platform")
    assert len(warned(replace(recording, platform="vehicle"), "recording.platform")) == 1


def test_milliseconds_that_count_from_the_start_of_the_imu_are_found(part: Callable[[str], Recording]) -> None:
    """The first fix, at 0 ms, lies within the IMU's time."""
    recording = part("dresden_car_20140326")
    zero = replace(recording.gnss, t=recording.gnss.t - recording.gnss.t[0] + recording.start)
    assert not warned(replace(recording, gnss=zero), "gnss.clock")
    wrong = replace(recording, gnss=replace(zero, t=1e3 * zero.t))
    assert len(warned(wrong, "gnss.clock", r'units = \{ t = "ms" \}')) == 1


ODD = [
    (3.6, "odometer.unit", 'speed = "km/h"'),
    (1 / 0.44704, "odometer.unit", 'speed = "mph"'),
    (3600 / 1852, "odometer.unit", 'speed = "knots"'),
    (1 / 3.6, "odometer.unit", "m/s already"),
    (-1.0, "odometer.sign", ""),
    (1.15, "odometer.scale", r"0\.8\d+ times .* scale_sigma = 0\.02"),
]


@pytest.mark.parametrize(
    ("name", "factor", "key", "hint"),
    [
        *(("comma_highway_20180802", *one) for one in ODD),
        *((name, *one) for name in ("tokyo_20201105", "oracle_drive") for one in (ODD[0], ODD[-1])),
    ],
)
def test_an_odometer_in_another_unit_is_found(
    drive: Callable[[str], Recording], name: str, factor: float, key: str, hint: str
) -> None:
    assert len(warned(odometer(speed=lambda x: x * factor)(drive(name).crop(0.0, 500.0)), key, hint)) == 1


def test_a_late_odometer_is_found(drive: Callable[[str], Recording]) -> None:
    # as recorded, before the description's time_offset of -0.65 s
    (warning,) = warned(odometer(t=lambda t: t + 0.65)(drive("tokyo_20201105")), "odometer.late")
    assert 0.60 <= float(re.search(r"by ([0-9.]+) s", warning)[1]) <= 0.70


@pytest.mark.parametrize("name", ["tokyo_20201105", "kitti", "oracle_drive"])
def test_a_jump_of_30_m_is_found_where_it_is(part: Callable[[str], Recording], name: str) -> None:
    recording = part(name)
    llh = recording.gnss.llh.copy()
    llh[200:203, 0] += 30.0 / 6.37e6
    (warning,) = warned(replace(recording, gnss=replace(recording.gnss, llh=llh)), "gnss.jump")
    at = float(re.search(r"at ([0-9.]+) s", warning)[1])
    t = recording.gnss.t - recording.start
    assert t[199] - 0.05 <= at <= t[204] + 0.05  # it is said to a tenth of a second


def test_understated_noise_is_found(drive: Callable[[str], Recording]) -> None:
    recording = drive("oracle_drive")
    small = replace(recording.imu.noise, gyro_noise_density=1e-7)
    changed = replace(recording, imu=replace(recording.imu, noise=small))
    assert len(warned(changed, "imu.noise_small", "gyro_noise_density = 1e-07")) == 1


def test_a_recording_of_almost_nothing_is_inspected_without_a_word_of_axes(drive: Callable[[str], Recording]) -> None:
    short = drive("tokyo_20201105").crop(0.0, 0.1)
    found = inspect(short)
    assert found.facts["imu"]["rows"] == len(short.imu.t)
    assert not any("axes" in w or "stamps" in w for w in found.warnings)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r.without("gnss"),
        lambda r: r.without("gnss", (1.0, 1e9)),
        lambda r: r.without("odometer", (-1e9, 1e9)),
        lambda r: r.crop(0.0, 0.05),
        lambda r: r.crop(0.0, 20.0),
        lambda r: replace(r, platform="foot"),
        imu(gyro=np.zeros_like, accel=np.zeros_like),
    ],
    ids=["no-gnss", "gnss-start-only", "odometer-without-rows", "3-rows", "20-s", "as-foot", "imu-of-zeros"],
)
@pytest.mark.filterwarnings("error")
def test_parts_of_a_recording_are_inspected_too(part: Callable[[str], Recording], change: Change) -> None:
    some = change(part("tokyo_20201105"))
    assert inspect(some).facts["imu"]["rows"] == len(some.imu.t)


def test_the_text_names_sensors_units_and_findings(drive: Callable[[str], Recording]) -> None:
    inspection = inspect(drive("oracle_drive"))
    text = inspection.format()
    assert isinstance(inspection, Inspection)
    assert f"{inspection.facts['imu']['rate_hz']:.4g} Hz" in text
    assert all(finding.sentence in text for finding in inspection.findings)
    assert "gnss.gap" in {finding.key for finding in inspection.findings}
    assert text.splitlines()[0] == "oracle drive, seed 20240612, rtk (vehicle)"


def keys(recording: Recording) -> list[str]:
    return [f.key for f in inspect(recording).findings]


@pytest.mark.parametrize(
    ("name", "velocities"),
    [
        ("boulder_drive_20250708", True),
        ("tokyo_20201105", False),
        ("comma_highway_20180802", True),
        ("comma_highway_20180802", False),
    ],
)
def test_heights_in_feet_are_seen_where_it_goes_up_and_down(
    part: Callable[[str], Recording], name: str, velocities: bool
) -> None:
    some = part(name)
    some = replace(some, gnss=replace(some.gnss, v=some.gnss.v if velocities else None))
    feet = replace(some, gnss=replace(some.gnss, llh=some.gnss.llh * [1.0, 1.0, 1 / 0.3048]))
    assert "gnss.feet" in keys(feet)
    tenths = replace(some, gnss=replace(some.gnss, llh=some.gnss.llh * [1.0, 1.0, 10.0]))
    assert "gnss.height_scale" in keys(tenths)
    assert not {"gnss.feet", "gnss.height_scale"} & set(keys(some))


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize(
    "wrong", [lambda llh: np.tile(llh[:1], (len(llh), 1)), lambda llh: llh * [1e-7, 1e-7, 1.0]], ids=["frozen", "1e-7"]
)
def test_fixes_that_stay_while_the_wheels_turn_are_told(
    wrong: Callable[[np.ndarray], np.ndarray], velocities: bool
) -> None:
    right = read(Path(__file__).parents[2] / "data" / "tokyo")
    if not velocities:
        right = replace(right, gnss=replace(right.gnss, v=None, sd_v=None))
    still = replace(right, gnss=replace(right.gnss, llh=wrong(right.gnss.llh)), truth=None)
    assert "gnss.frozen" in keys(still)
    assert ("gnss.frozen" in keys(still.without("odometer"))) == velocities  # nothing else tells
    assert "gnss.frozen" not in keys(still.crop(25.0, 50.0))  # where it stands
    assert "gnss.frozen" not in keys(right)


def test_heights_in_feet_are_seen_on_a_drive_with_an_outage(drive: Callable[[str], Recording]) -> None:
    """Across a minute without fixes there is no slope to compare."""
    right = drive("oracle_drive")
    feet = replace(right, gnss=replace(right.gnss, llh=right.gnss.llh * [1.0, 1.0, 1 / 0.3048]))
    assert "gnss.feet" in keys(feet)
    assert "gnss.feet" not in keys(right)


def test_exchanged_places_are_seen_on_a_drive_in_circles(drive: Callable[[str], Recording]) -> None:
    """Where the ways are distorted so much that their turns are those of nothing."""
    right = drive("car_circles_boston_20241021")
    wrong = replace(right, gnss=replace(right.gnss, llh=right.gnss.llh[:, [1, 0, 2]]))
    assert "gnss.lat_lon" in keys(wrong)
    assert "gnss.lat_lon" not in keys(right)


def test_fixes_that_are_late_are_not_mended_at_the_odometer(drive: Callable[[str], Recording]) -> None:
    """Of the three the IMU tells which is off; the advice, followed, leaves nothing to say."""
    some = drive("tokyo_20201105").crop(100.0, 500.0)
    late = replace(some, gnss=replace(some.gnss, t=some.gnss.t + 0.4))
    (said,) = [f.sentence for f in inspect(late).findings if f.key == "odometer.late"]
    (offset,) = map(float, re.findall(r"add (\S+) to time_offset in \[gnss\]", said))
    mended = replace(late, gnss=replace(late.gnss, t=late.gnss.t + offset))
    assert "odometer.late" not in keys(mended)
    assert abs(offset + 0.4) < 0.05


def test_axes_are_denied_only_by_better_ones() -> None:
    """Fifty seconds of fixes with one change of speed tell no direction, and the axes are right."""
    whole = load(str(Path(__file__).parents[2] / "data" / "tokyo"))
    late = whole.without("gnss", (0.0, 80.0))
    assert not any(f.key == "imu.axes" for f in inspect(late).findings)


def test_right_lever_arms_are_not_denied() -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0), seed=5, lever_arm=(0.4, -0.5, 1.2))
    assert find_wrong_arms(recording) == []


@pytest.mark.parametrize(
    ("arm", "sd", "told"),
    [((0.4, -0.5, 1.2), 2.0, True), ((0.4, -0.5, 1.2), 0.02, False), ((0.0, 0.0, 0.0), 2.0, False)],
)
def test_an_arm_that_no_fix_can_check_is_said(arm: tuple[float, ...], sd: float, told: bool) -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 20.0), seed=5, lever_arm=arm)
    assert recording.gnss is not None
    coarse = replace(recording, gnss=replace(recording.gnss, sd=np.full_like(recording.gnss.sd, sd)))
    assert bool(find_untold_arm(coarse)) == told


def test_fixes_of_before_the_drive_are_left_out(drive: Callable[[str], Recording]) -> None:
    part = drive("tokyo_20201105").crop(100.0, 160.0)
    g = part.gnss
    t, llh = np.concatenate([[g.t[0] - 1200.0], g.t]), np.vstack([g.llh[:1] + 1e-4, g.llh])
    cached = replace(part, gnss=replace(g, t=t, llh=llh, sd=np.vstack([g.sd[:1], g.sd]), v=None, sd_v=None))
    assert "gnss.cached" in keys(cached)
    assert len(inspect(cached).recording.gnss.t) == len(g.t)
    assert "gnss.cached" not in keys(part)
    fast = replace(part, gnss=replace(g, t=1e3 * (g.t - part.start) + part.start - 0.01))  # ms beside s: none is cached
    assert "gnss.cached" not in keys(fast)


def test_a_comparison_says_that_a_lever_arm_has_the_wrong_sign(tmp_path: Path) -> None:
    shutil.copytree(Path(__file__).parents[2] / "data" / "tokyo", tmp_path / "drive")
    text = (tmp_path / "drive" / "recording.toml").read_text(encoding="utf-8")
    found = {}
    for sign in ("", "-"):
        (tmp_path / "drive" / "recording.toml").write_text(
            text.replace("0.0, 0.6]", f"0.0, {sign}0.6]"), encoding="utf-8"
        )
        asked = ["compare", str(tmp_path / "drive"), "-o", str(tmp_path / "out"), "--solver", "ekf", "--no-report"]
        assert cli.run([*asked, "--end", "90", "--noise", "stated", "--quiet"]) == 0
        checks = json.loads((tmp_path / "out" / "ekf" / "summary.json").read_text())["checks"]
        found[sign] = "gnss.lever_arm_sign" in {check["key"] for check in checks}
    assert found == {"": False, "-": True}


def test_lever_arms_are_not_judged_by_an_imu_that_is_wrong() -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0), seed=5, lever_arm=(0.4, -0.5, 1.2))
    assert recording.gnss is not None
    wrong = replace(recording, gnss=replace(recording.gnss, lever_arm=np.array([0.4, 0.5, 1.2])))
    turned = inspect(replace(wrong, imu=replace(wrong.imu, gyro=-wrong.imu.gyro)))
    assert "imu.gyro_sign" in {f.key for f in turned.findings}
    assert find_wrong_arms(wrong, inspect(wrong).findings) != []
    assert find_wrong_arms(wrong, turned.findings) == []


@pytest.mark.parametrize(
    ("stated", "told"), [((0.4, 0.5, 1.2), ["gnss.lever_arm_sign"]), ((1.9, 0.5, 1.2), ["gnss.lever_arm"])]
)
def test_a_sign_is_named_where_it_is_all_that_is_wrong(stated: tuple[float, ...], told: list[str]) -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0), seed=5, lever_arm=(0.4, -0.5, 1.2))
    assert recording.gnss is not None
    wrong = replace(recording, gnss=replace(recording.gnss, lever_arm=np.array(stated)))
    assert [f.key for f in find_wrong_arms(wrong)] == told
    solved = run(wrong, solvers="rts", noise="stated")["rts"].graphs
    assert [f.key for f in find_wrong_arms(wrong, (), solved)] == told


def test_axes_that_too_weak_accelerations_do_not_show_are_told_by_the_course(drive: Callable[[str], Recording]) -> None:
    slow = drive("canada_rover")
    told = find_wrong_axes(slow, inspect(slow).findings)
    assert [(f.key, f.severity) for f in told] == [("imu.axes", "unreliable")]
    assert "RBD" in told[0].sentence
    R = parse_axes_letters("RBD") @ parse_axes_letters("FRD").T
    turned = replace(slow, imu=replace(slow.imu, gyro=slow.imu.gyro @ R.T, accel=slow.imu.accel @ R.T))
    assert find_wrong_axes(turned) == []


@pytest.mark.parametrize(
    ("name", "sensor", "axis", "told"),
    [
        ("boulder_drive_20250708", "gyro", 0, "imu.gyro_axis_sign"),
        ("dresden_car_20140326", "gyro", 1, "imu.gyro_axis_sign"),
        ("car_circles_boston_20241021", "gyro", 1, "imu.gyro_axis_sign"),
        ("dresden_car_20140326", "accel", 0, "imu.sideways_reversed"),
        ("car_circles_boston_20241021", "accel", 0, "imu.sideways_reversed"),
    ],
)
def test_one_reversed_axis_is_told(
    drive: Callable[[str], Recording], name: str, sensor: str, axis: int, told: str
) -> None:
    recording = drive(name)
    values = getattr(recording.imu, sensor) * np.where(np.arange(3) == axis, -1.0, 1.0)
    wrong = replace(recording, imu=replace(recording.imu, **{sensor: values}))
    assert told not in keys(recording)
    assert told in keys(wrong)


@pytest.mark.parametrize("name", ["dresden_car_20140326", "motorbike_dresden_20160809", "car_circles_boston_20241021"])
@pytest.mark.parametrize("exchanged", [False, True])
def test_a_reversed_gyro_is_no_exchange_of_latitude_and_longitude(
    drive: Callable[[str], Recording], name: str, exchanged: bool
) -> None:
    """Both mirror the course; the exchange stretches it, too."""
    recording = drive(name)
    gnss, sign = recording.gnss, 1.0 if exchanged else -1.0
    llh = gnss.llh - [0.0, np.median(gnss.llh[:, 1]) - 0.2, 0.0]  # where both are latitudes
    moved = replace(gnss, llh=llh[:, [1, 0, 2]] if exchanged else llh)
    found = keys(replace(recording, gnss=moved, imu=replace(recording.imu, gyro=sign * recording.imu.gyro)))
    assert ("gnss.lat_lon" in found) == exchanged
    assert ("imu.gyro_sign" in found) != exchanged


@pytest.mark.parametrize(
    "name", [*TURNING, "canada_rover", "car_circles_boston_20251119", "motorbike_dresden_20160809"]
)
@pytest.mark.parametrize("in_g", [False, True])
def test_forces_without_gravity_are_not_taken_for_another_unit(
    drive: Callable[[str], Recording], name: str, in_g: bool
) -> None:
    recording = drive(name)
    force = recording.imu.accel
    force = force / 9.80665 if in_g else force - force.mean(axis=0)
    (refused,) = [
        f
        for f in inspect(replace(recording, imu=replace(recording.imu, accel=force))).findings
        if f.severity == "refused"
    ]
    assert refused.key == "imu.force_scale"
    assert ('units = { accel = "g" }' in refused.sentence) == in_g  # the key to be written, only where it helps


def test_fixes_in_milliseconds_of_which_one_lies_within_the_drive(drive: Callable[[str], Recording]) -> None:
    recording = drive("dresden_car_20140326")
    late = replace(recording, gnss=replace(recording.gnss, t=1e3 * recording.gnss.t))
    assert [f.key for f in inspect(late).findings if f.severity != "note"] == ["gnss.clock"]


def test_an_imu_that_covers_little_of_the_fixes_is_named(drive: Callable[[str], Recording]) -> None:
    recording = drive("boulder_drive_20250708")
    for share, told in ((0.2, True), (0.7, False)):
        rows = recording.imu.t < recording.start + share * recording.duration
        cut = replace(recording, imu=take_rows(recording.imu, rows))
        assert ("gnss.beyond_imu" in keys(cut)) == told


def test_a_shift_of_clocks_that_one_turn_leaves_open_spoils_no_other_figure(
    drive: Callable[[str], Recording],
) -> None:
    recording = drive("oracle_drive").crop(*TURNS_LITTLE)
    assert recording.gnss is not None
    fit = fit_yaw_rate(recording.imu, compute_track(recording.gnss))
    assert fit is not None
    assert fit.spread > 1.0
    assert fit.coefficients == pytest.approx([1.0], abs=0.05)
    upside = imu(accel=lambda x: x * [1.0, 1.0, -1.0])(recording)
    assert [one.key for one in inspect(upside).findings if one.severity != "note"] == ["imu.force_sign"]


def test_jumps_of_fixes_are_no_exchange_of_latitude_and_longitude() -> None:
    """The few turns of a minute, exchanged, agree with the gyro by chance at some delay: less than as they are."""
    recording = simulate("electric", 8, duration=240.0, tunnels=0, gnss="rtk").recording
    assert recording.gnss is not None
    llh = recording.gnss.llh.copy()
    llh[np.abs(recording.gnss.t - recording.gnss.t[0] - 45.0) < 10.0, 0] += 20.0 / 6.37e6
    found = inspect(replace(recording, gnss=replace(recording.gnss, llh=llh)).crop(0.0, 60.0))
    assert not [f.key for f in found.findings if f.severity == "refused"]
