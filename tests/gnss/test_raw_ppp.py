"""Precise point positioning: its models against RTKLIB, ANTEX, and a station whose place is known."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import oracle
import pytest
import raw_drive
from helpers import errors, refused

from graphnav.config import parse_settings
from graphnav.core import earth
from graphnav.core.errors import ConfigError, GraphnavError, RecordingError
from graphnav.estimation.pipeline import run
from graphnav.gnss.antex import compute_satellite_axes, compute_wind_up, read_antex
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.atmosphere import compute_directions, compute_niell_mapping
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.ppp import combine_ionosphere_free
from graphnav.gnss.precise import Orbits
from graphnav.gnss.series import choose_primary
from graphnav.gnss.sigmas import REFLECTED, compute_reflection_sigma
from graphnav.gnss.signals import L1, C, name_satellite, number_satellite, number_signal
from graphnav.gnss.tides import compute_solid_tide, locate_sun_and_moon
from graphnav.recording import Gnss, Imu, ImuNoise, Recording

DAY = 2155 * 604800.0 + 3 * 86400.0  # 2021-04-28, s since the GPS epoch
PLACES = np.array(
    [[-2703116.3, -4291766.8, 3854248.1], [4027881.4, 306998.8, 4919499.0], [-901776.1, 2409383.2, -5816748.6]]
)


@pytest.fixture(scope="module")
def rtklib():
    return pytest.importorskip("pyrtklib")


@pytest.mark.parametrize("hours", [0.0, 7.0, 19.5])
def test_the_tide_is_rtklibs(rtklib, hours):
    """Within what it leaves out: the terms out of phase and those that go with frequency."""
    gps = np.full(len(PLACES), DAY + 3600.0 * hours)
    found = compute_solid_tide(PLACES, *locate_sun_and_moon(gps))
    time = rtklib.gpst2utc(rtklib.gpst2time(2155, 3 * 86400.0 + 3600.0 * hours))
    for place, ours in zip(PLACES, found, strict=True):
        at, out = rtklib.Arr1Ddouble(3), rtklib.Arr1Ddouble(3)
        for i in range(3):
            at[i] = float(place[i])
        rtklib.tidedisp(time, at, 1, rtklib.erp_t(), rtklib.Arr1Ddouble(66), out)
        theirs = np.array([out[i] for i in range(3)])
        assert np.linalg.norm(theirs) > 0.02
        assert np.linalg.norm(ours - theirs) < 0.015


def test_the_mapping_function_is_rtklibs(rtklib):
    time = rtklib.gpst2time(2155, 3 * 86400.0)
    llh = earth.ecef_to_llh(PLACES)
    for place in llh:
        for degrees in (7.0, 20.0, 60.0):
            pos, azel, wet = rtklib.Arr1Ddouble(3), rtklib.Arr1Ddouble(2), rtklib.Arr1Ddouble(1)
            for i in range(3):
                pos[i] = float(place[i])
            azel[0], azel[1] = 0.3, float(np.radians(degrees))
            dry = rtklib.tropmapf(time, pos, azel, wet)
            ours = compute_niell_mapping(place[None], np.radians([degrees]), np.array([117.0]))
            np.testing.assert_allclose([ours[0][0], ours[1][0]], [dry, wet[0]], rtol=2e-4)


def test_wind_up_follows_the_turn_of_a_satellite():
    """A quarter turn of its antenna about its axis is a quarter of a cycle, and whole turns are counted on."""
    n = 9
    place = np.tile([2.6e7, 0.0, 0.0], (n, 1))
    axes = compute_satellite_axes(place, np.tile([0.0, 1.5e11, 3e10], (n, 1)))
    assert np.allclose(axes @ np.swapaxes(axes, -1, -2), np.eye(3))
    angle = 0.5 * np.pi * np.arange(n)
    turned = axes.copy()
    turned[:, 0] = np.cos(angle)[:, None] * axes[:, 0] + np.sin(angle)[:, None] * axes[:, 1]
    turned[:, 1] = -np.sin(angle)[:, None] * axes[:, 0] + np.cos(angle)[:, None] * axes[:, 1]
    e = np.tile([1.0, 0.0, 0.0], (n, 1))
    enu = np.tile(earth.enu_axes(np.zeros((1, 3))), (n, 1, 1))
    cycles = compute_wind_up(np.ones(n, dtype=np.int16), np.arange(float(n)), turned, e, enu)
    np.testing.assert_allclose(np.abs(np.diff(cycles)), 0.25, atol=1e-9)
    assert abs(cycles[-1] - cycles[0]) == pytest.approx(2.0)


ANTEX = """     1.4            M                                       ANTEX VERSION / SYST
                                                            START OF ANTENNA
BLOCK IIF           G01                 G063      2011-036A TYPE / SERIAL NO
  2011     7    16     0     0    0.0000000                 VALID FROM
   G01                                                      START OF FREQUENCY
    394.00      0.00   1500.00                              NORTH / EAST / UP
   G01                                                      END OF FREQUENCY
   G02                                                      START OF FREQUENCY
    394.00      0.00   1600.00                              NORTH / EAST / UP
   G02                                                      END OF FREQUENCY
                                                            END OF ANTENNA
                                                            START OF ANTENNA
SOME RECEIVER   NONE                                        TYPE / SERIAL NO
   G01                                                      START OF FREQUENCY
      0.10      0.20     89.50                              NORTH / EAST / UP
   G01                                                      END OF FREQUENCY
                                                            END OF ANTENNA
"""


def test_satellites_antennas_bring_them_nearer(tmp_path):
    """By what the file has along the line from the centre of mass to the receiver."""
    path = tmp_path / "some.atx"
    path.write_text(ANTEX)
    antennas, _ = read_antex(path)
    assert set(antennas) == {number_satellite("G01")}
    drive = oracle.vehicle_path(120.0)
    made = raw_drive.with_observations(oracle.drive(drive)[0], drive, carrier=0.0, second=True).crop(0.0, 5.0)
    raw = replace(made.raw_gnss, zero=DAY + 3600.0)
    plain = combine_ionosphere_free(raw.take(choose_primary(raw)), raw)
    first = replace(raw, antennas=antennas)
    known = combine_ionosphere_free(first.take(choose_primary(first)), first)
    satellite = raw.take(choose_primary(raw)).satellite[plain.which]
    nearer = plain.known - known.known
    one = satellite == number_satellite("G01")
    alpha = 1575.42**2 / (1575.42**2 - 1227.6**2)
    along = alpha * 1.5 - (alpha - 1.0) * 1.6
    assert np.all(nearer[~one] == 0.0)
    assert np.all(nearer[one] < np.hypot(along, 0.394) + 1e-6)
    assert np.all(nearer[one] > 0.95 * along - 0.394 * 0.25)
    path.write_text(ANTEX.replace("1600.00", "16x0.00"))
    with refused("table.cell", RecordingError, "line 9"):
        read_antex(path)


def test_the_combination_has_no_ionosphere_and_counts_arcs_of_both():
    drive = oracle.vehicle_path(120.0)
    made = raw_drive.with_observations(oracle.drive(drive)[0], drive, carrier=0.0, second=True).crop(0.0, 20.0)
    raw = made.raw_gnss
    free = combine_ionosphere_free(raw.take(choose_primary(raw)), raw)
    rows = raw.take(choose_primary(raw)).take(free.which)
    names = [name_satellite(x) for x in rows.satellite]
    cycles = 1000.0 * np.array([raw_drive.SATELLITES.index(x) for x in names])
    f2 = np.array([raw_drive.BANDS[x[0]][1][0] for x in names])
    alpha = L1**2 / (L1**2 - f2**2)
    # the ionosphere, metres of the opposite sign in codes and carriers, is gone; wind-up is a cycle of 0.11 m at most
    ambiguity = free.carrier - free.code - cycles * C * (alpha / L1 - (alpha - 1.0) / f2)
    assert np.abs(ambiguity).max() < 0.12
    assert np.ptp(ambiguity[rows.satellite == rows.satellite[0]]) < 1e-2
    second = np.flatnonzero((raw.satellite == rows.satellite[0]) & (raw.signal // 100 != 1))
    slip = np.zeros(len(raw), dtype=bool)
    slip[second[8]] = True
    slipped = replace(raw, slip=slip)
    arcs = combine_ionosphere_free(slipped.take(choose_primary(slipped)), slipped)
    own = rows.satellite == rows.satellite[0]
    assert len(np.unique(arcs.arcs.arc[own])) == len(np.unique(free.arcs.arc[own])) + 1


def test_the_code_that_the_clocks_are_of_goes_before_another():
    drive = oracle.vehicle_path(120.0)
    made = raw_drive.with_observations(oracle.drive(drive)[0], drive, carrier=0.0, second=True).crop(0.0, 20.0)
    raw, off = made.raw_gnss, 3.0
    gps = np.flatnonzero((raw.satellite < 100) & (raw.signal == number_signal("1C")) & (raw.t < np.median(raw.t)))
    more = raw.take(gps)
    more = replace(
        more, signal=np.full(len(gps), number_signal("1W")), code=more.code + off, carrier=np.full(len(gps), np.nan)
    )
    order = np.argsort(np.concatenate([raw.t, more.t]), kind="stable")
    arrays = {
        f.name: np.concatenate([getattr(raw, f.name), getattr(more, f.name)])[order]
        for f in fields(raw)
        if isinstance(getattr(raw, f.name), np.ndarray) and len(getattr(raw, f.name)) == len(raw)
    }
    both = replace(raw, **arrays)
    rows = raw.take(choose_primary(raw))
    plain, found = combine_ionosphere_free(rows, raw), combine_ionosphere_free(rows, both)
    one = rows.take(plain.which)
    changed = (one.satellite < 100) & (one.t < np.median(raw.t))
    assert 0 < changed.sum() < len(one)
    alpha = L1**2 / (L1**2 - 1227.6e6**2)
    np.testing.assert_allclose(found.code - plain.code, np.where(changed, alpha * off, 0.0), atol=1e-6)
    np.testing.assert_array_equal(found.carrier, plain.carrier)


def test_how_far_clocks_are_off_a_line_is_told_by_their_nodes():
    """Of a random walk, sampled every second: beside what it truly is in the middle between nodes 300 s apart."""
    rng = np.random.default_rng(3)
    walk = np.cumsum(rng.normal(scale=5e-12, size=300 * 400 + 1))  # s
    t = np.arange(len(walk), dtype=float)
    nodes = slice(None, None, 300)
    steady = 1e-4 + 1e-11 * t
    orbits = Orbits({}, {5: (t[nodes], walk[nodes]), 6: (t[nodes], steady[nodes])})
    noise = orbits.compute_clock_noise()
    middle = walk[150::300] - 0.5 * (walk[nodes][:-1] + walk[nodes][1:])
    sigma, apart = noise[5]
    assert apart == 300.0
    assert sigma == pytest.approx(C * np.sqrt(np.mean(middle**2)), rel=0.2)
    assert noise[6][0] < 1e-6


def test_reflections_that_last_are_in_the_sigma():
    """As long and as large as they are taken to be, on both signals of each satellite; three drives."""
    drive, total = oracle.vehicle_path(120.0), 0.0
    made, truth = oracle.drive(drive, seed=5, gnss_velocity_sd=(0.1, 0.1, 0.1))
    plain = raw_drive.with_observations(made, drive, noise=0.3, carrier=0.002, second=True, seed=1).crop(0.0, 110.0)
    raw = plain.raw_gnss
    _, elevation = compute_directions(raw.antenna, raw.p)
    heading = float(np.degrees(truth.rph[0, 2])) % 360.0
    for seed in range(3):
        rng, carrier = np.random.default_rng(seed), raw.carrier.copy()
        for satellite, signal in sorted(set(zip(raw.satellite.tolist(), raw.signal.tolist(), strict=True))):
            own = (raw.satellite == satellite) & (raw.signal == signal)
            decay = np.exp(-np.diff(raw.t[own]) / REFLECTED)
            x = rng.standard_normal(int(own.sum()))
            for i, a in enumerate(decay):
                x[i + 1] = a * x[i] + np.sqrt(1.0 - a * a) * x[i + 1]
            carrier[own] += compute_reflection_sigma(elevation[own]) * x * raw.frequency[own] / C
        spoilt = replace(plain, raw_gnss=replace(raw, carrier=carrier))
        chosen = {
            "raw_gnss": {"ppp": True, "period": 5.0},
            "noise": {"mode": "stated"},
            "alignment": {"heading": heading},
            "keyframes": {"rate": 0.2},
        }
        found = run(spoilt, parse_settings(chosen), ("ekf",))["ekf"]
        off = errors(found, truth)[0][-1]
        total += off @ np.linalg.solve(found.covariance[-1][3:6, 3:6], off)
    assert 1.15 < total < 27.9  # chi-square of 9, 0.1 and 99.9 %


@pytest.fixture(scope="module")
def slipping():
    """Four satellites alone for half a minute: as they are, and where both signals of one slip by a cycle."""
    path = oracle.vehicle_path(120.0, 50.0)
    made, _ = oracle.drive(path, seed=5, gnss_velocity_sd=(0.1, 0.1, 0.1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raw_drive, "SATELLITES", raw_drive.MANY)
        made = raw_drive.with_observations(made, path, noise=0.3, seed=2, carrier=0.002, second=True).crop(0.0, 60.0)
    raw, at = made.raw_gnss, 45.0
    late = raw.t > at - 15.0
    seen = np.unique(raw.satellite[late & (compute_directions(raw.antenna, raw.p)[1] > np.radians(20.0))])
    left = seen[:: len(seen) // 4][:4]
    raw = raw.take(~late | np.isin(raw.satellite, left))
    slipped = replace(raw, carrier=raw.carrier + ((raw.satellite == left[1]) & (raw.t > at - 1e-3)))
    assert find_arcs(slipped).slips == find_arcs(raw).slips
    return at, name_satellite(left[1]), [replace(made, raw_gnss=one) for one in (raw, slipped)]


def test_a_slip_that_no_flag_and_no_satellites_tell_begins_a_new_arc(slipping):
    """Of 11 cm in the combination; changes of carriers of four satellites fit any displacement."""
    at, name, recordings = slipping
    how = parse_settings({"noise": {"mode": "stated"}, "raw_gnss": {"ppp": True}})
    plain, slipped = (run(one, how, ("ekf", "rts")) for one in recordings)
    for solver, one in slipped.items():
        own = np.char.startswith(one.arcs.name, name)
        assert np.abs(one.arcs.begin[own] - at).min() < 1e-3, solver
        assert not np.any(np.abs(plain[solver].arcs.begin - at) < 1e-3), solver
        late = one.t > at
        assert np.linalg.norm((one.states.p - plain[solver].states.p)[late, :2], axis=1).max() < 0.03, solver
        assert len(one.fixed) == 0, solver  # float ambiguities are no epochs that could be fixed


def test_ppp_says_what_it_lacks():
    assert not parse_settings({"raw_gnss": {"ppp": True}}).raw_gnss.code
    with pytest.raises(ConfigError):
        parse_settings({"raw_gnss": {"ppp": "perhaps"}})
    drive = oracle.vehicle_path(120.0)
    one = raw_drive.with_observations(oracle.drive(drive)[0], drive, carrier=0.0).crop(0.0, 30.0)
    settings = parse_settings({"raw_gnss": {"ppp": True}})
    for recording, key in (
        (one, "raw.ppp_signals"),
        (replace(one, raw_gnss=replace(one.raw_gnss, precise=False)), "raw.ppp_orbits"),
    ):
        with refused(key, GraphnavError):
            run(recording, settings, ("ekf",))


# m in e, where the phase centre of the station SLAC was on that day (scripts/reproduce_ppp.py says from where)
SLAC = np.array([-2703116.3143, -4291766.7591, 3854248.0714])
PHASE_CENTRE = 0.055  # m, up


def test_a_station_comes_to_its_place_within_a_decimetre(shared_data):
    """After an hour, float, GPS and Galileo, with CODE's orbits and clocks; the IMU at rest is simulated."""
    data = shared_data / "raw_gnss_slac_20210428"
    begin = DAY + 19.5 * 3600.0
    sources = Sources(
        (data / "slac1180.21o.gz",),
        (data / "brdc1180.21n.gz",),
        tuple(data.glob("*SP3.gz")),
        tuple(data.glob("*CLK.gz")),
    )
    raw, fixes, _ = load_raw(sources, begin)
    t = np.arange(1, 3600 * 5 + 1) / 5.0
    llh = earth.ecef_to_llh(SLAC[None])[0]
    rng = np.random.default_rng(0)
    noise = ImuNoise(1.5e-4, 4e-3, 5e-6, 2e-4, 2e-3, 0.1)
    rate = earth.EARTH_RATE * np.array([0.0, np.cos(llh[0]), np.sin(llh[0])])
    gyro = rate + noise.gyro_noise_density * np.sqrt(5.0) * rng.standard_normal((len(t), 3))
    force = np.array([0.0, 0.0, float(earth.gravity(llh[0], llh[2]))])
    accel = force + noise.accel_noise_density * np.sqrt(5.0) * rng.standard_normal((len(t), 3))
    good = np.isfinite(fixes.p[:, 0]) & (fixes.t > 0.0) & (fixes.t < 3600.0)
    sd = np.sqrt(np.diagonal(fixes.covariance[good], axis1=1, axis2=2))
    gnss = Gnss(fixes.t[good], earth.ecef_to_llh(fixes.p[good]), sd, derived=True)
    recording = Recording("SLAC", "vehicle", Imu(t, gyro, accel, noise), gnss, gps_zero=begin, raw_gnss=raw)
    chosen = {"raw_gnss": {"ppp": True}, "alignment": {"heading": 0.0}, "keyframes": {"rate": 0.1}}
    found = run(recording, parse_settings(chosen), ("ekf",))["ekf"]
    off = found.states.p[-1] - found.frame.from_llh(earth.ecef_to_llh(SLAC[None]))[0] - [0.0, 0.0, PHASE_CENTRE]
    assert np.linalg.norm(off) < 0.1
    assert off @ np.linalg.solve(found.covariance[-1][3:6, 3:6], off) < 16.3  # chi-square of 3, 99.9 %
