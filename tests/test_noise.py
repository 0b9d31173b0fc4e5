"""The noise model: its derivatives, its figures on drives whose true ones are known, and what it leaves out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest

from graphnav import load
from graphnav.alignment import align
from graphnav.config import Settings, settings_from
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.noise.apply import with_noise
from graphnav.noise.model import Figure, NoiseModel
from graphnav.noise.moments import disturbances, imu_moments, process_moments, row_moments
from graphnav.pipeline import origin
from graphnav.preintegration import NOISE_FIGURES
from graphnav.problem import Problem, pose
from graphnav.recording import Recording
from graphnav.solvers.batch import batch
from graphnav.solvers.ekf import ekf, refilter
from graphnav.solvers.passes import Forward, Smoothed
from graphnav.solvers.rts import backward


def posed(recording: Recording, settings: Settings | None = None) -> tuple[Problem, float | None]:
    """A problem with stated noise and the parts of its intervals, and what its alignment has seen."""
    settings = settings or Settings()
    frame, stops = LocalFrame(origin(recording)), detect(recording, settings).stationary
    found = align(recording, settings, frame, lambda p, x: batch(p, x, wanted=(0,), reintegrate=False), stops)
    return pose(recording, settings, frame, found.state, found.sigma, stops, parts_of_noise=True), found.until


def groups(problem: Problem) -> list[str]:
    """Every variance component of a problem."""
    names = [f"imu.{name}" for name in NOISE_FIGURES]
    for rows in problem.constraints:
        names += [*rows.noise_groups()[0], *(g for p in (*rows.parameters, *rows.processes) for g in p.noise_groups)]
    return list(dict.fromkeys(names))


def moments(problem: Problem, forward: Forward, smoothed: Smoothed) -> dict[str, tuple[float, float]]:
    """A and B of every component."""
    steps, out = disturbances(problem, forward, smoothed), {}
    A, B = imu_moments(problem, forward, steps)
    out |= {f"imu.{name}": (A[:, i].sum(), B[:, i].sum()) for i, name in enumerate(NOISE_FIGURES)}
    for chain in problem.chains:
        _, A, B = process_moments(problem, chain, steps, len(problem.t))
        own = np.array(chain.parameter.noise_groups)
        out |= {g: (A[:, own == g].sum(), B[:, own == g].sum()) for g in chain.parameter.noise_groups}
    for rows in problem.constraints:
        names, index = rows.noise_groups()
        found = row_moments(problem, rows, smoothed, len(rows))
        out |= {g: (found.A[index == i].sum(), found.B[index == i].sum()) for i, g in enumerate(names)}
    return out


# ---------------------------------------------------------------------------------------------------------- derivatives


def lap() -> Recording:
    recording, _ = oracle.drive(
        oracle.vehicle_path(duration=120, seed=4), seed=2, gnss_velocity_sd=(0.05, 0.05, 0.08), odometer_rate=20.0
    )
    gnss = recording.gnss
    assert gnss is not None
    return replace(recording, gnss=replace(gnss, type=np.where(np.arange(len(gnss.t)) % 3 == 0, 2, 1)))


@pytest.mark.parametrize("name", ["simulated", "tokyo"])
def test_moments_are_the_derivative_of_the_likelihood(name: str) -> None:
    """A - B of every component, against the innovations' likelihood by central differences in ln f."""
    shipped = Path(__file__).resolve().parents[1] / "data" / "tokyo"
    recording = lap() if name == "simulated" else load(shipped).crop(0.0, 60.0)
    base, opening = posed(recording)
    # figures that differ, so that no component is all of its noise
    size = np.random.default_rng(1).normal(0.0, 0.5, len(groups(base)))
    noise = NoiseModel({name: Figure(float(x)) for name, x in zip(groups(base), size, strict=True)})
    used = with_noise(base, noise)
    about = backward(used, ekf(used, opening=opening))
    for _ in range(3):
        about = backward(used, refilter(used, about))
    forward = refilter(used, about)
    found = moments(used, forward, backward(used, forward))
    assert set(found) == set(groups(base))
    h = 0.01
    for name, (A, B) in found.items():
        both = []
        for step in (-h, h):
            other = {**noise.figures, name: Figure(noise.figures[name].log_factor + step)}
            both.append(refilter(with_noise(base, replace(noise, figures=other)), about).log_likelihood.sum())
        slope = (both[1] - both[0]) / (2.0 * h)
        assert 0.5 * (A - B) == pytest.approx(slope, rel=1e-3, abs=1e-3 * (1.0 + A + B)), name
