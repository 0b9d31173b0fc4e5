"""Noise figures in data-sheet units, the figures of known IMUs, and what is wrong with one that cannot be read."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import pytest
from helpers import refused
from test_recording import describe

from graphnav.core.errors import RecordingError
from graphnav.recording.formats import read
from graphnav.recording.formats.figures import EXAMPLES, FIGURE_UNITS, parse_figure
from graphnav.recording.formats.imu_models import MODELS, find_model
from graphnav.recording.formats.schema import STATED_FIGURES

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("key", "text", "si"),
    [
        ("gyro_noise_density", "0.15 deg/sqrt(h)", 0.15 * 2.908882e-4),
        ("gyro_noise_density", "0.15 °/√h", 0.15 * 2.908882e-4),
        ("gyro_noise_density", "0.15deg/sqrt(hr)", 0.15 * 2.908882e-4),
        ("gyro_noise_density", "0.0025 deg/s/sqrt(Hz)", 4.363323e-5),
        ("gyro_noise_density", "3.8 mdps/rtHz", 6.632251e-5),
        ("gyro_noise_density", "9 deg/h/√Hz", 4.363323e-5),
        ("gyro_noise_density", "1e-4 rad/s/sqrt(Hz)", 1e-4),
        ("accel_noise_density", "60 µg/√Hz", 5.88399e-4),
        ("accel_noise_density", "60 ug/sqrt(Hz)", 5.88399e-4),
        ("accel_noise_density", "0.06 m/s/sqrt(h)", 1e-3),
        ("accel_noise_density", "0.0578 m/s/√hr", 0.0578 / 60),
        ("gyro_bias_walk", "1e-5 rad/s^2/sqrt(Hz)", 1e-5),
        ("gyro_bias_walk", "3.6 deg/h/sqrt(h)", 2.908882e-7),
        ("accel_bias_walk", "2e-4 m/s^3/sqrt(Hz)", 2e-4),
        ("accel_bias_walk", "60 ug/sqrt(h)", 9.80665e-6),
        ("gyro_bias_sigma", "7 deg/h", 3.393696e-5),
        ("gyro_bias_sigma", "0.5 °/s", 8.726646e-3),
        ("accel_bias_sigma", "0.1 mg", 9.80665e-4),
        ("accel_bias_sigma", "15 mGal", 1.5e-4),
        ("accel_scale_sigma", "300 ppm", 3e-4),
        ("gyro_scale_sigma", "0.1 %", 1e-3),
    ],
)
def test_figures_in_data_sheet_units(key, text, si):
    assert parse_figure(key, text) == pytest.approx(si, rel=1e-6)


@pytest.mark.parametrize("key", FIGURE_UNITS)
def test_the_example_in_every_error_is_understood(key):
    deg, g, hour = math.pi / 180.0, 9.80665, 3600.0
    known = {
        "gyro_noise_density": 0.15 * deg / 60.0, "accel_noise_density": 60e-6 * g,
        "gyro_bias_walk": 2.0 * deg / hour / 60.0, "accel_bias_walk": 20e-6 * g / 60.0,
        "gyro_bias_sigma": 7.0 * deg / hour, "accel_bias_sigma": 5e-3 * g,
        "gyro_scale_sigma": 300e-6, "accel_scale_sigma": 1e-3,
    }  # fmt: skip
    assert parse_figure(key, EXAMPLES[key]) == pytest.approx(known[key], rel=1e-12)


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ('gyro_noise_density = "7 deg/h"', ("'deg/h'", "gyro_noise_density", "gyro_bias")),
        ('gyro_noise_density = "0.15"', ("'0.15'",)),
        ('accel_bias_sigma = "five mg"', ("'five mg'", '"5 mg"')),
        ('accel_bias_sigma = "5 furlong"', ("'furlong'", "accel_bias_sigma")),
        ('gyro_bias_sigma = "-7 deg/h"', ("gyro_bias_sigma",)),
        ("gyro_bias_sigma = true", ("gyro_bias_sigma' = True",)),
    ],
)
def test_a_figure_that_cannot_be_read_says_why(tmp_path, line, names):
    with refused("key.value", RecordingError, "recording.toml, line 6", *names):
        read(describe(tmp_path, f"[imu.noise]\n{line}"))


def test_figures_with_units_are_read(tmp_path):
    noise = read(
        describe(tmp_path, '[imu.noise]\ngyro_noise_density = "0.15 deg/sqrt(h)"\naccel_bias_sigma = 0.02')
    ).imu.noise
    assert noise.gyro_noise_density == pytest.approx(4.363323e-5, rel=1e-6)
    assert noise.accel_bias_sigma == 0.02


def test_a_model_gives_its_figures_and_the_file_goes_before_it(tmp_path):
    found = read(describe(tmp_path, 'model = "adis 16465"\n[imu.noise]\naccel_noise_density = "0.2 m/s/sqrt(h)"')).imu
    assert found.noise.gyro_noise_density == pytest.approx(0.1 * 2.908882e-4, rel=1e-6)
    assert found.noise.gyro_bias_sigma == pytest.approx(25 * 4.848137e-6, rel=1e-6)
    assert found.noise.gyro_bias_walk == pytest.approx(25 * 4.848137e-6 * (2 / 3600) ** 0.5, rel=1e-6)
    assert found.noise.accel_noise_density == pytest.approx(0.2 / 60)
    assert not found.noise_assumed
    with refused("key.value", RecordingError, "'ADIS16456'", "'ADIS16465'"):
        read(describe(tmp_path, 'model = "ADIS16456"'))


@pytest.mark.parametrize("name", MODELS)
def test_every_model_is_plausible_and_has_a_source(name):
    model = find_model(name.lower())
    assert model is MODELS[name]
    assert set(model.noise) <= {*STATED_FIGURES, "gyro_scale_sigma", "accel_scale_sigma"}
    assert 5e-7 < model.noise["gyro_noise_density"] < 1e-3
    assert 1e-4 < model.noise["accel_noise_density"] < 1e-2
    assert len(model.source) > 20


def test_the_page_has_the_table_of_the_code():
    spec = importlib.util.spec_from_file_location("imu_models", ROOT / "scripts" / "imu_models.py")
    imu_models = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(imu_models)
    page = ROOT / "docs" / "experiments" / "imu-models.md"
    assert imu_models.table() in page.read_text(encoding="utf-8")
    assert imu_models.table().count("\n") == len(MODELS) + 2
