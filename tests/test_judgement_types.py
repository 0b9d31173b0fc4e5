"""Fixes of several types: each gets the factor that is its own, where the data tell them apart, and else none does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from graphnav.judgement.chance import median, scatter
from graphnav.judgement.types import apart, factors, reaching
from helpers import difference, random_states
from test_constraints import scene_of
from test_judgement import wandering

from graphnav.config import Settings, read_settings, settings_from, settings_text
from graphnav.constraints.gnss import SLOW_ERRORS, GnssPosition
from graphnav.earth import LocalFrame
from graphnav.errors import ConfigError
from graphnav.pipeline import run
from graphnav.recording import Gnss, Recording
from graphnav.rotation import Array
from graphnav.scoring import errors
from graphnav.trajectory import Trajectory


@pytest.fixture(scope="module")
def path() -> oracle.ExactPath:
    return oracle.vehicle_path(duration=420, seed=11)


def kinds_of(gnss: Gnss, other: int) -> Array:
    """Fixed, with 40 s of another type in every 120 s."""
    return np.where((gnss.t // 40).astype(int) % 3 == 1, other, 1)


def scattering(recording: Recording, times: float, seed: int) -> Recording:
    """The recording with float fixes that scatter so many times as they state."""
    gnss = recording.gnss
    kinds = kinds_of(gnss, 2)
    more = np.where(kinds == 2, np.sqrt(times**2 - 1.0), 0.0)[:, None] * gnss.sd
    e, n, u = (more * np.random.default_rng(seed).normal(size=more.shape)).T
    moved = np.stack([n / 6.36e6, e / (6.378e6 * np.cos(gnss.llh[:, 0])), u], -1)
    return replace(recording, gnss=replace(gnss, llh=gnss.llh + moved, type=kinds))


def untyped(recording: Recording) -> Recording:
    return replace(recording, gnss=replace(recording.gnss, type=None))


def rms_and_nees(trajectory: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Horizontal RMS (m) and NEES of position per degree of freedom."""
    found = errors(trajectory, truth)
    return float(np.sqrt(np.nanmean(np.sum(found.p[:, :2] ** 2, axis=1)))), float(np.nanmean(found.nees_p)) / 3.0


# ---- statistics


def drawn(rng: np.random.Generator, factor: dict[int, float], counts: dict[int, int]) -> dict[str, tuple[float, float]]:
    kinds = np.repeat(list(counts), list(counts.values()))
    z = rng.normal(size=(len(kinds), 3)) * np.sqrt([factor[k] for k in kinds])[:, None]
    return factors(z, np.sum(z * z, axis=1), kinds)


def test_types_that_are_alike_are_told_apart_no_oftener_than_chance_allows() -> None:
    """Three standard deviations are 0.27 %; medians of few have longer tails."""
    rng, n = np.random.default_rng(1), 1000
    alarms = sum(apart(drawn(rng, {1: 2.0, 2: 2.0, 5: 2.0}, {1: 280, 2: 140, 5: 8})) is not None for _ in range(n))
    assert alarms <= 15


def test_factors_are_within_their_own_uncertainty() -> None:
    rng, z = np.random.default_rng(2), []
    true = {1: 1.0, 2: 9.0, 4: 3.0, 5: 4.0}
    for _ in range(200):
        found = apart(drawn(rng, true, {1: 300, 2: 100, 4: 5, 5: 60}))
        assert found is not None
        for kind, name in ((1, "fixed"), (2, "float"), (4, "differential"), (5, "single")):
            z.append((found[name][0] - np.log(true[kind])) / found[name][1])
    by_type = np.mean(np.reshape(z, (-1, 4)) ** 2, axis=0)
    assert np.all((by_type > 0.3) & (by_type < 1.7)), by_type


def test_a_type_with_few_fixes_leans_on_the_others() -> None:
    few, many = scatter(3.0), scatter(900.0)
    seen = {"fixed": (0.0, many), "single": (4.0, many), "float": (5.0, few)}
    found = apart(seen)
    assert found is not None
    assert abs(found["fixed"][0]) < 0.01
    assert abs(found["single"][0] - 4.0) < 0.01
    assert 3.0 < found["float"][0] < 4.9
    assert found["float"][1] < few
    assert 0.0 < found["ppp"][0] < 4.0  # never seen: between the others, and nobody knows where
    assert found["ppp"][1] > 1.0
    assert apart({"fixed": (0.0, many), "float": (0.5, few)}) is None
    assert apart({"fixed": (3.0, many)}) is None


def test_residuals_that_are_alike_are_worth_less() -> None:
    rng = np.random.default_rng(0)
    z = np.repeat(rng.normal(size=(40, 3)), 10, axis=0)
    ((_, alike),) = factors(z, np.sum(z * z, axis=1), np.full(400, 5)).values()
    assert 2.0 * scatter(1200.0) < alike < 5.0 * scatter(1200.0)  # by the root of ten
    (found,) = factors(np.ones((1, 3)), np.array([3.0]), np.array([2])).values()
    assert found == (np.log(3.0 / median(3)), scatter(3.0))


# ---- drives


@pytest.mark.parametrize("seed", [0, 1])
def test_float_fixes_that_scatter_ten_times_as_much(path: oracle.ExactPath, seed: int) -> None:
    """The factor is found, sigmas of every solver hold, and the result is that of true sigmas."""
    recording, truth = oracle.drive(path, seed=seed)
    made = scattering(recording, 10.0, 100 + seed)
    solutions = run(made, None, ("ekf", "rts", "batch"))
    said = " ".join(solutions["rts"].notes)
    assert "fixed fixes: as stated" in said
    factor = float(said.split("float fixes: sigmas x ")[1].split()[0])
    assert abs(np.log(factor / 10.0)) < 0.5 * 4.0 * scatter(3.0 * 141), said  # four of its standard deviations
    sd = made.gnss.sd * np.where(made.gnss.type == 2, 10.0, 1.0)[:, None]
    best, _ = rms_and_nees(
        run(untyped(replace(made, gnss=replace(made.gnss, sd=sd))), None, ("rts",))["rts"].trajectory(), truth
    )
    found = {name: rms_and_nees(s.trajectory(), truth) for name, s in solutions.items()}
    assert all(0.5 < nees < 1.6 for _, nees in found.values()), found
    assert found["rts"][0] < 1.15 * best


def test_types_that_are_as_good_as_stated_change_nothing(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=2)
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds_of(recording.gnss, 2)))
    one, other = (run(r, None, ("ekf", "batch")) for r in (recording, untyped(recording)))
    for name in one:
        assert np.array_equal(one[name].states.p, other[name].states.p)
        assert np.array_equal(one[name].covariance, other[name].covariance)
        assert one[name].notes == other[name].notes


def test_errors_of_one_type_that_last(path: oracle.ExactPath) -> None:
    """Single-point fixes of 2 m that are 5 m wrong for ten seconds at a time, beside fixed ones that are not."""
    recording, truth = oracle.drive(path, seed=1)
    single, _ = oracle.drive(path, seed=51, gnss_sd=(2.0, 2.0, 4.0))
    single = wandering(single, 1.0, 101, 10.0, 2.5)
    kinds = kinds_of(recording.gnss, 5)
    mixed = {
        k: np.where(kinds[:, None] == 5, getattr(single.gnss, k), getattr(recording.gnss, k)) for k in ("llh", "sd")
    }
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds, **mixed))
    solutions = run(recording, None, ("ekf", "rts", "batch", "incremental"))
    said = " ".join(solutions["rts"].notes)
    assert "fixed fixes: as stated" in said
    words = said.split("single fixes: sigmas x ")[1]
    assert 2.0 < float(words.split()[0]) < 3.8, words  # true: 2.7
    assert 3.0 < float(words.split("errors last ")[1].split()[0]) < 15.0, words
    found = {name: rms_and_nees(s.trajectory(), truth) for name, s in solutions.items()}
    assert all(0.5 < nees < 1.6 for _, nees in found.values()), found
    assert found["rts"][0] < 0.04  # 0.055 with one factor for all


def test_what_is_judged_on_reaches_to_every_type(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=2)
    t = recording.gnss.t

    def reach(kinds: Array) -> float:
        typed = replace(recording, gnss=replace(recording.gnss, type=kinds))
        return reaching(typed, 50.0, typed.crop(0.0, 200.0)).end

    assert reach(np.ones(len(t), int)) <= 200.0
    assert 399.0 < reach(np.where(t > 300.0, 2, 1)) < 401.5  # a hundred of them
    assert reach(np.where((t > 300.0) & (t < 320.0), 2, 1)) <= 200.0  # too few to tell


# ---- settings and rows


TYPED = {"sd_factor": {"float": 3.0, "single": 2.0}}


def test_factors_by_type_are_a_setting(tmp_path) -> None:
    settings = settings_from({"gnss": TYPED})
    text = settings_text(settings)
    assert "sd_factor = { float = 3.0, single = 2.0 }" in text
    (tmp_path / "s.toml").write_text(text)
    assert read_settings(tmp_path / "s.toml").gnss.sd_factor == TYPED["sd_factor"]
    for wrong, sentence in (
        ({"floating": 2.0}, "'floating' is no type of fix; known: unknown, fixed, float"),
        ({"float": 0.0}, "must be a number above 0, or one for each type"),
        ("much", "must be a number above 0"),
    ):
        with pytest.raises(ConfigError, match=sentence) as caught:
            settings_from({"gnss": {"sd_factor": wrong}})
        assert "\n" not in str(caught.value)


def rows_of(recording: Recording, settings: Settings) -> GnssPosition:
    rows = GnssPosition.build(scene_of(GnssPosition, recording, settings, LocalFrame(recording.gnss.llh[0])))
    assert rows is not None
    return rows


def test_a_factor_by_hand_is_of_its_type_and_of_every_fix_where_there_is_one(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=2)
    recording = recording.crop(0.0, 200.0)
    kinds = kinds_of(recording.gnss, 2)
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds))
    rows = rows_of(recording, settings_from({"gnss": TYPED}))
    assert np.array_equal(rows.sigma, recording.gnss.sd * np.where(kinds == 2, 3.0, 1.0)[:, None])
    assert np.array_equal(
        rows_of(recording, settings_from({"gnss": {"sd_factor": 2.0}})).sigma, 2.0 * recording.gnss.sd
    )
    assert np.array_equal(rows_of(untyped(recording), settings_from({"gnss": TYPED})).sigma, recording.gnss.sd)


def test_slow_errors_of_types_are_apart_and_their_jacobians_right(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=2)
    recording = recording.crop(0.0, 200.0)
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds_of(recording.gnss, 5)))
    shares = {"slow_share": {"fixed": 0.3, "single": 0.8}}
    settings = Settings()
    settings = settings.model_copy(update={"gnss": settings.gnss.model_copy(update=shares)})
    rows = rows_of(recording, settings)
    names = [p.name for p in rows.parameters if p.name.startswith(SLOW_ERRORS)]
    assert len(names) == 4
    rng = np.random.default_rng(0)
    states = random_states(rng, len(rows), span=500.0)
    values = {
        p.name: np.tile(p.initial, (len(rows), 1)) + rng.normal(size=(len(rows), p.size)) for p in rows.parameters
    }
    linear = rows.linearize(states, values, slice(None))
    for name in names:

        def along(step: Array, name: str = name) -> Array:
            return rows.linearize(states, {**values, name: values[name] + step}, slice(None)).residual

        numerical = difference(along, np.full(3, 1e-3))
        np.testing.assert_allclose(linear.jacobians[name], numerical, atol=1e-6)
        of = 1 if name.endswith("fixed") else 5
        assert not linear.jacobians[name][rows.type != of].any()
        assert linear.jacobians[name][rows.type == of].any()
    share = np.where(rows.type == 5, 0.8, 0.3)[:, None]
    assert rows.sigma == pytest.approx(np.sqrt(1.0 - share) * rows.stated)


def test_slow_errors_of_two_types_have_nodes_of_their_own_at_the_same_times(path: oracle.ExactPath) -> None:
    """Shares as different as these ask for nodes 0.4 and 5 s apart; batch and filter's smoother must still agree."""
    recording = scattering(oracle.drive(path, seed=4, gnss_rate=5.0)[0], 1.0, 4).crop(0.0, 150.0)
    gnss = Settings().gnss.model_copy(update={"slow_share": {"fixed": 0.98, "float": 0.1}, "sd_factor": 1.0})
    found = run(recording, Settings().model_copy(update={"gnss": gnss}), ("rts", "batch"))
    names = [f"{slow}_{kind}" for slow in SLOW_ERRORS for kind in ("fixed", "float")]
    times = [found["batch"].parameters[name].t for name in names]
    assert all(np.array_equal(t, times[0]) for t in times)
    apart_by = np.linalg.norm(found["batch"].states.p - found["rts"].states.p, axis=1)
    sigma = np.sqrt(np.trace(found["batch"].covariance[:, 3:6, 3:6], axis1=1, axis2=2))
    assert np.max(apart_by / sigma) < 0.2
