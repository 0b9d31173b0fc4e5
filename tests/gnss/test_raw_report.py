"""What a solution and its report hold of raw observations: clock, arcs, weights of single satellites, pictures."""

from __future__ import annotations

import base64
from dataclasses import replace

import numpy as np
import pytest
from test_raw_rtk import STATED, drive  # noqa: F401

from graphnav.estimation.long_drives import Share, crop_solution
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import CarrierArcs
from graphnav.report.plots import satellites as plots
from graphnav.report.satellites import make_satellite_parts, select_satellite_records

SPOILT = 201  # Galileo's first satellite, whose carrier is a fifth of a cycle off at one epoch


@pytest.fixture(scope="module")
def solved(drive):  # noqa: F811
    recording, _ = drive
    raw = recording.raw_gnss
    epoch = np.unique(raw.t)[15]
    off = np.where((raw.satellite == SPOILT) & (raw.t == epoch), 0.2, 0.0)
    spoilt = replace(recording, raw_gnss=replace(raw, carrier=raw.carrier + off))
    return spoilt, epoch, run(spoilt, STATED, ("ekf", "rts", "batch"))


@pytest.mark.parametrize("solver", ["ekf", "rts", "batch"])
def test_the_receivers_clock_is_told(solved, solver):
    """As it was simulated: what is taken off by the base is without the clock of the base."""
    clock = solved[2][solver].parameters["receiver_clock"]
    t = clock.t
    true = np.stack([150.0 + t - 40.0 * np.cos(0.05 * t), 1.0 + 2.0 * np.sin(0.05 * t)], -1)
    off = (clock.value - true) / clock.sigma
    assert len(t) == 26
    assert np.abs(off).max() < 5.0
    assert np.all(clock.sigma[-1] < [0.5, 0.1])
    assert clock.prior_sigma.shape == (2,)


def test_a_satellite_that_is_off_has_less_weight_and_the_others_of_its_epoch_have_not(solved):
    _, epoch, solutions = solved
    for solver in ("ekf", "batch"):
        record = solutions[solver].records["gnss_phase"]
        there = np.abs(record.t - epoch) < 1e-6
        own = there & (record.satellite == "E01")
        assert own.sum() == 1
        assert record.weight[own][0] < 0.3, solver
        assert record.weight[there & ~own].min() > 0.5, solver


def test_arcs_cover_the_rows_and_are_integers_where_epochs_are_fixed(solved):
    _, _, solutions = solved
    for one in solutions.values():
        arcs, record = one.arcs, one.records["gnss_phase"]
        for name in np.unique(record.satellite):
            own, t = arcs.name == f"{name}.1C", record.t[record.satellite == name]
            inside = (t[:, None] >= arcs.begin[own]) & (t[:, None] <= arcs.end[own])
            np.testing.assert_array_equal(inside.sum(axis=1), 1)
        for t, fixed in one.fixed:
            whole = np.sum(arcs.integer & (arcs.begin <= t) & (arcs.end >= t))
            assert whole > 4 if fixed else whole <= 4


def test_rows_become_stretches_where_arc_and_state_are_the_same():
    t = np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0])
    slot = np.array([0, 1] * 4)
    arc = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 2.0])
    integer = np.array([0, 0, 0, 1, 1, 1, 1, 1], dtype=bool)
    found = CarrierArcs.from_rows(t, slot, arc, integer, ("a", "b"))
    assert found.name.tolist() == ["a", "a", "b", "b", "b"]
    assert found.begin.tolist() == [0.0, 2.0, 0.0, 1.0, 2.0]
    assert found.end.tolist() == [1.0, 3.0, 0.0, 1.0, 3.0]
    assert found.integer.tolist() == [False, True, False, True, True]
    assert not len(CarrierArcs.from_rows(t[:0], slot[:0], arc[:0], integer[:0], ()).name)


def test_a_part_of_a_solution_has_the_arcs_of_its_span(solved):
    recording, _, solutions = solved
    one = solutions["rts"]
    middle = recording.start + 10.0
    part = crop_solution(one, Share(recording, -np.inf, middle))
    assert part.arcs.end.max() <= middle
    assert set(part.arcs.name) == set(one.arcs.name[one.arcs.begin < middle])


def test_the_sky_is_drawn_where_the_satellites_are(solved):
    _, _, solutions = solved
    record = solutions["rts"].records["gnss_code"]
    one = replace(
        record, azimuth=np.full(len(record.t), np.radians(90.0)), elevation=np.full(len(record.t), np.radians(30.0))
    )
    words = {note["text"]: note for note in plots.plot_sky(one, "rts").annotations}
    assert words["G01"]["x"] == pytest.approx(60.0)
    assert words["G01"]["y"] == pytest.approx(0.0, abs=1e-9)
    assert words["N"]["y"] > 0.0


def test_a_satellite_with_some_rows_refused_is_not_drawn_as_refused(solved):
    """Rows of less than half weight are below those used, and none of them is among these."""
    record = solved[2]["rts"].records["gnss_code"]
    one = replace(record, weight=np.where(np.arange(len(record.t)) % 9 == 0, 0.1, 1.0))
    dots = [trace for trace in plots.plot_sky(one, "rts").data if "marker" in trace]
    drawn = [(trace["marker"]["color"], len(base64.b64decode(trace["customdata"]["bdata"])) // 4) for trace in dots]
    refused = int(np.sum(one.weight < plots.HALF))
    assert drawn[0][1] == refused
    assert sum(n for _, n in drawn[1:]) == len(one.t) - refused
    assert {colour for colour, _ in drawn[1:]} != {drawn[0][0]}


def test_pictures_are_of_raw_observations_alone(solved):
    recording, _, solutions = solved
    one = solutions["rts"]
    kinds = set(select_satellite_records(one))
    assert kinds == {"gnss_code", "gnss_doppler", "gnss_phase"}
    parts = "".join(make_satellite_parts(one, recording.start, recording.duration, {}))
    assert parts.count("<figure") == 5 + len(kinds)
    plain = replace(one, records={k: r for k, r in one.records.items() if k not in kinds})
    assert make_satellite_parts(plain, recording.start, recording.duration, {}) == []


def test_what_gtsam_gets_is_at_its_optimum(solved):
    """With its ambiguities, which are not among the parameters that it lists."""
    one = solved[2]["batch"]
    graph, values = one.to_gtsam()
    assert graph.error(values) == pytest.approx(one.cost, rel=1e-9)
