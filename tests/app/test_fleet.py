"""Many drives with one command: what one of them does costs the others nothing, and what is done is not done again."""

from __future__ import annotations

import csv
import json
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from helpers import refused

from graphnav import load
from graphnav.app import cli
from graphnav.app.fleet import page, tables
from graphnav.app.fleet.drive import CRASHED, DONE, HUNG, REFUSED, choose_spans, hash_task, read_row, solve_drive
from graphnav.app.fleet.manifest import DriveOptions, Task, build_task, read_drives
from graphnav.app.fleet.workers import Limits, Worker, solve_on_cluster
from graphnav.config import Settings
from graphnav.core.errors import ConfigError

RUNS = ("run02", "run30", "run31")


@pytest.fixture
def walks(shared_data: Path, tmp_path: Path) -> Path:
    """Three short walks, and a file that is no recording."""
    folder = tmp_path / "walks"
    folder.mkdir()
    for name in RUNS:
        for file in (f"{name}.toml", f"{name}_imu.csv.gz"):
            shutil.copyfile(shared_data / "openshoe_loops" / file, folder / file)
    (folder / "worse").mkdir()
    (folder / "worse" / "recording.toml").write_text('format = "graphnav-recording/1"\nplatform = "submarine"\n')
    return folder


def run(capsys: pytest.CaptureFixture[str], folder: Path, out: Path) -> dict[str, dict[str, object]]:
    """The rows of a fleet, by drive."""
    arguments = ["--solver", "ekf", "--noise", "stated", "--end", "8", "--no-report", "--processes", "1", "--json"]
    code = cli.run(["fleet", str(folder), "-o", str(out), *arguments])
    rows = {row["drive"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    # 0 says that every drive has a result
    assert code == (0 if all(row["status"] == DONE for row in rows.values()) else 3)
    return rows


def test_a_bad_drive_costs_itself_alone_and_what_is_done_stays(
    walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    rows = run(capsys, walks, out)
    assert {name: row["status"] for name, row in rows.items()} == {**dict.fromkeys(RUNS, DONE), "worse": REFUSED}
    assert "submarine" in str(rows["worse"]["error"])
    assert all((out / "drives" / name / "trajectory.csv").exists() for name in RUNS)
    with (out / "fleet.csv").open(newline="") as file:
        written = {row["drive"]: row for row in csv.DictReader(file)}
    assert float(written["run02"]["duration_s"]) == pytest.approx(8.0, abs=0.1)
    assert written["worse"]["keyframes"] == ""
    assert (out / "fleet.html").exists()

    # as if it had been killed before the second, and the third had been measured again
    (out / "drives" / "run30" / "drive.json").unlink()
    text = (walks / "run31.toml").read_text()
    (walks / "run31.toml").write_text(text.replace("gyro_noise_density = 0.001", "gyro_noise_density = 0.002"))
    (out / "drives" / "run31" / "report.html").write_text("of a result that is replaced without a new one")
    again = run(capsys, walks, out)
    assert not (out / "drives" / "run31" / "report.html").exists()
    assert {name for name, row in again.items() if row.get("skipped")} == {"run02", "worse"}
    assert again["run30"]["sd_h_median_m"] == rows["run30"]["sd_h_median_m"]
    assert again["run31"]["sd_h_median_m"] != rows["run31"]["sd_h_median_m"]

    shutil.rmtree(walks / "worse")
    assert {row["status"] for row in run(capsys, walks, out).values()} == {DONE}


def test_a_killed_process_and_one_that_takes_too_long_are_said_and_replaced(tmp_path: Path) -> None:
    tasks = [Task(name, "nowhere", str(tmp_path / name), "ekf", {}) for name in ("killed", "late", "next")]
    worker, hasty = Worker(Limits(100.0)), Worker(Limits(0.001))

    def kill() -> None:
        while worker._process is None:
            time.sleep(0.001)
        worker._process.kill()

    try:
        # either comes long before the process has imported what it needs to answer
        threading.Thread(target=kill).start()
        killed = worker.solve(tasks[0])
        late = hasty.solve(tasks[1])
        following = worker.solve(tasks[2])
    finally:
        worker.close()
        hasty.close()
    assert [row["status"] for row in (killed, late, following)] == [CRASHED, HUNG, REFUSED]
    assert "SIGKILL" in killed["error"]
    for row in (killed, late):  # and both would be tried again
        folder = tmp_path / str(row["drive"])
        assert read_row(folder) is not None
        assert read_row(folder, "") is None


class Cluster:
    """What is used of a Dask client: every third drive loses its worker for good."""

    waiting: ClassVar[list[SimpleNamespace]] = []
    most = 0

    def __init__(self, address: str, timeout: float) -> None:
        if "nobody" in address:
            raise OSError("refused")

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        assert not self.waiting

    def nthreads(self) -> dict[str, int]:
        return {"tcp://a": 1}

    def map(self, solve: object, tasks: list[Task], limits: Limits, pure: bool) -> list[SimpleNamespace]:
        assert not pure  # else the same drive, asked for twice, would be solved once
        return [self.future(task) for task in tasks]

    def cancel(self, futures: list[SimpleNamespace]) -> None:
        self.waiting.clear()

    @staticmethod
    def future(task: Task) -> SimpleNamespace:
        lost = int(task.name) % 3 == 0
        row = {"drive": task.name, "status": DONE}
        return SimpleNamespace(
            key=f"k{task.name}", status="error" if lost else "finished", result=lambda: row,
            exception=lambda: RuntimeError("worker lost"),
        )  # fmt: skip

    @classmethod
    def completed(cls, futures: list[SimpleNamespace]) -> Iterator[SimpleNamespace]:
        cls.waiting = list(futures)

        class Queue:
            futures = cls.waiting

            def update(self, more: list[SimpleNamespace]) -> None:
                cls.waiting.extend(more)

            def __iter__(self) -> Iterator[SimpleNamespace]:
                while cls.waiting:
                    cls.most = max(cls.most, len(cls.waiting))
                    yield cls.waiting.pop()

        return Queue()  # type: ignore[return-value]


def test_a_scheduler_is_told_of_a_few_drives_and_those_it_loses_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=Cluster, as_completed=Cluster.completed))
    tasks = [Task(str(k), "kitti", str(tmp_path / str(k)), "ekf", {}) for k in range(30)]
    rows = {row["drive"]: row for row in solve_on_cluster(tasks, "tcp://a:1", Limits(1.0))}
    assert {name: row["status"] for name, row in rows.items()} == {
        str(k): CRASHED if k % 3 == 0 else DONE for k in range(30)
    }
    assert "worker lost" in rows["3"]["error"]
    assert Cluster.most <= 10
    with refused("fleet.no_cluster", ConfigError, "tcp://nobody:1"):
        next(solve_on_cluster(tasks, "tcp://nobody:1", Limits(1.0)))


def test_a_result_depends_on_input_settings_and_what_is_asked(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "recording.toml").write_text('format = "graphnav-recording/1"\n[imu]\nfile = "a.csv"\n')
    (folder / "a.csv").write_text("1")
    (folder / "b.csv").write_text("1")
    task = Task("a", str(folder), "x", "ekf", Settings().model_dump(mode="json"))
    first = hash_task(task)
    assert hash_task(replace(task, name="b", folder="y")) == first
    assert hash_task(replace(task, solver="rts")) != first
    assert hash_task(replace(task, settings={**task.settings, "profile": "car"})) != first
    (folder / "b.csv").write_text("2")
    assert hash_task(task) == first
    (folder / "a.csv").write_text("2")
    assert hash_task(task) != first


def test_a_manifest_gives_each_drive_its_own_settings(tmp_path: Path) -> None:
    (tmp_path / "fast.toml").write_text("[keyframes]\nrate = 4\n")
    (tmp_path / "m.csv").write_text(
        "recording,name,config,settings,end,without\n"
        "kitti,,fast.toml,standstill.zero_rate = false; noise.mode = 'stated',60,gnss:10-20 odometer\n"
        "kitti,,,,,\n"
    )
    (tmp_path / "m.toml").write_text(
        '[[drive]]\nrecording = "kitti"\nconfig = "fast.toml"\nend = 60.0\nwithout = ["gnss:10-20", "odometer"]\n'
        '[drive.settings]\nstandstill.zero_rate = false\nnoise = { mode = "stated" }\n[[drive]]\nrecording = "kitti"\n'
    )
    found = []
    for name in ("m.csv", "m.toml"):
        drives = read_drives(tmp_path / name, DriveOptions(solver="rts"))
        tasks = [build_task(drive, tmp_path, {}) for drive in drives]
        assert [task.name for task in tasks] == ["kitti", "kitti-2"]
        found.append([replace(task, place="") for task in tasks])
    assert found[0] == found[1]
    own, usual = (Settings.model_validate(task.settings) for task in found[0])
    assert (own.keyframes.rate, own.standstill.zero_rate, own.noise.mode) == (4.0, False, "stated")
    assert usual == Settings()
    assert (found[0][0].end, found[0][0].without, found[0][1].without) == (60.0, ("gnss:10-20", "odometer"), ())


def test_a_manifest_of_a_spreadsheet_may_have_semicolons(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("recording;name;end\nkitti;one;60\n")
    (task,) = [build_task(drive, tmp_path, {}) for drive in read_drives(tmp_path / "m.csv", DriveOptions())]
    assert (task.name, task.end) == ("one", 60.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recording,profil\nkitti,car\n", ("line 1", "profile")),
        ("name\na\n", ("line 1", "recording")),
        ("recording,start\nkitti,soon\n", ("line 2", "start", "soon")),
        ("recording,name\nkitti,a\nkitti,a\n", ("line 3", "'a'")),
        ("recording,solver\nkitti,rst\n", ("line 2", "rts")),
        ("recording,settings\nkitti,keyframes.rat = 2\n", ("line 2", "rate")),
        ("recording,settings\nkitti,keyframes rate\n", ("line 2", "settings")),
        ("recording,end\nkitti\n", ("line 2", "2 cells")),
        ("recording\n", ("no recording",)),
        ("recording\n../elsewhere\n", ("line 2", "--allow-outside")),
        ("recording,start\nkitti,nan\n", ("line 2", "start", "nan")),
        ("recording,config\nkitti,/etc/settings.toml\n", ("line 2", "config", "--allow-outside")),
    ],
)
def test_a_manifest_that_cannot_be_is_refused_where_it_says_so(tmp_path: Path, text: str, words: tuple[str]) -> None:
    path = tmp_path / "m.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        [build_task(drive, tmp_path, {}) for drive in read_drives(path, DriveOptions())]
    assert "m.csv" in str(caught.value)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("m.csv", "recording,name\nkitti,a\n\nlost,b\n", 4),
        ("m.toml", '[[drive]]\nrecording = "kitti"\n\n[[drive]]\nrecording = "lost"\n', 4),
    ],
)
def test_a_recording_that_is_not_there_is_refused_where_a_manifest_names_it(
    tmp_path: Path, name: str, text: str, line: int
) -> None:
    path = tmp_path / name
    path.write_text(text)
    row = solve_drive(build_task(read_drives(path, DriveOptions())[1], tmp_path / "out", {}))
    assert row["status"] == REFUSED
    assert f"{path}, line {line}: {tmp_path / 'lost'}" in row["error"]


def test_a_manifest_is_not_blamed_for_what_the_command_line_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "m.csv").write_text("recording\nkitti\n")
    for option, value in (("--without", "gnss:soon"), ("--start", "nan"), ("--config", "missing.toml")):
        assert cli.run(["fleet", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out"), option, value]) == 2
        said = capsys.readouterr().err
        assert value in said
        assert "m.csv" not in said
    assert not (tmp_path / "out").exists()


def test_drives_in_which_nothing_could_be_withheld_are_counted() -> None:
    parts = [load("kitti").crop(100.0, 100.0 + length) for length in (104.9, 105.1, 300.0, 300.0)]
    parts[2] = replace(parts[2], gnss=None)
    rows = [{"status": DONE, "placed": part.gnss is not None, "duration_s": part.duration} for part in parts]
    unscored = [row for row, part in zip(rows, parts, strict=True) if not choose_spans(part, 15.0)]
    assert unscored == [rows[0], rows[2]]
    assert "2 of 4" in tables.describe_unscored([*rows, {"status": REFUSED}], 15.0)
    assert tables.describe_unscored([rows[1], rows[3]], 15.0) == ""


def test_withheld_spans_are_outages_by_themselves() -> None:
    recording = load("kitti")
    found = np.array(choose_spans(recording, 30.0, zero=5.0)) - 5.0
    assert len(found) > 3
    assert found[0, 0] >= 60.0
    assert found[-1, 1] <= recording.duration - 30.0
    np.testing.assert_allclose(found[:, 1] - found[:, 0], 30.0)
    assert (found[1:, 0] - found[:-1, 1] >= 30.0).all()
    assert choose_spans(replace(recording, gnss=None), 30.0) == []


def test_the_page_has_the_worst_first_and_takes_no_markup_from_names(tmp_path: Path) -> None:
    track = [[8.0, 49.0], [8.001, 49.0]]
    good = {"drive": "good", "status": DONE, "verdict": "sound", "h_rms_m": 0.5, "track": track, "placed": True}
    good["report"] = "good.html"
    bad = {**good, "drive": "bad", "h_rms_m": 5.0, "report": "bad.html"}
    doubted = {**good, "drive": "doubted", "verdict": "doubtful", "track": [[139.0, 35.0], [139.1, 35.0]]}
    lost = {"drive": "<b>lost", "status": HUNG, "error": "<script>"}
    rows = [good, bad, doubted, lost]
    assert [row["drive"] for row in tables.sort_by_error(rows)] == ["<b>lost", "doubted", "bad", "good"]
    page.write_page(rows, tmp_path / "a.html", "fleet")
    text = (tmp_path / "a.html").read_text()
    assert "<script>" not in text
    assert "<b>" not in text
    assert text.count("<polyline") == 3
    assert "not drawn" not in text
    page.write_page([*rows, {**good, "drive": "more", "track": None, "placed": True}], tmp_path / "a.html", "fleet")
    assert "1 more tracks" in (tmp_path / "a.html").read_text()
    assert text.index("&lt;b&gt;lost</td>") < text.index('href="bad.html">bad<') < text.index('href="good.html">good<')
