"""Figures hold the data given to them, where plotly looks for it."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from graphnav.detectors.base import Detection
from graphnav.estimation.solution import ConstraintRecord
from graphnav.recording import Imu, Recording
from graphnav.report import plots

go = pytest.importorskip("plotly.graph_objects")

START, COUNT = 1000.0, 600


def record(m=3, seed=1):
    white = np.random.default_rng(seed).normal(size=(COUNT, m))
    weight = np.ones(COUNT)
    weight[50], white[50] = 0.0, 40.0
    weight[60:63] = 0.3
    t = START + np.arange(COUNT) + 1.0
    axes = ("east", "north", "up")[:m]
    return ConstraintRecord(
        "innovation", t, 0.5 * white, np.full((COUNT, m), 0.5), (white**2).sum(1), weight, axes, "m"
    )


def drawn_as(figure, label):
    return [trace for trace in figure.data if trace["name"] == label]


def numbers(packed):
    """What plotly will read from a typed array."""
    return np.frombuffer(base64.b64decode(packed["bdata"]), dtype=packed["dtype"]).astype(float)


def x_of(trace):
    return numbers(trace["x"]).tolist()


def y_of(trace):
    return numbers(trace["y"])


def y_range(figure, k=0):
    return figure.json["layout"][f"yaxis{k + 1 if k else ''}"]["range"]


def detected():
    rng = np.random.default_rng(5)
    t = START + np.arange(1, 6001) / 10
    imu = Imu(t, rng.normal(size=(6000, 3)), rng.normal(9.8, 1.0, size=(6000, 3)))
    at = START + np.arange(1.0, 600.0)
    spectrum = {
        "spectrogram": np.outer(np.linspace(1.0, 10.0, len(at)), np.ones(20)),
        "spectrogram_t": at,
        "spectrogram_frequency": np.linspace(0.0, 57.0, 20),
        "idle_line": np.array([26.0, 25.0, 27.0]),
    }
    spans = START + np.array([[100.0, 150.0], [300.0, 320.0]])
    low_band = Detection("low_band_glrt", at, rng.uniform(0.1, 100.0, len(at)), 3.0, at > 0, spans)
    fft = replace(low_band, name="fft", threshold=1.0, details=spectrum)
    return Recording("drive", "vehicle", imu), (low_band, fft, replace(low_band, name="fused"))


T = np.arange(COUNT, dtype=float)
THREE = np.random.default_rng(0).normal(size=(COUNT, 3))
FIXES = plots.DrawnFixes(T, THREE, T > 590, {"fixed": T < 300, "float": T >= 300})
END = float(COUNT)
EVERY = {
    "way": lambda: plots.plot_trajectory(
        {"batch": (T, THREE[:, :2]), "ekf": (T, THREE[:, :2] + 1)},
        fixes=FIXES,
        truth=THREE[:, :2],
        spans={"withheld": [(10, 50)], "no GNSS": [(100, 140)]},
        stops=[(200, 220)],
    ),
    "profile": lambda: plots.plot_profile({"batch": (T, THREE[:, 2])}, {"fixed": (T, THREE[:, 2])}),
    "bands": lambda: plots.plot_bands(
        {"rts": plots.Curve(T, THREE, np.ones((COUNT, 3)))}, ("a", "b", "c"), "m", END, spans={"withheld": [(3, 9)]}
    ),
    "sigmas": lambda: plots.plot_sigmas(
        {"unknown solver": plots.Curve(T, np.abs(THREE))}, ("a", "b", "c"), "m/s", END, spans={}
    ),
    "zoom": lambda: plots.plot_span_zoom({"ekf": plots.Curve(T, THREE[:, :1] ** 2)}, [(100, 200), (300, 340)]),
    "residuals": lambda: plots.plot_residuals(record(), START, END, "ekf", spans={"excluded": [(90, 99)]}),
    "nees": lambda: plots.plot_nees({"ekf": plots.Curve(T, THREE**2)}, ("p", "v", "rph"), (3, 3, 3), END, spans={}),
    "timeline": lambda: plots.plot_timeline({"gnss": record(), "nhc": record(2)}, START, END, "ekf", spans={}),
    "detections": lambda: plots.plot_detections(*detected()),
}


# --------------------------------------------------------------------------------------------------------- thinning
def test_thin_keeps_extremes_ends_and_breaks():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 1000, 50_000))
    y = rng.normal(size=len(t))
    y[123], y[45_678] = 99.0, -99.0
    y[20_000:20_100] = np.nan
    rows = plots.thin(t, y, 200)
    assert len(rows) <= 4 * 200 + 1
    assert (np.diff(rows) > 0).all()
    assert {0, 123, 45_678, len(t) - 1, 20_000} <= set(rows.tolist())
    column = np.minimum((t - t[0]) * 200 / (t[-1] - t[0]), 199).astype(int)
    for c in range(200):
        inside, kept = y[column == c], y[rows[column[rows] == c]]
        assert np.nanmin(kept) == np.nanmin(inside)
        assert np.nanmax(kept) == np.nanmax(inside)


def test_thin_leaves_short_series_and_survives_odd_ones():
    np.testing.assert_array_equal(plots.thin(np.arange(9.0), np.ones(9)), np.arange(9))
    assert len(plots.thin(np.zeros(9999), np.arange(9999.0), 10)) >= 2
    assert len(plots.thin(np.arange(9999.0), np.full(9999, np.nan), 10)) >= 1


def test_long_series_are_thinned_and_keep_their_spikes():
    t = np.arange(200_000.0)
    y = np.sin(t / 1e4)
    y[77_777] = 9.0
    figure = plots.plot_bands({"ekf": plots.Curve(t, y[:, None])}, ("east",), "m", t[-1], spans={})
    (drawn,) = drawn_as(figure, "ekf")
    assert len(x_of(drawn)) <= 4 * plots.BINS
    assert 77_777.0 in x_of(drawn)


def test_lines_and_bands_do_not_lead_across_gaps():
    t = np.concatenate([np.arange(100.0), 500 + np.arange(100.0)])
    value = np.ones((200, 1))
    figure = plots.plot_bands({"ekf": plots.Curve(t, value, value)}, ("east",), "m", t[-1], spans={})
    (line,) = drawn_as(figure, "ekf")
    assert np.flatnonzero(np.isnan(y_of(line))).tolist() == [100]
    (band,) = drawn_as(figure, "3 sigma")
    x, y = numbers(band["x"]), y_of(band)
    assert np.isnan(x).sum() == np.isnan(y).sum() == 1
    assert not ((x > 99) & (x < 500)).any()


# ----------------------------------------------------------------------------------------------------------- figures
def test_bands_draw_the_values_given():
    figure = plots.plot_bands(
        {"batch": plots.Curve(T, THREE, np.full((COUNT, 3), 2.0))}, ("east", "north", "up"), "m", END, spans={}
    )
    drawn = drawn_as(figure, "batch")
    assert [line["yaxis"] for line in drawn] == ["y", "y2", "y3"]
    assert {line["xaxis"] for line in drawn} == {"x"}
    for k, line in enumerate(drawn):
        assert x_of(line) == T.tolist()
        np.testing.assert_allclose(y_of(line), THREE[:, k], rtol=1e-6)
    assert set(y_of(drawn_as(figure, "3 sigma")[0])) == {6.0, -6.0}


def test_a_spike_does_not_set_the_scale_but_what_lies_in_a_span_does():
    value = np.random.default_rng(2).normal(size=(COUNT, 1))
    value[100] = 500.0
    series = {"ekf": plots.Curve(T, value)}
    figure = plots.plot_bands(series, ("east",), "m", END, spans={})
    assert np.abs(np.delete(value, 100)).max() <= y_range(figure)[1] < 10.0
    assert 500.0 in y_of(drawn_as(figure, "ekf")[0])  # it is there to zoom out to
    inside = plots.plot_bands(series, ("east",), "m", END, spans={"withheld": [(90.0, 110.0)]})
    assert y_range(inside)[1] > 500.0


def test_the_first_sigma_of_a_filter_does_not_set_the_scale():
    value, sigma = np.zeros((COUNT, 1)), np.full((COUNT, 1), 0.1)
    sigma[0] = 1000.0
    low, high = y_range(plots.plot_bands({"ekf": plots.Curve(T, value, sigma)}, ("up",), "m", END, spans={}))
    assert 0.3 < high < 0.4
    assert low == -high


def test_trajectory_is_to_scale_and_marks_what_happened():
    enu = np.stack([3 * T, T, T], -1)
    out = (T == 7) | (T == 9)
    figure = plots.plot_trajectory(
        {"batch": (T, enu[:, :2])}, fixes=plots.DrawnFixes(T, enu + 1, out, {"fixed": T < 100, "single": T >= 100}),
        spans={"withheld": [(10, 20)], "no GNSS": [(30, 33)]}, stops=[(40, 42)],
    )  # fmt: skip
    assert figure.json["layout"]["yaxis"]["scaleanchor"] == "x"
    assert figure.json["layout"]["yaxis"]["scaleratio"] == 1
    (line,) = drawn_as(figure, "batch")
    np.testing.assert_array_equal(np.stack([x_of(line), y_of(line)], -1), enu[:, :2])
    np.testing.assert_array_equal(numbers(line["customdata"]), T)
    under = {what: numbers(drawn_as(figure, what)[0]["x"]) for what in ("withheld", "no GNSS")}
    np.testing.assert_array_equal(under["withheld"][:9], enu[11:20, 0])
    np.testing.assert_array_equal(under["no GNSS"][:2], enu[31:33, 0])
    times = {kind: numbers(drawn_as(figure, kind)[0]["customdata"]).tolist() for kind in ("fixed", "single")}
    gone = numbers(drawn_as(figure, "excluded fix")[0]["customdata"]).tolist()
    assert gone == [7.0, 9.0]
    assert times == {"fixed": [t for t in range(100) if t not in (7, 9)], "single": list(range(100, COUNT))}
    (stop,) = drawn_as(figure, "stop")
    assert (x_of(stop), y_of(stop).tolist(), numbers(stop["customdata"]).tolist()) == ([123.0], [41.0], [40.0])


@pytest.mark.parametrize(("over", "up"), [(30.0, 0.0), (-30.0, 2.0), (25.0, -10.0), (0.0, -25.0), (0.0, 25.0)])
def test_labels_of_ends_that_are_near_do_not_cover_each_other(over: float, up: float) -> None:
    way = np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 500.0], [over, up]])
    notes = [
        note for note in plots.plot_trajectory({"batch": (T[:4], way)}).annotations if note["text"] in ("start", "end")
    ]
    (low, high) = sorted((note["y"] + note["yshift"], note["y"]) for note in notes)  # a metre is about a pixel
    assert high[0] - low[0] >= 14.0  # a line of text
    assert high[1] >= low[1]


def test_scale_bar_is_as_long_as_it_says():
    figure = plots.plot_trajectory({"batch": (T, np.stack([3 * T, T], -1))})
    words = next(note["text"] for note in figure.annotations if note["text"].endswith((" m", " km")))
    (bar,) = [shape for shape in figure.shapes if shape["type"] == "line"]
    metres = float(words.split()[0]) * (1000 if words.endswith("km") else 1)
    assert bar["x1"] - bar["x0"] == pytest.approx(metres, rel=1e-9)


def test_residuals_mark_what_was_rejected_and_weakened():
    figure = plots.plot_residuals(record(), START, END, "ekf", spans={})
    assert [x_of(m) for m in drawn_as(figure, "rejected")] == [[51.0]] * 4
    assert x_of(drawn_as(figure, "weight < 0.5")[0]) == [61.0, 62.0, 63.0]
    # three components, and the NIS with the middle 99 % of chi-square (tables: 0.0717, 12.84)
    assert len(drawn_as(figure, "used")) == 4
    (band,) = drawn_as(figure, "99 % of chi-square")
    assert sorted(set(y_of(band))) == pytest.approx([0.07172, 12.838], rel=1e-4)


def test_nees_is_drawn_per_degree_of_freedom():
    series = {"ekf": plots.Curve(T, np.full((COUNT, 2), 6.0))}
    figure = plots.plot_nees(series, ("position", "attitude"), (2, 3), END, spans={})
    assert [set(y_of(line)) for line in drawn_as(figure, "ekf")] == [{3.0}, {2.0}]


def test_timeline_has_a_row_per_constraint():
    figure = plots.plot_timeline({"gnss": record(), "nhc": record(2)}, START, 700.0, "ekf", spans={})
    layout = figure.json["layout"]
    assert layout["xaxis"]["range"] == [0.0, 700.0]
    assert (layout["yaxis"]["tickvals"], layout["yaxis"]["ticktext"]) == ([1.0, 0.0], ["gnss", "nhc"])
    assert [(set(y_of(m)), x_of(m)) for m in drawn_as(figure, "rejected")] == [({1.0}, [51.0]), ({0.0}, [51.0])]


def test_detections_show_statistics_thresholds_and_the_idle_line():
    recording, found = detected()
    figure = plots.plot_detections(recording, found)
    assert [y_of(line)[0] for line in drawn_as(figure, "threshold: stationary below")] == [3.0, 1.0]
    tints = [(shape["yref"], shape["x0"], shape["x1"]) for shape in figure.shapes]
    ahead = START - recording.start
    # force, rate and two statistics: nothing measures a speed
    assert tints == [
        (f"y{k} domain" if k > 1 else "y domain", a + ahead, b + ahead)
        for k in (1, 2, 3, 4) for a, b in ((100.0, 150.0), (300.0, 320.0))
    ]  # fmt: skip
    (image,) = [trace for trace in figure.data if trace["type"] == "heatmap"]
    z = numbers(image["z"]).reshape([int(n) for n in image["z"]["shape"].split(",")])
    assert z.shape == (len(y_of(image)), len(x_of(image)))
    assert (np.diff(z[0]) >= 0).all()
    assert any(note["text"] == "idle line 26.0 Hz" for note in figure.annotations)
    lines = [y_of(t)[0] for t in figure.data if t["yaxis"] == "y5" and t["type"] == "scatter"]
    assert lines == [26.0, 52.0]


def test_span_zoom_has_a_panel_per_span():
    t = np.arange(1000.0)
    figure = plots.plot_span_zoom({"ekf": plots.Curve(t, t[:, None])}, [(100, 200), (400, 440), (700, 760)])
    drawn = drawn_as(figure, "ekf")
    assert [(x_of(d)[0], x_of(d)[-1]) for d in drawn] == [(65, 235), (386, 454), (679, 781)]
    assert [d["xaxis"] for d in drawn] == ["x", "x2", "x3"]
    assert not figure.time  # each has a range of its own


def test_everything_is_named_once_for_the_legend():
    figure = EVERY["bands"]()
    assert [trace["name"] for trace in figure.data if trace["showlegend"]] == ["withheld", "3 sigma", "rts"]


@pytest.mark.parametrize("name", EVERY)
def test_plotly_takes_every_figure(name):
    """Validated by plotly's own classes; the colours are those of the page."""
    figure = EVERY[name]()
    text = json.dumps(figure.json)
    assert "NaN" not in text
    names = set(re.findall(r"var\(--([\w-]+)\)", text))
    assert names <= {*plots.PALETTE, "soft", "card", "edge", "words", plots.name_variable("unknown solver")[2:]}
    go.Figure(json.loads(re.sub(r"var\(--[\w-]+\)([0-9a-f]{2})?", "#112233", text)))


def test_figures_load_no_plotting_library():
    code = (
        "import sys, numpy as np, graphnav.report.documents, graphnav.report.plots as p\n"
        "p.plot_bands({'ekf': p.Curve(np.arange(3.0), np.ones((3, 1)))}, ('a',), 'm', 2.0, spans={}).json\n"
        "assert not {'matplotlib', 'plotly'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
