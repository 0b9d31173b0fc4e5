"""A noise model comes back from its file to the last digit, and a file that is no noise model is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import refused

from graphnav.app import cli
from graphnav.app.workflow import list_unused_noise
from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.gnss import CLOCK_RATE
from graphnav.constraints.odometer import ODOMETER_DELAY
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import ConfigError
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.estimation.noise.files import list_noise, read_noise, read_noise_and_mode, write_noise
from graphnav.estimation.noise.groups import list_groups
from graphnav.estimation.noise.model import (
    STATED,
    FreedConstant,
    NoiseModel,
    Remounting,
    Rival,
    RowWeights,
    VarianceComponent,
)
from graphnav.estimation.noise.table import compute_whole_ratio, tabulate_figures
from graphnav.estimation.problem import build_problem
from graphnav.recording.formats import read as load

TOKYO = Path(__file__).resolve().parents[2] / "data" / "tokyo"


def some_noise(seed: int = 0) -> NoiseModel:
    """Every group there is, with figures of all digits."""
    rng = np.random.default_rng(seed)
    figures = {name: VarianceComponent(*rng.normal(size=1), *rng.uniform(0.1, 3.0, 4)) for name in list_groups()}
    t = np.sort(rng.uniform(1.6e9, 1.7e9, 50))  # of a clock that counts from 1970
    return NoiseModel(
        figures,
        {"gnss_error_of_seconds": float(rng.uniform(0.2, 60.0)), "nhc_error": 1.0 / 3.0},
        {"gnss_position": RowWeights(t, rng.uniform(0.0, 1.0, 50))},
        {"gnss_position": ((t[3], t[7]), (t[9], t[9])), "nhc": ((t[1], t[2]),)},
        remountings=(Remounting(t[4], t[5], tuple(rng.normal(size=3).tolist()), float(rng.uniform(0.01, 0.1))),),
        rivals=(Rival(float(rng.uniform()), {"gnss_position": ((t[8], t[9]),)}),),
        freed={
            LEVER_ARM: FreedConstant(tuple(rng.normal(size=3).tolist()), tuple(rng.uniform(0.001, 0.1, 3).tolist())),
            CLOCK_RATE: FreedConstant((float(rng.normal(0.0, 1e-4)),), (float(rng.uniform(1e-6, 1e-5)),)),
            ODOMETER_DELAY: FreedConstant((float(rng.normal(0.0, 0.1)),), (float(rng.uniform(0.001, 0.01)),)),
        },
    )


def test_a_noise_model_comes_back_to_the_last_digit(tmp_path: Path) -> None:
    noise = some_noise()
    again, mode = read_noise_and_mode(write_noise(tmp_path / "noise.json", noise, "stated"))
    assert mode == "stated"
    assert (again.figures, again.times, again.excluded) == (noise.figures, noise.times, noise.excluded)
    assert (again.freed, again.rivals, again.remountings) == (noise.freed, noise.rivals, noise.remountings)
    assert again.weights.keys() == noise.weights.keys()
    for name, some in noise.weights.items():
        np.testing.assert_array_equal(again.weights[name].t, some.t)
        np.testing.assert_array_equal(again.weights[name].weight, some.weight)
    empty = read_noise(write_noise(tmp_path / "stated.json", STATED))
    assert not empty.figures
    assert not empty.excluded


def test_every_group_of_a_problem_can_be_written_down() -> None:
    """Else what a run finds could not be read again."""
    recording = load(TOKYO).crop(0.0, 20.0)
    assert recording.gnss is not None
    frame = LocalFrame(recording.gnss.llh[0])
    zero: Array = np.zeros((1, 3))
    start = States(np.eye(3)[None], zero, zero, zero, zero)
    problem = build_problem(recording, Settings(), frame, start, np.ones(15), np.empty((0, 2)))
    groups = {g for rows in problem.constraints for g in rows.list_noise_groups()[0]}
    groups |= {g for rows in problem.constraints for p in (*rows.parameters, *rows.processes) for g in p.noise_groups}
    assert {"odometer.forward", "gnss_velocity.seconds.up", "nhc.seconds.right"} <= groups
    assert groups <= set(list_groups())


def changed(key: str, value: Any) -> dict[str, Any]:
    """The values of a good file with one of them another; a key with dots leads to it."""
    values = json.loads(json.dumps({"noise": list_noise(some_noise())}))
    at = values
    *way, last = key.split("/")
    for part in way:
        at = at[part]
    at[last] = value
    return values


FIGURE = "noise/figures/imu.gyro_noise_density"
BAD = {
    "no noise model": ({"settings": {}}, "noise.no_model", ()),
    "a list": ([1, 2], "noise.no_model", ()),
    "unknown part": (changed("noise/weight", {}), "key.unknown", ("'noise.weight'", "'weights'")),
    "unknown mode": (changed("noise/mode", "guessed"), "key.value", ("'noise.mode'", "guessed")),
    "unknown group": (
        changed("noise/figures/imu.gyro_noise", {"log_factor": 0.0}),
        "key.unknown",
        ("imu.gyro_noise'", "'imu.gyro_noise_density'"),
    ),
    "unknown key of a figure": (changed(f"{FIGURE}/sigmas", 1.0), "key.unknown", ("sigmas'", "'sigma'")),
    "no remounting": (changed("noise/remountings", [[1.0, 2.0, 0.5]]), "key.value", ("'noise.remountings'",)),
    "no flag": (changed("noise/searched", 1), "key.value", ("'noise.searched'", "= 1")),
    "no figure": (changed(FIGURE, {"sigma": 1.0}), "key.missing", ("log_factor",)),
    "a figure is a number": (changed(FIGURE, 2.0), "key.value", ("= 2.0",)),
    "words": (changed(f"{FIGURE}/log_factor", "1"), "key.value", ("log_factor", '"1"')),
    "true": (changed(f"{FIGURE}/log_factor", True), "key.value", ("log_factor", "true")),
    "null": (changed(f"{FIGURE}/sigma", None), "key.value", ("sigma'", "null")),
    "infinite": (changed(f"{FIGURE}/log_factor", float("inf")), "key.value", ("log_factor", "Infinity")),
    "nothing left of a variance": (
        changed(FIGURE, {"variance_factor": 0.0}),
        "key.value",
        ("variance_factor", "= 0.0"),
    ),
    "two figures": (changed(f"{FIGURE}/variance_factor", 4.0), "noise.disagree", ("gyro_noise_density",)),
    "negative sigma": (changed(f"{FIGURE}/sigma", -1.0), "key.value", ("sigma'", "= -1.0")),
    "figures in a list": (changed("noise/figures", []), "key.value", ("'noise.figures'", "= []")),
    "time of no process": (
        changed("noise/correlation_times/nhc", 2.0),
        "key.unknown",
        ("correlation_times.nhc'", "'nhc_error'"),
    ),
    "no time": (changed("noise/correlation_times/nhc_error", 0.0), "key.value", ("nhc_error'", "= 0.0")),
    "weights of nothing": (
        changed("noise/weights/gnss", {"t": [], "weight": []}),
        "key.unknown",
        ("weights.gnss'", "'gnss_code'"),
    ),
    "weights without times": (changed("noise/weights/nhc", {"weight": [0.5]}), "key.value", ("weights.nhc'",)),
    "too few weights": (changed("noise/weights/nhc", {"t": [1.0, 2.0], "weight": [0.5]}), "noise.lengths", ("2", "1")),
    "weight above one": (
        changed("noise/weights/nhc", {"t": [1.0], "weight": [1.5]}),
        "key.value",
        ("weight'", "= 1.5"),
    ),
    "times not sorted": (
        changed("noise/weights/nhc", {"t": [2.0, 1.0], "weight": [0.5, 0.5]}),
        "noise.not_ascending",
        ("weights.nhc.t'",),
    ),
    "weights are a number": (
        changed("noise/weights/nhc", {"t": 1.0, "weight": [0.5]}),
        "key.value",
        ("weights.nhc.t'", "= 1.0"),
    ),
    "arm of two": (changed("noise/lever_arm/value", [0.0, 1.0]), "key.value", ("lever_arm.value'", "[0.0, 1.0]")),
    "arm without sigma": (
        changed("noise/lever_arm", {"value": [0.0, 1.0, 2.0]}),
        "key.missing",
        ("lever_arm", "sigma"),
    ),
    "two rates": (changed("noise/clock_rate/value", [0.0, 1.0]), "key.value", ("clock_rate.value'", "[0.0, 1.0]")),
    "rate of a stopped clock": (changed("noise/clock_rate/value", [-1.0]), "key.value", ("clock_rate.value'", "-1.0")),
    "readings of an hour ago": (
        changed("noise/odometer_delay", {"value": [3600.0], "sigma": [0.01]}),
        "key.value",
        ("odometer_delay.value'", "3600.0"),
    ),
    "half a span": (changed("noise/excluded/nhc", [[1.0]]), "key.value", ("excluded.nhc'", "[1.0]")),
    "a rival alone": (changed("noise/rivals", {"probability": 0.5}), "key.value", ("noise.rivals'",)),
    "rivals by chance": (changed("noise/rivals", [{"excluded": {}}]), "key.value", ("rivals.probability'", "null")),
    "more than certain": (changed("noise/rivals", [{"probability": 1.5}]), "key.value", ("probability'", "= 1.5")),
    "half a rival's span": (
        changed("noise/rivals", [{"probability": 0.5, "excluded": {"nhc": [[1.0]]}}]),
        "key.value",
        ("excluded.nhc'", "[1.0]"),
    ),
    "backward span": (changed("noise/excluded/nhc", [[2.0, 1.0]]), "key.value", ("excluded.nhc'", "[2.0, 1.0]")),
}


@pytest.mark.parametrize(("values", "key", "names"), BAD.values(), ids=BAD)
def test_what_is_no_noise_model_is_refused_in_one_sentence(
    values: Any, key: str, names: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "noise.json"
    path.write_text(json.dumps(values), encoding="utf-8")
    with refused(key, ConfigError, str(path), *names):
        read_noise(path)


@pytest.mark.parametrize(
    ("content", "key", "name"),
    [
        (None, "file.unreadable", "noise.json"),
        (b'{\n"noise": ', "json.syntax", "line 2"),
        (b"\xff\xfe\x00", "file.text", "UTF-8"),
        (b"", "json.syntax", "line 1"),
    ],
    ids=["missing", "cut off", "not text", "empty"],
)
def test_a_file_that_is_no_json_is_refused(
    content: bytes | None, key: str, name: str, tmp_path: Path, capsys: Any
) -> None:
    path = tmp_path / "noise.json"
    if content is not None:
        path.write_bytes(content)
    with refused(key, ConfigError, name):
        read_noise(path)
    assert cli.run(["smooth", "kitti", "--noise", str(path), "-o", str(tmp_path / "o")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert str(path) in printed.err
    assert not (tmp_path / "o").exists()


def test_rows_stand_beside_what_is_stated() -> None:
    recording = load(TOKYO).crop(0.0, 20.0)
    assert recording.gnss is not None
    noise = NoiseModel(
        {
            "imu.accel_bias_walk": VarianceComponent(np.log(9.0)),
            "gnss_position.up": VarianceComponent(np.log(4.0)),
            "gnss_position.minutes.up": VarianceComponent(np.log(0.25)),
            "nhc.seconds.right": VarianceComponent(0.0),
        },
        {"nhc_error": 7.0},
    )
    rows = {row.group: row for row in tabulate_figures(noise, recording, (90.0, 3000.0))}
    walk = rows["imu.accel_bias_walk"]
    assert (walk.stated, walk.correlation_time) == (recording.imu.noise.accel_bias_walk, None)
    assert walk.used == pytest.approx(3.0 * recording.imu.noise.accel_bias_walk)
    up = float(np.median(recording.gnss.sd[:, 2]))
    assert rows["gnss_position.up"].used == pytest.approx(2.0 * up)
    assert rows["gnss_position.minutes.up"].used == pytest.approx(0.5 * up)
    assert rows["gnss_position.minutes.up"].correlation_time == 90.0
    assert rows["nhc.seconds.right"].correlation_time == 7.0
    assert rows["nhc.seconds.right"].stated is None
    assert compute_whole_ratio(noise, "gnss_position", "up") == pytest.approx(np.sqrt(4.25))
    assert compute_whole_ratio(noise, "gnss_position", "horizontal") is None


def test_what_a_noise_model_says_of_nothing_is_told() -> None:
    t = np.arange(10.0)
    solution: Any = SimpleNamespace(t=t, records={"gnss_position": SimpleNamespace(t=t)})
    weights = RowWeights(np.array([3.0, 4.5]), np.array([0.5, 0.5]))
    noise = NoiseModel(
        {
            "odometer.forward": VarianceComponent(0.0),
            "gnss_position.up": VarianceComponent(0.0),
            "imu.gyro_bias_walk": VarianceComponent(0.0),
        },
        weights={"gnss_position": weights, "imu.gyro": RowWeights(np.array([7.0]), np.array([0.5]))},
        excluded={"gnss_position": ((2.0, 3.0), (20.0, 30.0))},
    )
    said = list_unused_noise(noise, solution)
    assert [get_key(one) for one in said] == [f"noise.file.{what}" for what in ("unused", "rows", "spans")]
    assert "odometer" in said[0]
    assert [re.findall(r"\d+", one) for one in said[1:]] == [["1", "2"]] * 2
    assert list_unused_noise(NoiseModel({"gnss_position.up": VarianceComponent(0.0)}), solution) == []
