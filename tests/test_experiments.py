"""The paper's experiments: what is measured, that nothing is measured twice, and what happens when all goes wrong."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from test_cli import SMALL, trifix
from trifix.config import paper_options
from trifix.errors import ConfigError, SimulationError
from trifix.experiments import paper
from trifix.experiments.measuring import Part, growth, slope
from trifix.experiments.page import claims, write_experiment
from trifix.experiments.paper import TECHNIQUES, run_paper, tasks
from trifix.geometry.pose import Pose, exp_rotation
from trifix.positioner import Positioner
from trifix.records import Fix, Frame, NoFix, Reason, ReferenceMap, SensorPoints

FRAMES = 60


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small experiment, as the command line makes it."""
    out = tmp_path_factory.mktemp("experiment") / "out"
    names = ["--scenes", "statue", "plane", "--techniques", "distances", "frequency"]
    done = trifix("experiment", "paper", "-o", out, "--frames", FRAMES, *names)
    assert done.code == 0, done.stderr
    (out / "printed.txt").write_text(done.stdout, encoding="utf-8")
    return out


@pytest.fixture(scope="module")
def parts(room: Path) -> dict[str, Part]:
    found = run_paper(room, ["statue", "plane"], ["distances", "frequency"], FRAMES)
    return {f"{part.scene} {part.technique}": part for part in found}


def stamps(room: Path) -> dict[str, int]:
    return {file.name: file.stat().st_mtime_ns for file in (room / "parts").iterdir()}


def table(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


# --- what is measured ------------------------------------------------------------------------------------------------


def test_every_frame_is_counted_once(parts: dict[str, Part]) -> None:
    assert list(parts) == ["statue frequency", "statue distances", "plane frequency", "plane distances"]
    for part in parts.values():
        assert part.frames == FRAMES == part.positioned + sum(part.refused.values())
        assert len(part.targets) == len(part.sizes) == FRAMES
        assert part.positioned == len(part.path_frame) == len(part.path_mm)
        assert part.positioned_of_reachable <= part.reachable <= FRAMES
        assert part.positioned_of_sharing <= part.sharing
        assert len(part.map_mm) == part.targets[-1] == len(part.sightings)


def test_on_a_plane_each_technique_positions_every_frame_rightly(parts: dict[str, Part]) -> None:
    for name in ("plane frequency", "plane distances"):
        part = parts[name]
        assert part.positioned == FRAMES
        assert part.misidentified == []
        assert part.error_mm.median is not None
        assert 0.01 < part.error_mm.median < 2.0
        assert part.unknown_targets == part.duplicates == 0


def test_distances_grow_with_the_square_and_frequency_triangles_do_not(parts: dict[str, Part]) -> None:
    of_distances, of_frequency = parts["plane distances"], parts["plane frequency"]
    assert of_distances.sizes == [n * (n - 1) // 2 for n in of_distances.targets]
    assert max(of_frequency.sizes) <= 3 * max(of_frequency.targets)
    assert 0 < of_frequency.sizes[-1] == len(of_frequency.triangles)
    assert of_frequency.kept is not None
    assert 0.5 < of_frequency.kept <= 1.0
    assert of_frequency.without_triangle == 0
    assert of_distances.kept is None
    assert of_distances.comparisons.median is not None


def test_the_targets_are_found_where_they_truly_are(parts: dict[str, Part]) -> None:
    part = parts["plane frequency"]
    true, found = np.array(part.true_mm), np.array(part.map_mm)
    distance = np.linalg.norm(found[:, None] - true, axis=2).min(axis=1)
    assert np.median(distance) < 1.0  # in coordinates of the object, to which path and targets were brought


def test_growth_is_the_median_at_each_size_of_the_list() -> None:
    count, size = growth([0, 3, 3, 3, 5, 5], [0, 1, 3, 8, 7, 9])
    np.testing.assert_array_equal(count, [3, 5])
    np.testing.assert_array_equal(size, [3, 8])
    assert slope([10, 20, 30], [25, 45, 65]) == pytest.approx(2.0)
    assert slope([7, 7], [10, 12]) is None


def test_the_papers_techniques_are_tried_and_ours_is_not() -> None:
    named = {"frequency", "minimal", "delaunay", "triangles", "hashing", "distances", "icp"}
    assert set(TECHNIQUES) == named  # each has a line in the figures


def test_the_paper_judges_by_one_tolerance_and_residuals_alone() -> None:
    for technique in TECHNIQUES:
        options = paper_options(technique)
        assert options.identify.technique == technique
        assert options.identify.max_sigmas == 0
        assert options.verify.method == "residual"
        assert options.update.method == "kalman"
        assert options.update.max_misses == 0
        assert replace(options, identify=paper_options().identify) == paper_options()


# --- what is shown ---------------------------------------------------------------------------------------------------


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.drawings = 0

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.drawings += tag == "svg"
        for name, value in attributes:
            if name in ("src", "href", "xlink:href") and value and not value.startswith(("#", "data:")):
                self.addresses.append(value)


def test_the_page_holds_all_figures_and_asks_for_nothing(room: Path) -> None:
    text = (room / "experiment.html").read_text(encoding="utf-8")
    page = _Page()
    page.feed(text)
    assert page.addresses == []
    assert page.drawings == 5
    assert "nan" not in text.lower().replace("nanm", "")
    names = {"accepted", "growth", "triangles", "path-statue", "path-plane"}
    assert {file.name for file in (room / "figures").iterdir()} == {f"{n}.{e}" for n in names for e in ("svg", "png")}


def test_the_tables_hold_the_same_numbers(room: Path, parts: dict[str, Part]) -> None:
    rows = table(room / "tables" / "techniques.csv")
    assert [f"{row['scene']} {row['technique']}" for row in rows] == list(parts)
    assert [int(row["positioned"]) for row in rows] == [part.positioned for part in parts.values()]
    compared = {row["quantity"]: row for row in table(room / "tables" / "paper.csv")}
    assert compared["plane: positioned by frequency"]["paper"] == "94"
    assert float(compared["plane: positioned by frequency"]["ours"]) == 100.0
    assert compared["statue: failures of distances on top of these"]["paper"] == "16"
    printed = (room / "printed.txt").read_text(encoding="utf-8")
    for quantity in compared:
        assert quantity in printed


def test_claims_count_failures_among_all_frames(parts: dict[str, Part]) -> None:
    part = replace(parts["statue frequency"], frames=200, positioned=100, reachable=150, positioned_of_reachable=98)
    ours = {claim.what: claim.ours for claim in claims([part])}
    assert ours["statue: frames that no technique can position"] == pytest.approx(25.0)
    assert ours["statue: failures of frequency on top of these"] == pytest.approx(26.0)
    assert ours["statue: positioned by frequency"] == pytest.approx(50.0)


def test_a_part_without_poses_is_shown_too(parts: dict[str, Part], tmp_path: Path) -> None:
    none = replace(
        parts["statue frequency"],
        positioned=0,
        targets=[0] * FRAMES,
        sizes=[0] * FRAMES,
        kept=None,
        map_mm=[],
        sightings=[],
        triangles=[],
        path_mm=[],
        path_frame=[],
    )
    assert write_experiment([none], tmp_path, "trifix experiment paper").exists()


# --- nothing twice ---------------------------------------------------------------------------------------------------


def test_what_is_finished_is_not_measured_again(room: Path) -> None:
    before = stamps(room)
    names = ["statue", "plane"], ["frequency", "distances"]
    run_paper(room, *names, FRAMES)
    assert stamps(room) == before


def test_what_is_broken_is_measured_again_and_comes_out_the_same(
    room: Path, parts: dict[str, Part], tmp_path: Path
) -> None:
    again = tmp_path / "again"
    shutil.copytree(room, again)
    file = again / "parts" / "plane-distances.json"
    file.write_bytes(file.read_bytes()[:1000])
    before = stamps(again)
    found = run_paper(again, ["plane"], ["frequency", "distances"], FRAMES)
    assert {name for name, stamp in stamps(again).items() if stamp != before[name]} == {"plane-distances.json"}
    assert [replace(part, frame_ms=found[0].frame_ms) for part in found] == [
        replace(parts[name], frame_ms=found[0].frame_ms) for name in ("plane frequency", "plane distances")
    ]


def test_other_inputs_are_other_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def keys(frames: int | None = 9, seed: int = 0) -> set[str]:
        simulations, measurements = tasks(tmp_path, ["plane", "head"], ["minimal", "icp"], frames, seed)
        assert len(simulations) == 2
        assert len(measurements) == 4
        return {task.key for task in (*simulations, *measurements)}

    first = keys()
    assert len(first) == 6
    assert keys() == first
    assert keys(frames=10).isdisjoint(first)
    assert keys(frames=None).isdisjoint(first)
    assert keys(seed=1).isdisjoint(first)
    monkeypatch.setattr(paper, "code_key", lambda: "a program that was changed")
    assert keys().isdisjoint(first)


def test_an_interrupt_leaves_finished_parts_whole_and_ends_at_once(tmp_path: Path) -> None:
    options = ["--scenes", "plane", "--techniques", "frequency", "hashing", "triangles", "--workers", "1"]
    command = [sys.executable, "-m", "trifix", "experiment", "paper", "-o", str(tmp_path), *options, "--frames", "150"]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 60
    while not list((tmp_path / "parts").glob("*.json")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does: to all processes of the command
    _, stderr = running.communicate(timeout=30)
    assert running.returncode == 130
    assert stderr.splitlines()[-1] == "trifix: interrupted; what was finished until then is whole."
    assert "Traceback" not in stderr
    files = {file.name for file in (tmp_path / "parts").iterdir()}
    assert "plane-frequency.json" in files
    assert "plane-triangles.json" not in files
    assert all(name.endswith(".json") for name in files)
    before = stamps(tmp_path)["plane-frequency.json"]
    run_paper(tmp_path, ["plane"], ["frequency"], 150)
    assert stamps(tmp_path)["plane-frequency.json"] == before


# --- bad input -------------------------------------------------------------------------------------------------------


def test_an_unknown_name_is_answered_with_the_nearest_known(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(SimulationError, match=r"There is no scene 'statute'; did you mean 'statue'\?"):
        run_paper(out, ["statute"])
    with pytest.raises(ConfigError, match=r"There is no technique 'frequence'; did you mean 'frequency'\?"):
        run_paper(out, techniques=["frequence"])
    assert not out.exists()


def test_numbers_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="An experiment of 0 frames cannot be made: at least 1 is needed"):
        run_paper(tmp_path / "out", ["plane"], ["frequency"], frames=0)
    with pytest.raises(ConfigError, match="The seed is -1: it must not be negative"):
        run_paper(tmp_path / "out", ["plane"], ["frequency"], frames=3, seed=-1)
    assert not (tmp_path / "out").exists()


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear", encoding="utf-8")
    with pytest.raises(ConfigError, match="holds files that are not an experiment's: name a new or an empty folder"):
        run_paper(tmp_path)
    with pytest.raises(ConfigError, match="is a file, expected a folder for the experiment: name another"):
        run_paper(tmp_path / "letter.txt")
    assert [file.name for file in tmp_path.iterdir()] == ["letter.txt"]


def test_an_experiment_of_one_frame_comes_to_its_end(tmp_path: Path) -> None:
    done = trifix("experiment", "paper", "-o", tmp_path, "--scenes", "plane", "--techniques", "minimal", "--frames", 1)
    assert done.code == 0, done.stderr
    assert (tmp_path / "experiment.html").exists()


SCATTER = np.random.default_rng(5).uniform(-120, 120, (12, 3)) + [0, 0, 450]


def seen(xyz_mm: np.ndarray, index: int = 1) -> Frame:
    n = len(xyz_mm)
    points = SensorPoints(xyz_mm, np.tile(0.01 * np.eye(3), (n, 1, 1)), np.full(n, -1), np.full(n, -1), np.arange(n))
    return Frame(index, index, None, points)


@pytest.mark.parametrize("technique", TECHNIQUES)
class TestEveryTechnique:
    def test_refuses_what_holds_no_pose(self, technique: str) -> None:
        positioner = Positioner(paper_options(technique), ReferenceMap.given(SCATTER))  # type: ignore[arg-type]
        line = np.linspace([0, 0, 400], [90, 30, 430], 5)
        strangers = np.random.default_rng(8).uniform(-900, 900, (7, 3)) + [0, 0, 2000]
        for k, (points, reasons) in enumerate(
            [
                (SCATTER[:0], {Reason.too_few_points}),
                (SCATTER[:2], {Reason.too_few_points}),
                (line, {Reason.no_candidate, Reason.residual, Reason.weak_geometry}),
                (strangers, {Reason.no_candidate, Reason.residual}),
            ]
        ):
            fix = positioner.step(seen(points, k)).fix
            assert isinstance(fix, NoFix)
            assert fix.why in reasons

    def test_gives_no_pose_against_a_map_on_one_line_or_of_two_targets(self, technique: str) -> None:
        for targets in (SCATTER[:2], np.linspace([0, 0, 400], [200, 70, 470], 9)):
            positioner = Positioner(paper_options(technique), ReferenceMap.given(targets))  # type: ignore[arg-type]
            for points in (SCATTER, targets):
                assert isinstance(positioner.step(seen(points)).fix, NoFix)

    def test_finds_the_pose_of_what_it_knows(self, technique: str) -> None:
        positioner = Positioner(paper_options(technique))  # type: ignore[arg-type]
        T = Pose(exp_rotation(np.array([0.02, -0.03, 0.05])), np.array([4.0, -3, 2]))
        positioner.step(seen(SCATTER, 0))
        fix = positioner.step(seen(T.inverse().apply(SCATTER), 1)).fix
        assert isinstance(fix, Fix)
        assert np.linalg.norm((T.inverse() @ fix.T_world_sensor).log()) < 1e-3


# --- run as the paper does -------------------------------------------------------------------------------------------


def test_run_takes_the_papers_options_and_those_said_beside_them(tmp_path: Path) -> None:
    done = trifix("run", SMALL / "recording", "-o", tmp_path, "--paper", "--identify", "minimal", "--update", "mean")
    assert done.code == 0, done.stderr
    summary = (tmp_path / "summary.json").read_text(encoding="utf-8")
    for text in ('"technique": "minimal"', '"method": "mean"', '"method": "residual"', '"is_online": true'):
        assert text in summary
    assert '"tolerance_mm": 0.4' in summary


def test_a_file_of_options_and_the_papers_exclude_each_other(tmp_path: Path) -> None:
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out", "--paper", "--config", "mine.toml")
    assert done.code == 2
    assert "choose one" in done.stderr


def test_an_empty_recording_is_run_to_its_end(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    recording.mkdir()
    (recording / "calibration.yaml").write_bytes((SMALL / "recording" / "calibration.yaml").read_bytes())
    (recording / "frames.csv").write_text("frame,timestamp_ns\n", encoding="utf-8")
    (recording / "dots.csv").write_text("frame,timestamp_ns,camera,u,v\n", encoding="utf-8")
    done = trifix("run", recording, "-o", tmp_path / "out", "--paper")
    assert done.code in (0, 1)
    assert "Traceback" not in done.stderr
