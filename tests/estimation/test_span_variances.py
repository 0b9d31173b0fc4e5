"""Measurements of excluded spans, used with the variance that their errors show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers import forget_residuals

from graphnav import load
from graphnav.app.scores import score
from graphnav.config import Settings, parse_settings
from graphnav.estimation.noise.apply import select_weights
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.noise.span_variances import count_repetition
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Recording

FIXES_ALONE = {
    "gnss": {"velocity": False},
    "vehicle": {"nhc": False, "odometer": False},
    "standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False},
}


@pytest.mark.parametrize("r", [0.0, 0.5, 0.9])
def test_the_mean_of_correlated_errors_is_as_uncertain_as_that_of_fewer_independent_ones(r: float) -> None:
    """Against the scatter of means of a simulated first-order process."""
    rng = np.random.default_rng(3)
    n, many = 60, 4000
    e = np.empty((many, n))
    e[:, 0] = rng.standard_normal(many)
    for k in range(1, n):
        e[:, k] = r * e[:, k - 1] + np.sqrt(1.0 - r * r) * rng.standard_normal(many)
    scatter = float(np.var(e.mean(axis=1)) * n)
    # of one process in many axes, so that r is known well
    assert count_repetition(e.T) == pytest.approx(scatter, rel=0.1)


def test_an_error_in_common_counts_once() -> None:
    n = 50
    assert count_repetition(np.full((n, 3), 20.0)) == pytest.approx(n)
    assert count_repetition(np.zeros((n, 3))) == 1.0
    assert count_repetition(np.full((1, 3), 20.0)) == 1.0


@pytest.fixture(scope="module")
def among_houses(shared_data: Path) -> tuple[Recording, dict[str, Solution], dict[str, Solution]]:
    """Single-point fixes that are tens of metres off for half a minute, and nothing else: estimated and stated."""
    recording = forget_residuals(load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(56.1, 356.1))
    stated = run(recording, parse_settings({**FIXES_ALONE, "noise": {"mode": "stated"}}), ("ekf", "rts"))
    return recording, run(recording, parse_settings(FIXES_ALONE), ("ekf", "rts")), stated


def test_a_filter_does_not_drift_where_fixes_are_wrong(
    among_houses: tuple[Recording, dict[str, Solution], dict[str, Solution]],
) -> None:
    recording, solutions, stated = among_houses
    found = summarise(score(recording, recording, solutions, ())[0]["ekf"])
    plain = summarise(score(recording, recording, stated, ())[0]["ekf"])
    assert found["h_rms_m"] < 1.3 * plain["h_rms_m"]
    assert found["nees_p"] < 2.0 < plain["nees_p"]


@dataclass(frozen=True)
class Displaced:
    """A drive, the same with a minute of fixes 20 m farther north, and what that is solved as."""

    clean: Recording
    damaged: Recording
    settings: Settings
    solutions: dict[str, Solution]


@pytest.fixture(scope="module")
def displaced(shared_data: Path) -> Displaced:
    clean = load(shared_data / "tokyo_20201105").crop(680.0, 860.0)
    gnss = clean.gnss
    assert gnss is not None
    llh = gnss.llh.copy()
    llh[(gnss.t > clean.start + 70.0) & (gnss.t < clean.start + 130.0), 0] += 20.0 / 6.37e6
    damaged, settings = replace(clean, gnss=replace(gnss, llh=llh)), parse_settings({"gnss": {"velocity": False}})
    return Displaced(clean, damaged, settings, run(damaged, settings, ("ekf", "rts")))


def test_the_weights_are_part_of_the_noise_model(displaced: Displaced, tmp_path: Path) -> None:
    found = displaced.solutions["rts"]
    noise = found.noise
    decided = [span for span in found.excluded if span.kind in noise.span_weights and span.sigma_factor < np.inf]
    assert sum(span.count for span in decided) > 30
    for span in decided:
        t = np.array([span.t_start, span.t_end])
        np.testing.assert_allclose(select_weights(t, noise, span.kind), span.sigma_factor**-2.0)
        assert 1.0 < span.sigma_factor < np.inf
    kept = read_noise(write_noise(tmp_path / "noise.json", noise))
    again = run(displaced.damaged, displaced.settings, ("rts",), noise=kept)["rts"]
    np.testing.assert_array_equal(again.states.p, found.states.p)
    assert again.excluded == found.excluded


def test_fixes_displaced_together_do_no_harm(displaced: Displaced) -> None:
    """A minute of good fixes displaced by 20 m: as good as without them, which a drive with wheels can do without."""
    used, damaged = displaced.solutions, displaced.damaged
    without = run(damaged, displaced.settings, ("ekf", "rts"), noise=replace(used["rts"].noise, span_weights={}))
    (span,) = [one for one in used["rts"].excluded if one.count > 30]
    sigma = span.sigma_factor * float(np.median(used["rts"].records["gnss_position"].sigma))
    assert sigma > 20.0 * np.sqrt(0.5 * span.count)
    for name in ("ekf", "rts"):
        rms = [summarise(score(displaced.clean, damaged, x, ())[0][name])["h_rms_m"] for x in (used, without)]
        assert rms[0] < 1.02 * rms[1], name
