"""Drawings hold the data given to them, and each of the three ways to show them puts it where it belongs."""

from __future__ import annotations

import base64
import io
import itertools
import re
import subprocess
import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.image import imread

from graphnav import panels, plots
from graphnav.detectors.base import Detection
from graphnav.panels import interactive, still, svg
from graphnav.panels.drawing import FINE
from graphnav.recording import Imu, Recording
from graphnav.solution import ConstraintRecord

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


def drawn_as(drawing, label):
    return [item for panel in drawing.panels for item in panel.items if item.label == label]


def numbers(packed):
    """What plotly will read from a typed array."""
    return np.frombuffer(base64.b64decode(packed["bdata"]), dtype=packed["dtype"]).astype(float)


def detected():
    rng = np.random.default_rng(5)
    t = START + np.arange(1, 6001) / 10
    imu = Imu(t, rng.normal(size=(6000, 3)), rng.normal(9.8, 1.0, size=(6000, 3)))
    at = START + np.arange(1.0, 600.0)
    spectrum = {
        "spectrogram": np.outer(np.linspace(1.0, 10.0, len(at)), np.ones(20)),
        "spectrogram_rows": np.arange(len(at)),
        "spectrogram_frequency": np.linspace(0.0, 57.0, 20),
        "idle_line": np.array([26.0, 25.0, 27.0]),
    }
    spans = START + np.array([[100.0, 150.0], [300.0, 320.0]])
    low_band = Detection("low_band_glrt", at, rng.uniform(0.1, 100.0, len(at)), 3.0, at > 0, spans)
    fft = replace(low_band, name="fft", threshold=1.0, details=spectrum)
    return Recording("drive", "vehicle", imu), (low_band, fft, replace(low_band, name="fused"))


T = np.arange(COUNT, dtype=float)
THREE = np.random.default_rng(0).normal(size=(COUNT, 3))
EVERY = {
    "way": lambda: plots.trajectory(
        {"batch": (T, THREE[:, :2]), "ekf": (T, THREE[:, :2] + 1)},
        fixes=plots.Fixes(T, THREE[:, :2], T > 590),
        truth=THREE[:, :2],
        spans={"withheld": [(10, 50)], "no GNSS": [(100, 140)]},
        stops=[(200, 220)],
    ),
    "bands": lambda: plots.bands(
        {"rts": plots.Series(T, THREE, np.ones((COUNT, 3)))}, ("a", "b", "c"), "m", spans={"withheld": [(3, 9)]}
    ),
    "sigmas": lambda: plots.sigmas({"unknown solver": plots.Series(T, np.abs(THREE))}, ("a", "b", "c"), "m/s"),
    "zoom": lambda: plots.span_zoom({"ekf": plots.Series(T, THREE[:, :1] ** 2)}, [(100, 200), (300, 340)]),
    "residuals": lambda: plots.residuals(record(), START, "ekf", spans={"excluded": [(90, 99)]}),
    "nees": lambda: plots.nees({"ekf": plots.Series(T, THREE**2)}, ("p", "v", "rph"), (3, 3, 3)),
    "timeline": lambda: plots.timeline({"gnss": record(), "nhc": record(2)}, START, START + COUNT, "ekf"),
    "detections": lambda: plots.detections(*detected()),
}


# --------------------------------------------------------------------------------------------------------- thinning
def test_thin_keeps_extremes_ends_and_breaks():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 1000, 50_000))
    y = rng.normal(size=len(t))
    y[123], y[45_678] = 99.0, -99.0
    y[20_000:20_100] = np.nan
    rows = panels.thin(t, y, 200)
    assert len(rows) <= 4 * 200 + 1
    assert (np.diff(rows) > 0).all()
    assert {0, 123, 45_678, len(t) - 1, 20_000} <= set(rows.tolist())
    column = np.minimum((t - t[0]) * 200 / (t[-1] - t[0]), 199).astype(int)
    for c in range(200):
        inside, kept = y[column == c], y[rows[column[rows] == c]]
        assert np.nanmin(kept) == np.nanmin(inside)
        assert np.nanmax(kept) == np.nanmax(inside)


def test_thin_leaves_short_series_and_survives_odd_ones():
    np.testing.assert_array_equal(panels.thin(np.arange(9.0), np.ones(9)), np.arange(9))
    assert len(panels.thin(np.zeros(9999), np.arange(9999.0), 10)) >= 2
    assert len(panels.thin(np.arange(9999.0), np.full(9999, np.nan), 10)) >= 1


def test_long_series_are_thinned_for_zooming_and_again_for_a_still_picture():
    t = np.arange(200_000.0)
    y = np.sin(t / 1e4)
    y[77_777] = 9.0
    (drawn,) = drawn_as(plots.bands({"ekf": plots.Series(t, y[:, None])}, ("east",), "m"), "ekf")
    assert len(drawn.x) <= 4 * FINE
    fewer = drawn.thinned(panels.BINS)
    assert len(fewer.x) <= 4 * panels.BINS
    assert 77_777.0 in drawn.x
    assert 77_777.0 in fewer.x


def test_lines_and_bands_do_not_lead_across_gaps():
    t = np.concatenate([np.arange(100.0), 500 + np.arange(100.0)])
    value = np.ones((200, 1))
    drawing = plots.bands({"ekf": plots.Series(t, value, value)}, ("east",), "m")
    (line,) = drawn_as(drawing, "ekf")
    assert np.flatnonzero(np.isnan(line.y)).tolist() == [100]
    np.testing.assert_array_equal(line.x[np.isfinite(line.y)], t)
    (tint,) = drawn_as(drawing, "3 sigma")
    assert np.flatnonzero(np.isnan(tint.y)).tolist() == [100]
    # and so in each way to show them
    path = re.search(r'<path d="([^"]*)"[^>]* style="fill: var\(--ekf\)', svg(drawing, "x"))
    assert path.group(1).count("M") == path.group(1).count("z") == 2
    (band,) = [trace for trace in interactive.figure(drawing)["data"] if trace["name"] == "3 sigma"]
    x, y = numbers(band["x"]), numbers(band["y"])
    assert np.isnan(x).sum() == np.isnan(y).sum() == 1
    assert not ((x > 99) & (x < 500)).any()


# ---------------------------------------------------------------------------------------------------------- drawings
def test_bands_draw_the_values_given():
    drawing = plots.bands({"batch": plots.Series(T, THREE, np.full((COUNT, 3), 2.0))}, ("east", "north", "up"), "m")
    drawn = drawn_as(drawing, "batch")
    assert len(drawn) == 3
    for k, line in enumerate(drawn):
        np.testing.assert_array_equal(line.x, T)
        np.testing.assert_array_equal(line.y, THREE[:, k])
    (tint, _, _) = drawn_as(drawing, "3 sigma")
    assert set(tint.y) == {6.0}
    assert set(tint.low) == {-6.0}


def test_the_scale_shows_every_value_but_not_the_first_sigma():
    value, sigma = np.zeros((COUNT, 1)), np.full((COUNT, 1), 0.1)
    value[7], sigma[0] = 5.0, 1000.0
    (panel,) = plots.bands({"ekf": plots.Series(T, value, sigma)}, ("heading",), "deg").panels
    assert 5.0 < panel.ylim[1] < 6.0
    assert panel.ylim[0] == -panel.ylim[1]


def test_trajectory_is_to_scale_and_marks_what_happened():
    en = np.stack([3 * T, T], -1)
    drawing = plots.trajectory(
        {"batch": (T, en)}, fixes=plots.Fixes(T, en + 1, (T == 7) | (T == 9)),
        spans={"withheld": [(10, 20)], "no GNSS": [(30, 33)]}, stops=[(40, 42)],
    )  # fmt: skip
    (panel,) = drawing.panels
    per_point = [(panel.xlim[1] - panel.xlim[0]) / panel.box[2], (panel.ylim[1] - panel.ylim[0]) / panel.box[3]]
    assert per_point[0] == pytest.approx(per_point[1], rel=1e-12)
    (line,) = drawn_as(drawing, "batch")
    np.testing.assert_array_equal(np.stack([line.x, line.y], -1), en)
    np.testing.assert_array_equal(line.hover, T)
    under = {what: one.x[np.isfinite(one.x)] for what in ("withheld", "no GNSS") for one in drawn_as(drawing, what)}
    np.testing.assert_array_equal(under["withheld"], en[11:20, 0])
    np.testing.assert_array_equal(under["no GNSS"], en[31:33, 0])
    (gone,) = drawn_as(drawing, "excluded fix")
    assert gone.hover.tolist() == [7.0, 9.0]
    assert not set(gone.hover) & set(drawn_as(drawing, "GNSS fix")[0].hover)
    (stop,) = drawn_as(drawing, "stop")
    assert (stop.x.tolist(), stop.y.tolist(), stop.hover.tolist()) == ([123.0], [41.0], [40.0])


def test_scale_bar_is_as_long_as_it_says():
    drawing = plots.trajectory({"batch": (T, np.stack([3 * T, T], -1))})
    (panel,) = drawing.panels
    words = next(label.words for label in panel.labels if label.words.endswith((" m", " km")))
    bar = next(item for item in panel.items if item.size == 2.5)
    metres = float(words.split()[0]) * (1000 if words.endswith("km") else 1)
    assert np.ptp(bar.x) == pytest.approx(metres, rel=1e-12)


def test_residuals_mark_what_was_rejected_and_weakened():
    drawing = plots.residuals(record(), START, "ekf")
    marks = drawn_as(drawing, "rejected")
    assert [m.x.tolist() for m in marks] == [[51.0]] * 4
    assert drawn_as(drawing, "weight < 0.5")[0].x.tolist() == [61.0, 62.0, 63.0]
    # three components, and the NIS
    assert len(drawn_as(drawing, "used")) == 4


def test_nis_histogram_is_a_density_of_what_was_used():
    drawing = plots.residuals(record(), START, "ekf")
    (bars,) = drawn_as(drawing, "measured NIS")
    area = np.sum(np.diff(bars.x) * bars.y[:-1])
    inside = np.delete(record().nis, 50) < bars.x[-1]
    assert area == pytest.approx(inside.mean(), rel=1e-9)
    # the middle 99 % of chi-square with three degrees of freedom (tables: 0.0717, 12.84)
    (band,) = drawn_as(drawing, "99 % of chi-square")
    np.testing.assert_allclose([band.low[0], band.y[0]], [0.07172, 12.838], rtol=1e-4)


def test_nees_is_drawn_per_degree_of_freedom():
    drawing = plots.nees({"ekf": plots.Series(T, np.full((COUNT, 2), 6.0))}, ("position", "attitude"), (2, 3))
    assert [set(line.y) for line in drawn_as(drawing, "ekf")] == [{3.0}, {2.0}]


def test_timeline_has_a_row_per_constraint():
    drawing = plots.timeline({"gnss": record(), "nhc": record(2)}, START, START + 700.0, "ekf")
    (panel,) = drawing.panels
    assert panel.xlim == (0.0, 700.0)
    assert panel.names == {1.0: "gnss", 0.0: "nhc"}
    assert [(set(m.y), m.x.tolist()) for m in drawn_as(drawing, "rejected")] == [({1.0}, [51.0]), ({0.0}, [51.0])]


def test_detections_show_statistics_thresholds_and_the_idle_line():
    recording, found = detected()
    drawing = plots.detections(recording, found)
    assert [line.y[0] for line in drawn_as(drawing, "threshold: below it stands")] == [3.0, 1.0]
    tints = drawn_as(drawing, "stands")
    assert len(tints) == 4  # force, rate and two statistics: nothing measures a speed
    starts = recording.start
    np.testing.assert_allclose(tints[0].x, START + np.array([100, 150, 150, 300, 320, 320]) - starts)
    spectrogram = drawing.panels[-1]
    (image,) = [item for item in spectrogram.items if item.kind == "map"]
    assert image.values.shape == (len(image.y), len(image.x))
    assert (np.diff(image.values[0]) >= 0).all()
    assert any(label.words == "idle line 26.0 Hz" for label in spectrogram.labels)
    assert sum(item.dash and item.y[0] in (26.0, 52.0) for item in spectrogram.items) == 2


def test_span_zoom_has_a_panel_per_span():
    t = np.arange(1000.0)
    drawing = plots.span_zoom({"ekf": plots.Series(t, t[:, None])}, [(100, 200), (400, 440), (700, 760)])
    drawn = drawn_as(drawing, "ekf")
    assert [(d.x[0], d.x[-1]) for d in drawn] == [(65, 235), (386, 454), (679, 781)]


def test_legend_names_everything_once_areas_last():
    legend = EVERY["bands"]().legend
    assert [words for words, _, _ in legend] == ["rts", "3 sigma", "withheld"]
    assert [kind for _, _, kind in legend] == ["line", "band", "band"]


# ------------------------------------------------------------------------------------------------------------- ticks
@pytest.mark.parametrize(("lo", "hi"), [(-1e-6, 3e-6), (0.0, 1.0), (-3700.0, 12345.0), (1e7, 1.0001e7)])
def test_ticks_are_inside_and_told_apart(lo, hi):
    values, names = panels.ticks(lo, hi, 5)
    assert 2 <= len(values) <= 6
    assert values.min() >= lo - 1e-9 * (hi - lo)
    assert values.max() <= hi + 1e-9 * (hi - lo)
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(("lo", "hi"), [(-0.7, -0.2), (-3.1, -0.4), (-6.0, 5.5), (2.02, 2.08)])
def test_logarithmic_ticks_are_at_least_two_and_say_what_they_are(lo, hi):
    values, names = panels.log_ticks(lo, hi)
    assert 2 <= len(values) <= 12
    assert ((values >= lo - 1e-9) & (values <= hi + 1e-9)).all()
    powers = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for value, name in zip(values, names, strict=True):
        read = float("1e" + name[2:].translate(powers)) if re.search("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]", name) else float(name)
        assert read == pytest.approx(10.0**value, rel=1e-5)


# ------------------------------------------------------------------------------------------------- the ways to show
@pytest.mark.parametrize("name", EVERY)
def test_svg_puts_things_where_the_panel_says(name):
    drawing = EVERY[name]()
    text = re.sub('href="data:[^"]*"', "", svg(drawing, "<what>"))
    assert text.startswith(f'<svg viewBox="0 0 {drawing.width:g} {drawing.height:g}"')
    assert "&lt;what&gt;" in text
    assert "nan" not in text
    assert "inf" not in text
    starts = np.array(re.findall(r' d="M (\S+) (\S+?)L', text), dtype=float)
    for panel in drawing.panels:
        x, y, w, h = panel.box
        for item in panel.items:
            if item.kind != "line" or panel.log:
                continue
            k = int(np.flatnonzero(np.isfinite(item.x) & np.isfinite(item.y))[0])
            across = x + (item.x[k] - panel.xlim[0]) / (panel.xlim[1] - panel.xlim[0]) * w
            down = drawing.height - y - (item.y[k] - panel.ylim[0]) / (panel.ylim[1] - panel.ylim[0]) * h
            assert np.abs(starts - [across, down]).max(axis=1).min() < 0.02


def test_svg_follows_the_page():
    """Its colours and its font are those of the page, and nothing in it is named as something in another drawing."""
    names = []
    for name, make in EVERY.items():
        text = re.sub('href="data:[^"]*"', "", svg(make(), name))
        assert not re.search("#[0-9a-f]{6}|font-family|<style|<metadata", text)
        names += re.findall(r' id="([^"]*)"', text)
    assert len(names) == len(set(names))


def test_svg_keeps_words_and_numbers_as_they_are():
    drawing = panels.Drawing(100.0)
    drawing.panel((50, 20, 300, 60), (0.0, 1.0), (0.0, 1.0), title="a < b, 0.123456", names={0.5: "#d55e00"})
    text = svg(drawing, "x")
    assert "a &lt; b, 0.123456" in text
    assert ">#d55e00<" in text


def test_svg_draws_logarithmic_axes():
    drawing = plots.sigmas({"rts": plots.Series(np.arange(3.0), np.array([[0.01], [0.3], [1.0]]))}, ("east",), "m")
    line = re.search(r'<path d="M ([^"]*)"[^>]* style="fill: none; stroke: var\(--rts\)', svg(drawing, "x")).group(1)
    heights = [float(pair.split()[1]) for pair in line.split("L")]
    decade = (heights[0] - heights[2]) / 2
    assert decade > 5
    assert heights[1] - heights[2] == pytest.approx(-np.log10(0.3) * decade, abs=0.02)


def test_spectrogram_is_an_image():
    data = base64.b64decode(
        re.search(r'href="data:image/png;base64,([^"]*)"', svg(EVERY["detections"](), "x")).group(1)
    )
    image = imread(io.BytesIO(data), format="png")
    # the spectrogram rises with time: from the darkest to the lightest colour
    middle = image.shape[0] // 2
    np.testing.assert_allclose(image[middle, 1, :3], colormaps["viridis"](0.0)[:3], atol=0.02)
    np.testing.assert_allclose(image[middle, -2, :3], colormaps["viridis"](1.0)[:3], atol=0.02)


@pytest.mark.parametrize("name", EVERY)
def test_plotly_takes_the_figure_and_its_numbers(name):
    drawing = EVERY[name]()
    made = interactive.figure(drawing)
    # the colours are the page's, which plotly's own check does not know
    plain = interactive.json.loads(re.sub(r"var\(--[\w-]+\)", "#123456", interactive.text(drawing)))
    go.Figure(plain)
    assert len(made["data"]) == sum(len(panel.items) for panel in drawing.panels)
    shown = iter(made["data"])
    for panel in drawing.panels:
        for item in sorted(panel.items, key=lambda item: item.z):
            trace = next(shown)
            assert trace["legendgroup"] == item.label
            if item.kind in ("line", "dots", "marks"):
                np.testing.assert_allclose(numbers(trace["x"]), item.x, rtol=1e-6)
                np.testing.assert_allclose(numbers(trace["y"]), item.y, rtol=1e-6)
    assert interactive.text(drawing).count("</") == 0


def test_plotly_panels_share_time_and_keep_the_map_to_scale():
    layout = interactive.figure(EVERY["bands"]())["layout"]
    assert {key for key in layout if key.startswith("xaxis")} == {"xaxis"}
    assert {key for key in layout if key.startswith("yaxis")} == {"yaxis", "yaxis2", "yaxis3"}
    domains = [layout[key]["domain"] for key in ("yaxis3", "yaxis2", "yaxis")]
    assert domains[0][0] == pytest.approx(0.0, abs=1e-9)
    assert all(a[1] < b[0] for a, b in itertools.pairwise(domains))
    assert domains[2][1] == pytest.approx(1.0, abs=1e-9)
    assert layout["xaxis"]["anchor"] == "y3"
    assert interactive.figure(EVERY["way"]())["layout"]["yaxis"]["scaleanchor"] == "x"


@pytest.mark.parametrize("name", EVERY)
def test_any_drawing_can_be_saved(name, tmp_path):
    EVERY[name]().savefig(tmp_path / "x.png", dpi=50)
    assert (tmp_path / "x.png").read_bytes()[:4] == b"\x89PNG"


def test_matplotlib_draws_in_the_same_coordinates():
    drawing = plots.trajectory({"batch": (T, np.stack([3 * T, T], -1))})
    figure = still.figure(drawing)
    (line,) = figure.findobj(lambda artist: artist.get_label() == "batch")
    origin, east, north = line.get_transform().transform([[0, 0], [10, 0], [0, 10]])
    assert east[0] - origin[0] == pytest.approx(north[1] - origin[1], rel=1e-9)


def test_the_library_is_plotlys_own_deflated():
    own = (interactive.Path(go.__file__).parents[1] / "package_data" / "plotly.min.js").read_bytes()
    assert zlib.decompress(base64.b64decode(interactive.library())) == own


def test_pages_are_drawn_without_pyplot_and_plotly():
    code = (
        "import sys, numpy as np, graphnav.report, graphnav.plots as p; from graphnav import page\n"
        "assert 'matplotlib' not in sys.modules\n"
        "page.page('x', [], [('a', [page.picture(p.sigmas({'ekf': p.Series(np.arange(3.), np.ones((3, 1)))},"
        " ('e',), 'm'), 'x')])])\n"
        "p.sigmas({'ekf': p.Series(np.arange(3.), np.ones((3, 1)))}, ('e',), 'm').savefig(sys.argv[1])\n"
        "assert not {'matplotlib.pyplot', 'plotly'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, "/dev/null"], check=True)
