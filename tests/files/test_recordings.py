"""Recordings are read at every level; a faulty one is refused, a faulty frame is set aside."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from recording_folders import SIZE, STAMPS, made_image, made_rig, write_euroc, write_image, write_tables

from trifix.errors import CalibrationError, RecordingError
from trifix.files.calibrations import write_rig
from trifix.files.recordings import (
    DOTS_HEADER,
    Recording,
    dots_rows,
    read_recording,
    write_dots,
    write_frames,
    write_points,
)
from trifix.geometry.camera import StereoRig
from trifix.geometry.triangulation import triangulate
from trifix.records import Dots, Frame, Reason, SensorPoints, StereoDots, StereoImages, Unusable

DOTS = """\
frame,timestamp_ns,camera,u,v
3,1080000000,1,5.5,6.5
0,1000000000,1,1.5,2.5
0,1000000000,0,3.5,4.5
3,1080000000,0,7.5,8.5
0,1000000000,1,9.5,10.5
"""

POINTS = """\
frame,timestamp_ns,x_mm,y_mm,z_mm
3,1080000000,10,20,500
0,1000000000,30,40,600
3,1080000000,50,60,700
"""


def stereo_dots(frame: Frame) -> StereoDots:
    assert isinstance(frame.content, StereoDots)
    return frame.content


def without_diameter(line: str) -> str:
    cells = line.split(",")
    return ",".join(cells[:6] + cells[7:])


def points(frame: Frame) -> SensorPoints:
    assert isinstance(frame.content, SensorPoints)
    return frame.content


def unusable(frame: Frame) -> Unusable:
    assert isinstance(frame.content, Unusable)
    return frame.content


def kinds(recording: Recording) -> list[str]:
    return [type(frame.content).__name__ for frame in recording]


# --- dots


def test_dots_are_sorted_into_frames_and_cameras_and_remember_their_rows(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    recording = read_recording(tmp_path)
    assert (recording.level, len(recording), recording.is_noise_stated) == ("dots", 3, False)
    assert recording.index.tolist() == [0, 1, 3]
    assert recording.timestamp_ns.tolist() == STAMPS
    first, nothing, last = (stereo_dots(frame) for frame in recording)
    assert first.left.uv_px.tolist() == [[3.5, 4.5]]
    assert first.right.uv_px.tolist() == [[1.5, 2.5], [9.5, 10.5]]
    assert first.right.row.tolist() == [1, 4]
    assert (len(nothing.left), len(nothing.right)) == (0, 0)
    assert (last.left.row.tolist(), last.right.row.tolist()) == ([3], [0])
    assert first.right.label.tolist() == [-1, -1]
    assert np.isnan(first.left.diameter_px).all()
    np.testing.assert_array_equal(first.left.cov_px2, [np.eye(2) * 0.3**2])
    np.testing.assert_array_equal(
        stereo_dots(read_recording(tmp_path, sigma_px=0.1).frame(0)).left.cov_px2, [np.eye(2) * 0.1**2]
    )


def test_a_recording_may_be_iterated_again_and_read_by_position(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    recording = read_recording(tmp_path)
    assert [f.index for f in recording] == [f.index for f in recording] == [0, 1, 3]
    assert recording.frame(2).index == recording.frame(-1).index == 3
    with pytest.raises(IndexError):
        recording.frame(3)


def test_stated_noise_sizes_and_labels_are_read(tmp_path: Path) -> None:
    rows = "frame,timestamp_ns,camera,u,v,label,sigma_px,diameter_px,a_px,b_px,theta_rad\n"
    rows += "0,1000000000,0,1,2,7,0.1,12,8,5,0.25\n0,1000000000,0,3,4,,0.2,12,,,\n0,1000000000,0,3,4,2,0.3,,3,6,0.5\n"
    write_tables(tmp_path, "dots.csv", rows)
    recording = read_recording(tmp_path)
    left = stereo_dots(recording.frame(0)).left
    assert recording.is_noise_stated
    np.testing.assert_allclose(left.cov_px2[:, 0, 0], [0.01, 0.04, 0.09], atol=1e-15)
    np.testing.assert_array_equal(left.cov_px2[:, 0, 1], 0)
    assert left.label.tolist() == [7, -1, 2]
    np.testing.assert_allclose(left.ellipse[:2], [[8, 5, 0.25], [6, 6, 0]])
    np.testing.assert_allclose(left.ellipse[2], [6, 3, 0.5 + np.pi / 2])


def test_a_dot_without_stated_noise_has_that_to_start_from(tmp_path: Path) -> None:
    rows = "frame,timestamp_ns,camera,u,v,sigma_px\n0,1000000000,0,1,2,0.1\n0,1000000000,0,3,4,{}\n"
    write_tables(tmp_path, "dots.csv", rows.format(""))
    recording = read_recording(tmp_path, sigma_px=0.4)
    assert recording.is_noise_stated
    np.testing.assert_allclose(stereo_dots(recording.frame(0)).left.cov_px2[:, 0, 0], [0.01, 0.16], atol=1e-15)
    write_tables(tmp_path, "dots.csv", rows.format("").replace("0.1", ""))
    assert not read_recording(tmp_path).is_noise_stated
    write_tables(tmp_path, "dots.csv", rows.format("inf"))
    assert "column 'sigma_px': found inf" in unusable(read_recording(tmp_path).frame(0)).detail


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3,1080000000,1", "2,1080000000,1", r"dots\.csv, line 2, column 'frame': found 2, expected a frame of frames"),
        ("3,1080000000,1", "9,1080000000,1", r"line 2, column 'frame': found 9, expected a frame of frames\.csv"),
        ("3,1080000000,1", "3,1080000001,1", r"line 2: frame 3 has time stamp 1080000001, in frames\.csv it has 1080"),
        ("3,1080000000,1", "3,1080000000,2", r"line 2, column 'camera': found 2, expected 0 \(left\) or 1 \(right\)"),
        ("5.5,6.5", "five,6.5", r"line 2, column 'u': found 'five', expected a finite number"),
        ("5.5,6.5", "5.5", r"line 2: found 4 cells, expected 5"),
        ("camera,u,v", "camera,u", r"column 'v' is missing"),
    ],
)
def test_faulty_dots_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in DOTS
    write_tables(tmp_path, "dots.csv", DOTS.replace(old, new, 1))
    with pytest.raises(RecordingError, match=message):
        read_recording(tmp_path)


@pytest.mark.parametrize(
    ("columns", "cells", "message"),
    [
        ("sigma_px", "0", r"line 2, column 'sigma_px': found 0\.0, expected a positive number"),
        ("diameter_px", "-3", r"line 2, column 'diameter_px': found -3\.0, expected a positive number"),
        ("a_px,b_px,theta_rad", "1,0,0", r"line 2, column 'b_px': found 0\.0, expected a positive number"),
        ("a_px,b_px", "1,1", r"column theta_rad is missing, expected all of a_px, b_px, theta_rad or none"),
    ],
)
def test_faulty_optional_columns_of_dots_are_refused(tmp_path: Path, columns: str, cells: str, message: str) -> None:
    rows = f"frame,timestamp_ns,camera,u,v,{columns}\n0,1000000000,0,1,2,{cells}\n"
    write_tables(tmp_path, "dots.csv", rows)
    with pytest.raises(RecordingError, match=message):
        read_recording(tmp_path)


def test_a_value_that_is_no_number_spoils_its_frame_alone(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS.replace("9.5,10.5", "9.5,nan"))
    recording = read_recording(tmp_path)
    assert kinds(recording) == ["Unusable", "StereoDots", "StereoDots"]
    content = unusable(recording.frame(0))
    assert content.reason is Reason.bad_points
    assert content.detail == "dots.csv, line 6, column 'v': found nan, expected a finite number."


def test_written_dots_read_back_in_their_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    n = 200
    position = rng.integers(0, 3, n)
    camera = rng.integers(0, 2, n)
    uv = rng.uniform(-0.5, 31.5, (n, 2))
    sigma = rng.uniform(0.02, 0.5, n)
    b = rng.uniform(1, 5, n)
    ellipse = np.stack([b + rng.uniform(0, 5, n), b, rng.uniform(-np.pi, np.pi, n)], axis=1)
    ellipse[0] = [np.nan, np.nan, 0]
    label = rng.integers(-1, 4, n)
    write_tables(tmp_path, "dots.csv", "")
    index, stamps = np.array([0, 1, 3]), np.array(STAMPS)
    write_frames(tmp_path / "frames.csv", index, stamps)
    write_dots(
        tmp_path / "dots.csv",
        index[position],
        stamps[position],
        camera,
        uv,
        sigma_px=sigma,
        diameter_px=2 * np.sqrt(ellipse[:, 0] * ellipse[:, 1]),
        ellipse=ellipse,
        label=label,
    )
    seen = 0
    lines = [DOTS_HEADER]
    for k, frame in enumerate(read_recording(tmp_path)):
        content = stereo_dots(frame)
        for side, dots in enumerate((content.left, content.right)):
            assert dots.row.tolist() == np.flatnonzero((position == k) & (camera == side)).tolist()
            np.testing.assert_allclose(dots.uv_px, uv[dots.row], atol=5.1e-7)
            np.testing.assert_allclose(np.sqrt(dots.cov_px2[:, 0, 0]), sigma[dots.row], atol=5.1e-7)
            np.testing.assert_allclose(dots.ellipse, ellipse[dots.row], atol=5.1e-7)
            assert dots.label.tolist() == label[dots.row].tolist()
            seen += len(dots)
        lines += dots_rows(frame.index, frame.timestamp_ns, content)
    assert seen == n
    # a file that grows frame by frame receives the same rows (but for the diameter, made from the rounded ellipse)
    written = (tmp_path / "dots.csv").read_text().splitlines()
    assert sorted(map(without_diameter, lines)) == sorted(map(without_diameter, written))


# --- points


def test_points_are_sorted_into_frames_and_need_no_calibration(tmp_path: Path) -> None:
    write_tables(tmp_path, "points.csv", POINTS)
    (tmp_path / "calibration.yaml").unlink()
    recording = read_recording(tmp_path)
    assert (recording.level, recording.is_noise_stated, recording.rig) == ("points", False, None)
    assert [points(frame).row.tolist() for frame in recording] == [[1], [], [0, 2]]
    assert points(recording.frame(2)).xyz_mm.tolist() == [[10, 20, 500], [50, 60, 700]]
    assert points(recording.frame(2)).match.tolist() == [-1, -1]


def test_points_without_covariance_and_rig_are_surer_across_the_ray_than_along_it(tmp_path: Path) -> None:
    write_tables(tmp_path, "points.csv", POINTS)
    (tmp_path / "calibration.yaml").unlink()
    content = points(read_recording(tmp_path, sigma_px=0.2).frame(2))
    assert not content.is_cov_known
    for p, cov in zip(content.xyz_mm, content.cov_mm2, strict=True):
        variance, axes = np.linalg.eigh(cov)
        np.testing.assert_allclose(np.sqrt(variance), 0.2 * p[2] / 1000 * np.array([1, 1, 5]), rtol=1e-12)
        assert abs(axes[:, 2] @ p) / np.linalg.norm(p) > 1 - 1e-12


def test_points_without_covariance_get_that_of_two_dots_in_the_rig(tmp_path: Path) -> None:
    write_tables(tmp_path, "points.csv", POINTS)
    content = points(read_recording(tmp_path, sigma_px=0.2).frame(2))
    assert not content.is_cov_known
    rig = made_rig()
    xy = [c.unproject(c.project(T.apply(content.xyz_mm))) for c, T in cameras(rig)]
    cov = [np.tile(np.eye(2) * (0.2 / 40) ** 2, (2, 1, 1))] * 2
    _, expected = triangulate(rig, xy[0], xy[1], cov[0], cov[1])
    np.testing.assert_allclose(content.cov_mm2, expected, rtol=1e-9)


def cameras(rig: StereoRig) -> Iterator[tuple]:
    yield rig.left, rig.T_right_left @ rig.T_right_left.inverse()
    yield rig.right, rig.T_right_left


def test_a_point_behind_the_sensor_has_no_default_covariance(tmp_path: Path) -> None:
    write_tables(tmp_path, "points.csv", POINTS.replace("30,40,600", "30,40,-1"))
    content = unusable(read_recording(tmp_path).frame(0))
    assert content.reason is Reason.bad_points
    assert content.detail == "points.csv, line 3, column 'z_mm': found -1.0, expected a point before the sensor."


def test_written_points_read_back_with_covariance_and_label(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    n = 60
    position = rng.integers(0, 3, n)
    xyz = rng.normal(size=(n, 3)) * 100
    A = rng.normal(size=(n, 3, 3)) * 1e-3
    cov = A @ np.swapaxes(A, 1, 2)
    label = rng.integers(-1, 4, n)
    write_tables(tmp_path, "points.csv", "")
    index, stamps = np.array([0, 1, 3]), np.array(STAMPS)
    write_points(tmp_path / "points.csv", index[position], stamps[position], xyz, cov_mm2=cov, label=label)
    recording = read_recording(tmp_path)
    assert recording.is_noise_stated
    for k, frame in enumerate(recording):
        content = points(frame)
        assert content.is_cov_known
        assert content.row.tolist() == np.flatnonzero(position == k).tolist()
        np.testing.assert_allclose(content.xyz_mm, xyz[content.row], atol=5.1e-7)
        np.testing.assert_allclose(content.cov_mm2, cov[content.row], rtol=1e-8)
        assert content.label.tolist() == label[content.row].tolist()


@pytest.mark.parametrize(
    ("header", "cells", "message"),
    [
        ("xx,xy,xz,yy,yz", "1,0,0,1,0", r"column zz is missing, expected all of xx, xy, xz, yy, yz, zz or none"),
        ("xx,xy,xz,yy,yz,zz", "1,2,0,1,0,1", r"points\.csv, line 2, column 'xx': found 1\.0, expected a covariance"),
        ("xx,xy,xz,yy,yz,zz", "1,0,0,1,0,0", r"positive definite"),
        ("xx,xy,xz,yy,yz,zz", "1,0,0,1,0,x", r"column 'zz': found 'x', expected a finite number"),
    ],
)
def test_faulty_covariances_are_refused(tmp_path: Path, header: str, cells: str, message: str) -> None:
    write_tables(tmp_path, "points.csv", f"frame,timestamp_ns,x_mm,y_mm,z_mm,{header}\n0,1000000000,1,2,3,{cells}\n")
    with pytest.raises(RecordingError, match=message):
        read_recording(tmp_path)


@pytest.mark.parametrize("cells", ["1,inf,300,1,0,0,1,0,1", "1,2,300,1,0,0,1,0,nan", "1,2,300,1,0,0,1,0,"])
def test_points_that_are_not_finite_spoil_their_frame_alone(tmp_path: Path, cells: str) -> None:
    rows = (
        f"frame,timestamp_ns,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz\n3,1080000000,1,2,300,1,0,0,1,0,1\n0,1000000000,{cells}\n"
    )
    write_tables(tmp_path, "points.csv", rows)
    recording = read_recording(tmp_path)
    assert kinds(recording) == ["Unusable", "SensorPoints", "SensorPoints"]
    assert "points.csv, line 3, column" in unusable(recording.frame(0)).detail


def test_points_in_metres_are_refused_with_a_hint_at_the_unit(tmp_path: Path) -> None:
    rows = "frame,timestamp_ns,x_mm,y_mm,z_mm\n0,1000000000,0.03,-0.12,0.45\n0,1000000000,0.05,0.1,30\n"
    write_tables(tmp_path, "points.csv", rows + "3,1080000000,0.01,0.02,0.5\n")
    with pytest.raises(RecordingError, match=r"points\.csv: half .* within 0\.5 mm of the sensor.*in metres\?"):
        read_recording(tmp_path)


# --- frames.csv


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,timestamp_ns\n", r"frames\.csv lists no frame"),
        ("frame,timestamp_ns\n0,1\n0,2\n", r"frames\.csv, line 3: frame 0 follows frame 0, expected ascending numbers"),
        ("frame,timestamp_ns\n0,1\n2,2\n1,3\n", r"frames\.csv, line 4: frame 1 follows frame 2"),
        ("frame,timestamp_ns\n-1,1\n", r"frames\.csv, line 2: frame -1 comes first, expected ascending numbers from 0"),
        ("frame,timestamp_ns\n0,nan\n", r"line 2, column 'timestamp_ns': found 'nan', expected an integer"),
        ("", r"frames\.csv is empty"),
    ],
)
def test_faulty_lists_of_frames_are_refused(tmp_path: Path, text: str, message: str) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    (tmp_path / "frames.csv").write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_recording(tmp_path)


def test_tables_need_a_list_of_frames(tmp_path: Path) -> None:
    write_tables(tmp_path, "points.csv", POINTS)
    (tmp_path / "frames.csv").unlink()
    with pytest.raises(RecordingError, match=r"frames\.csv does not exist"):
        read_recording(tmp_path)


def test_time_that_runs_backwards_is_left_to_be_judged_frame_by_frame(tmp_path: Path) -> None:
    write_tables(tmp_path, "points.csv", "frame,timestamp_ns,x_mm,y_mm,z_mm\n")
    (tmp_path / "frames.csv").write_text("frame,timestamp_ns\n0,5\n1,4\n")
    assert [frame.timestamp_ns for frame in read_recording(tmp_path)] == [5, 4]


# --- images


def test_images_become_frames_with_the_rig(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    recording = read_recording(tmp_path)
    assert (recording.level, len(recording), recording.is_noise_stated) == ("images", 3, False)
    assert recording.index.tolist() == [0, 1, 2]
    assert recording.timestamp_ns.tolist() == STAMPS
    for k, frame in enumerate(recording):
        assert isinstance(frame.content, StereoImages)
        np.testing.assert_array_equal(frame.content.left, made_image(k, 0))
        np.testing.assert_array_equal(frame.content.right, made_image(k, 1))
        assert frame.rig is recording.rig is not None


@pytest.mark.parametrize(("side", "k"), [(0, 0), (1, 1)])
def test_a_truncated_image_spoils_its_frame_alone(tmp_path: Path, side: int, k: int) -> None:
    write_euroc(tmp_path)
    path = tmp_path / f"cam{side}" / "data" / f"{STAMPS[k]}.png"
    path.write_bytes(path.read_bytes()[:-40])
    recording = read_recording(tmp_path)
    assert [i for i, frame in enumerate(recording) if isinstance(frame.content, Unusable)] == [k]
    content = unusable(recording.frame(k))
    assert content.reason is Reason.unreadable_image
    assert str(path) in content.detail


@pytest.mark.parametrize("odd", [0, 1, 2])
def test_a_single_image_of_another_size_spoils_its_frame_alone(tmp_path: Path, odd: int) -> None:
    write_euroc(tmp_path)
    write_image(tmp_path / "cam1" / "data" / f"{STAMPS[odd]}.png", np.zeros((10, 20), dtype=np.uint8))
    recording = read_recording(tmp_path)
    assert [k for k, frame in enumerate(recording) if isinstance(frame.content, Unusable)] == [odd]
    content = unusable(recording.frame(odd))
    assert content.reason is Reason.unreadable_image
    file = tmp_path / "cam1" / "data" / f"{STAMPS[odd]}.png"
    assert f"the right image {file} is 20 x 10 pixels, its calibration is for 32 x 24" in content.detail


def test_images_of_another_size_than_the_calibration_are_refused(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    text = (tmp_path / "calibration.yaml").read_text()
    (tmp_path / "calibration.yaml").write_text(text.replace(f"[{SIZE[0]}, {SIZE[1]}]", "[640, 480]"))
    with pytest.raises(
        RecordingError,
        match=rf"image pair 0: the left image .*cam0/data/{STAMPS[0]}\.png is 32 x 24 pixels, its calibration is for",
    ):
        read_recording(tmp_path)


def test_a_list_of_frames_beside_images_numbers_them(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    write_frames(tmp_path / "frames.csv", np.array([4, 5, 9]), np.array(STAMPS))
    assert [frame.index for frame in read_recording(tmp_path)] == [4, 5, 9]
    write_frames(tmp_path / "frames.csv", np.array([4, 5, 9]), np.array(STAMPS) + np.array([0, 7, 0]))
    with pytest.raises(RecordingError, match=r"frame 5 has time stamp 1040000007, its images have 1040000000"):
        read_recording(tmp_path)
    write_frames(tmp_path / "frames.csv", np.array([4, 5]), np.array(STAMPS[:2]))
    with pytest.raises(RecordingError, match=r"has 2 frames, expected one for each of the 3 image pairs"):
        read_recording(tmp_path)


def test_a_list_of_frames_gives_images_without_time_theirs(tmp_path: Path) -> None:
    for k in range(3):
        for side in (0, 1):
            write_image(tmp_path / ("left", "right")[side] / f"image{k}.png", made_image(k, side))
    write_rig(made_rig(), tmp_path / "calibration.yaml")
    assert read_recording(tmp_path).timestamp_ns.tolist() == [0, 10**9, 2 * 10**9]
    write_frames(tmp_path / "frames.csv", np.arange(3), np.array(STAMPS))
    assert read_recording(tmp_path).timestamp_ns.tolist() == STAMPS


# --- levels and calibrations


def test_the_richest_level_is_read_unless_another_is_asked_for(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    frames = "frame,timestamp_ns\n" + "".join(f"{k},{s}\n" for k, s in enumerate(STAMPS))
    (tmp_path / "frames.csv").write_text(frames)
    (tmp_path / "dots.csv").write_text("frame,timestamp_ns,camera,u,v\n")
    (tmp_path / "points.csv").write_text("frame,timestamp_ns,x_mm,y_mm,z_mm\n")
    assert read_recording(tmp_path).level == "images"
    assert kinds(read_recording(str(tmp_path), "dots")) == ["StereoDots"] * 3
    assert kinds(read_recording(tmp_path, "points")) == ["SensorPoints"] * 3


def test_a_level_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="holds no recording: found neither images nor tables, expected cam0"):
        read_recording(tmp_path)
    write_tables(tmp_path, "points.csv", POINTS)
    with pytest.raises(RecordingError, match="holds no dots: found points"):
        read_recording(tmp_path, "dots")
    with pytest.raises(RecordingError, match="gone is not a folder, expected a recording"):
        read_recording(tmp_path / "gone")


def test_dots_and_images_without_any_calibration_are_refused(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    (tmp_path / "calibration.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"has no calibration: expected calibration\.yaml, or calibrations/"):
        read_recording(tmp_path)


def test_a_frame_may_have_a_calibration_of_its_own(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    (tmp_path / "calibrations").mkdir()
    write_rig(made_rig(70.0), tmp_path / "calibrations" / f"{STAMPS[1]}.yaml")
    baselines = [frame.rig.baseline_mm for frame in read_recording(tmp_path) if frame.rig]
    np.testing.assert_allclose(baselines, [100, 70, 100])


def test_a_frame_without_calibration_is_refused_where_others_have_theirs(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    (tmp_path / "calibrations").mkdir()
    (tmp_path / "calibration.yaml").rename(tmp_path / "calibrations" / f"{STAMPS[0]}.yaml")
    recording = read_recording(tmp_path)
    assert recording.rig is None
    assert kinds(recording) == ["StereoDots", "Unusable", "Unusable"]
    frame = recording.frame(2)
    assert frame.rig is None
    assert unusable(frame).reason is Reason.no_calibration
    assert "1080000000.yaml does not exist, and there is no calibration.yaml" in unusable(frame).detail


def test_image_pairs_without_calibration_are_refused_where_others_have_theirs(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    (tmp_path / "calibrations").mkdir()
    (tmp_path / "calibration.yaml").rename(tmp_path / "calibrations" / f"{STAMPS[1]}.yaml")
    recording = read_recording(tmp_path)
    assert kinds(recording) == ["Unusable", "StereoImages", "Unusable"]
    assert unusable(recording.frame(0)).reason is Reason.no_calibration
    own = tmp_path / "calibrations" / f"{STAMPS[1]}.yaml"
    own.write_text(own.read_text().replace(f"[{SIZE[0]}, {SIZE[1]}]", "[640, 480]"))
    with pytest.raises(RecordingError, match=rf"image pair 1: the left image .*{STAMPS[1]}\.png is 32 x 24 pixels"):
        read_recording(tmp_path)


def test_calibrations_of_other_frames_only_are_refused(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    (tmp_path / "calibrations").mkdir()
    write_rig(made_rig(), tmp_path / "calibrations" / "12.yaml")
    with pytest.raises(CalibrationError, match=r"no file belongs to a frame, expected names like 1000000000\.yaml"):
        read_recording(tmp_path)


def test_a_broken_calibration_of_a_frame_is_named(tmp_path: Path) -> None:
    write_tables(tmp_path, "dots.csv", DOTS)
    (tmp_path / "calibrations").mkdir()
    (tmp_path / "calibrations" / f"{STAMPS[1]}.yaml").write_text("cam0: {}")
    with pytest.raises(CalibrationError, match=r"1040000000\.yaml: key 'cam1' is missing"):
        read_recording(tmp_path)


def test_written_dots_have_only_the_columns_that_were_given(tmp_path: Path) -> None:
    one = np.array([1])
    write_dots(tmp_path / "dots.csv", one, one, one, np.array([[1.5, -0.25]]), diameter_px=np.array([8.0]))
    assert (tmp_path / "dots.csv").read_text() == (
        "frame,timestamp_ns,camera,u,v,diameter_px\n1,1,1,1.500000,-0.250000,8.000000\n"
    )


def test_the_rows_of_a_frame_hold_every_column_left_before_right() -> None:
    left, right = Dots.of(np.zeros((2, 2)), diameter_px=np.array([4.0, 6.0])), Dots.of(np.ones((1, 2)))
    rows = dots_rows(3, 5, StereoDots(left, right))
    assert DOTS_HEADER == "frame,timestamp_ns,camera,u,v,sigma_px,diameter_px,a_px,b_px,theta_rad,label"
    assert rows == [
        "3,5,0,0.000000,0.000000,0.300000,4.000000,2.000000,2.000000,0.000000,",
        "3,5,0,0.000000,0.000000,0.300000,6.000000,3.000000,3.000000,0.000000,",
        "3,5,1,1.000000,1.000000,0.300000,,,,0.000000,",
    ]
