from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_steps import steps
from test_report import Page

from trifix.errors import RecordingError
from trifix.geometry.pose import Pose
from trifix.outputs.comparison import Comparison, compare_runs, differences, write_comparison
from trifix.outputs.results import ResultsWriter
from trifix.outputs.runs import read_run
from trifix.records import Fix, NoFix, PositionedReason, Reason, ReferenceMap, Step

OPTIONS = "[match]\nmax_depth_mm = 900.0\n"


@pytest.fixture(scope="module")
def made() -> list[Step]:
    return list(steps(60, n_targets=40))


def written(out: Path, made: list[Step], options: str = OPTIONS) -> Path:
    with ResultsWriter(out, "plate", "dots", options, is_online=True) as results:
        for step in made:
            results.write(step)
        results.finish()
    return out


def compared(first: Path, second: Path) -> Comparison:
    return compare_runs(read_run(first), read_run(second))


def with_fixes(made: list[Step], change: Callable[[Fix], Fix]) -> list[Step]:
    return [replace(step, fix=change(step.fix)) if isinstance(step.fix, Fix) else step for step in made]


def moved(made: list[Step], T: Pose) -> list[Step]:
    """The same in another world."""
    targets = replace(made[0].map, xyz_mm=T.apply(made[0].map.xyz_mm), cov_mm2=T.R @ made[0].map.cov_mm2 @ T.R.T)
    there = with_fixes(made, lambda fix: replace(fix, T_world_sensor=T @ fix.T_world_sensor))
    return [replace(step, map=targets) for step in there]


def positioned(made: list[Step]) -> int:
    return sum(isinstance(step.fix, Fix) for step in made)


def test_a_run_and_itself_are_nothing_apart(made: list[Step], tmp_path: Path):
    out = written(tmp_path / "out", made)
    c = compared(out, out)
    assert (c.frames, c.judged_by_one) == (60, 0)
    assert (c.positioned_by_both, c.positioned_by_first, c.positioned_by_second) == (positioned(made), 0, 0)
    assert c.positioned_by_none == 60 - positioned(made)
    assert not c.is_aligned
    assert max(c.difference_mm.max, c.difference_deg.max, c.difference_sigmas.max, c.target_mm.max) < 1e-6
    assert (c.targets_in_both, c.targets_in_first, c.targets_in_second) == (39, 0, 0)
    assert (c.options, c.versions, c.furthest) == ({}, {}, ())


def test_poses_are_apart_by_what_one_was_moved_in_the_units_of_both_covariances(made: list[Step], tmp_path: Path):
    offset = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])

    def off(fix: Fix) -> Fix:
        if fix.reason is PositionedReason.defines_world:
            return fix
        return replace(fix, T_world_sensor=fix.T_world_sensor @ Pose.exp(offset))

    c = compared(written(tmp_path / "one", made), written(tmp_path / "two", with_fixes(made, off)))
    # 0.1 mm of standard deviation along x in each run; one of six degrees of freedom
    expected = 0.3 / np.sqrt(2 * 0.01) / np.sqrt(6)
    assert abs(c.difference_mm.median - 0.3) < 1e-5
    assert abs(c.difference_sigmas.median - expected) < 1e-4
    assert abs(c.difference_sigmas.max - expected) < 1e-4
    assert c.difference_deg.max < 1e-5
    assert len(c.furthest) == 5
    assert c.furthest[0].frame != 0


def test_frames_are_counted_by_who_positioned_them(made: list[Step], tmp_path: Path):
    refused = [
        replace(step, fix=NoFix(Reason.out_of_time)) if 10 <= k < 20 and isinstance(step.fix, Fix) else step
        for k, step in enumerate(made)
    ]
    lost = positioned(made) - positioned(refused)
    c = compared(written(tmp_path / "one", made), written(tmp_path / "two", refused[:50]))
    assert lost > 5
    assert (c.positioned_by_both, c.positioned_by_first) == (positioned(refused[:50]), lost)
    assert (c.frames, c.judged_by_one, c.positioned_by_second) == (50, 10, 0)
    assert (c.refused["out_of_time"].first, c.refused["out_of_time"].second) == (0, lost)
    assert "defines_world" in c.special


def test_runs_in_different_worlds_are_aligned_and_it_is_said(made: list[Step], tmp_path: Path):
    T = Pose.exp(np.array([400.0, -50.0, 80.0, 0.4, -0.9, 0.3]))
    there = moved(made, T)
    first, second = made[0].fix, there[1].fix
    assert isinstance(first, Fix)
    assert isinstance(second, Fix)
    there[0] = replace(there[0], fix=replace(there[0].fix, reason=None))
    there[1] = replace(there[1], fix=replace(second, reason=PositionedReason.defines_world))
    runs = read_run(written(tmp_path / "one", made)), read_run(written(tmp_path / "two", there))
    c = compare_runs(*runs)
    assert c.is_aligned
    assert differences(*runs).T_first_second.distance_mm(T.inverse()) < 1e-3
    assert c.difference_mm.max < 1e-3
    assert (c.targets_in_both, c.targets_in_first) == (39, 0)


def test_targets_further_apart_than_their_covariances_allow_are_two(made: list[Step], tmp_path: Path):
    xyz_mm = made[0].map.xyz_mm.copy()
    xyz_mm[0] += [0.0, 0.0, 3.0]
    xyz_mm[1] += [0.05, 0.0, 0.0]
    other = [replace(step, map=replace(step.map, xyz_mm=xyz_mm)) for step in made]
    c = compared(written(tmp_path / "one", made), written(tmp_path / "two", other))
    assert (c.targets_in_both, c.targets_in_first, c.targets_in_second) == (38, 1, 1)
    assert abs(c.target_mm.max - 0.05) < 1e-5
    assert abs(c.target_sigmas.max - 0.05 / np.sqrt(3 * (2 * 0.004 + 0.05**2))) < 1e-4


def test_options_that_differ_are_named(made: list[Step], tmp_path: Path):
    other = "[match]\nmax_depth_mm = 800.0\n[update]\nmethod = 'mean'\n"
    c = compared(written(tmp_path / "one", made), written(tmp_path / "two", made, other))
    assert c.options == {"match.max_depth_mm": (900.0, 800.0), "update.method": (None, "mean")}


@pytest.mark.parametrize("count", [0, 1, 3])
def test_runs_that_found_nothing_can_be_compared(made: list[Step], tmp_path: Path, count: int):
    nothing = [replace(step, fix=NoFix(Reason.no_candidate), map=ReferenceMap.empty()) for step in made[:count]]
    out = written(tmp_path / "out", nothing)
    run = read_run(out)
    c = compare_runs(run, run)
    assert (c.frames, c.positioned_by_none, c.targets_in_both) == (count, count, 0)
    assert np.isnan(c.difference_mm.rmse)
    write_comparison(c, run, run, tmp_path / "page.html")


def test_the_page_shows_both_runs_and_asks_nothing_of_the_network(made: list[Step], tmp_path: Path):
    runs = read_run(written(tmp_path / "one", made)), read_run(written(tmp_path / "two", made[:50]))
    write_comparison(compare_runs(*runs), *runs, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert all(address.startswith(("data:", "#")) for address in page.loaded)
    assert text.count("<svg xmlns") == 5
    words = " ".join(" ".join(page.words).split())
    assert f"Targets and path: {tmp_path / 'one'}" in words
    assert page.tags.count("canvas") == 2
    assert "50, 10 more judged by one run only" in words


def test_what_is_no_pair_of_runs_is_refused_in_one_sentence(made: list[Step], tmp_path: Path):
    out = written(tmp_path / "out", made)
    with pytest.raises(RecordingError, match="nowhere is not a folder, expected results that `trifix run` wrote"):
        read_run(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"empty holds no summary.json: expected results"):
        read_run(tmp_path / "empty")
    (tmp_path / "empty" / "summary.json").write_text('{"recording": 3}', encoding="utf-8")
    with pytest.raises(RecordingError, match=r"is no summary of a run \(.*\): run the recording again"):
        read_run(tmp_path / "empty")
    later = [replace(step, frame=replace(step.frame, timestamp_ns=step.frame.timestamp_ns + 1)) for step in made]
    with pytest.raises(RecordingError, match="are not of one recording: frame 0 was taken at 1000000000 ns and"):
        compared(out, written(tmp_path / "later", later))
    others = [replace(step, frame=replace(step.frame, index=step.frame.index + 1000)) for step in made]
    with pytest.raises(RecordingError, match="have no frame in common"):
        compared(out, written(tmp_path / "others", others))
