"""Fixes of several types: each has figures that are its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from helpers import difference, random_states
from test_constraints import scene_of
from test_noise_scenarios import times, wandering, whole

from graphnav.config import Settings
from graphnav.constraints.gnss import GnssPosition
from graphnav.constraints.lasting import ERRORS
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.evaluation.scoring import compute_errors
from graphnav.recording import Gnss, Recording


@pytest.fixture(scope="module")
def path() -> oracle.ExactPath:
    return oracle.vehicle_path(duration=240, rate=50.0, seed=11)


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
    found = compute_errors(trajectory, truth)
    return float(np.sqrt(np.nanmean(np.sum(found.p[:, :2] ** 2, axis=1)))), float(np.nanmean(found.nees_p)) / 3.0


# ---- drives


@pytest.fixture(scope="module")
def floating(path: oracle.ExactPath) -> tuple[Recording, Trajectory, dict[str, Solution]]:
    """Float fixes that scatter ten times as much as they state, solved."""
    recording, truth = oracle.drive(path, seed=0)
    made = scattering(recording, 10.0, 100)
    return made, truth, run(made, None, ("ekf", "rts", "batch"))


@pytest.fixture(scope="module")
def lasting(path: oracle.ExactPath) -> tuple[Trajectory, dict[str, Solution]]:
    """Single-point fixes of 2 m that are 5 m wrong for ten seconds at a time, beside fixed ones that are not; solved"""
    recording, truth = oracle.drive(path, seed=1)
    single, _ = oracle.drive(path, seed=51, gnss_sd=(2.0, 2.0, 4.0))
    single = wandering(single, 1.0, 101, 10.0, 2.5)
    kinds = kinds_of(recording.gnss, 5)
    mixed = {
        k: np.where(kinds[:, None] == 5, getattr(single.gnss, k), getattr(recording.gnss, k)) for k in ("llh", "sd")
    }
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds, **mixed))
    return truth, run(recording, None, ("ekf", "rts", "batch", "incremental"))


def test_float_fixes_that_scatter_ten_times_as_much(
    floating: tuple[Recording, Trajectory, dict[str, Solution]],
) -> None:
    """The factor is found, no solver's sigmas are too small, and the result is that of true sigmas."""
    made, truth, solutions = floating
    noise = solutions["rts"].noise
    for axis in ("horizontal", "up"):
        fixed, floats = (noise.figures[f"gnss_position.{kind}.{axis}"] for kind in ("fixed", "float"))
        assert 0.8 < np.sqrt(fixed.factor) < 1.2, axis
        # four of its standard deviations
        assert abs(floats.log_factor - np.log(100.0)) < 4.0 * floats.sigma, axis
    sd = made.gnss.sd * np.where(made.gnss.type == 2, 10.0, 1.0)[:, None]
    best, _ = rms_and_nees(
        run(untyped(replace(made, gnss=replace(made.gnss, sd=sd))), None, ("rts",))["rts"].trajectory(), truth
    )
    found = {name: rms_and_nees(s.trajectory(), truth) for name, s in solutions.items()}
    assert all(nees < 1.6 for _, nees in found.values()), found
    assert found["rts"][0] < 1.15 * best


def test_types_that_are_as_good_as_stated_change_little(path: oracle.ExactPath) -> None:
    """Figures of two types from half the fixes each: within a tenth of a sigma of those of one."""
    recording, _ = oracle.drive(path, seed=2)
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds_of(recording.gnss, 2)))
    one, other = (run(r, None, ("ekf", "batch")) for r in (recording, untyped(recording)))
    for name in one:
        d = one[name].states.p - other[name].states.p
        sigma = np.sqrt(np.einsum("kii->ki", other[name].covariance[:, 3:6, 3:6]))
        assert np.sqrt(np.mean((d / sigma) ** 2)) < 0.3, name


def test_errors_of_one_type_that_last(lasting: tuple[Trajectory, dict[str, Solution]]) -> None:
    truth, solutions = lasting
    noise = solutions["rts"].noise
    assert 0.8 < times(noise, "gnss_position.fixed.horizontal") < 1.2
    assert 2.0 < whole(noise, "gnss_position.single", "horizontal") < 3.8  # true: 2.7
    # drawn with 10 s; the errors themselves are likeliest with 16 s, and by 1.8 nats less so with 10 s
    assert 8.0 < noise.times["gnss_error_of_seconds_single"] < 30.0
    found = {name: rms_and_nees(s.trajectory(), truth) for name, s in solutions.items()}
    assert all(nees < 1.6 for _, nees in found.values()), found
    assert found["rts"][0] < 0.04  # 0.055 with one factor for all


@pytest.mark.xfail(strict=True, reason="NEES 0.25 to 0.4: what lasts for hours adds its prior")
@pytest.mark.parametrize("drive", ["floating", "lasting"])
def test_sigmas_of_types_are_not_too_large(drive: str, request: pytest.FixtureRequest) -> None:
    *_, truth, solutions = request.getfixturevalue(drive)
    assert all(rms_and_nees(s.trajectory(), truth)[1] > 0.5 for s in solutions.values())


# ---- rows


def rows_of(recording: Recording, settings: Settings) -> GnssPosition:
    rows = GnssPosition.build(scene_of(GnssPosition, recording, settings, LocalFrame(recording.gnss.llh[0])))
    assert rows is not None
    return rows


def test_errors_of_types_are_apart_and_their_jacobians_right(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=2)
    recording = recording.crop(0.0, 200.0)
    recording = replace(recording, gnss=replace(recording.gnss, type=kinds_of(recording.gnss, 5)))
    rows = rows_of(recording, Settings())
    assert [p.name for p in rows.processes if not p.name.startswith(ERRORS)] == ["gnss_stamp_error"]
    of_types = [p for p in rows.processes if p.name.startswith(ERRORS)]
    names = [p.name for p in of_types]
    assert len(names) == 6
    assert {g.split(".")[1] for p in of_types for g in p.noise_groups} == {"fixed", "single"}
    rows = replace(rows, parameters=(*rows.parameters, *rows.processes))
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


def test_errors_of_two_types_have_nodes_at_the_same_times(path: oracle.ExactPath) -> None:
    """And batch and filter's smoother agree, although those of one type are large and of the other small."""
    recording = scattering(oracle.drive(path, seed=4, gnss_rate=5.0)[0], 1.0, 4).crop(0.0, 100.0)
    shares = {"fixed": 0.98, "float": 0.1}
    noise = NoiseModel(
        {
            f"gnss_position.{kind}.{time}.{axis}": VarianceComponent(float(np.log(0.5 * share)))
            for kind, share in shares.items()
            for time in ("minutes", "hours")
            for axis in ("horizontal", "up")
        }
    )
    found = run(recording, None, ("rts", "batch"), noise=noise)
    names = [f"{error}_{kind}" for error in ERRORS[1:] for kind in ("fixed", "float")]
    at = [found["batch"].parameters[name].t for name in names]
    assert all(np.array_equal(t, at[0]) for t in at)
    apart_by = np.linalg.norm(found["batch"].states.p - found["rts"].states.p, axis=1)
    sigma = np.sqrt(np.trace(found["batch"].covariance[:, 3:6, 3:6], axis1=1, axis2=2))
    assert np.max(apart_by / sigma) < 0.2
