"""Figures hold the data given to them, and the pages hold the numbers, well formed and on their own."""

from __future__ import annotations

import base64
import json
import re
import tomllib
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from graphnav import load, run
from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.foot import FOOT_AXIS, PATTERN, PIVOT, TRAVEL
from graphnav.constraints.gnss import TIME_OFFSET, VELOCITY_TIME_OFFSET
from graphnav.constraints.odometer import ODOMETER_DELAY, ODOMETER_SCALE
from graphnav.constraints.vehicle import AXLE, BODY, MOUNTING
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import Note, get_key
from graphnav.core.state import States
from graphnav.detectors.base import Detection
from graphnav.estimation.names import has_names, name_components
from graphnav.estimation.noise.model import NoiseModel, RowWeights, VarianceComponent
from graphnav.estimation.noise.table import tabulate_figures
from graphnav.estimation.solution import (
    ConstraintRecord,
    ExcludedSpan,
    ParameterEstimate,
    Separation,
    Solution,
    join_solutions,
)
from graphnav.evaluation.metrics import Errors
from graphnav.evaluation.segments import compute_relative_errors
from graphnav.imu.dynamics import SCALE
from graphnav.recording import Gnss, Imu, Recording, Truth
from graphnav.recording.allan import compute_allan
from graphnav.report import allan as allan_page
from graphnav.report import page, wording
from graphnav.report import pictures as report_pictures
from graphnav.report.beside import locate_truth, select_fixes
from graphnav.report.consistency import summarise_record
from graphnav.report.documents import write_comparison, write_report
from graphnav.report.doubts import find_departures, list_doubts
from graphnav.report.provenance import format_command, format_toml
from graphnav.report.sentences import describe_sigma_without_truth
from graphnav.report.summary import describe_excluded, tabulate_fixes, tabulate_sigmas, tabulate_verdicts
from graphnav.report.tables import (
    tabulate_accuracy,
    tabulate_excluded,
    tabulate_rejected,
    tabulate_span,
    tabulate_stops,
)
from graphnav.report.wording import format_to_sigma

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
        self.open, self.ids, self.references, self.words, self.tags, self.figures = [], [], [], [], [], []
        self.keys = []  # of the notes
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag == "figure":
            self.figures.append(dict(attrs))
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
            if key == "data-key":
                self.keys.append(value)
            if key in ("src", "href", "xlink:href", "data", "srcset", "action"):
                self.references.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("script", "style"):
            self.words.append(data)


def unpacked(text):
    """What `page.js` unpacks of a script element."""
    return zlib.decompress(base64.b64decode(text)).decode()


def figures_of(path):
    """Title -> the figure that plotly is given, of everything on a page."""
    found = re.findall(
        r'<figcaption>([^<]*)</figcaption><div class="plot"[^>]*></div><script type="[\w/-]*" data-size="\d+">([^<]*)<',
        path.read_text(encoding="utf-8"),
    )
    return {title: json.loads(unpacked(packed)) for title, packed in found}


def checked(path):
    """Parse a page and assert what holds for every page; returns the parser and its text, with that of its figures."""
    html = path.read_text(encoding="utf-8")
    parser = Strict(html)
    assert len(parser.ids) == len(set(parser.ids))
    assert parser.references
    assert all(r[1:] in parser.ids for r in parser.references if r.startswith("#"))
    assert all(r.startswith(("#", "data:", "trajectory.")) for r in parser.references)
    own = re.sub(r'id="plotly-library" data-size="\d+">[^<]*<', "<", html)
    assert not re.search(r"url\(|@import", own)
    drawn = figures_of(path)
    assert len(drawn) == len(parser.figures)
    assert "Plotly" in unpacked(re.search(r'id="plotly-library" data-size="\d+">([^<]*)<', html)[1])
    # two elements of the library and its use, and the data of every figure
    assert parser.tags.count("script") == len(parser.figures) + 2
    said = json.dumps(list(drawn.values()))
    assert set(re.findall(r"var\(--([\w-]+)\)", html + said)) <= set(re.findall(r"--([\w-]+):", html))
    assert "NaN" not in said
    assert "Infinity" not in said
    text = " ".join([*parser.words, said])
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
        "101.23", "0.04", "599 GNSS positions", "0.321", "1.821", "1237",
        "the IMU clock drifts by 12 ppm", "3 rows < NaN were left out", "9.8.7", "deadbeef", "[gnss]",
        "robust_scale = 3.25", "0.8765", "an IMU at 10 Hz", "Spans without", "99.5 to 160.5 s",
    ):  # fmt: skip
        assert words in text, words


def test_each_program_of_a_comparison_has_a_colour_of_its_own(tmp_path, recording):
    names = ["ekf", "isam2", "rtk (2)", "rtk.(2", "slam", "é"]
    found = {name: replace(solution(name), solver=name) for name in names}
    path = write_comparison(tmp_path / "c.html", recording, found, settings={})
    checked(path)
    html = path.read_text(encoding="utf-8")
    used = [re.search(rf'background:var\((--[\w-]+)\)"></i>{re.escape(name)}<', html)[1] for name in names]
    values = [re.search(rf"{name}:([^;]+);", html)[1] for name in used]
    assert len(set(values)) == len(names)


def test_report_without_truth_shows_sigma_instead(tmp_path, recording):
    parser, _ = checked(write(tmp_path, recording))
    assert "no_truth.consistent" in parser.keys
    # way, heights, position, velocity and attitude, three sigmas, two biases, what was used when, one constraint
    assert len(parser.figures) == 13


def test_report_of_next_to_nothing(tmp_path, recording):
    bare = solution()
    two = np.arange(2)
    small = Solution("batch", bare.frame, bare.t[two], bare.states[two], bare.covariance[two])
    path = write_report(tmp_path / "r.html", recording, small, settings={})
    checked(path)


def test_a_truth_without_heights_has_no_panel_of_them():
    flat = errors_of()
    flat.p[:, 2] = np.nan
    (position, _) = report_pictures.draw_errors({"ekf": flat}, START, COUNT, {})
    (figure,) = (json.loads(unpacked(packed)) for packed in re.findall(r'data-size="\d+">([^<]*)<', position))
    assert len([name for name in figure["layout"] if name.startswith("yaxis")]) == 2


def test_what_was_excluded_is_listed_and_marked(tmp_path, recording):
    part = ExcludedSpan("gnss_position", START + 200.0, START + 219.5, 20, "jumped by 31 m <sideways>")
    found = replace(solution(), excluded=(part,))
    _, text = checked(write_report(tmp_path / "r.html", recording, found, settings={}))
    for words in ("200.0 to 219.5 s", "jumped by 31 m <sideways>", "20 measurements", "excluded fix"):
        assert words in text, words
    # seconds 200 to 219, and the one that the record says was rejected
    fixes = select_fixes(recording, found)
    np.testing.assert_allclose(fixes.t[fixes.excluded], [51.0, *np.arange(200.0, 220.0)])
    assert "excluded fix" in checked(write(tmp_path, recording))[1]
    kept = replace(solution(), records={})
    assert "excluded" not in checked(write_report(tmp_path / "r.html", recording, kept, settings={}))[1]


def test_of_many_exclusions_ten_are_shown_and_three_lines_say_what_was_left_out(tmp_path, recording):
    parts = tuple(ExcludedSpan("gnss_position", START + 20.0 * k, START + 20.0 * k + 4.0, 5 + k) for k in range(14))
    found = replace(solution(), excluded=parts)
    (shown, folded) = tabulate_excluded(found, START)[1:]
    assert shown.count("<tr>") == 11
    assert "<details>" in folded
    assert folded.count("<tr>") == 5
    lines = describe_excluded(found, START)[1]
    assert lines.count("<li>") <= 3
    assert "18 rows from 260.0 to 264.0 s" in lines
    assert f"{sum(range(5, 17))} rows in 12 more spans" in lines
    assert 'data-key="left_out.nothing"' in describe_excluded(replace(solution(), records={}), START)[1]


def cells(table):
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", table)[1:]]


def test_fixes_are_counted_and_coloured_by_type(tmp_path, recording):
    kinds = np.ones(COUNT, int)
    kinds[100:150] = 2
    typed = replace(recording, gnss=replace(recording.gnss, type=kinds))
    found = replace(solution(), t=solution().t)
    rows = {row[0]: row for row in cells(tabulate_fixes(typed, found, [("gnss", (200.5, 230.5))])[1])}
    # row 50 was rejected, and 30 are withheld; of a fix the distance from the antenna counts, whatever the residual
    assert [rows[k][1:5] for k in ("fixed", "float", "all")] == [
        ["550", "30", "1", "519"], ["50", "0", "0", "50"], ["600", "30", "1", "569"],
    ]  # fmt: skip
    assert float(rows["all"][5]) == 31.0
    used = np.delete(np.arange(COUNT), [50, *range(200, 230)])
    apart = found.frame.from_llh(typed.gnss.llh) - found.states.p - found.states.R_nb @ typed.gnss.lever_arm
    assert float(rows["all"][6]) == pytest.approx(np.hypot(*apart[used, :2].T).max(), rel=1e-3)
    assert float(rows["all"][7]) == pytest.approx(np.abs(record().residual / record().sigma)[used].max(), rel=1e-3)
    path = write_report(tmp_path / "r.html", typed, found, settings={})
    way_of_it = figures_of(path)["Plan view"]["data"]
    shown = {trace["name"]: trace for trace in way_of_it}
    colours = {name: shown[name]["marker"]["color"] for name in ("fixed", "float", "excluded fix")}
    assert len(set(colours.values())) == 3
    stated = np.where(np.arange(COUNT) < 9, 5.0, 0.01)[:, None] * np.ones(3)
    unknown = replace(recording, gnss=replace(recording.gnss, sd=stated))
    assert {name: rows.sum() for name, rows in select_fixes(unknown, found).kinds.items()} == {
        "sigma below 0.1 m": COUNT - 9, "sigma 1 m and more": 9,
    }  # fmt: skip


def test_the_heading_is_drawn_without_a_jump(tmp_path, recording):
    turning = replace(solution(), states=replace(solution().states, R_nb=turned(np.arange(COUNT) / 20.0)))
    path = write_report(tmp_path / "r.html", recording, turning, settings={})
    attitude = figures_of(path)["Attitude and 3 sigma"]
    (line,) = [t for t in attitude["data"] if t["yaxis"] == "y3" and t["name"] == "ekf" and t["mode"] == "lines"]
    y = np.frombuffer(base64.b64decode(line["y"]["bdata"]), "<f4")
    assert np.abs(np.diff(y)).max() < 4.0
    assert np.ptp(y) == pytest.approx(np.degrees((COUNT - 1) / 20.0), rel=1e-3)
    assert attitude["layout"]["yaxis3"]["range"][1] > y.max()


def turned(heading):
    """Attitudes (N, 3, 3) of a level body."""
    zero = np.zeros_like(heading)
    return rotation.exp(np.stack([zero, zero, -heading], -1))


def test_all_figures_over_time_have_one_axis(tmp_path, recording):
    drawn = figures_of(write(tmp_path, recording, errors=errors_of()))
    over_time = [f["layout"]["xaxis"]["range"] for f in drawn.values()
                 if "time" in json.dumps(f["layout"]["xaxis"]) or f["layout"]["hovermode"] == "x"]  # fmt: skip
    assert len(over_time) > 8
    assert {tuple(x) for x in over_time} == {(0.0, recording.duration)}


def test_the_time_axis_can_be_read_on_every_clock_that_is_known(tmp_path, recording):
    def clocks(path):
        return re.findall(r'<option value="([\d.]+)"( data-date)?>', path.read_text(encoding="utf-8"))

    assert clocks(write(tmp_path, recording)) == [(str(recording.start), "")]
    # GPS week 2200 began on 2022-03-06, 18 s before midnight UTC
    dated = clocks(write(tmp_path, replace(recording, gps_zero=2200 * 604800.0)))
    midnight = np.datetime64("2022-03-06") - np.datetime64("1970-01-01")
    unix = midnight / np.timedelta64(1, "s") - 18.0
    assert [(float(start), mark) for start, mark in dated[1:]] == [
        (unix + recording.start, " data-date"), (unix + 18.0 + recording.start, " data-date"),
    ]  # fmt: skip


def test_quantiles_of_sigma_are_those_of_the_keyframes():
    rows = {row[0]: row[1:] for row in cells(tabulate_sigmas(solution())[1])}
    assert [float(x) for x in rows["position, horizontal [m]"]] == pytest.approx([0.2 * np.sqrt(2.0)] * 3, rel=1e-3)
    assert float(rows["heading [deg]"][2]) == pytest.approx(np.degrees(1e-3), rel=1e-2)


def test_each_block_is_judged_by_itself():
    e = errors_of(sd=0.02)
    assert re.findall(r'class="verdict (\w*)"><b>(\w+)', tabulate_verdicts(solution(), e)) == [
        ("bad", "Position"), ("", "Velocity"), ("", "Attitude"),
    ]  # fmt: skip
    off = record(kind="residual")
    off.nis[60:63], off.weight[60:63] = 1e6, 1e-6  # rows that weigh next to nothing do not speak against the others
    velocities = replace(solution(), records={"gnss_position": off, "gnss_velocity": record(3.0)})
    assert re.findall(r'class="verdict (\w*)"><b>(\w+)', tabulate_verdicts(velocities, None)) == [
        ("", "Position"), ("bad", "Velocity"), ("", "Attitude"),
    ]  # fmt: skip


def test_a_calibration_has_names_and_no_index():
    sizes = {SCALE: 11, MOUNTING: 2, AXLE: 1, BODY: 2, ODOMETER_SCALE: 1, ODOMETER_DELAY: 1, LEVER_ARM: 3,
             TIME_OFFSET: 1, VELOCITY_TIME_OFFSET: 1, PIVOT: 3, TRAVEL: 2, FOOT_AXIS: 2}  # fmt: skip
    for name, size in (*sizes.items(), (SCALE, 18)):
        found = name_components(name, size, "u")
        assert has_names(name)
        assert len({c.words for c in found}) == size
        assert not any("[" in c.words for c in found)
    assert not has_names(PATTERN)
    assert len(name_components(PATTERN, 15, "m/s")) == 15


def test_relative_errors_are_those_of_displacements():
    n = 2001
    e, way = errors_of(), np.linspace(0.0, 10_000.0, n)
    off = np.column_stack([0.01 * way + 7.0, np.zeros(n), np.zeros(n)])  # 1 % of the way, and an offset that is in none
    drifting = replace(e, t=np.arange(n) * 1.0, p=off, distance=way, rph=np.radians(way / 1000.0)[:, None] * np.ones(3))
    found = compute_relative_errors(drifting)
    assert [r.length for r in found] == [10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0]
    for r in found:
        assert r.percent == pytest.approx(1.0, rel=1e-6)
        assert r.heading_rms == pytest.approx(r.length / 1000.0, rel=1e-6)
    assert compute_relative_errors(replace(e, distance=np.full(COUNT, np.nan))) == ()


def test_rejected_measurements_are_listed_with_their_times(tmp_path, recording):
    # of row 50, at 51 s: every component is 40 sigma, which is 20 m
    (only,) = cells(tabulate_rejected(solution(), START)[0])
    assert only[:1] + only[2:] == ["51.00 s", "+20 m, east", "40.00"]
    assert "51.00 s" in checked(write(tmp_path, recording))[1]


def test_stops_and_outages_are_told(tmp_path, recording):
    spans = START + np.array([[100.0, 130.0], [400.0, 412.0]])
    t = START + np.arange(0.5, COUNT)
    still = Detection("low_band_glrt", t, np.full(len(t), 0.5), 3.0, t > 0, spans)
    found = replace(solution(), detections=(still, replace(still, name="fused")))
    parser, text = checked(write_report(tmp_path / "r.html", recording, found, settings={}, outages=[(200.0, 230.0)]))
    assert [row[:2] for row in cells(tabulate_stops(found, START, "fused")[0])] == [
        ["100.00 s", "30.00 s"],
        ["400.00 s", "12.00 s"],
    ]
    assert all(words in text for words in ("200 to 230 s", "42 s"))
    assert len(parser.figures) == 14


@pytest.mark.parametrize(
    ("scale", "kind", "key"),
    [
        (1.0, "innovation", "consistent"),
        (2.0, "innovation", "too_small"),
        (0.4, "innovation", "cautious"),
        (0.9, "residual", "residuals_only"),
        (1.5, "residual", "residuals_large"),
    ],
)
def test_sigma_is_judged_by_what_was_met_where_there_is_no_truth(tmp_path, recording, scale, kind, key):
    found = replace(solution(), records={"gnss_position": record(scale, kind)})
    said = describe_sigma_without_truth(found)
    assert re.findall(r'data-key="([^"]*)"', said) == [f"no_truth.{key}"]
    size = np.sqrt(summarise_record(found.records["gnss_position"]).mean_nis / 3.0)
    assert f"{size:.2f}" in said
    assert f"no_truth.{key}" in checked(write_report(tmp_path / "r.html", recording, found, settings={}))[0].keys


def test_what_cannot_be_trusted_says_so_first(tmp_path, recording):
    def first_keys(found):
        return [key for key in checked(write_report(tmp_path / "r.html", recording, found, settings={}))[0].keys
                if key.startswith("doubt.")]  # fmt: skip

    assert first_keys(solution()) == []
    t = record().t
    mostly = NoiseModel(excluded={"gnss_position": ((t[100], t[500]),)})  # 401 of 600
    assert first_keys(replace(solution(), noise=mostly)) == ["doubt.left_out"]
    assert "67 %" in list_doubts({"ekf": replace(solution(), noise=mostly)}, {})[0]
    partly = NoiseModel(excluded={"gnss_position": ((t[100], t[200]),)})
    assert first_keys(replace(solution(), noise=partly)) == []
    larger = replace(solution(), records={"gnss_position": record(2.0)})
    assert first_keys(larger) == ["doubt.sigma"]
    late = Note("imu.clock", "the stamps of the IMU are late")
    for path in (
        write_report(tmp_path / "r.html", recording, larger, settings={}, defects=[late]),
        write_comparison(tmp_path / "c.html", recording, {"ekf": larger}, settings={}, defects=[late]),
    ):
        assert checked(path)[0].keys[:2] == ["imu.clock", "doubt.sigma"]
    assert list_doubts({"ekf": solution()}, {"ekf": errors_of(sd=0.02)})
    assert not list_doubts({"ekf": solution()}, {"ekf": errors_of(sd=0.3)})


def test_a_solver_that_the_others_contradict_is_named_first(tmp_path, recording):
    """By its own sigma: what a filter has not known yet it may be wrong by; what it claims to know, not."""

    def moved(one, by, sd=0.2, share=0.05):
        p, P = one.states.p.copy(), one.covariance.copy()
        some = slice(40, 40 + max(int(share * len(p)), 1))
        p[some, 1] += by
        P[some, 3:6, 3:6] = sd**2 * np.eye(3)
        return replace(one, states=replace(one.states, p=p), covariance=P)

    rts, batch = solution("rts"), solution("batch")
    assert find_departures({"ekf": moved(solution(), 0.5), "rts": rts, "batch": batch}) == {}
    assert find_departures({"ekf": moved(solution(), 98.0, sd=60.0), "rts": rts}) == {}
    assert find_departures({"ekf": moved(solution(), 98.0)}) == {}  # nothing to compare with
    assert find_departures({"ekf": moved(solution(), 2.0, share=0.0), "rts": rts}) == {}  # an outlier that it met
    astray = {"ekf": moved(solution(), 98.0), "rts": rts, "batch": batch}
    assert list(find_departures(astray)) == ["ekf"]
    assert "98 m" in find_departures(astray)["ekf"]
    assert list(find_departures({"rts": rts, "batch": moved(batch, 3.0)})) == ["rts"]
    loose = replace(moved(solution(), 98.0), solver="ekf-loose")
    assert find_departures({"ekf-loose": loose, "rts": rts}) == {}  # which knows other measurements
    assert list(find_departures({"ekf-loose": loose, "rts-loose": rts})) == ["ekf-loose"]
    path = write_comparison(tmp_path / "c.html", recording, astray, settings={})
    assert checked(path)[0].keys[0] == "doubt.solver"
    told = find_departures(astray)["ekf"]
    path = write_report(tmp_path / "r.html", recording, astray["ekf"], settings={}, contradicted=told)
    assert checked(path)[0].keys[0] == "doubt.solver"


def test_the_noise_model_is_a_table(tmp_path, recording):
    noise = NoiseModel(
        {
            "imu.gyro_bias_walk": VarianceComponent(np.log(16.0), 0.5, 0.0, 2.0, 37.0),
            "gnss_position.seconds.up": VarianceComponent(np.log(0.09)),
        },
        {"gnss_error_of_seconds": 4.25},
        {"gnss_position": RowWeights(record().t[:7], np.full(7, 0.125))},
    )
    rows = tabulate_figures(noise, recording, (100.0, 3600.0))
    found = replace(solution(), noise=noise)
    for text in (
        checked(write_report(tmp_path / "r.html", recording, found, settings={}, noise=rows))[1],
        checked(write_comparison(tmp_path / "c.html", recording, {"ekf": found}, settings={}, noise=rows))[1],
    ):
        # 1-sigma of the factor 4 on sigma: a quarter either way in the logarithm
        for words in (
            "gyro, bias random walk",
            "4.000",
            "3.1 to 5.1",
            "37",
            "0.3000",
            "4.250",
            "7 of 600",
            "0.12",
        ):
            assert words in text, words
    assert "noise.as_stated" in checked(write_report(tmp_path / "r.html", recording, solution(), settings={}))[0].keys


def test_pieces_keep_all_weights_and_spans_and_the_report_says_whose_figures_it_has(tmp_path, recording):
    t = record().t
    names = ("gnss_position", "nhc")
    parts = [
        replace(
            solution(),
            noise=NoiseModel(
                {"imu.gyro_bias_walk": VarianceComponent(float(k))},
                weights={names[k]: RowWeights(t[[k]], np.array([0.5]))},
                excluded={"gnss_position": ((t[k], t[k + 1]),)},
            ),
            passes={"filter": 3, "smoother": k},
            between=(None,),
        )
        for k in (0, 1)
    ]
    whole = join_solutions(parts)
    assert whole.noise.figures == parts[0].noise.figures
    assert {name: list(some.t) for name, some in whole.noise.weights.items()} == {
        "gnss_position": [t[0]],
        "nhc": [t[1]],
    }
    assert whole.noise.excluded == {"gnss_position": ((t[0], t[1]), (t[1], t[2]))}
    assert whole.passes == {"filter": 6, "smoother": 1}
    rows = tabulate_figures(whole.noise, recording, (100.0, 3600.0))
    shown = replace(whole, t=parts[0].t, states=parts[0].states, covariance=parts[0].covariance)
    page, _ = checked(write_report(tmp_path / "r.html", recording, shown, settings={}, noise=rows))
    assert "noise.of_first_piece" in page.keys


def test_innovations_speak_for_all_solvers(tmp_path, recording):
    met, fitted = solution("ekf"), replace(solution("batch"), records={"gnss_position": record(kind="residual")})
    page, _ = checked(write_comparison(tmp_path / "c.html", recording, {"ekf": met, "batch": fitted}, settings={}))
    assert [key for key in page.keys if key.startswith("no_truth.")] == ["no_truth.consistent"]


def test_numbers_that_are_displayed_alike_are_best_alike_and_none_is_minus_zero():
    rows = [["ekf", 0.5], ["rts", 0.093512], ["batch", 0.093518]]
    assert page.make_table(["solver", "a"], rows, best=[1]).count('class="best"') == 2
    assert format_to_sigma(-0.2, 13.0) == "0"
    assert format_to_sigma(-4058.2, 728.0) == "-4058"


def test_a_column_without_any_number_is_left_out():
    nan = float("nan")
    rows = [["ekf", 2.0, nan, nan], ["rts", 1.0, nan, 5.0]]
    assert page.make_table(["solver", "a", "b", "c"], rows, best=[1, 2, 3]).count("<td") == 6
    assert page.make_table(["solver", "a", "b", "c"], rows, best=[1, 2, 3]).count('class="best"') == 2
    assert "b" not in re.findall(r"<th[^>]*>(\w+)</th>", page.make_table(["solver", "a", "b", "c"], rows))


def test_settings_and_command_come_back_as_they_were():
    settings = Settings().model_dump()
    settings["gnss"]["robust"] = 'a "quoted" \\ word, µ'
    assert tomllib.loads(format_toml(settings)) == without_none(settings)
    options = {"recording": "a b", "solvers": "ekf,rts", "without": ["gnss:4-6", "odometer"], "rate": 5.0}
    assert format_command(options) == (
        "graphnav compare 'a b' --solvers ekf,rts --without gnss:4-6 --without odometer --rate 5.0 "
        "--config settings.toml -o again"
    )


def without_none(values):
    return {
        key: without_none(value) if isinstance(value, dict) else list(value) if isinstance(value, tuple) else value
        for key, value in values.items()
        if value is not None
    }


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
        assert wording.format_number(0.111 * (k + 1)) in text
        assert wording.format_number(7 * 0.111 * (k + 1)) in text
    assert text.count("Withheld 100 to 160 s") == text.count("Withheld 250 to 350 s") == 1
    said = [key.removeprefix("sigma.") for key in parser.keys if key.startswith("sigma.")]
    assert dict(zip(solvers, said, strict=True)) == {
        "ekf": "consistent", "rts": "cautious", "incremental": "consistent", "batch": "too_small",
    }  # fmt: skip
    assert parser.tags.count("table") >= 5


def test_accuracy_rows():
    e = errors_of(0.25, sd=0.5)
    squares = np.array([0.25**2] * (COUNT - 1) + [(7 * 0.25) ** 2])
    np.testing.assert_allclose(
        tabulate_accuracy(e),
        [np.sqrt(squares.mean()), 7 * 0.25, 0, np.nan, *np.degrees([0.01, 0.01]), np.sqrt(squares.mean() / 3) / 0.5],
    )
    # 61 epochs, so 60 intervals of 5 m
    np.testing.assert_allclose(
        tabulate_span(e, (100.0, 160.0), START),
        [0.25, 0.25, 0.25, 100 * 0.25 / 300, 0, np.degrees(0.01), 0.5 / np.sqrt(3)],
    )
    assert np.isnan(tabulate_span(e, (5000.0, 5001.0), START)).all()


def test_closed_loop_without_errors(tmp_path, recording):
    metrics = {"closure_h_m": 0.321, "closure_distance_m": 78.5, "closure_percent": 0.4089, "closure_up_m": -0.0625}
    _, text = checked(write(tmp_path, recording, metrics=metrics))
    for words in ("0.3210 m", "78.50 m", "0.4089 %", "-0.0625 m"):
        assert words in text


def test_consistency_counts_and_judges():
    c = summarise_record(record())
    assert (c.count, c.rejected, c.reduced, c.dof) == (COUNT, 1, 3, 3)
    white = np.random.default_rng(1).normal(size=(COUNT, 3))
    used = np.arange(COUNT) != 50
    assert c.mean_nis == pytest.approx((white[used] ** 2).sum(1).mean(), rel=1e-12)
    assert c.outside == pytest.approx((np.abs(white[used]) > 3).mean(), rel=1e-12)
    for one, key in (
        (record(), "as_predicted"), (replace(record(), weight=np.zeros(COUNT)), "few"),
        (replace(record(), nis=np.full(COUNT, np.nan)), "few"), (record(2.0), "overconfident"),
        (record(0.5), "cautious"), (record(0.5, "residual"), "residuals_within"),
        (record(2.0, "residual"), "residuals_large"),
    ):  # fmt: skip
        assert summarise_record(one).verdict.key == f"consistency.{key}"


def test_an_outlier_that_has_little_weight_says_nothing_against_sigma():
    """Of residuals: one row in ten 12 sigma off, with the weights by which the smoother used them; not without."""
    kept = record(0.9, "residual")
    off, weight = np.arange(COUNT) % 10 == 0, kept.weight.copy()
    white = np.where(off[:, None], 12.0, kept.residual / kept.sigma)
    weight[off] = 16.3 / (white[off] ** 2).sum(1)  # as unlikely as one in a thousand, chi-square of three
    rows = replace(kept, residual=white * kept.sigma, nis=(white**2).sum(1), weight=weight)
    found = {}
    for name, some in (("weighted", rows), ("as good as the others", replace(rows, weight=np.ones(COUNT)))):
        one = replace(solution("rts"), records={"gnss_position": some})
        found[name] = [get_key(doubt) for doubt in list_doubts({"rts": one}, {})]
    assert found == {"weighted": [], "as good as the others": ["doubt.sigma"]}


def test_separation_satellites_and_stated_accuracy_are_shown(tmp_path, recording):
    found = solution()
    three = np.ones((len(found.t), 3))
    apart = Separation(found.t, 0.25 * three, 0.5 * three)
    apart.value[-1] = np.nan
    seen = replace(recording, gnss=replace(recording.gnss, satellites=np.full(len(recording.gnss.t), 17.0)))
    checked(write_report(tmp_path / "r.html", seen, replace(found, separation=apart), settings={}))
    html = (tmp_path / "r.html").read_text()
    rows = re.findall(r"<tr><td[^>]*>(east|north|up)</td>(.*?)</tr>", html)
    assert [axis for axis, _ in rows] == ["east", "north", "up"]
    for _, cells in rows:
        assert [float(x) for x in re.findall(r">([\d.]+)<", cells)] == [0.25, 0.25, 0.25, 0.5]
    drawn = figures_of(tmp_path / "r.html")
    assert {"Combined separation and 3 sigma", "Fixes: stated accuracy and satellites"} <= drawn.keys()
    assert re.search(
        r">17<.*>17<", (tmp_path / "r.html").read_text().partition("Fixes</h3>")[2].partition("</table>")[0]
    )


def test_a_separation_that_is_no_chance_is_in_the_verdict_and_above_it():
    """Of independent epochs, on one axis; one that lasts for all of them counts once, and may be chance."""
    rng, one = np.random.default_rng(5), solution("rts")
    value = rng.normal(size=(len(one.t), 3))
    along = np.array([1.0, 4.0, 1.0])
    fits, near, far = (Separation(one.t, value * x, np.ones_like(value)) for x in (1.0, along / 2.0, along))
    lasts = Separation(one.t, np.full_like(value, 2.0), np.ones_like(value))
    seen = replace(one, records={"gnss_position": record(0.9, "innovation")})
    for apart, truth, kind, keys in (
        (fits, None, "good", []), (near, None, "bad", []), (far, None, "bad", ["doubt.sigma"]),
        (lasts, None, "good", []), (far, errors_of(sd=0.3), "", []),
    ):  # fmt: skip
        found = replace(seen, separation=apart)
        assert re.findall(r'class="verdict (\w*)"><b>Position', tabulate_verdicts(found, truth)) == [kind]
        errors = {} if truth is None else {"rts": truth}
        assert [get_key(doubt) for doubt in list_doubts({"rts": found}, errors)] == keys


def test_a_truth_on_the_earth_is_laid_onto_a_walk_that_counts_from_its_start(recording):
    """The solution's frame stands anywhere and is turned; the truth lies elsewhere on the Earth."""
    turned, far = solution(offset=0.0), LocalFrame(np.array([0.9, 1.4, 300.0]))
    p = turned.states.p @ rotation.exp(np.array([0.0, 0.0, 0.7])).T + [50.0, -20.0, 4.0]
    states = replace(turned.states, p=p)
    walk = replace(turned, states=states, records={"stance": record()})
    walked = replace(recording, gnss=None, truth=replace(recording.truth, llh=far.to_llh(way(turned.t - START))))
    t, laid = locate_truth(walked, {"ekf": walk})
    assert t == pytest.approx(turned.t)
    assert laid == pytest.approx(p, abs=0.05)  # the Earth is round


def test_a_truth_is_drawn_while_the_run_lasts_and_not_across_its_gaps(recording):
    """A part of a drive: the truth of the rest, and a straight line where it has none, would be no truth."""
    one = solution(offset=0.0)
    t = np.arange(one.t[0] - 50.0, one.t[-1] + 50.0, 0.1)
    t = t[(t < one.t[0] + 3.0) | (t > one.t[0] + 23.0)]
    truth = replace(recording.truth, t=t, llh=one.frame.to_llh(way(t - START)))
    seen, p = locate_truth(replace(recording, truth=truth), {"rts": one})
    assert (seen[0], seen[-1]) == pytest.approx((one.t[0], one.t[-1]), abs=0.1)
    (gap,) = np.flatnonzero(np.isnan(p).any(axis=1))
    assert (seen[gap - 1] - one.t[0], seen[gap + 1] - one.t[0]) == pytest.approx((3.0, 23.0), abs=0.11)
    assert np.isfinite(np.delete(p, gap, axis=0)).all()


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(1.5e-4, 4, "0.00015"), (2.07e-4, 4, "0.000207"), (0.0182, 2, "0.018"), (0.01234, 4, "0.0123"), (0.0, 4, "0"),
     (1.234e-5, 4, "1.23e-05"), (12.345, 4, "12.35"), (1234.5, 4, "1234"), (0.1, 3, "0.100"), (np.nan, 4, "-")],
)  # fmt: skip
def test_small_numbers_keep_their_digits(value, digits, text):
    assert wording.format_number(value, digits) == text


def test_the_page_of_an_allan_variance_draws_the_deviations_and_their_fit(tmp_path):
    rng, rate = np.random.default_rng(3), 50.0
    t = np.arange(1, 6001) / rate
    gyro, accel = rng.normal(0.0, 1e-3, (len(t), 3)), rng.normal([0.0, 0.0, 9.8], 1e-2, (len(t), 3))
    result = compute_allan(t, gyro, accel)
    path, _, _ = allan_page.write_allan(result, tmp_path)
    for title, deviation, sigma in (("Gyro", result.gyro, 1e-3), ("Accelerometer", result.accel, 1e-2)):
        figure = figures_of(path)[title]
        *axes, fit = figure["data"]
        for k, trace in enumerate(axes):
            assert typed(trace["x"]) == pytest.approx(result.tau, rel=1e-6)
            assert typed(trace["y"]) == pytest.approx(deviation[:, k], rel=1e-6)
        # white noise: a slope of a half, through sigma / sqrt(rate) at a second
        assert typed(fit["y"])[0] * np.sqrt(result.tau[0]) == pytest.approx(sigma / np.sqrt(rate), rel=0.05)
        assert figure["layout"]["xaxis"]["type"] == figure["layout"]["yaxis"]["type"] == "log"


def typed(packed):
    """The numbers of an array as plotly is given it."""
    return np.frombuffer(base64.b64decode(packed["bdata"]), "<f4")


def test_a_drive_whose_fixes_leave_its_direction_open_is_doubted():
    """Two fixes: nothing tells which way the vehicle went between them."""
    moved = solution("rts")
    P = moved.covariance.copy()
    P[:, 2, 2] = np.radians(40.0) ** 2
    found = [get_key(d) for d in list_doubts({"rts": replace(moved, covariance=P)}, {"rts": errors_of(sd=0.3)})]
    assert found == ["doubt.heading"]
    assert list_doubts({"rts": moved}, {"rts": errors_of(sd=0.3)}) == ()


@pytest.mark.parametrize(("begin", "end", "told"), [(24.0, 50.0, True), (24.0, 75.0, False)])
def test_a_car_that_only_stands_has_no_heading(begin, end, told):
    drive = load(Path(__file__).resolve().parents[2] / "data" / "tokyo").crop(begin, end)
    found = run(drive, Settings.model_validate({"noise": {"mode": "stated"}}), ("batch",))
    assert ("doubt.heading" in [get_key(d) for d in list_doubts(found, {})]) == told
