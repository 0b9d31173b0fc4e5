"""Figures hold the data given to them, and the pages hold the numbers, well formed and on their own."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from graphnav import page, panels, plots, rotation
from graphnav.earth import LocalFrame
from graphnav.metrics import Errors
from graphnav.recording import Gnss, Imu, Recording, Truth
from graphnav.report import write_comparison, write_report
from graphnav.report_tables import accuracy_row, consistency, span_row
from graphnav.solution import ConstraintRecord, ParameterEstimate, Solution
from graphnav.state import States

START, COUNT = 1000.0, 600
NAME = "drive <script>alert('x')</script> & \"co\""


def way(t):
    """A closed curve of some hundred metres, (N, 3)."""
    return np.stack([300 * np.sin(t / 90), 200 * np.sin(t / 45), 2 * np.cos(t / 60)], -1)


@pytest.fixture
def recording():
    t = START + np.arange(COUNT) + 1.0
    frame = LocalFrame(np.array([0.6, 0.2, 50.0]))
    llh = frame.to_llh(way(t - START))
    imu_t = START + np.arange(1, COUNT * 10 + 1) / 10
    imu = Imu(imu_t, np.zeros((len(imu_t), 3)), np.tile([0, 0, 9.8], (len(imu_t), 1)))
    gnss = Gnss(t, llh, np.ones((COUNT, 3)))
    return Recording(NAME, "vehicle", imu, gnss, truth=Truth(t, llh=llh), remarks=("3 rows < NaN were left out",))


def record(scale=1.0, kind="innovation", seed=1):
    rng = np.random.default_rng(seed)
    white = scale * rng.normal(size=(COUNT, 3))
    weight = np.ones(COUNT)
    weight[50], white[50] = 0.0, 40.0
    weight[60:63] = 0.3
    t = START + np.arange(COUNT) + 1.0
    return ConstraintRecord(
        kind, t, 0.5 * white, np.full((COUNT, 3), 0.5), (white**2).sum(1), weight, ("east", "north", "up"), "m"
    )


def solution(solver="ekf", offset=0.25):
    t = START + np.arange(COUNT) + 1.0
    zero = np.zeros((COUNT, 3))
    p = way(t - START) + np.array([offset, 0.0, 0.0])
    v = np.gradient(p, t, axis=0)
    R = rotation.exp(np.stack([zero[:, 0], zero[:, 0], t / 200], -1))
    sd = np.repeat([1e-3, 0.2, 0.02, 1e-2, 1e-5], 3)
    return Solution(
        solver,
        LocalFrame(np.array([0.6, 0.2, 50.0])),
        t,
        States(R, p, v, zero + 0.01, zero + 1e-4),
        np.tile(np.diag(sd**2), (COUNT, 1, 1)),
        parameters={
            "odometer_scale": ParameterEstimate(
                t[[0]], np.array([[1.0123]]), np.array([[0.0004]]), np.array([0.02]), "1"
            )
        },
        records={"gnss_position": record()},
        counts={"gnss_position": 599},
        iterations=4,
        cost=1237.3,
        stopped="the next step could lower the cost by less than the tolerance",
        timings={"filter": 0.321, "solve": 1.5},
    )


def errors_of(offset=0.25, sd=0.2):
    t = START + np.arange(COUNT) + 1.0
    p = np.tile([offset, 0.0, 0.0], (COUNT, 1))
    p[300, 0] = 7 * offset
    nothing = np.full((COUNT, 3), np.nan)
    sd_p = np.full((COUNT, 3), sd)
    return Errors(
        t, p, p[:, :2], nothing, 0.01 * np.ones((COUNT, 3)), sd_p, nothing, nothing,
        ((p / sd_p) ** 2).sum(1), (p / sd_p) ** 2, nothing[:, 0], nothing[:, 0], np.arange(COUNT) * 5.0,
    )  # fmt: skip


class Strict(HTMLParser):
    """Well-formedness: every element is closed, in order, and no id is used twice."""

    VOID = ("meta", "br", "link", "img", "hr", "input")

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.references, self.words, self.tags = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        self._attributes(attrs)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self._attributes(attrs)

    def _attributes(self, attrs):
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            if key in ("src", "href", "xlink:href", "data", "srcset", "action"):
                self.references.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def checked(path):
    """Parse a page and assert what holds for every page; returns the parser and its text."""
    html = path.read_text(encoding="utf-8")
    parser = Strict(html)
    assert len(parser.ids) == len(set(parser.ids))
    assert parser.references
    assert all(r.startswith("#") and r[1:] in parser.ids for r in parser.references)
    assert all(target in parser.ids for target in re.findall(r"url\(#([^)]*)\)", html))
    assert not re.search(r"url\((?!#)|@import", html)
    assert "script" not in parser.tags
    assert set(re.findall(r"var\(--([\w-]+)\)", html)) <= set(re.findall(r"--([\w-]+):", html))
    text = " ".join(parser.words)
    assert NAME in text
    return parser, text


def write(tmp_path, recording, **kw):
    values = {
        "settings": {"gnss": {"robust": "none", "robust_scale": 3.25}},
        "withheld": [("gnss", (99.5, 160.5)), ("odometer", None)],
        "findings": ["the IMU clock drifts by 12 ppm"],
        "provenance": {"version": "9.8.7", "inputs": {"imu.csv": "deadbeef"}},
    }
    return write_report(tmp_path / "report.html", recording, solution(), **{**values, **kw})


def test_report_holds_what_it_was_given(tmp_path, recording):
    _, text = checked(write(tmp_path, recording, metrics={"h_rms_m": 0.8765}, errors=errors_of()))
    for words in (
        "539 GNSS fixes", "gnss 99.5 to 160.5 s", "all of odometer",
        "1.0123", "0.0004", "599 gnss_position", "0.321", "1.821", "1237",
        "the IMU clock drifts by 12 ppm", "3 rows < NaN were left out", "9.8.7", "deadbeef", "gnss.robust_scale",
        "3.25", "0.8765", "6000 IMU rows at 10 Hz", "Withheld spans",
    ):  # fmt: skip
        assert words in text, words


def test_report_without_truth_shows_sigma_instead(tmp_path, recording):
    parser, text = checked(write(tmp_path, recording))
    assert "Accuracy" not in text
    assert "1 sigma as stated" in text
    # way, position and attitude sigma, two biases, one constraint
    assert parser.tags.count("svg") == 6


def test_report_of_next_to_nothing(tmp_path, recording):
    bare = solution()
    two = np.arange(2)
    small = Solution("batch", bare.frame, bare.t[two], bare.states[two], bare.covariance[two])
    path = write_report(tmp_path / "r.html", recording, small, settings={})
    checked(path)


def test_comparison_has_a_row_per_solver_and_span(tmp_path, recording):
    solvers = ("ekf", "rts", "incremental", "batch")
    path = write_comparison(
        tmp_path / "comparison.html",
        recording,
        {s: solution(s, 0.1 * k) for k, s in enumerate(solvers)},
        settings={},
        errors={
            s: errors_of(0.111 * (k + 1), sd)
            for k, (s, sd) in enumerate(zip(solvers, (0.07, 0.9, 0.2, 0.1), strict=False))
        },
        metrics={s: {"h_rms_m": 0.5 + k} for k, s in enumerate(solvers)},
        withheld=[("gnss", (100.0, 160.0)), ("gnss", (250.0, 350.0))],
    )
    parser, text = checked(path)
    for k in range(4):
        # outside the outlier's span RMS and largest are the offset itself
        assert page.number(0.111 * (k + 1)) in text
        assert page.number(7 * 0.111 * (k + 1)) in text
    assert text.count("Withheld 100 to 160 s") == text.count("Withheld 250 to 350 s") == 1
    assert "batch: the stated sigma is too small" in text
    assert "rts: the stated sigma is cautious" in text
    assert "ekf: the stated sigma can be believed" in text
    assert parser.tags.count("table") >= 5


def test_accuracy_rows():
    e = errors_of(0.25, sd=0.5)
    squares = np.array([0.25**2] * (COUNT - 1) + [(7 * 0.25) ** 2])
    np.testing.assert_allclose(
        accuracy_row(e),
        [np.sqrt(squares.mean()), 7 * 0.25, 0, np.nan, *np.degrees([0.01, 0.01]), np.sqrt(squares.mean() / 3) / 0.5],
    )
    # 61 epochs, so 60 intervals of 5 m
    np.testing.assert_allclose(
        span_row(e, (100.0, 160.0), START),
        [0.25, 0.25, 0.25, 100 * 0.25 / 300, 0, np.degrees(0.01), 0.5 / np.sqrt(3)],
    )
    assert np.isnan(span_row(e, (5000.0, 5001.0), START)).all()


def test_closed_loop_without_errors(tmp_path, recording):
    metrics = {"closure_h_m": 0.321, "closure_distance_m": 78.5, "closure_percent": 0.4089, "closure_up_m": -0.0625}
    _, text = checked(write(tmp_path, recording, metrics=metrics))
    for words in ("0.3210 m", "78.50 m", "0.4089 %", "-0.0625 m"):
        assert words in text


def test_consistency_counts_and_judges():
    c = consistency(record())
    assert (c.count, c.rejected, c.reduced, c.dof) == (COUNT, 1, 3, 3)
    white = np.random.default_rng(1).normal(size=(COUNT, 3))
    used = np.arange(COUNT) != 50
    assert c.mean_nis == pytest.approx((white[used] ** 2).sum(1).mean(), rel=1e-12)
    assert c.outside == pytest.approx((np.abs(white[used]) > 3).mean(), rel=1e-12)
    assert "can be believed" in c.verdict
    assert consistency(replace(record(), weight=np.zeros(COUNT))).verdict == "too few to judge"
    assert consistency(replace(record(), nis=np.full(COUNT, np.nan))).verdict == "too few to judge"
    assert "overconfident" in consistency(record(2.0)).verdict
    assert "wider" in consistency(record(0.5)).verdict
    assert "within" in consistency(record(0.5, "residual")).verdict
    assert "too small" in consistency(record(2.0, "residual")).verdict


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


def drawn_as(figure, label):
    return [artist for artist in figure.artists if artist.get_label() == label]


def test_bands_draw_the_values_given():
    t = np.arange(200.0)
    value, sigma = np.random.default_rng(0).normal(size=(200, 3)), np.full((200, 3), 2.0)
    figure = plots.bands({"batch": plots.Series(t, value, sigma)}, ("east", "north", "up"), "m")
    drawn = drawn_as(figure, "batch")
    assert len(drawn) == 3
    for k, line in enumerate(drawn):
        np.testing.assert_array_equal(line.get_xdata(), t)
        np.testing.assert_array_equal(line.get_ydata(), value[:, k])
    tints = drawn_as(figure, "batch 3 sigma")
    assert len(tints) == 3
    assert set(np.abs(tints[0].get_path().vertices[:, 1])) == {6.0}


def test_lines_and_bands_do_not_lead_across_gaps():
    t = np.concatenate([np.arange(100.0), 500 + np.arange(100.0)])
    value = np.ones((200, 1))
    figure = plots.bands({"ekf": plots.Series(t, value, value)}, ("east",), "m")
    x, y = drawn_as(figure, "ekf")[0].get_data()
    assert np.flatnonzero(np.isnan(y)).tolist() == [100]
    np.testing.assert_array_equal(x[np.isfinite(y)], t)
    (tint,) = drawn_as(figure, "ekf 3 sigma")
    assert not tint.get_path().contains_point((300.0, 0.0))
    assert tint.get_path().contains_point((50.0, 0.0))
    assert tint.get_path().contains_point((550.0, 0.0))


def test_the_scale_shows_every_value_but_not_the_first_sigma():
    t = np.arange(400.0)
    value, sigma = np.zeros((400, 1)), np.full((400, 1), 0.1)
    value[7], sigma[0] = 5.0, 1000.0
    figure = plots.bands({"ekf": plots.Series(t, value, sigma)}, ("heading",), "deg")
    line = drawn_as(figure, "ekf")[0]
    zero, top = line.get_transform().transform([[7.0, 0.0], [7.0, 5.0]])[:, 1]
    (frame,) = [a for a in drawn_as(figure, "_frame") if len(a.get_xdata()) == 5]
    edges = frame.get_transform().transform(frame.get_xydata())[:, 1]
    assert edges.min() < zero < top < edges.max()
    assert top - zero > 0.4 * np.ptp(edges)


def test_trajectory_is_to_scale():
    t = np.arange(100.0)
    en = np.stack([3 * t, t], -1)
    figure = plots.trajectory({"batch": (t, en)}, fixes=en + 1, spans=[(10, 20)])
    (line,) = drawn_as(figure, "batch")
    np.testing.assert_array_equal(line.get_xydata(), en)
    origin, east, north = line.get_transform().transform([[0, 0], [10, 0], [0, 10]])
    assert east[0] - origin[0] == pytest.approx(north[1] - origin[1], rel=1e-9)
    (under,) = drawn_as(figure, "withheld")
    drawn = under.get_xydata()[np.isfinite(under.get_xydata()).all(axis=1)]
    np.testing.assert_array_equal(drawn, en[10:21])
    (fixes,) = drawn_as(figure, "fixes")
    np.testing.assert_array_equal(fixes.get_path().vertices[::2], en + 1)


def test_residuals_mark_what_was_rejected():
    figure = plots.residuals("gnss", record(), START, "ekf")
    marks = drawn_as(figure, "rejected")
    assert len(marks) == 4
    assert [m.get_xdata().tolist() for m in marks] == [[51.0]] * 4
    reduced = drawn_as(figure, "weight < 0.5")
    assert reduced[0].get_path().vertices[::2, 0].tolist() == [61.0, 62.0, 63.0]


def test_sigmas_are_drawn_as_logarithms():
    t = np.arange(50.0)
    sd = np.geomspace(0.01, 10, 50)[:, None]
    figure = plots.sigmas({"rts": plots.Series(t, sd)}, ("east",), "m")
    np.testing.assert_allclose(10 ** drawn_as(figure, "rts")[0].get_ydata(), sd[:, 0])


def test_span_zoom_has_a_panel_per_span():
    t = np.arange(1000.0)
    figure = plots.span_zoom({"ekf": plots.Series(t, t[:, None])}, [(100, 200), (400, 440), (700, 760)])
    drawn = drawn_as(figure, "ekf")
    assert [(d.get_xdata()[0], d.get_xdata()[-1]) for d in drawn] == [(65, 235), (386, 454), (679, 781)]


@pytest.mark.parametrize(("lo", "hi"), [(-1e-6, 3e-6), (0.0, 1.0), (-3700.0, 12345.0), (1e7, 1.0001e7)])
def test_ticks_are_inside_and_told_apart(lo, hi):
    values, names = panels.ticks(lo, hi, 5)
    assert 2 <= len(values) <= 6
    assert values.min() >= lo - 1e-9 * (hi - lo)
    assert values.max() <= hi + 1e-9 * (hi - lo)
    assert len(set(names)) == len(names)


def test_labels_keep_their_digits_in_svg():
    t = np.arange(50.0)
    figure = plots.sigmas({"rts": plots.Series(t, np.geomspace(0.002, 0.008, 50)[:, None])}, ("east",), "m")
    text = panels.svg(figure, "x")
    assert ">0.005<" in text
    assert ">0.00<" not in text


def test_drawing_never_touches_pyplot():
    import subprocess
    import sys

    code = (
        "import sys, graphnav.report, graphnav.plots as p; assert 'matplotlib' not in sys.modules\n"
        "import numpy as np; from graphnav.panels import svg\n"
        "svg(p.sigmas({'ekf': p.Series(np.arange(3.), np.ones((3, 1)))}, ('e',), 'm'), 'x')\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
