"""Image pairs are paired rightly or not at all, and decoded as they are stored."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recording_folders import SIZE, STAMPS, made_image, write_euroc, write_image

from trifix.errors import RecordingError
from trifix.files.images import holds_images, read_image, read_image_pairs


def write_folders(folder: Path, names: list[str], right_names: list[str] | None = None) -> None:
    for side, of_side in enumerate((names, names if right_names is None else right_names)):
        for k, name in enumerate(of_side):
            write_image(folder / ("left", "right")[side] / name, made_image(k, side))


def test_euroc_images_are_paired_by_time_stamp_in_the_order_of_the_left_camera(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    pairs = read_image_pairs(tmp_path)
    assert pairs.timestamp_ns.tolist() == STAMPS
    assert not pairs.is_nominal
    for k in (2, 0, 1):
        np.testing.assert_array_equal(pairs.left(k), made_image(k, 0))
        np.testing.assert_array_equal(pairs.right(k), made_image(k, 1))


def test_an_empty_folder_holds_no_images(tmp_path: Path) -> None:
    assert not holds_images(tmp_path)
    with pytest.raises(RecordingError, match="holds no images"):
        read_image_pairs(tmp_path)


def test_a_missing_camera_is_named(tmp_path: Path) -> None:
    (tmp_path / "cam1").mkdir()
    assert holds_images(tmp_path)
    with pytest.raises(RecordingError, match=r"cam0 does not exist, though cam1 does: expected both cameras"):
        read_image_pairs(tmp_path)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cam0", "", r"cam0/data\.csv lists no image"),
        ("cam1", "#t\n", r"cam1/data\.csv lists no image"),
        (
            "cam0",
            "1000000000,1000000000.png\n",
            r"cam1/data\.csv: time stamps 1040000000, 1080000000 are not in the oth",
        ),
        (
            "cam1",
            "1000000000,1000000000.png\n1080000000,1080000000.png\n",
            r"cam0/data\.csv: time stamp 1040000000 is not in the other camera's",
        ),
        ("cam0", "#t\n1000000000,gone.png\n", r"cam0/data\.csv, line 2: .*cam0/data/gone\.png does not exist"),
        (
            "cam0",
            "1000000000,1000000000.png\n\n1000000000,1040000000.png\n",
            r"line 3: time stamp 1000000000 was already in line 1",
        ),
        ("cam0", "1.5,1000000000.png\n", r"line 1, column 'timestamp \[ns\]': found '1\.5', expected an integer"),
    ],
)
def test_euroc_images_that_do_not_pair_up_are_refused(tmp_path: Path, file: str, text: str, message: str) -> None:
    write_euroc(tmp_path)
    (tmp_path / file / "data.csv").write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_image_pairs(tmp_path)


def test_many_unpaired_stamps_are_not_all_listed(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    (tmp_path / "cam0" / "data.csv").write_text("".join(f"{i},{STAMPS[0]}.png\n" for i in range(9)))
    with pytest.raises(RecordingError, match=r"time stamps 0, 1, 2, 3, 4 and 4 more are not"):
        read_image_pairs(tmp_path)


def test_folders_are_paired_by_sorted_name_with_numbers_by_value(tmp_path: Path) -> None:
    write_folders(tmp_path, ["l2.png", "l10.png"], ["r_002.png", "r_010.png"])
    (tmp_path / "left" / "notes.txt").write_text("no image")
    pairs = read_image_pairs(tmp_path)
    assert pairs.is_nominal
    assert pairs.timestamp_ns.tolist() == [0, 1_000_000_000]
    for k in (0, 1):
        np.testing.assert_array_equal(pairs.left(k), made_image(k, 0))
        np.testing.assert_array_equal(pairs.right(k), made_image(k, 1))


def test_names_that_step_like_nanoseconds_are_time_stamps(tmp_path: Path) -> None:
    write_folders(tmp_path, [f"{stamp}.png" for stamp in STAMPS])
    pairs = read_image_pairs(tmp_path)
    assert not pairs.is_nominal
    assert pairs.timestamp_ns.tolist() == STAMPS


def test_names_that_count_frames_are_no_time_stamps(tmp_path: Path) -> None:
    write_folders(tmp_path, ["0007.png", "0008.png"])
    assert read_image_pairs(tmp_path).timestamp_ns.tolist() == [0, 1_000_000_000]


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (["a.png", "b.png"], ["a.png"], "found 2 images in left and 1 in right, expected pairs"),
        (["1.png", "2.png"], ["1.png", "3.png"], r": left/2\.png, right/3\.png have no partner, expected names that"),
        (["img_3.png"], ["img_33.png"], r": left/img_3\.png, right/img_33\.png have no partner"),
        (["a1.png", "a2.png", "a3.png"], ["a2.png", "a3.png", "a4.png"], r": left/a1\.png, right/a4\.png have no"),
        (["a1.png", "b2.png"], ["b1.png", "a2.png"], r": left/a1\.png, right/a2\.png have no partner"),
        ([f"{k}.png" for k in range(5)], [f"{k}.png" for k in range(9, 14)], r"right/9\.png and 4 more have no"),
    ],
)
def test_folders_that_do_not_pair_up_are_refused(
    tmp_path: Path, left: list[str], right: list[str], message: str
) -> None:
    write_folders(tmp_path, left, right)
    with pytest.raises(RecordingError, match=message):
        read_image_pairs(tmp_path)


@pytest.mark.parametrize("name", ["{side}{k:02d}.png", "img_{k}_cam{camera}.png", "{side}_{letter}.png"])
def test_names_may_tell_the_camera(tmp_path: Path, name: str) -> None:
    left, right = (
        [name.format(side=side, camera=camera, k=k, letter="abc"[k]) for k in range(3)]
        for camera, side in enumerate(("left", "right"))
    )
    write_folders(tmp_path, left, right)
    pairs = read_image_pairs(tmp_path)
    assert [pairs.files(k) for k in range(3)] == [
        (tmp_path / "left" / a, tmp_path / "right" / b) for a, b in zip(left, right, strict=True)
    ]


def test_empty_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    (tmp_path / "right").mkdir()
    with pytest.raises(RecordingError, match="found 0 images in left and 0 in right"):
        read_image_pairs(tmp_path)


def write_video(path: Path, greys: list[int]) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for grey in greys:
        writer.write(np.full((48, 64, 3), grey, dtype=np.uint8))
    writer.release()


def test_videos_are_read_in_any_order_at_their_frame_rate(tmp_path: Path) -> None:
    write_video(tmp_path / "left.avi", [10, 60, 110, 160])
    write_video(tmp_path / "right.avi", [30, 80, 130, 180])
    pairs = read_image_pairs(tmp_path)
    assert pairs.is_nominal
    assert pairs.timestamp_ns.tolist() == [0, 40_000_000, 80_000_000, 120_000_000]
    for k in (0, 1, 3, 2, 2, 0):
        left, right = pairs.left(k), pairs.right(k)
        assert isinstance(left, np.ndarray)
        assert isinstance(right, np.ndarray)
        assert left.shape == (48, 64, 3)
        assert abs(float(left.mean()) - (10 + 50 * k)) < 3
        assert abs(float(right.mean()) - (30 + 50 * k)) < 3
    assert "cannot be decoded" in str(pairs.left(4))


def test_videos_of_unequal_length_are_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "left.avi", [10, 20, 30])
    write_video(tmp_path / "right.avi", [10, 20])
    with pytest.raises(RecordingError, match=r"left\.avi has 3 images and right\.avi has 2, expected synchronous"):
        read_image_pairs(tmp_path)


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "left.mp4").write_bytes(b"no video")
    (tmp_path / "right.mp4").write_bytes(b"no video")
    with pytest.raises(RecordingError, match=r"left\.mp4 is not a video that can be decoded"):
        read_image_pairs(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".pgm"])
def test_grey_images_of_every_format_keep_their_size(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"a{suffix}", np.full(SIZE[::-1], 100, dtype=np.uint8))
    image = read_image(tmp_path / f"a{suffix}")
    assert isinstance(image, np.ndarray)
    assert (image.shape, image.dtype) == (SIZE[::-1], np.uint8)
    assert np.abs(image.astype(int) - 100).max() <= 1


def test_sixteen_bits_and_colour_survive_and_alpha_does_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for shape, dtype in (((24, 32), np.uint16), ((24, 32, 3), np.uint8), ((24, 32, 4), np.uint8)):
        stored = rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
        write_image(tmp_path / "a.png", stored)
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), stored[..., :3] if len(shape) == 3 else stored)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.99])
def test_a_truncated_image_is_said_to_be_unreadable(tmp_path: Path, suffix: str, part: float) -> None:
    path = tmp_path / f"a{suffix}"
    write_image(path, made_image(0, 0))
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    fault = read_image(path)
    assert isinstance(fault, str)
    assert f"a{suffix} " in fault
    assert f"({int(part * len(data))} bytes)" in fault


def test_what_is_no_image_is_said_to_be_unreadable(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("hello")
    assert "is not an image that can be decoded (5 bytes)" in str(read_image(tmp_path / "a.png"))
    assert "cannot be read: No such file" in str(read_image(tmp_path / "b.png"))
    cv2.imwrite(str(tmp_path / "c.tiff"), np.zeros((4, 4), dtype=np.float32))
    assert "holds float32 values, expected 8 or 16 bit" in str(read_image(tmp_path / "c.tiff"))
