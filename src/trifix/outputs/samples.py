"""A handful of frames kept to be looked at: chosen as they pass, shrunk, their dots sorted by what became of them."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Int

from trifix.geometry.camera import Camera
from trifix.records import Dots, Fix, GreyOrColour, NoFix, SensorPoints, Step, StereoImages

WIDTH_PX, HEIGHT_PX = 560, 420
"""Width of a kept picture, and height of a canvas for points (px)."""
SPREAD = 6
"""Most frames kept evenly over the recording."""

KINDS = ("identified", "refused", "unidentified", "single")
"""What becomes of a dot: identified as a target; part of a point of a refused frame, or of one that was positioned
without it; seen by one camera only."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What one camera saw."""

    width_px: int
    """Columns of the canvas, in the units of the dots."""
    height_px: int
    """Rows of the canvas."""
    jpeg: str | None
    """The image, base64; None where the recording has none."""
    dots: dict[str, Float[np.ndarray, "n 2"]]
    """Centres of the dots of each of ``KINDS`` (px)."""


@dataclass(slots=True, eq=False)
class Sample:
    """One frame to be looked at."""

    step_index: int
    """How many frames came before it."""
    frame: int
    """Its number."""
    verdict: str
    """What came of it, in words."""
    detail: str
    """More about that."""
    is_positioned: bool
    """Whether it has a pose."""
    pictures: tuple[Picture, ...]
    """Left and right; one for points; none for an unusable frame."""
    why_shown: list[str] = field(default_factory=list)
    """Why it was chosen."""


class Samples:
    """Chooses frames: the first, the last, some evenly in between, the worst, the first refused for each reason."""

    def __init__(self) -> None:
        self._seen = 0
        self._stride = 1
        self._spread: list[Sample] = []
        self._refused: dict[str, Sample] = {}
        self._worst: tuple[float, Sample] | None = None
        self._last: Step | None = None

    def show(self, step: Step) -> None:
        """Look at the next frame, and keep what is worth it."""
        if self._seen % self._stride == 0:
            if len(self._spread) == SPREAD:
                self._spread, self._stride = self._spread[::2], 2 * self._stride
            if self._seen % self._stride == 0:
                self._spread.append(sample(step, self._seen))
        match step.fix:
            case NoFix(why=why) if why.name not in self._refused:
                self._refused[why.name] = sample(step, self._seen)
            case Fix(rms_mm=rms_mm) if rms_mm > (self._worst[0] if self._worst else 0.0):
                self._worst = rms_mm, sample(step, self._seen)
            case _:
                pass
        self._last = step
        self._seen += 1

    def chosen(self) -> list[Sample]:
        """The frames to show, in the order of the recording, each once."""
        if self._last is None:
            return []
        by_index: dict[int, Sample] = {}
        for why, each in self._reasons():
            by_index.setdefault(each.step_index, each).why_shown.append(why)
        return [by_index[index] for index in sorted(by_index)]

    def _reasons(self) -> Iterator[tuple[str, Sample]]:
        assert self._last is not None
        yield "first", self._spread[0]
        for each in self._spread[1:]:
            yield "in between", each
        for each in self._refused.values():
            yield "first with this reason", each
        if self._worst is not None:
            yield "largest residual", self._worst[1]
        yield "last", sample(self._last, self._seen - 1)


def sample(step: Step, step_index: int) -> Sample:
    """A frame shrunk to what the report shows of it."""
    match step.fix:
        case Fix() as fix:
            verdict = f"{len(fix.point)} identified, rms {fix.rms_mm:.3f} mm"
            if fix.reason is not None:
                verdict += f", {fix.reason.name.replace('_', ' ')}"
        case NoFix() as refusal:
            verdict = f"refused: {refusal.why.name.replace('_', ' ')}"
    is_positioned = isinstance(step.fix, Fix)
    return Sample(step_index, step.frame.index, verdict, step.fix.detail, is_positioned, _pictures(step))


def _pictures(step: Step) -> tuple[Picture, ...]:
    """Left and right, or the points on one canvas."""
    dots, content, rig = step.dots, step.frame.content, step.frame.rig
    if dots is None:
        if step.points is None:
            return ()
        return (Picture(WIDTH_PX, HEIGHT_PX, None, points_by_kind(step.points, step.fix)),)
    assert rig is not None, "dots come with the rig that saw them"
    left_image, right_image = (content.left, content.right) if isinstance(content, StereoImages) else (None, None)
    match, point = step.matches, step.points
    of_left = of_right = np.zeros(0, dtype=np.int64)
    if match is not None and point is not None:
        of_left, of_right = match.left[point.match], match.right[point.match]
    return (
        _picture(dots.left, of_left, step.fix, left_image, rig.left),
        _picture(dots.right, of_right, step.fix, right_image, rig.right),
    )


def _picture(
    dots: Dots, dot_of_point: Int[np.ndarray, "n"], fix: Fix | NoFix, image: GreyOrColour | None, camera: Camera
) -> Picture:
    by_kind = dots_by_kind(dots, dot_of_point, fix)
    if image is not None:
        return Picture(image.shape[1], image.shape[0], _jpeg(image), by_kind)
    return Picture(camera.width_px, camera.height_px, None, by_kind)


def dots_by_kind(
    dots: Dots, dot_of_point: Int[np.ndarray, "n"], fix: Fix | NoFix
) -> dict[str, Float[np.ndarray, "m 2"]]:
    """Centres of the dots of each of ``KINDS`` (px)."""
    kind = np.full(len(dots), "single", dtype=object)
    kind[dot_of_point] = "unidentified" if isinstance(fix, Fix) else "refused"
    if isinstance(fix, Fix):
        kind[dot_of_point[fix.point]] = "identified"
    return {each: dots.uv_px[kind == each] for each in KINDS}


def points_by_kind(points: SensorPoints, fix: Fix | NoFix) -> dict[str, Float[np.ndarray, "m 2"]]:
    """The points of each of ``KINDS`` as a pinhole at the sensor's origin would see them, filling the canvas (px)."""
    kind = np.full(len(points), "unidentified" if isinstance(fix, Fix) else "refused", dtype=object)
    if isinstance(fix, Fix):
        kind[fix.point] = "identified"
    ahead = points.xyz_mm[:, 2] > 0
    xy = points.xyz_mm[ahead, :2] / points.xyz_mm[ahead, 2:]
    if len(xy):
        low, high = xy.min(axis=0), xy.max(axis=0)
        canvas = np.array([WIDTH_PX, HEIGHT_PX])
        xy = (xy - (low + high) / 2) * (0.9 * canvas / np.maximum(high - low, 1e-6)).min() + canvas / 2
    return {each: xy[kind[ahead] == each] for each in KINDS}


def _jpeg(image: GreyOrColour) -> str:
    """The image, shrunk, as base64 JPEG; 16 bits are stretched to what they use."""
    scale = WIDTH_PX / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    if small.dtype == np.uint16:
        low, high = int(small.min()), int(small.max())
        small = ((small - low) * (255.0 / max(high - low, 1))).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return base64.b64encode(jpeg.tobytes()).decode()
