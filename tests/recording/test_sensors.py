"""A declared sensor is read, checked, cut, withheld, written and sent by its declaration alone."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import oracle
import pytest
from helpers import refuse_command, refused

from graphnav.app import cli
from graphnav.app.convert import convert_log
from graphnav.app.withholding import parse_withheld
from graphnav.config import Settings, format_settings, parse_settings, read_settings
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.online import Sensors, drop_rows, list_rows
from graphnav.online.lines import format_head, format_line, parse_row, parse_setup
from graphnav.online.rows import Reading
from graphnav.recording import Recording
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import read
from graphnav.recording.formats.writer import write_folder
from graphnav.sensors import Sensor, list_sensors, register


@pytest.fixture(scope="module")
def drive() -> Recording:
    made, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0), seed=3)
    made = made.crop(0.0, 20.0)
    rng, series = np.random.default_rng(1), {}
    for name, sensor in list_sensors().items():
        t = np.arange(made.start + 0.1, made.end, 0.25)
        columns = {c.name: c.lowest + (c.highest - c.lowest) * rng.uniform(0.1, 0.9, len(t)) for c in sensor.columns}
        optional = [c for c in sensor.names if all(c not in some for some in sensor.needs)]
        for column in optional:
            columns[column][::3] = np.nan
        series[name] = sensor.make_series(t, columns)
    return replace(made, sensors=series)


def same(a: Recording, b: Recording) -> None:
    assert a.sensors.keys() == b.sensors.keys()
    for name, series in a.sensors.items():
        np.testing.assert_array_equal(series.t, b.sensors[name].t)
        np.testing.assert_allclose(series.values, b.sensors[name].values, rtol=1e-14)
        assert series.figures == b.sensors[name].figures


def test_written_and_read_again(drive, tmp_path):
    write_folder(drive, tmp_path / "a")
    same(drive, read(tmp_path / "a"))
    convert_log(str(tmp_path / "a"), tmp_path / "b", None)
    same(drive, read(tmp_path / "b"))


def test_read_from_a_file_it_can_be_stored_as_a_checkpoint_does(drive, tmp_path):
    """Reading makes a model of its table, which cannot be."""
    write_folder(drive, tmp_path)
    again = pickle.loads(pickle.dumps(read(tmp_path)))
    same(drive, again)
    assert all(series.sensor.table.model_fields for series in again.sensors.values())


@pytest.mark.parametrize("name", sorted(list_sensors()))
def test_cut_withheld_and_summed_up(drive, name):
    t = drive.sensors[name].t - drive.start
    part = drive.crop(4.0, 12.0)
    assert len(part.sensors[name]) == np.sum((t >= 4.0) & (t <= 12.0))
    left = drive.without(*parse_withheld(f"{name}:5-9"))
    assert len(left.sensors[name]) == np.sum((t < 5.0) | (t > 9.0))
    assert name not in drive.without(name).sensors
    assert inspect(drive).facts[name]["rows"] == len(t)


@pytest.mark.parametrize("name", sorted(list_sensors()))
def test_what_cannot_be_read_is_left_out_or_refused(drive, name):
    series = drive.sensors[name]
    sensor = series.sensor
    column = sensor.names.index(sensor.needs[0][0])
    spiked, all_wrong = series.values.copy(), series.values.copy()
    spiked[3] = np.nan
    spiked[3, column] = 2.0 * sensor.columns[column].highest
    all_wrong[:, column] = 2.0 * sensor.columns[column].highest
    found = inspect(replace(drive, sensors={name: replace(series, values=spiked)}))
    assert len(found.recording.sensors[name]) == len(series) - 1
    assert f"{name}.bounds" in {f.key for f in found.findings}
    with refused(f"{name}.unit", RecordingError):
        inspect(replace(drive, sensors={name: replace(series, values=all_wrong)})).refuse()


def test_rows_of_the_line_protocol(drive):
    setup = parse_setup(format_head(drive))
    same(replace(drive, sensors=drop_rows(drive).sensors), setup)
    sensors = Sensors(setup)
    for row in list_rows(drive)[1]:
        back = parse_row(format_line(row))
        assert back[0] == row[0]
        np.testing.assert_allclose(back[1:][1], row[2], rtol=1e-14)
        if row[0] in drive.sensors or row[0] == "imu":
            assert sensors.add(*back)
            if row[0] in drive.sensors:
                assert not sensors.add(*back), "the same again"
    same(drive, sensors.make_recording())
    for wrong, name in (
        ("S,barometr,1.0,2.0,", "'barometr'"),
        ("S,barometer,1.0", "'S,barometer'"),
        ("S,barometer,1.0,x,", "'S,barometer,1.0,x,'"),
        ("S", "''"),
    ):
        with pytest.raises(ValueError, match=re.escape(name)):
            parse_row(wrong)
    with refused("row.bounds", RecordingError):
        Reading(1.0, list_sensors()["barometer"], pressure=1.0)
    assert Reading(1.0, list_sensors()["barometer"], pressure=1e5)[0] == "barometer"


@pytest.mark.parametrize(
    ("table", "key", "name"),
    [
        ("[barometr]\nfile = 'b.csv'\n", "key.unknown", "barometer"),
        ("[barometer]\nfile = 'b.csv'\nsigmas = 1.0\n", "key.unknown", "sigma"),
        ("[barometer]\nfile = 'b.csv'\nunits = { pressure = 'bar' }\n", "key.value", "hPa"),
        ("[barometer]\nfile = 'b.csv'\ncolumns = { pressur = 'p' }\n", "key.value", "pressure"),
        ("[barometer]\nfile = 'none.csv'\n", "file.missing", "none.csv"),
        ("[barometer]\nfile = 'b.csv'\n", "table.column", "pressure"),
    ],
)
def test_a_table_that_cannot_be_used(drive, tmp_path, table, key, name):
    write_folder(replace(drive, sensors={}), tmp_path)
    (tmp_path / "b.csv").write_text("t,p\n1.0,1000.0\n2.0,1001.0\n")
    with (tmp_path / "recording.toml").open("a") as file:
        file.write(f"\n{table}")
    with refused(key, RecordingError, name):
        read(tmp_path)


def test_columns_and_units_of_a_file(drive, tmp_path):
    write_folder(replace(drive, sensors={}), tmp_path)
    (tmp_path / "b.csv").write_text("t,p\n1.0,1000.0\n2.0,\n3.0,1001.0\n")
    with (tmp_path / "recording.toml").open("a") as file:
        file.write("\n[barometer]\nfile = 'b.csv'\ncolumns = { pressure = 'p' }\n")
        file.write("units = { pressure = 'hPa' }\ntime_offset = 0.5\n")
    series = read(tmp_path).sensors["barometer"]
    np.testing.assert_allclose(series.t, [1.5, 3.5])
    np.testing.assert_allclose(series["pressure"], [1e5, 1.001e5])


def test_settings_of_a_sensor(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text(format_settings(parse_settings({"sensors": {"barometer": {"use": False}}})))
    assert not read_settings(file).get_sensor("barometer").use
    assert Settings().get_sensor("barometer").use
    with refused("key.value", ConfigError, "barometer"):
        parse_settings({"sensors": {"barometre": {}}})


def test_a_name_that_is_taken():
    with refused("sensor.name_taken", RecordingError, "gnss"):
        register(Sensor("gnss", "", list_sensors()["barometer"].columns, (("height",),)))


def test_a_command_with_a_sensor_withheld(drive, tmp_path, capsys):
    t = np.arange(drive.start + 0.1, drive.end, 0.25)
    flat = list_sensors()["barometer"].make_series(t, {"height": np.full(len(t), 20.0)})
    write_folder(replace(drive, sensors={"barometer": flat}), tmp_path / "in")
    out = tmp_path / "out"
    command = ["smooth", str(tmp_path / "in"), "-o", str(out), "--solver", "ekf", "--no-report", "--noise", "stated"]
    assert cli.run([*command, "--without", "barometer:5-8"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert 0 < summary["counts"]["barometer"] < summary["keyframes"] - 3  # that many fall into the span
    found = json.loads((out / "calibration.json").read_text())
    assert "barometer_offset" in found
    assert all(len(one["names"]) == len(one["prior_sigma"]) for one in found.values())
    capsys.readouterr()
    assert "barometer" in refuse_command(capsys, "option.withheld", *command, "--without", "barometre")
