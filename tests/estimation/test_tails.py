"""Tails of the errors of rows: the density, its index, and what a drive with heavy-tailed fixes comes out as."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import oracle
import pytest
from scipy.integrate import quad
from scipy.special import chdtrc, chdtri, gammaln
from scipy.stats import chi2

from graphnav import run
from graphnav.config import Settings, parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.noise.apply import apply_noise, are_of_others
from graphnav.estimation.noise.model import NoiseModel, RowWeights
from graphnav.estimation.noise.outliers import compute_row_costs, list_reduced
from graphnav.estimation.noise.tails import (
    CHANCE,
    compute_information_share,
    compute_log_normaliser,
    compute_unweighted_factor,
    estimate_tail_index,
    get_tail_index,
    weigh_outlying,
    widen_unweighted,
)
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.problem import Problem, build_problem
from graphnav.evaluation.scoring import compute_errors
from graphnav.recording import Recording

CASES = [(1, 0.6), (1, 2.0), (2, 1.0), (3, 2.0), (3, 12.0)]  # numbers of a row, and index


def log_density(s: Array, m: int, index: float) -> Array:
    """Of s = |e|^2, not normalised, relative to a Gaussian e."""
    limit = index + m
    radial = (0.5 * m - 1.0) * np.log(s) - 0.5 * m * np.log(2.0) - gammaln(0.5 * m)
    return radial - np.where(s < limit, 0.5 * s, 0.5 * limit * (1.0 + np.log(s / limit)))


def expect(of: Callable[[float], float], m: int, index: float) -> float:
    """The integral of a function of s over the density, not normalised."""
    limit = index + m
    core = quad(lambda s: of(s) * np.exp(log_density(np.array(s), m, index)), 0.0, limit)[0]
    tail = quad(lambda x: of(np.exp(x)) * np.exp(log_density(np.exp(np.array(x)), m, index) + x), np.log(limit), 200.0)
    return float(core + tail[0])


def draw(n: int, m: int, index: float, rng: np.random.Generator) -> Array:
    """(n,) squared errors from the density, by its distribution function."""
    limit = index + m
    beyond = expect(lambda s: float(s > limit), m, index) / expect(lambda s: 1.0, m, index)
    u = rng.uniform(size=n)
    inside = chi2.ppf(rng.uniform(size=n) * (1.0 - chdtrc(m, limit)), m)
    outside = limit * rng.uniform(size=n) ** (-2.0 / index)
    return np.where(u < beyond, outside, inside)


@pytest.mark.parametrize(("m", "index"), CASES)
def test_the_density_and_its_information_are_integrals(m: int, index: float) -> None:
    limit, total = index + m, expect(lambda s: 1.0, m, index)
    assert float(compute_log_normaliser(index, m)) == pytest.approx(np.log(total), abs=1e-6)
    weighted = expect(lambda s: s * float(weigh_outlying(np.array([s]), m, index)[0]), m, index) / total
    assert weighted == pytest.approx(m, rel=1e-6)  # the variance by these weights is the one of the maximum likelihood
    fisher = expect(lambda s: min(s, limit**2 / s), m, index) / m
    stated = expect(lambda s: min(1.0, limit / s), m, index)
    assert compute_information_share(index, m) == pytest.approx(fisher / stated, rel=1e-6)
    factor, most = compute_unweighted_factor(index, m), float(chdtri(m, CHANCE))
    gaussian = m * (1.0 - chdtrc(m + 2, most)) + most * CHANCE
    assert expect(lambda s: min(s / factor, most), m, index) / total == pytest.approx(gaussian, rel=5e-3)


@pytest.mark.parametrize(("m", "index"), CASES)
def test_an_index_is_found_again(m: int, index: float) -> None:
    found = [estimate_tail_index(draw(4000, m, index, np.random.default_rng(seed)), m) for seed in range(4)]
    assert np.mean(np.log(found)) == pytest.approx(np.log(index), abs=0.12 if index < 5.0 else 0.5)


def test_gaussian_errors_have_no_tails() -> None:
    """Nor what few of them hint at: the prior's median stands where there is next to nothing."""
    for m in (1, 3):
        rng, median = np.random.default_rng(m), get_tail_index({}, "", m)
        assert estimate_tail_index(rng.chisquare(m, size=3000), m) > 0.7 * median
        assert estimate_tail_index(rng.chisquare(m, size=2), m) == pytest.approx(median, rel=0.2)


def build(recording: Recording) -> Problem:
    settings = Settings()
    frame, stops = LocalFrame(choose_origin(recording)), detect(recording, settings).stationary
    found = align(recording, settings, frame, stops)
    return build_problem(recording, settings, frame, found.state, found.sigma, stops, parts_of_noise=True)


def test_what_weights_cost_makes_the_density_of_a_gaussian() -> None:
    base = build(oracle.drive(oracle.vehicle_path(duration=120, rate=50.0, seed=4), seed=2)[0])
    rows = next(c for c in base.constraints if c.name == "gnss_position")
    n, m, index = len(rows), len(rows.axes), 1.7
    s = draw(n, m, index, np.random.default_rng(1))
    weight = weigh_outlying(s, m, index)
    listed = list_reduced(base.t[rows.keyframe], weight, np.ones(n, dtype=bool))
    used = apply_noise(base, NoiseModel(weights={rows.name: listed}))
    others = [c.name for c in base.constraints if c is not rows]
    cost = compute_row_costs(used, {rows.name: index}, without=others)
    gaussian = 0.5 * m * np.log(weight) - 0.5 * weight * s
    density = log_density(s, m, index) - compute_log_normaliser(index, m)
    radial = (0.5 * m - 1.0) * np.log(s) - 0.5 * m * np.log(2.0) - gammaln(0.5 * m)
    assert gaussian - cost[rows.keyframe] == pytest.approx(density - radial, abs=1e-9)


def make_heavy(seed: int, index: float) -> tuple[Recording, Recording, Trajectory]:
    """Minutes with fixes as stated, and with errors of t-distributed sizes instead, and the truth."""
    recording, truth = oracle.drive(oracle.vehicle_path(duration=240, rate=50.0, seed=7), seed=seed, gnss_rate=1.0)
    gnss = recording.gnss
    assert gnss is not None
    rng = np.random.default_rng([seed, 99])
    exact, _ = oracle.drive(
        oracle.vehicle_path(duration=240, rate=50.0, seed=7), seed=seed, gnss_rate=1.0, gnss_exact=True
    )
    assert exact.gnss is not None
    error = gnss.llh - exact.gnss.llh
    wider = 1.0 / np.sqrt(rng.chisquare(index, size=len(gnss.t)) / index)
    return recording, replace(recording, gnss=replace(gnss, llh=exact.gnss.llh + error * wider[:, None])), truth


def test_heavy_tailed_fixes_leave_the_solution_and_its_sigma_right() -> None:
    """A Gaussian model of errors with two degrees of freedom has the error of their variance, which is infinite."""
    nees, ratios, indices = [], [], []
    for seed in range(4):
        gaussian, heavy, truth = make_heavy(seed, 2.0)
        plain, found = (run(one, None, ("rts",))["rts"] for one in (gaussian, heavy))
        assert plain.noise.tails["gnss_position"] > 5.0
        assert not any(found.noise.excluded.values())
        indices.append(found.noise.tails["gnss_position"])
        before, errors = (compute_errors(one.trajectory(), truth) for one in (plain, found))
        ratios.append(np.sqrt(np.nanmean(errors.p**2) / np.nanmean(before.p**2)))
        nees.append(np.nanmean(errors.nees_p) / np.nanmean(before.nees_p))
    assert np.exp(np.mean(np.log(indices))) == pytest.approx(2.0, rel=0.4), indices
    assert np.mean(ratios) < 1.6, ratios
    assert 0.6 < np.mean(nees) < 1.6, nees


def test_figures_of_another_recording_are_those_of_rows_without_weights() -> None:
    settings = parse_settings({"noise": {"mode": "estimated"}})
    _, heavy, _ = make_heavy(0, 2.0)
    noise = run(heavy, settings, ("rts",))["rts"].noise
    own = build(heavy.crop(0.0, 120.0))
    other = build(heavy.crop(120.0, 240.0))
    assert not are_of_others(own, noise)
    assert are_of_others(
        other, replace(noise, weights={"gnss_position": RowWeights(np.array([-5.0]), np.array([0.1]))})
    )
    wider = widen_unweighted(own, noise)
    group, index = "gnss_position.up", noise.tails["gnss_position"]
    more = wider.figures[group].log_factor - noise.figures[group].log_factor
    assert more == pytest.approx(np.log(compute_unweighted_factor(index, 3)))
    assert not wider.tails
    assert np.all(wider.weights["gnss_position"].weight >= noise.weights["gnss_position"].weight)
