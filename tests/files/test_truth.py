"""The truth is read in millimetres and radians, and must not contradict itself."""

from pathlib import Path

import numpy as np
import pytest

from trifix.errors import RecordingError
from trifix.files.truth import read_truth

FRAMES = """\
frame,timestamp_ns,n_visible_cam0,n_visible_cam1,n_visible_both,n_known_both,positionable,reachable_online,\
reachable_offline,kidnapped,blank,sigma_pos_mm,sigma_rot_deg
0,1000000000,5,6,4,0,0,1,1,0,0,,
2,1033333333,7,8,3,3,1,0,1,1,0,0.5,180
"""

FILES = {
    "frames_truth.csv": FRAMES,
    "trajectory.tum": "1.000000000 0.1 0 -1.5 0 0 0 1\n1.033333333 0 0 0 1 0 0 0\n",
    "map.csv": "id,x,y,z,nx,ny,nz,valid_from,valid_to,frames_seen_both,name\n"
    "3,0.01,-0.02,0.5,0,0,-1,0,3,2,a\n8,0,0,0.001,,,,1,3,0,b\n",
    "labels_dots.csv": "row,frame,id\n0,0,3\n1,2,-1\n2,0,8\n",
    "labels_points.csv": "row,frame,id\n1,2,3\n0,0,-1\n",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_metres_become_millimetres_and_degrees_radians(folder: Path) -> None:
    truth = read_truth(folder)
    assert (len(truth.frames), len(truth.targets)) == (2, 2)
    np.testing.assert_allclose(truth.frames.T_map_sensor[0].t_mm, [100, 0, -1500])
    np.testing.assert_allclose(truth.frames.T_map_sensor[1].R, np.diag([1, -1, -1]), atol=1e-15)
    np.testing.assert_allclose(truth.targets.xyz_mm, [[10, -20, 500], [0, 0, 1]])
    np.testing.assert_array_equal(truth.frames.sigma_position_mm, [np.nan, 0.5])
    np.testing.assert_array_equal(truth.frames.sigma_rotation_rad, [np.nan, np.pi])


def test_counts_flags_and_labels_are_read(folder: Path) -> None:
    truth = read_truth(folder)
    frames, targets = truth.frames, truth.targets
    assert (frames.index.tolist(), frames.timestamp_ns.tolist()) == ([0, 2], [1_000_000_000, 1_033_333_333])
    assert (frames.visible_left.tolist(), frames.visible_right.tolist()) == ([5, 7], [6, 8])
    assert (frames.visible_both.tolist(), frames.known_both.tolist()) == ([4, 3], [0, 3])
    assert (frames.positionable.tolist(), frames.kidnapped.tolist()) == ([False, True], [False, True])
    assert (frames.reachable_online.tolist(), frames.reachable_offline.tolist()) == ([True, False], [True, True])
    assert frames.blank.tolist() == [False, False]
    assert (targets.id.tolist(), targets.frames_seen_both.tolist()) == ([3, 8], [2, 0])
    assert (targets.valid_from.tolist(), targets.valid_to.tolist()) == ([0, 1], [3, 3])
    np.testing.assert_array_equal(targets.normal, [[0, 0, -1], [np.nan, np.nan, np.nan]])
    assert truth.id_of_dot is not None
    assert truth.id_of_point is not None
    assert (truth.id_of_dot.tolist(), truth.id_of_point.tolist()) == ([3, -1, 8], [-1, 3])


def test_labels_may_be_missing(folder: Path) -> None:
    (folder / "labels_dots.csv").unlink()
    truth = read_truth(folder)
    assert truth.id_of_dot is None
    assert truth.id_of_point is not None


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "frames_truth.csv",
            "1,0,1,1,0,0.5",
            "1,0,2,1,0,0.5",
            r"line 3, column 'reachable_offline': found 2, expected 0",
        ),
        (
            "frames_truth.csv",
            "1033333333",
            "1033335333",
            r"frame 2 has time stamp 1033335333, in trajectory\.tum it has",
        ),
        (
            "trajectory.tum",
            "1.000000000 0.1 0 -1.5 0 0 0 1\n",
            "",
            r"has 1 poses, expected one for each of the 2 frames",
        ),
        ("map.csv", "valid_from", "from", r"map\.csv: column 'valid_from' is missing"),
        ("labels_dots.csv", "2,0,8", "3,0,8", r"labels_dots\.csv, line 4: found row 3, expected each of 0 to 2 once"),
        ("labels_dots.csv", "2,0,8", "1,0,8", r"labels_dots\.csv, line 4: found row 1, expected each of 0 to 2 once"),
        ("labels_dots.csv", "2,0,8", "2,1,8", r"line 4, column 'frame': found 1, expected a frame of frames_truth"),
        (
            "labels_points.csv",
            "2,3",
            "2,4",
            r"labels_points\.csv, line 2, column 'id': found 4, expected -1 or a target",
        ),
    ],
)
def test_truth_that_contradicts_itself_is_refused(folder: Path, name: str, old: str, new: str, message: str) -> None:
    assert old in FILES[name]
    (folder / name).write_text(FILES[name].replace(old, new, 1))
    with pytest.raises(RecordingError, match=message):
        read_truth(folder)


@pytest.mark.parametrize("name", ["frames_truth.csv", "trajectory.tum", "map.csv"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(RecordingError, match=f"{name} does not exist"):
        read_truth(folder)
    with pytest.raises(RecordingError, match="is not a folder, expected the truth"):
        read_truth(folder / name)
