"""Cameras as a source of Frames; where they deliver nothing of use for a while, frames say so in a sentence.

A camera is anything that can ``read`` and ``close``; OpenCV's are here, others need a dozen lines (examples/). Cameras
that are gone, black and frozen images and pairs that were not taken together are told apart; what comes back is used
again. Knows no dot and no pose.
"""

import time
from collections.abc import Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from trifix.errors import CameraError
from trifix.geometry.camera import StereoRig
from trifix.records import Frame, GreyOrColour, Reason, StereoImages, Unusable

_RETRY_S = 0.5  # between two attempts to open a camera that is gone
_STREAM_LIMIT_MS = 3000  # after which a network camera is taken to be gone
_CATCH_UP = 3  # images of the camera that lags that may be passed over for one pair
_STRIDE_PX = 4  # images are looked at in every fourth row and column
_DARK, _DARK_DEEP = 12, 48  # no grey value above it: nothing to be seen, in 8 bit; in 10 bit of 16
_FEW_LIT = 10  # samples that may be brighter, as hot pixels are
_REPEATS = 2  # times that an image may come again, to the last bit, before the camera is taken to be frozen
_EPOCH_NS = time.time_ns() - time.monotonic_ns()


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """An image and its time."""

    image: GreyOrColour
    """Grey or BGR, 8 or 16 bit."""
    timestamp_ns: int
    """Middle of the exposure where the camera tells it, otherwise when the image came (ns)."""


@runtime_checkable
class Camera(Protocol):
    """Where the images of one camera come from.

    Both cameras of a pair tell the time by one clock, which goes on while a camera is gone.
    """

    def read(self) -> Shot | str | None:
        """The next image; a sentence if there is none now; None if there will be none any more.

        Waits for the image, and a moment before it gives the same sentence again.
        """
        ...

    def close(self) -> None:
        """Give the camera free."""
        ...


@runtime_checkable
class Pairs(Protocol):
    """Where pairs of images come from."""

    dropped: int
    """Images passed over so far."""

    def read(self) -> tuple[Shot, Shot] | str | None:
        """The next left and right image, as ``Camera.read``."""
        ...

    def close(self) -> None:
        """Give the cameras free."""
        ...


class VideoCamera:
    """A camera that OpenCV reads: a number, a URL, a GStreamer pipeline (told by its "!"), or a video at its own pace.

    The driver's exposure time is used where Video4Linux tells it. ``size_px`` is the width and height to ask for.

    Raises:
        CameraError: it cannot be opened. Later on, that is a state which may pass.
    """

    def __init__(self, source: str, size_px: tuple[int, int] | None = None) -> None:
        self._source, self._size_px = source, size_px
        self._is_file = Path(source).is_file()
        self._count, self._start_s = 0, 0.0
        self._capture = self._opened()
        if self._capture is None:
            raise CameraError(
                f"camera {source} cannot be opened, expected the number of a camera that is plugged in and free, a "
                f"URL, a GStreamer pipeline or a video file."
            )

    def read(self) -> Shot | str | None:
        """The next image, as ``Camera.read``."""
        if self._capture is None:
            time.sleep(_RETRY_S)
            self._capture = self._opened()
        if self._capture is None:
            return f"camera {self._source} is gone: is it plugged in?"
        if self._is_file:
            return self._next_of_file(self._capture)
        if self._capture.grab():
            timestamp_ns = self._exposure_ns(self._capture)
            is_whole, image = self._capture.retrieve()
            if is_whole:
                return Shot(np.asarray(image), timestamp_ns)
        self.close()
        return f"camera {self._source} delivers no image: is it plugged in?"

    def close(self) -> None:
        """Give the camera free."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _next_of_file(self, capture: cv2.VideoCapture) -> Shot | None:
        is_there, image = capture.read()
        if not is_there:
            return None
        since_s = self._count / (capture.get(cv2.CAP_PROP_FPS) or 30.0)
        if self._count == 0:
            self._start_s = time.monotonic()
        self._count += 1
        time.sleep(max(0.0, self._start_s + since_s - time.monotonic()))
        return Shot(np.asarray(image), round(1e9 * since_s))

    def _opened(self) -> cv2.VideoCapture | None:
        source = self._source
        with _quiet():
            if source.isdecimal():
                capture = cv2.VideoCapture(int(source))
            elif "!" in source:
                capture = cv2.VideoCapture(source, cv2.CAP_GSTREAMER)
            elif "://" in source:
                limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _STREAM_LIMIT_MS]
                limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, _STREAM_LIMIT_MS]
                capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
            else:
                capture = cv2.VideoCapture(source)
        if not capture.isOpened():
            return None
        if self._size_px is not None and source.isdecimal():
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size_px[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size_px[1])
        return capture

    def _exposure_ns(self, capture: cv2.VideoCapture) -> int:
        """The driver's time stamp, if it is of this machine's clock; otherwise the time now."""
        now_ns = time.monotonic_ns()
        if capture.getBackendName() == "V4L2":
            driver_ns = round(1e6 * capture.get(cv2.CAP_PROP_POS_MSEC))
            if 0 <= now_ns - driver_ns < 1_000_000_000:
                return _EPOCH_NS + driver_ns
        return _EPOCH_NS + now_ns


class TwoCameras:
    """Pairs of images of two cameras, read side by side.

    Where one image is older than the other by more than ``max_skew_ms``, that camera is read again; if they do not
    meet, the pair is refused.
    """

    def __init__(self, left: Camera, right: Camera, max_skew_ms: float = 10.0) -> None:
        self.dropped = 0
        self._left, self._right, self._max_skew_ms = left, right, max_skew_ms
        self._readers = _Reader(left), _Reader(right)

    def read(self) -> tuple[Shot, Shot] | str | None:
        """The next left and right image, as ``Camera.read``."""
        coming = [each.read() for each in self._readers]
        wait(coming)
        left, right = (each.result() for each in coming)
        for _ in range(_CATCH_UP):
            if not (isinstance(left, Shot) and isinstance(right, Shot)) or self._are_one_exposure(left, right):
                break
            self.dropped += 1
            if left.timestamp_ns < right.timestamp_ns:
                left = self._left.read()
            else:
                right = self._right.read()
        if left is None or right is None:
            return None
        if isinstance(left, str) or isinstance(right, str):
            sides = (("Left", left), ("Right", right))
            return " ".join(f"{side} {fault}" for side, fault in sides if isinstance(fault, str))
        if not self._are_one_exposure(left, right):
            skew_ms = 1e-6 * abs(left.timestamp_ns - right.timestamp_ns)
            return (
                f"The images were taken {skew_ms:.1f} ms apart, expected at most {self._max_skew_ms:g}: are the "
                f"cameras synchronised?"
            )
        return left, right

    def close(self) -> None:
        """Give the cameras free."""
        for each in self._readers:
            each.close()
        self._left.close()
        self._right.close()

    def _are_one_exposure(self, left: Shot, right: Shot) -> bool:
        return abs(left.timestamp_ns - right.timestamp_ns) <= 1e6 * self._max_skew_ms


class _Reader:
    """A thread that reads one camera when asked to, and does not keep the program from ending if that hangs."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._asked: SimpleQueue[Future[Shot | str | None] | None] = SimpleQueue()
        Thread(target=self._work, name="capture", daemon=True).start()

    def read(self) -> "Future[Shot | str | None]":
        """What the camera will deliver next."""
        coming: Future[Shot | str | None] = Future()
        self._asked.put(coming)
        return coming

    def close(self) -> None:
        """No more reading."""
        self._asked.put(None)

    def _work(self) -> None:
        while (coming := self._asked.get()) is not None:
            try:
                coming.set_result(self._camera.read())
            except BaseException as error:  # whoever asked is told
                coming.set_exception(error)


class SideBySide:
    """Pairs of images of one camera that delivers both beside one another."""

    def __init__(self, camera: Camera) -> None:
        self.dropped = 0
        self._camera = camera

    def read(self) -> tuple[Shot, Shot] | str | None:
        """The next left and right image, as ``Camera.read``."""
        shot = self._camera.read()
        if not isinstance(shot, Shot):
            return shot if shot is None else f"The {shot}"
        half = shot.image.shape[1] // 2
        halves = shot.image[:, :half], shot.image[:, half : 2 * half]
        left, right = (Shot(np.ascontiguousarray(image), shot.timestamp_ns) for image in halves)
        return left, right

    def close(self) -> None:
        """Give the camera free."""
        self._camera.close()


class CameraFrames:
    """The frames of cameras, for as long as they deliver; pairs that cannot be had or used are frames that say why."""

    def __init__(self, pairs: Pairs, rig: StereoRig) -> None:
        self._pairs, self._rig = pairs, rig
        self._is_closed = False

    @property
    def dropped(self) -> int:
        """Images passed over so far."""
        return self._pairs.dropped

    def __iter__(self) -> Iterator[Frame]:
        index, eyes = 0, (_Eye("left"), _Eye("right"))
        newest_ns, came_ns = _EPOCH_NS + time.monotonic_ns(), time.monotonic_ns()
        stamp_ns = -(1 << 63)
        ahead_ns: int | None = None
        try:
            while not self._is_closed and (got := self._pairs.read()) is not None:
                content: StereoImages | Unusable
                if isinstance(got, str):
                    now_ns = time.monotonic_ns()  # by the camera's clock, whatever that is
                    stamp_ns, content = newest_ns + now_ns - came_ns, Unusable(Reason.unreadable_image, got)
                else:
                    left, right = got
                    if ahead_ns is None:  # faults before the first image have been told by another clock, perhaps
                        ahead_ns = max(stamp_ns - left.timestamp_ns, 0)
                    stamp_ns = newest_ns = left.timestamp_ns + ahead_ns
                    came_ns = time.monotonic_ns()
                    faults = [eye.fault(shot.image) for eye, shot in zip(eyes, got, strict=True)]
                    content = StereoImages(left.image, right.image)
                    if any(faults):
                        content = Unusable(Reason.unreadable_image, " ".join(filter(None, faults)))
                yield Frame(index, stamp_ns, self._rig, content)
                index += 1
        finally:  # also where nobody takes any more frames
            self._pairs.close()

    def close(self) -> None:
        """No more frames than the one that is being taken."""
        self._is_closed = True


class _Eye:
    """What is remembered of one camera's images to tell that it sees nothing, or nothing new."""

    def __init__(self, side: str) -> None:
        self._side = side
        self._before = np.zeros((0, 0), dtype=np.uint8)
        self._repeats = 0

    def fault(self, image: GreyOrColour) -> str:
        """What is wrong with the image; empty if nothing is."""
        small = image[::_STRIDE_PX, ::_STRIDE_PX]
        small = small[:, :, 1] if small.ndim == 3 else small
        self._repeats = self._repeats + 1 if np.array_equal(small, self._before) else 0
        self._before = small.copy()
        if np.count_nonzero(small > (_DARK if small.dtype == np.uint8 else _DARK_DEEP)) < _FEW_LIT:
            return f"The {self._side} image is black: is the lens covered, the light off?"
        if self._repeats >= _REPEATS:
            return f"The {self._side} image has been the same, bit for bit, {self._repeats + 1} times: is it frozen?"
        return ""


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps OpenCV from printing: what it would say is said in a sentence."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)
