"""Cameras that deliver, fail and come back, without any camera: scripted ones, and videos read as if they were live."""

import threading
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from constellations import PARALLEL
from trifix.errors import CameraError
from trifix.geometry.camera import Camera, StereoRig
from trifix.records import Frame, Reason, StereoImages, Unusable
from trifix.sources import cameras
from trifix.sources.cameras import CameraFrames, Shot, SideBySide, TwoCameras, VideoCamera

STEP_NS = 20_000_000


class Script:
    """A camera that delivers what it is told to."""

    def __init__(self, reads: Sequence[Shot | str | None]) -> None:
        self.reads = list(reads)
        self.is_closed = False

    def read(self) -> Shot | str | None:
        return self.reads.pop(0) if self.reads else None

    def close(self) -> None:
        self.is_closed = True


def noisy(seed: int, shape: tuple[int, ...] = (96, 128)) -> np.ndarray:
    return np.random.default_rng(seed).integers(90, 110, shape).astype(np.uint8)


def shot(k: int, image: np.ndarray | None = None, late_ns: int = 0) -> Shot:
    return Shot(noisy(k) if image is None else image, k * STEP_NS + late_ns)


def frames(left: Sequence[Shot | str | None], right: Sequence[Shot | str | None]) -> list[Frame]:
    return list(CameraFrames(TwoCameras(Script(left), Script(right)), PARALLEL))


def said(frame: Frame) -> str:
    """Why a frame is unusable; empty if it is not."""
    if isinstance(frame.content, StereoImages):
        return ""
    assert isinstance(frame.content, Unusable)
    assert frame.content.reason is Reason.unreadable_image
    return frame.content.detail


def test_pairs_become_frames_until_a_camera_ends() -> None:
    found = frames([shot(k) for k in range(5)], [shot(k, noisy(100 + k)) for k in range(4)])
    assert [frame.index for frame in found] == [0, 1, 2, 3]
    assert [frame.timestamp_ns for frame in found] == [k * STEP_NS for k in range(4)]
    assert all(frame.rig is PARALLEL for frame in found)
    content = found[2].content
    assert isinstance(content, StereoImages)
    np.testing.assert_array_equal(content.left, noisy(2))
    np.testing.assert_array_equal(content.right, noisy(102))


def test_a_camera_that_is_unplugged_says_so_until_it_is_back() -> None:
    gone = "camera 0 is gone: is it plugged in?"
    left = [shot(0), gone, gone, shot(3)]
    found = frames(left, [shot(k, noisy(100 + k)) for k in range(4)])
    assert [said(frame) for frame in found] == ["", f"Left {gone}", f"Left {gone}", ""]
    stamps = [frame.timestamp_ns for frame in found]
    assert stamps[0] <= stamps[1] <= stamps[2] <= stamps[3]


def test_a_black_image_is_told_and_passes() -> None:
    dark = np.random.default_rng(0).integers(0, 8, (96, 128)).astype(np.uint8)
    dark[3, 5] = 255  # a hot pixel
    found = frames([shot(0), shot(1, dark), shot(2)], [shot(k, noisy(100 + k)) for k in range(3)])
    assert [bool(said(frame)) for frame in found] == [False, True, False]
    assert said(found[1]) == "The left image is black: is the lens covered, the light off?"


def test_small_bright_targets_in_the_dark_are_not_black() -> None:
    night = np.zeros((1024, 1280), dtype=np.uint8)
    for u, v in np.random.default_rng(1).integers(20, 1000, (30, 2)):
        cv2.circle(night, (int(u), int(v)), 3, 200, -1)
    found = frames([shot(0, night)], [shot(0, night)])
    assert said(found[0]) == ""


def test_a_frozen_image_is_told_from_its_third_time_on_and_passes() -> None:
    still = noisy(7)
    right = [shot(k, still if 1 <= k <= 4 else noisy(100 + k)) for k in range(7)]
    found = frames([shot(k) for k in range(7)], right)
    assert [bool(said(frame)) for frame in found] == [False, False, False, True, True, False, False]
    assert said(found[4]) == "The right image has been the same, bit for bit, 4 times: is it frozen?"


def test_a_camera_that_lost_an_image_is_waited_for() -> None:
    left = [shot(k) for k in range(6)]
    right = [shot(k, noisy(100 + k)) for k in range(6) if k != 2]
    pairs = TwoCameras(Script(left), Script(right))
    found = list(CameraFrames(pairs, PARALLEL))
    assert [frame.timestamp_ns // STEP_NS for frame in found] == [0, 1, 3, 4, 5]
    assert [said(frame) for frame in found] == [""] * 5
    assert pairs.dropped == 1


def test_a_pair_that_never_meets_is_refused_until_it_does() -> None:
    late_ns = 10_000_000  # half of a step: neither the same image nor the next one is near
    left = [shot(k) for k in range(12)]
    right = [shot(k, noisy(100 + k), late_ns if k < 5 else 0) for k in range(12)]
    found = list(CameraFrames(TwoCameras(Script(left), Script(right), max_skew_ms=4.0), PARALLEL))
    assert said(found[0]) == "The images were taken 10.0 ms apart, expected at most 4: are the cameras synchronised?"
    assert said(found[-1]) == ""


def test_one_camera_side_by_side_is_cut_in_halves() -> None:
    both = noisy(0, (96, 256, 3))
    camera = Script([Shot(both, 5), "camera 2 is gone.", None])
    found = list(CameraFrames(SideBySide(camera), PARALLEL))
    content = found[0].content
    assert isinstance(content, StereoImages)
    np.testing.assert_array_equal(content.left, both[:, :128])
    np.testing.assert_array_equal(content.right, both[:, 128:])
    assert said(found[1]) == "The camera 2 is gone."
    assert len(found) == 2
    assert camera.is_closed


def test_a_closed_source_ends_with_the_frame_that_is_being_taken() -> None:
    left = Script([shot(k) for k in range(9)])
    source = CameraFrames(TwoCameras(left, Script([shot(k, noisy(100 + k)) for k in range(9)])), PARALLEL)
    taken = []
    for frame in source:
        taken.append(frame)
        if len(taken) == 3:
            source.close()
    assert len(taken) == 3
    assert left.is_closed


def test_cameras_are_given_free_where_nobody_takes_any_more_frames() -> None:
    left, right = Script([shot(k) for k in range(9)]), Script([shot(k, noisy(100 + k)) for k in range(9)])
    for _ in CameraFrames(TwoCameras(left, right), PARALLEL):
        break
    assert left.is_closed
    assert right.is_closed


def test_cameras_with_a_clock_of_their_own_may_begin_with_a_fault() -> None:
    left = ["camera 0 waits for its trigger.", *(shot(k) for k in range(3))]
    found = frames(left, [shot(k, noisy(100 + k)) for k in (0, 0, 1, 2)])
    stamps = np.array([frame.timestamp_ns for frame in found])
    assert [bool(said(frame)) for frame in found] == [True, False, False, False]
    assert (np.diff(stamps) >= 0).all()
    assert np.diff(stamps)[1:].tolist() == [STEP_NS, STEP_NS]


def test_a_camera_that_hangs_does_not_keep_the_program_from_ending() -> None:
    class Hanging(Script):
        def read(self) -> Shot | str | None:
            threading.Event().wait()
            return None

    pairs = TwoCameras(Hanging([]), Hanging([]))
    threading.Thread(target=pairs.read, daemon=True).start()
    capturing = [thread for thread in threading.enumerate() if thread.name == "capture"]
    assert len(capturing) >= 2
    assert all(thread.daemon for thread in capturing)
    pairs.close()


# --- OpenCV ----------------------------------------------------------------------------------------------------------


def video(path: Path, first: int, count: int = 6) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 100.0, (128, 96), isColor=False)
    for k in range(count):
        image = noisy(first + k)
        cv2.circle(image, (20 + 10 * k, 40), 9, 20, -1)
        writer.write(image)
    writer.release()
    return path


def test_a_pair_of_videos_is_read_as_two_cameras(tmp_path: Path) -> None:
    files = video(tmp_path / "a.avi", 0), video(tmp_path / "b.avi", 50)
    small = Camera(100.0, 100.0, 63.5, 47.5, 128, 96)
    rig = StereoRig(small, small, PARALLEL.T_right_left)
    found = list(CameraFrames(TwoCameras(*(VideoCamera(str(file)) for file in files)), rig))
    assert [said(frame) for frame in found] == [""] * 6
    assert [frame.timestamp_ns for frame in found] == [k * 10_000_000 for k in range(6)]
    content = found[3].content
    assert isinstance(content, StereoImages)
    assert content.left.shape == (96, 128, 3)
    assert int(content.left[40, 50].max()) < 60 < int(content.left[40, 80].min())


def test_a_camera_that_is_not_there_is_an_error_that_says_what_could_be(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(
        CameraError, match="camera 63 cannot be opened, expected the number of a camera that is plugged"
    ):
        VideoCamera("63")
    assert capfd.readouterr().err == ""


def test_a_stream_is_opened_again_once_it_is_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "_RETRY_S", 0.0)
    file = video(tmp_path / "stream.avi", 0, count=2)
    camera = VideoCamera(f"file://{file}")
    before = [camera.read(), camera.read()]
    assert camera.read() == f"camera file://{file} delivers no image: is it plugged in?"
    file.rename(tmp_path / "elsewhere.avi")
    assert camera.read() == f"camera file://{file} is gone: is it plugged in?"
    (tmp_path / "elsewhere.avi").rename(file)
    shots = [each for each in (*before, camera.read()) if isinstance(each, Shot)]
    assert len(shots) == 3
    assert shots[0].timestamp_ns < shots[1].timestamp_ns < shots[2].timestamp_ns
    camera.close()
