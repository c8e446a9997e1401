"""Trajectories survive being written, time to the nanosecond."""

from pathlib import Path

import numpy as np
import pytest

from trifix.errors import RecordingError
from trifix.files.trajectories import POSES_HEADER, poses_row, read_poses, read_tum, tum_row
from trifix.geometry.pose import Pose


def made_poses(n: int) -> list[Pose]:
    rng = np.random.default_rng(6)
    return [Pose.exp(np.concatenate([rng.uniform(-900, 900, 3), rng.uniform(-1.8, 1.8, 3)])) for _ in range(n)]


def assert_same_poses(a: list[Pose], b: list[Pose], atol_mm: float) -> None:
    assert len(a) == len(b)
    for p, q in zip(a, b, strict=True):
        np.testing.assert_allclose(p.t_mm, q.t_mm, atol=atol_mm)
        np.testing.assert_allclose(p.R, q.R, atol=5e-12)


def test_a_tum_line_is_in_seconds_and_metres_with_w_not_negative() -> None:
    half_turn = Pose(np.diag([1.0, -1.0, -1.0]), np.array([1.5, -0.0000001, 2000.0]))
    assert tum_row(1_403_636_579_763_555_584, half_turn) == (
        "1403636579.763555584 0.001500000 0.000000000 2.000000000 "
        "1.000000000000 0.000000000000 0.000000000000 0.000000000000"
    )
    assert tum_row(-5, half_turn).startswith("-0.000000005 ")


def test_tum_files_read_back_exactly_in_time(tmp_path: Path) -> None:
    stamps = [0, 1, 999_999_999, 1_403_636_579_763_555_584, 1_403_636_579_763_555_585]
    poses = made_poses(len(stamps))
    rows = [tum_row(stamp, pose) for stamp, pose in zip(stamps, poses, strict=True)]
    (tmp_path / "trajectory.tum").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    read_stamps, read = read_tum(tmp_path / "trajectory.tum")
    assert read_stamps.tolist() == stamps
    assert read_stamps.dtype == np.int64
    assert_same_poses(read, poses, 5.1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.0 0 0 0 0 0 1\n", r"a\.tum, line 1: found 7 cells, expected 8 \(timestamp, tx, ty, tz, qx"),
        ("#\nnow 0 0 0 0 0 0 1\n", r"line 2: found the time 'now', expected seconds"),
        ("nan 0 0 0 0 0 0 1\n", r"line 1: found the time 'nan', expected seconds"),
        ("1e300 0 0 0 0 0 0 1\n", r"line 1: found the time '1e300', expected seconds"),
        ("1 0 0 nan 0 0 0 1\n", r"line 1, column 'tz': found 'nan', expected a finite number"),
        ("1 0 0 0 0 0 0 0.9\n", r"line 1: the quaternion qx, qy, qz, qw has length 0\.9, expected 1"),
        ("1 0 0 0 0 0 0 0\n", r"line 1: the quaternion .* has length 0, expected 1"),
    ],
)
def test_a_faulty_trajectory_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_tum(tmp_path / "a.tum")


def test_poses_read_back_with_their_covariances(tmp_path: Path) -> None:
    poses = made_poses(7)
    A = np.random.default_rng(7).normal(size=(7, 6, 6)) * np.array([[0.1], [0.1], [0.3], [1e-4], [1e-4], [1e-3]])
    cov = A @ np.swapaxes(A, 1, 2)
    cov[0] = 0
    rows = [poses_row(3 * k, 40 * k, pose, cov[k]) for k, pose in enumerate(poses)]
    (tmp_path / "poses.csv").write_text("\n".join([POSES_HEADER, *rows]) + "\n")
    index, stamps, read, read_cov = read_poses(tmp_path / "poses.csv")
    assert (index.tolist(), stamps.tolist()) == ([0, 3, 6, 9, 12, 15, 18], [0, 40, 80, 120, 160, 200, 240])
    assert_same_poses(read, poses, 5.1e-7)
    np.testing.assert_allclose(read_cov, cov, rtol=1e-8, atol=1e-12)


def test_the_covariance_is_written_as_its_upper_triangle_row_by_row() -> None:
    names = POSES_HEADER.split(",")
    assert names[:9] == ["frame", "timestamp_ns", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]
    assert names[9:16] == ["c00", "c01", "c02", "c03", "c04", "c05", "c11"]
    assert (len(names), names[-1]) == (30, "c55")
    cov = np.arange(36.0).reshape(6, 6)
    cov = np.triu(cov) + np.triu(cov, 1).T
    cells = dict(zip(names, poses_row(0, 0, Pose.identity(), cov).split(","), strict=True))
    assert all(float(cells[f"c{i}{j}"]) == 6 * i + j for i in range(6) for j in range(i, 6))
