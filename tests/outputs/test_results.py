import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from io import FileIO
from pathlib import Path

import numpy as np
import pytest
from made_steps import rig, steps

from trifix.errors import RecordingError
from trifix.files.maps import read_map
from trifix.files.recordings import Level
from trifix.files.tables import read_table
from trifix.files.trajectories import read_poses, read_tum
from trifix.outputs.results import ResultsWriter
from trifix.outputs.summary import Summary
from trifix.records import Fix, NoFix, Reason, SingleDots, Step

OPTIONS = "[match]\nmax_depth_mm = 900.0\n"
CLOCKED = {"timings.csv", "summary.json", "report.html"}


def written(out: Path, level: Level, made: list[Step]) -> Summary:
    with ResultsWriter(out, "plate", level, OPTIONS, is_online=True) as results:
        for step in made:
            results.write(step)
        return results.finish()


def test_the_map_may_be_told_by_more_than_the_last_step_knows(tmp_path: Path):
    made = list(steps(5, "points"))
    told = replace(made[-1].map, cov_mm2=4 * made[-1].map.cov_mm2)
    with ResultsWriter(tmp_path / "out", "plate", "points", OPTIONS, is_online=True) as results:
        for step in made:
            results.write(step)
        results.finish(told_map=told)
    np.testing.assert_allclose(read_map(tmp_path / "out" / "map.csv").cov_mm2, told.cov_mm2, atol=1e-6)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module", params=["images", "dots", "points"])
def level(request: pytest.FixtureRequest) -> Level:
    chosen: Level = request.param
    return chosen


@pytest.fixture(scope="module")
def run(level: Level, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Step], Summary]:
    out, made = tmp_path_factory.mktemp(level), list(steps(45, level))
    return out, made, written(out, level, made)


def test_the_folder_holds_the_promised_files_and_nothing_else(run: tuple[Path, list[Step], Summary], level: Level):
    out, _, _ = run
    expected = {
        "trajectory.tum", "poses.csv", "frames.csv", "sightings.csv", "map.csv", "map.ply", "events.csv", "rivals.csv",
        "timings.csv", "summary.json",
    }  # fmt: skip
    assert {each.name for each in out.iterdir()} == expected | ({"dots.csv"} if level == "images" else set())


def test_every_frame_has_one_row(run: tuple[Path, list[Step], Summary]):
    out, made, _ = run
    found = rows(out / "frames.csv")
    assert [int(row["frame"]) for row in found] == [step.frame.index for step in made]
    for row, step in zip(found, made, strict=True):
        match step.fix:
            case Fix() as fix:
                assert row["status"] == "positioned"
                assert row["reason"] == (fix.reason.name if fix.reason else "")
                assert int(row["matched"]) == len(fix.point)
                assert abs(float(row["residual_mm"]) - fix.rms_mm) < 1e-6
            case NoFix() as refusal:
                assert (row["status"], row["reason"]) == ("refused", refusal.why.name)
                assert row["detail"] == refusal.detail


def test_what_is_not_known_is_an_empty_cell(run: tuple[Path, list[Step], Summary]):
    out, made, _ = run
    found = rows(out / "frames.csv")
    assert (found[0]["reason"], found[0]["p_chance"]) == ("defines_world", "")
    few = next(k for k, s in enumerate(made) if isinstance(s.fix, NoFix) and s.fix.why is Reason.too_few_points)
    assert (found[few]["residual_mm"], found[few]["p_chance"]) == ("", "")


def test_positioned_frames_have_a_pose_in_both_files(run: tuple[Path, list[Step], Summary]):
    out, made, _ = run
    fixes = [(step.frame, step.fix) for step in made if isinstance(step.fix, Fix)]
    frame, timestamp_ns, poses, cov = read_poses(out / "poses.csv")
    tum_ns, tum_poses = read_tum(out / "trajectory.tum")
    assert frame.tolist() == [each.index for each, _ in fixes]
    assert timestamp_ns.tolist() == tum_ns.tolist() == [each.timestamp_ns for each, _ in fixes]
    for pose, tum_pose, c, (_, fix) in zip(poses, tum_poses, cov, fixes, strict=True):
        assert np.abs((pose.inverse() @ fix.T_world_sensor).log()).max() < 2e-6
        assert np.abs((tum_pose.inverse() @ fix.T_world_sensor).log()).max() < 2e-6
        assert np.abs(c - fix.cov).max() < 1e-9


def test_sightings_name_the_rows_of_the_level_below(run: tuple[Path, list[Step], Summary], level: Level):
    out, made, _ = run
    found = rows(out / "sightings.csv")
    at_frame = 5
    step = made[at_frame]
    fix, points = step.fix, step.points
    assert isinstance(fix, Fix)
    assert points is not None
    here = [row for row in found if row["frame"] == str(at_frame)]
    ids = step.map.id[fix.target].tolist()
    if level == "points":
        assert [row["kind"] for row in here] == ["point"] * len(ids)
        assert [int(row["row"]) for row in here] == points.row[fix.point].tolist()
        assert {row["residual_px"] for row in here} == {""}
        assert np.abs([float(row["residual_mm"]) for row in here] - fix.residual_mm).max() < 1e-6
        return
    assert [row["kind"] for row in here] == ["left", "right"] * len(ids)
    assert [int(row["target"]) for row in here] == np.repeat(ids, 2).tolist()
    # the dot that a sighting names is where the target was seen
    assert step.dots is not None
    if level == "images":
        table = rows(out / "dots.csv")
        uv = np.array([[float(table[int(row["row"])][name]) for name in "uv"] for row in here])
        assert {table[int(row["row"])]["frame"] for row in here} == {str(at_frame)}
        assert [table[int(row["row"])]["camera"] for row in here] == ["0", "1"] * len(ids)
    else:
        uv = np.empty((len(here), 2))
        uv[::2] = step.dots.left.uv_px[[int(row["row"]) for row in here[::2]]]
        uv[1::2] = step.dots.right.uv_px[[int(row["row"]) for row in here[1::2]]]
    p_left = fix.T_world_sensor.inverse().apply(step.map.xyz_mm[fix.target])
    expected = np.empty_like(uv)
    expected[::2] = rig().left.project(p_left)
    expected[1::2] = rig().right.project(rig().T_right_left.apply(p_left))
    distance = np.linalg.norm(uv - expected, axis=1)
    assert np.abs(distance - [float(row["residual_px"]) for row in here]).max() < 3e-6
    assert 0.05 < np.sqrt(np.mean(distance**2)) < 0.5  # 0.15 px an axis went in


@pytest.mark.parametrize("level", ["images", "dots"])
def test_dots_of_a_single_camera_are_sightings_too(tmp_path: Path, level: Level):
    made = list(steps(3, level))
    step = made[2]
    fix = step.fix
    assert isinstance(fix, Fix)
    assert step.dots is not None
    camera, dot, target = np.array([1, 0]), np.array([20, 21]), np.array([3, 7])
    single = SingleDots.of(camera, dot, target, step.dots, rig(), fix.T_world_sensor, step.map)
    made[2] = replace(step, fix=replace(fix, single=single))
    written(tmp_path, level, made)
    found = rows(tmp_path / "sightings.csv")[-2:]
    assert [(row["frame"], row["kind"], row["residual_mm"]) for row in found] == [("2", "right", ""), ("2", "left", "")]
    assert [int(row["target"]) for row in found] == step.map.id[target].tolist()
    assert np.abs([float(row["residual_px"]) for row in found] - single.residual_px).max() < 1e-6
    if level == "images":
        table = rows(tmp_path / "dots.csv")
        uv = np.array([[float(table[int(row["row"])][name]) for name in "uv"] for row in found])
        assert np.abs(uv - [step.dots.right.uv_px[20], step.dots.left.uv_px[21]]).max() < 1e-5
    else:
        assert [int(row["row"]) for row in found] == [step.dots.right.row[20], step.dots.left.row[21]]


def test_dots_of_an_image_recording_are_a_recording_again(tmp_path: Path):
    made = list(steps(3, "images"))
    written(tmp_path, "images", made)
    table = read_table(tmp_path / "dots.csv", {"frame": int, "camera": int, "u": float, "v": float, "sigma_px": float})
    expected = [dots for s in made if s.dots for dots in (s.dots.left, s.dots.right)]
    assert np.abs(table["u"] - np.concatenate([dots.uv_px[:, 0] for dots in expected])).max() < 1e-6
    assert table["camera"].tolist() == [k % 2 for k, dots in enumerate(expected) for _ in range(len(dots))]


def test_rivals_are_those_of_ambiguous_frames(run: tuple[Path, list[Step], Summary]):
    out, made, _ = run
    found = rows(out / "rivals.csv")
    ambiguous = [s for s in made if isinstance(s.fix, NoFix) and s.fix.why is Reason.ambiguous]
    assert [int(row["frame"]) for row in found] == [s.frame.index for s in ambiguous for _ in range(2)]
    assert [float(row["odds_to_best"]) for row in found[:2]] == pytest.approx([1.0, np.exp(-0.6)])
    assert [float(row["log_odds"]) for row in found[:2]] == [41.5, 40.9]


def test_free_text_stays_one_cell_of_one_line(run: tuple[Path, list[Step], Summary]):
    out, _, _ = run
    found = rows(out / "events.csv")
    assert [(row["event"], row["target"]) for row in found] == [("target_moved", "102"), ("island_founded", "")]
    assert found[0]["detail"] == 'by 3.1 mm, "far"'


def test_the_map_on_disk_is_the_last_one(run: tuple[Path, list[Step], Summary]):
    out, made, _ = run
    found = read_map(out / "map.csv")
    assert found.id.tolist() == made[-1].map.id.tolist()
    assert found.state.tolist() == made[-1].map.state.tolist()
    assert np.abs(found.xyz_mm - made[-1].map.xyz_mm).max() < 1e-6
    assert f"element vertex {(found.state == 1).sum()}\n" in (out / "map.ply").read_text()


def test_the_summary_counts_what_was_written(run: tuple[Path, list[Step], Summary], level: Level):
    out, made, summary = run
    stored = json.loads((out / "summary.json").read_text())
    assert stored["finished"] is True
    assert (stored["recording"], stored["level"], stored["is_online"]) == ("plate", level, True)
    assert stored["frames"] == len(made) == stored["positioned"] + stored["refused"]
    assert stored["positioned"] == sum(isinstance(s.fix, Fix) for s in made) == summary.positioned
    refused = [s.fix.why.name for s in made if isinstance(s.fix, NoFix)]
    assert stored["reasons"] == {"defines_world": 1} | {name: refused.count(name) for name in refused}
    assert stored["targets"] == {"trusted": 86, "provisional": 3, "quarantined": 1}
    squares = np.concatenate([s.fix.residual_mm**2 for s in made if isinstance(s.fix, Fix)])
    assert stored["residual_mm"]["rms"] == pytest.approx(np.sqrt(squares.mean()))
    assert (stored["residual_px"]["rms"] is None) == (level == "points")
    assert stored["timings"]["identify"]["frames"] > 0
    assert list(stored["timings"])[-1] == "total"
    assert stored["options"] == {"match": {"max_depth_mm": 900.0}}
    assert set(stored["versions"]) == {"trifix", "numpy", "opencv", "numba", "python"}
    assert stored["noise_scale"] == 1.1


def test_timings_have_a_column_a_stage(run: tuple[Path, list[Step], Summary]):
    out, made, _ = run
    found = rows(out / "timings.csv")
    assert len(found) == len(made)
    assert float(found[3]["identify_ms"]) == made[3].timings_ms["identify"]
    assert float(found[3]["total_ms"]) == pytest.approx(sum(made[3].timings_ms.values()))


def test_the_same_steps_give_the_same_bytes(run: tuple[Path, list[Step], Summary], level: Level, tmp_path: Path):
    out, made, _ = run
    written(tmp_path, level, made)
    for each in out.iterdir():
        if each.name not in CLOCKED:
            assert (tmp_path / each.name).read_bytes() == each.read_bytes(), each.name


def test_an_earlier_result_is_replaced(tmp_path: Path):
    written(tmp_path, "images", list(steps(3, "images")))
    (tmp_path / "report.html").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    written(tmp_path, "dots", list(steps(2)))
    assert len(rows(tmp_path / "frames.csv")) == 2
    assert not (tmp_path / "dots.csv").exists()
    assert not (tmp_path / "report.html").exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_folder_of_somebody_else_is_refused_untouched(tmp_path: Path):
    (tmp_path / "frames.csv").write_text("frame,timestamp_ns\n")
    with pytest.raises(RecordingError, match="not results of trifix: name a new or an empty folder"):
        ResultsWriter(tmp_path, "plate", "dots", "", is_online=False).__enter__()
    assert [each.name for each in tmp_path.iterdir()] == ["frames.csv"]
    assert (tmp_path / "frames.csv").read_text() == "frame,timestamp_ns\n"


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path):
    (tmp_path / "out").write_text("")
    with pytest.raises(RecordingError, match="is a file, expected a folder"):
        ResultsWriter(tmp_path / "out", "plate", "dots", "", is_online=False).__enter__()


def test_a_run_without_frames_is_whole(tmp_path: Path):
    summary = written(tmp_path / "a" / "b", "points", [])
    assert (summary.frames, summary.residual_mm.rms, summary.timings) == (0, None, {})
    assert len(read_map(tmp_path / "a" / "b" / "map.csv")) == 0


def test_an_interrupted_run_keeps_everything_and_is_not_finished(tmp_path: Path):
    def interrupted() -> None:
        with ResultsWriter(tmp_path, "plate", "dots", "", is_online=True) as results:
            for step in steps(6):
                results.write(step)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(rows(tmp_path / "frames.csv")) == len(rows(tmp_path / "timings.csv")) == 6
    assert len(read_map(tmp_path / "map.csv")) == 90
    stored = json.loads((tmp_path / "summary.json").read_text())
    assert (stored["finished"], stored["frames"]) == (False, 6)


class FullDisk:
    """Takes a hundred bytes more, then no more."""

    def __init__(self, file: FileIO) -> None:
        self.file, self.left = file, 100

    def write(self, block: bytes) -> int:
        if not self.left:
            raise OSError(28, "No space left on device")
        part, self.left = block[: self.left], 0
        return self.file.write(part)

    def truncate(self, size: int) -> None:
        self.file.truncate(size)

    def close(self) -> None:
        self.file.close()


def test_a_full_disk_is_reported_and_leaves_whole_lines(tmp_path: Path):
    made = list(steps(9))

    def fill_the_disk() -> None:
        with ResultsWriter(tmp_path, "plate", "dots", "", is_online=True) as results:
            results.write(made[0])
            while len(rows(tmp_path / "frames.csv")) == 0:
                time.sleep(0.01)
            results._logs["poses.csv"]._file = FullDisk(results._logs["poses.csv"]._file)
            for step in made[1:]:
                results.write(step)
            results.finish()

    with pytest.raises(RecordingError, match=r"cannot be written there \(No space left on device\)"):
        fill_the_disk()
    assert len(rows(tmp_path / "poses.csv")) == len(rows(tmp_path / "frames.csv")) == 1
    assert json.loads((tmp_path / "summary.json").read_text())["finished"] is False


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system cannot kill a process so")
@pytest.mark.parametrize("seed", range(4))
def test_after_a_kill_whole_rows_agree_for_every_frame_older_than_a_second(tmp_path: Path, seed: int):
    run = Path(__file__).parent / "endless_run.py"
    out = tmp_path / "out"
    process = subprocess.Popen([sys.executable, str(run), str(out)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(random.Random(seed).uniform(1.2, 2.4))
    os.kill(process.pid, signal.SIGKILL)
    killed = time.monotonic_ns()
    said = [line.split() for line in process.stdout.read().split("\n") if len(line.split()) == 2]
    process.wait()
    old = sum(killed - int(ns) > 1_000_000_000 for _, ns in said)
    assert old > 0

    for name in ("frames.csv", "poses.csv", "trajectory.tum", "sightings.csv", "timings.csv"):
        assert (out / name).read_bytes().endswith(b"\n"), name
    frames = rows(out / "frames.csv")
    assert len(frames) >= old
    assert all(None not in row and None not in row.values() for row in frames)  # no row is short or long
    positioned = [int(row["timestamp_ns"]) for row in frames if row["status"] == "positioned"]
    poses_ns, tum_ns = read_poses(out / "poses.csv")[1].tolist(), read_tum(out / "trajectory.tum")[0].tolist()
    assert poses_ns[: len(positioned)] == tum_ns[: len(positioned)] == positioned
    read_map(out / "map.csv")
    assert json.loads((out / "summary.json").read_text())["finished"] is False


def test_names_of_files_that_are_no_text_are_written_all_the_same(tmp_path: Path):
    made = list(steps(3))
    refused = replace(made[1], fix=NoFix(Reason.unreadable_image, "left/\udcff.png cannot be read."))
    written(tmp_path, "dots", [made[0], refused, made[2]])
    assert [row["detail"] for row in rows(tmp_path / "frames.csv")][1] == "left/\\udcff.png cannot be read."
    assert len(rows(tmp_path / "frames.csv")) == 3


def test_whatever_goes_wrong_while_files_are_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(self: object, lines: str) -> None:
        raise ValueError("out of order")

    results = ResultsWriter(tmp_path, "plate", "dots", "", is_online=True)
    with results:
        monkeypatch.setattr("trifix.outputs.results._Log.append", fail)
        results.write(next(steps(1)))
    with pytest.raises(ValueError, match="out of order"):
        results.finish()
