"""Fixes that state the rms of their pseudorange residuals: what it is worth, and no harm where it is worth nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import difference, forget_residuals, random_states
from test_constraints import scene_of
from test_noise import INERTIAL, SHARES, built, markov
from test_noise_types import rms_and_nees

from graphnav.config import Settings
from graphnav.constraints.gnss import GnssPosition
from graphnav.constraints.lasting import MULTIPATH_ERROR
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import estimate_noise
from graphnav.estimation.noise.model import STATED, NoiseModel, VarianceComponent
from graphnav.estimation.pipeline import run
from graphnav.evaluation.evaluate import evaluate_recording
from graphnav.recording import Recording
from graphnav.recording.formats import read

SPP = (2.5, 2.5, 4.0)
SATELLITES = 10
FACTOR = 0.5  # multipath in stated sigmas, where the pseudoranges are off by 1 m
SEEDS = range(4)
GROUPS = tuple(f"gnss_position.multipath.{axis}" for axis in ("horizontal", "up"))


@pytest.fixture(scope="module")
def path() -> oracle.ExactPath:
    return oracle.vehicle_path(duration=300, rate=50.0, seed=11)


def draw_telegraph(t: Array, rng: np.random.Generator) -> Array:
    """(N,) mask that in every other 50 s is true by turns, of five seconds on average."""
    on = np.zeros(len(t), dtype=bool)
    for k in range(1, len(t)):
        on[k] = on[k - 1] ^ (rng.uniform() < 0.2 * (t[k] - t[k - 1]))
    return on & ((t // 50).astype(int) % 2 == 1)


def place(recording: Recording, error: Array, rms: Array) -> Recording:
    """The recording with errors (N, 3) of its fixes, m, and the rms (N,) of their residuals."""
    gnss = recording.gnss
    assert gnss is not None
    many, llh = np.full(len(rms), float(SATELLITES)), gnss.llh + oracle.llh_rate(gnss.llh, error)
    return replace(recording, gnss=replace(gnss, llh=llh, residual_rms=rms, satellites=many))


def make_by_model(path: oracle.ExactPath, seed: int) -> tuple[Recording, Trajectory]:
    """Multipath as the noise model has it: of the larger of two errors what the smaller lacks is independent."""
    recording, truth = oracle.drive(path, seed=seed, gnss_sd=SPP, gnss_exact=True)
    gnss, rng = recording.gnss, np.random.default_rng([seed, 21])
    assert gnss is not None
    t, redundant = gnss.t, SATELLITES - 4
    s = np.where(draw_telegraph(t, rng), 12.0, 0.7)
    x = rng.standard_normal((len(t), 3))
    for k in range(1, len(t)):
        a = np.exp(-(t[k] - t[k - 1]) / 20.0) * min(s[k], s[k - 1]) / max(s[k], s[k - 1])
        x[k] = a * x[k - 1] + np.sqrt(1.0 - a * a) * x[k]
    error = gnss.sd * (0.1 * rng.standard_normal(x.shape) + FACTOR * s[:, None] * x)
    return place(recording, error, np.sqrt(((1 + redundant) * s**2 - 1.0) / SATELLITES)), truth


def make_by_pseudoranges(path: oracle.ExactPath, seed: int) -> tuple[Recording, Trajectory]:
    """Least squares of pseudoranges with noise of 0.7 m, of which some are late by a reflection now and then."""
    recording, truth = oracle.drive(path, seed=seed, gnss_exact=True)
    gnss, rng = recording.gnss, np.random.default_rng([seed, 22])
    assert gnss is not None
    t = gnss.t
    azimuth = 2.0 * np.pi * rng.uniform(size=SATELLITES)
    sine = rng.uniform(0.2, 1.0, SATELLITES)
    cosine = np.sqrt(1.0 - sine**2)
    H = np.column_stack([-cosine * np.sin(azimuth), -cosine * np.cos(azimuth), -sine, np.ones(SATELLITES)])
    off = 0.7 * rng.standard_normal((len(t), SATELLITES))
    for k in np.argsort(sine)[:5]:  # the low ones
        off[:, k] += 20.0 * np.abs(markov(t, 20.0, rng, 1)[:, 0]) * draw_telegraph(t, rng)
    solved = off @ np.linalg.pinv(H).T
    rms = np.sqrt(np.mean((off - solved @ H.T) ** 2, axis=1))
    sd = np.sqrt(np.diag(np.linalg.inv(H.T @ H)))[:3]
    recording = replace(recording, gnss=replace(gnss, sd=np.tile(sd, (len(t), 1))))
    return place(recording, solved[:, :3], rms), truth


def make_useless(path: oracle.ExactPath, seed: int, kind: str) -> tuple[Recording, Trajectory]:
    """Residuals that tell nothing: the sigma has it all ("stated"), or they are of anything else ("noise")."""
    recording, truth = oracle.drive(path, seed=seed, gnss_sd=SPP, gnss_exact=True)
    gnss, rng = recording.gnss, np.random.default_rng([seed, 23])
    assert gnss is not None
    rms = np.where(draw_telegraph(gnss.t, rng), 12.0, 0.7) * np.sqrt(rng.chisquare(6.0, len(gnss.t)) / 6.0)
    sd = gnss.sd * (rms[:, None] if kind == "stated" else 1.0)
    lasting = sum(np.sqrt(share) * markov(gnss.t, time, rng) for time, share in SHARES.items()) * gnss.sd
    recording = replace(recording, gnss=replace(gnss, sd=0.5 * sd))
    return place(recording, sd * rng.standard_normal(sd.shape) + lasting, rms), truth


def test_derivatives_of_a_fix_with_multipath(path: oracle.ExactPath) -> None:
    recording = make_by_model(path, 0)[0].crop(0.0, 60.0)
    assert recording.gnss is not None
    plain = GnssPosition.build(scene_of(GnssPosition, recording, Settings(), LocalFrame(recording.gnss.llh[0])))
    assert plain is not None
    rows = replace(plain, parameters=plain.processes)
    rng, n = np.random.default_rng(3), len(rows)
    states = random_states(rng, n, span=500.0)
    values = {p.name: 0.1 * rng.standard_normal((n, p.size)) for p in rows.parameters}

    def move(step: Array) -> Array:
        moved = values | {MULTIPATH_ERROR: values[MULTIPATH_ERROR] + step}
        return rows.linearize(states, moved, slice(None)).residual

    found = rows.linearize(states, values, slice(None)).jacobians[MULTIPATH_ERROR]
    np.testing.assert_allclose(found, difference(move, np.full(3, 1e-3)), rtol=1e-6, atol=1e-6)
    assert np.ptp(found[:, 0, 0]) > 10.0  # from fix to fix


def test_of_two_errors_the_smaller_is_a_part_of_the_larger(path: oracle.ExactPath) -> None:
    """Covariances of the errors of fixes a short time apart, by the nodes of the problem: the smaller variance."""
    recording = make_by_model(path, 1)[0].crop(40.0, 100.0)
    problem, _ = built(recording, INERTIAL)
    noise = NoiseModel(dict.fromkeys(GROUPS, VarianceComponent(0.0)), times={MULTIPATH_ERROR: 1e9})
    used = apply_noise(problem, noise)
    rows = next(c for c in used.constraints if isinstance(c, GnssPosition))
    chain = next(c for c in used.chains if c.parameter.name == MULTIPATH_ERROR)
    assert rows.multipath_sigma is not None
    m, node = rows.multipath_sigma[:, 2], chain.node[rows.keyframe]
    variance = np.ones(len(chain.t))
    for j in range(1, len(chain.t)):
        variance[j] = chain.decay[j] ** 2 * variance[j - 1] + chain.sigma[j, 2] ** 2
    np.testing.assert_allclose(variance, 1.0)  # at all times
    for i in range(len(m) - 1):
        between = np.prod(chain.decay[node[i] + 1 : node[i + 1] + 1])
        assert between * m[i] * m[i + 1] == pytest.approx(min(m[i], m[i + 1]) ** 2, rel=1e-6)
    assert apply_noise(problem, STATED).columns.keys() == used.columns.keys() - {MULTIPATH_ERROR}


def solve(recording: Recording, truth: Trajectory) -> tuple[float, float, float]:
    """Horizontal RMS (m) and NEES with the residuals, and the RMS over that without them."""
    with_them, without = (run(one, INERTIAL, ("rts",))["rts"] for one in (recording, forget_residuals(recording)))
    (error, nees), (other, _) = (rms_and_nees(one.trajectory(), truth) for one in (with_them, without))
    return error, nees, error / other


def test_the_size_of_multipath_is_found(path: oracle.ExactPath) -> None:
    found = []
    for seed in SEEDS:
        noise = estimate_noise(*built(make_by_model(path, seed)[0], INERTIAL)).noise
        found += [noise.figures[name].log_factor for name in GROUPS]
        assert 10.0 < noise.times[MULTIPATH_ERROR] < 40.0
    assert np.exp(0.5 * np.mean(found)) == pytest.approx(FACTOR, rel=0.15)


def test_fixes_that_tell_their_quality_are_worth_more(path: oracle.ExactPath) -> None:
    found = np.array([solve(*make_by_pseudoranges(path, seed)) for seed in SEEDS[:2]])
    assert np.exp(np.mean(np.log(found[:, 2]))) < 0.6
    assert np.mean(found[:, 1]) < 1.6


@pytest.mark.parametrize("kind", ["stated", "noise"])
def test_residuals_that_tell_nothing_new_do_no_harm(path: oracle.ExactPath, kind: str) -> None:
    found = np.array([solve(*make_useless(path, seed, kind)) for seed in SEEDS[:2]])
    assert np.exp(np.mean(np.log(found[:, 2]))) < 1.05
    assert np.mean(found[:, 1]) < 1.6


def test_a_street_in_tokyo(shared_data: Path) -> None:
    """Half of the fixes are 10 to 60 m off in height, stated as 7 m, between others that are right; GNSS alone."""
    recording = read(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(525.8, 825.8).without("odometer")
    found = evaluate_recording(run(recording, INERTIAL, ("rts",))["rts"].trajectory(), recording)
    assert found is not None
    assert found.errors is not None
    assert float(np.sqrt(np.mean(found.errors.horizontal**2))) < 4.0
    assert float(np.sqrt(np.mean(found.errors.p[:, 2] ** 2))) < 5.0
    assert 0.3 < float(np.nanmean(found.errors.nees_p)) / 3.0 < 1.6
