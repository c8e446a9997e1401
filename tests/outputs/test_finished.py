from pathlib import Path

import numpy as np
import pytest
from finished_runs import FRAMES, write_run

from trifix.errors import RecordingError
from trifix.outputs.finished import FinishedRun, recording_beside
from trifix.outputs.moments import drawn, moment_of
from trifix.records import Fix, Step


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Step]]:
    folder = tmp_path_factory.mktemp("finished")
    return folder, write_run(folder)


def test_frames_are_shown_as_their_steps_were(folder: tuple[Path, list[Step]]) -> None:
    path, steps = folder
    run = FinishedRun(path / "results", path / "plate")
    assert len(run) == FRAMES
    assert run.is_finished
    last = None
    for k, step in enumerate(steps):
        was, now = moment_of(step, last), run.moment(k)
        assert (now.frame, now.timestamp_ns, now.is_positioned) == (was.frame, was.timestamp_ns, was.is_positioned)
        assert (now.reason, now.detail, now.points, now.matched) == (was.reason, was.detail, was.points, was.matched)
        np.testing.assert_allclose(now.residual_mm, was.residual_mm, atol=1e-6)
        np.testing.assert_allclose(now.sigma_mm, was.sigma_mm, rtol=1e-6)
        assert sorted(now.targets) == sorted(was.targets)
        assert (now.advice is None) == (was.advice is None)
        if isinstance(step.fix, Fix):
            last = step.fix.T_world_sensor
            assert now.pose is not None
            assert now.pose.distance_mm(last) < 1e-5
            for shot, before in zip(now.shots, was.shots, strict=True):
                np.testing.assert_allclose(shot.dots["identified"], before.dots["identified"], atol=1e-6)
                assert shot.image is not None
                assert before.image is not None
                np.testing.assert_array_equal(shot.image, before.image)


def test_a_frame_whose_image_cannot_be_read_shows_none(folder: tuple[Path, list[Step]]) -> None:
    path, _ = folder
    run = FinishedRun(path / "results", path / "plate")
    moment = run.moment(40)
    assert moment.reason == "unreadable_image"
    assert moment.shots == ()
    assert moment.pose is not None, "where the sensor was last"


def test_sightings_of_a_target_name_frames_cameras_and_residuals(folder: tuple[Path, list[Step]]) -> None:
    path, steps = folder
    run = FinishedRun(path / "results")
    fix = steps[1].fix
    assert isinstance(fix, Fix)
    target = int(steps[1].map.id[fix.target[0]])
    sightings = run.sightings(target)
    assert 1 in sightings.frame
    at = list(sightings.frame).index(1)
    assert sightings.residual_mm[at] == pytest.approx(fix.residual_mm[0], abs=1e-6)
    assert 0.0 <= sightings.residual_px[at] < 1.5
    assert sightings.cameras[at] == "left and right"
    assert (np.diff(sightings.frame) > 0).all()
    assert not len(run.sightings(123456).frame)


def test_a_recording_beside_the_results_is_found(folder: tuple[Path, list[Step]], tmp_path: Path) -> None:
    path, _ = folder
    assert recording_beside(path / "results") == path.resolve() / "plate"
    assert recording_beside(tmp_path) is None


def test_marks_are_drawn_where_the_dots_are(folder: tuple[Path, list[Step]]) -> None:
    path, _ = folder
    shot = FinishedRun(path / "results", path / "plate").moment(1).shots[0]
    plain = drawn(shot.__class__(shot.image, shot.width_px, shot.height_px, {}), np.zeros((0, 2)))
    marked = drawn(shot, np.array([[320.0, 240.0]]))
    assert plain.shape == marked.shape == (540, 720, 3)
    changed = np.abs(marked.astype(int) - plain).sum(axis=2) > 60
    for u, v in (np.concatenate([shot.dots["identified"], [[320.0, 240.0]]]) + 0.5) * 720 / 640 - 0.5:
        rows, columns = slice(max(int(v) - 16, 0), int(v) + 17), slice(max(int(u) - 16, 0), int(u) + 17)
        assert changed[rows, columns].sum() > 30


def test_what_is_no_finished_run_is_refused_in_one_sentence(folder: tuple[Path, list[Step]], tmp_path: Path) -> None:
    path, _ = folder
    with pytest.raises(RecordingError, match="is not a folder, expected results that `trifix run` wrote"):
        FinishedRun(tmp_path / "nothing")
    with pytest.raises(RecordingError, match=r"holds no summary\.json: expected results that `trifix run` wrote"):
        FinishedRun(tmp_path)
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(RecordingError, match="is no summary of a run"):
        FinishedRun(tmp_path)
    (tmp_path / "summary.json").write_text((path / "results" / "summary.json").read_text())
    with pytest.raises(RecordingError, match=r"frames\.csv does not exist"):
        FinishedRun(tmp_path)
    for name in ("frames.csv", "poses.csv", "sightings.csv", "map.csv"):
        (tmp_path / name).write_text((path / "results" / name).read_text().split("\n")[0] + "\n")
    with pytest.raises(RecordingError, match="has not positioned or refused any frame yet"):
        FinishedRun(tmp_path)


def test_a_run_cut_short_is_shown_and_says_so(tmp_path: Path) -> None:
    write_run(tmp_path, is_finished=False)
    run = FinishedRun(tmp_path / "results", tmp_path / "plate")
    assert len(run) == FRAMES
    assert not run.is_finished


def test_a_recording_of_other_frames_is_refused(folder: tuple[Path, list[Step]], tmp_path: Path) -> None:
    path, _ = folder
    (tmp_path / "plate").mkdir()
    for each in ("left", "right"):
        (tmp_path / "plate" / each).symlink_to(path / "plate" / each)
    (tmp_path / "plate" / "calibration.yaml").symlink_to(path / "plate" / "calibration.yaml")
    rows = "\n".join(f"{k + 900},{k}" for k in range(FRAMES))
    (tmp_path / "plate" / "frames.csv").write_text(f"frame,timestamp_ns\n{rows}\n")
    with pytest.raises(RecordingError, match="has none of the frames"):
        FinishedRun(path / "results", tmp_path / "plate")
