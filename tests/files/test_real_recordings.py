"""The real recordings are read whole: every level, with the counts that their READMEs state."""

from pathlib import Path

import numpy as np
import pytest

from trifix.files.maps import read_map
from trifix.files.recordings import Recording, read_recording
from trifix.files.truth import read_truth
from trifix.geometry.camera import StereoRig
from trifix.records import SensorPoints, StereoDots, StereoImages

CLUSTERS = [f"markers_{a:02}_{a + 3:02}" for a in (*range(1, 30, 4), 41)]


def rows(recording: Recording) -> int:
    """Dots or points in all frames, each row of the table once."""
    seen: list[int] = []
    for frame in recording:
        match frame.content:
            case StereoDots(left=left, right=right):
                seen += [*left.row.tolist(), *right.row.tolist()]
            case SensorPoints() as points:
                seen += points.row.tolist()
    assert sorted(seen) == list(range(len(seen)))
    return len(seen)


@pytest.mark.parametrize(
    ("folder", "frames", "targets", "dots", "points"),
    [
        ("boofcv_dots", 65, 120, 68877, 36176),
        ("dice_plate", 7, 91, 1181, 561),
        ("dice_plate/subset", 7, 25, 350, 175),
        ("chess_subset/seed_1", 13, 25, 650, 370),
        ("chess_subset/seed_2", 13, 25, 650, 367),
        ("chess_subset/seed_3", 13, 25, 650, 373),
        *((f"optotrak_clusters/clusters/{name}", 29, 4, None, 1507) for name in CLUSTERS),
    ],
)
def test_tables_map_and_truth_agree(
    data: Path, folder: str, frames: int, targets: int, dots: int | None, points: int
) -> None:
    truth = read_truth(data / folder / "truth")
    assert (len(truth.frames), len(truth.targets)) == (frames, targets)
    given = read_map(data / folder / "map_given.csv")
    assert given.id.tolist() == truth.targets.id.tolist()
    np.testing.assert_allclose(given.xyz_mm, truth.targets.xyz_mm, atol=5.1e-5)  # printed to 0.1 µm
    for level, labels, count in (("dots", truth.id_of_dot, dots), ("points", truth.id_of_point, points)):
        if count is None:
            assert labels is None
            continue
        recording = read_recording(data / folder / f"recording_{level}")
        assert (recording.level, recording.is_noise_stated) == (level, level == "points")
        assert recording.index.tolist() == truth.frames.index.tolist()
        assert recording.timestamp_ns.tolist() == truth.frames.timestamp_ns.tolist()
        assert labels is not None
        assert rows(recording) == len(labels) == count


@pytest.mark.parametrize(
    ("folder", "frames", "size", "baseline_mm"),
    [("boofcv_dots", 65, (600, 800), None), ("dice_plate", 7, (2048, 2448), 89.6)],
)
def test_images_are_read(
    data: Path, folder: str, frames: int, size: tuple[int, int], baseline_mm: float | None
) -> None:
    recording = read_recording(data / folder / "recording")
    assert (recording.level, len(recording)) == ("images", frames)
    assert (recording.rig is None) == (baseline_mm is None)
    for frame in (recording.frame(0), recording.frame(-1)):
        assert isinstance(frame.content, StereoImages)
        assert frame.content.left.shape == frame.content.right.shape == size
        assert isinstance(frame.rig, StereoRig)
        if baseline_mm is not None:
            assert abs(frame.rig.baseline_mm - baseline_mm) < 0.1


@pytest.mark.parametrize(
    ("folder", "rms_px"), [("boofcv_dots", 0.32), ("dice_plate", 0.47), ("chess_subset/seed_1", 0.22)]
)
def test_true_targets_project_onto_their_dots(data: Path, folder: str, rms_px: float) -> None:
    """Units, sides and directions of all transforms at once: the rms (2-D) that the READMEs state."""
    truth = read_truth(data / folder / "truth")
    assert truth.id_of_dot is not None
    squares: list[float] = []
    for frame, T_map_sensor in zip(
        read_recording(data / folder / "recording_dots"), truth.frames.T_map_sensor, strict=True
    ):
        assert isinstance(frame.content, StereoDots)
        assert frame.rig is not None
        in_sensor = T_map_sensor.inverse().apply(truth.targets.xyz_mm)
        in_right = frame.rig.T_right_left.apply(in_sensor)
        for dots, camera, xyz in (
            (frame.content.left, frame.rig.left, in_sensor),
            (frame.content.right, frame.rig.right, in_right),
        ):
            ids = truth.id_of_dot[dots.row]
            target = np.searchsorted(truth.targets.id, ids[ids >= 0])
            squares += ((camera.project(xyz[target]) - dots.uv_px[ids >= 0]) ** 2).sum(axis=1).tolist()
    assert abs(np.sqrt(np.mean(squares)) - rms_px) < 0.006
