"""Image pairs of a recording, decoded one at a time. Knows layouts and containers, and nothing of calibrations.

Three layouts, in this order: EuRoC (``cam0/data.csv`` and ``cam0/data/``, paired by time stamp), folders ``left/`` and
``right/`` (paired by sorted name), videos ``left.*`` and ``right.*`` (paired by number).
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int

from trifix.errors import RecordingError
from trifix.files.tables import LINE, read_bare_table
from trifix.records import GreyOrColour

_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"})
_VIDEOS = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg"})
_NOMINAL_STEP_NS = 1_000_000_000
_SHORTEST_STEP_NS = 1_000  # names that count faster than this are numbers of frames, not nanoseconds


@dataclass(frozen=True, slots=True, eq=False)
class ImagePairs:
    """The image pairs of a recording, still on the disk."""

    timestamp_ns: Int[np.ndarray, "n"]
    """Time of each pair (ns); nominal, 1 s apart, where nothing tells it."""
    is_nominal: bool
    """Whether the times are nominal: from the frame rate or from nothing."""
    left: Callable[[int], GreyOrColour | str]
    """Decodes the left image of the k-th pair, or says why it cannot."""
    right: Callable[[int], GreyOrColour | str]
    """The same for the right one."""
    files: Callable[[int], tuple[Path, Path]]
    """Where the left and the right image of the k-th pair are stored."""


def holds_images(folder: Path) -> bool:
    """Whether a recording's folder holds images, be it of one camera only."""
    return _layout(folder) is not None


def read_image_pairs(folder: Path) -> ImagePairs:
    """The image pairs in a recording's folder that holds some.

    Raises:
        RecordingError: one camera's images are missing, or the two cameras' do not pair up.
    """
    layout = _layout(folder)
    if layout is None:
        raise RecordingError(f"{folder} holds no images: expected cam0 and cam1, or left and right.")
    (left, right), read = layout
    for missing, present in ((left, right), (right, left)):
        if not missing.exists():
            raise RecordingError(f"{missing} does not exist, though {present.name} does: expected both cameras.")
    return read(left, right)


def read_image(path: Path) -> GreyOrColour | str:
    """An image as it is stored, 8 or 16 bit, grey or BGR without alpha; or a sentence saying why it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as fault:
        return f"{path} cannot be read: {fault.strerror}."
    if _is_cut_off(data):
        return f"{path} ends in the middle of the image ({len(data)} bytes)."
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        return f"{path} is not an image that can be decoded ({len(data)} bytes)."
    if image.dtype not in (np.uint8, np.uint16):
        return f"{path} holds {image.dtype} values, expected 8 or 16 bit."
    return np.ascontiguousarray(image[:, :, :3]) if image.ndim == 3 else image


def _is_cut_off(data: bytes) -> bool:
    """Whether a PNG or JPEG lacks its end mark; some decoders then invent the rest of the image."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-4096:]
    if data.startswith(b"\xff\xd8"):  # a thumbnail inside has an end mark too, but it precedes the last scan
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return False


def _layout(folder: Path) -> tuple[tuple[Path, Path], Callable[[Path, Path], ImagePairs]] | None:
    """Both cameras' entries and their reader, in the first layout of which one entry exists."""
    videos = {p.stem: p for p in sorted(folder.iterdir(), reverse=True) if p.suffix.lower() in _VIDEOS}
    layouts = (
        ((folder / "cam0", folder / "cam1"), _read_euroc),
        ((folder / "left", folder / "right"), _read_folders),
        ((videos.get("left", folder / "left.mp4"), videos.get("right", folder / "right.mp4")), _read_videos),
    )
    return next((layout for layout in layouts if any(side.exists() for side in layout[0])), None)


def _read_euroc(cam0: Path, cam1: Path) -> ImagePairs:
    (stamps, left), (stamps_right, files_right) = _read_euroc_camera(cam0), _read_euroc_camera(cam1)
    right = dict(zip(stamps_right, files_right, strict=True))
    for camera, alone in ((cam0, set(stamps) - right.keys()), (cam1, right.keys() - set(stamps))):
        if alone:
            raise RecordingError(
                f"{camera / 'data.csv'}: {_some(sorted(alone))} not in the other camera's, expected every exposure in "
                f"both cam0 and cam1."
            )
    return _image_files(np.array(stamps, dtype=np.int64), False, left, [right[stamp] for stamp in stamps])


def _read_euroc_camera(camera: Path) -> tuple[list[int], list[Path]]:
    """Time stamps and files of data.csv, in its order."""
    path = camera / "data.csv"
    table = read_bare_table(path, {"timestamp [ns]": int, "filename": str})
    stamps: list[int] = table["timestamp [ns]"].tolist()
    if not stamps:
        raise RecordingError(f"{path} lists no image.")
    first_line: dict[int, int] = {}
    for stamp, line in zip(stamps, table[LINE], strict=True):
        if first_line.setdefault(stamp, line) != line:
            raise RecordingError(f"{path}, line {line}: time stamp {stamp} was already in line {first_line[stamp]}.")
    data = camera / "data"
    present = {entry.name for entry in data.iterdir()} if data.is_dir() else set()
    for name, line in zip(table["filename"], table[LINE], strict=True):
        if name not in present:
            raise RecordingError(f"{path}, line {line}: {data / name} does not exist.")
    return stamps, [data / name for name in table["filename"]]


def _read_folders(left_folder: Path, right_folder: Path) -> ImagePairs:
    left, right = (
        sorted((p for p in side.iterdir() if p.suffix.lower() in _IMAGES), key=_natural)
        for side in (left_folder, right_folder)
    )
    if len(left) != len(right) or not left:
        raise RecordingError(
            f"{left_folder.parent}: found {len(left)} images in left and {len(right)} in right, expected pairs."
        )
    _refuse_unpaired(left, right)
    return _image_files(*_stamps_of_names(left, right), left, right)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts names with the numbers in them by value: 9 before 10, padded with zeros or not."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


def _refuse_unpaired(left: list[Path], right: list[Path]) -> None:
    """Refuses sorted images whose names end in other numbers than their partners' do.

    A number that several images of a folder end in tells none of them; it may be the camera's.
    """
    numbers, others = [_last_number(p) for p in left], [_last_number(p) for p in right]
    if numbers == others or len(set(numbers)) < len(left) or len(set(others)) < len(right):
        return
    alone = [p for p, n in zip(left, numbers, strict=True) if n not in others]
    alone += [p for p, n in zip(right, others, strict=True) if n not in numbers]
    if not alone:
        k = next(k for k, n in enumerate(numbers) if n != others[k])
        alone = [left[k], right[k]]
    shown = ", ".join(str(Path(p.parent.name) / p.name) for p in alone[:6])
    more = f" and {len(alone) - 6} more" if len(alone) > 6 else ""
    raise RecordingError(
        f"{left[0].parent.parent}: {shown}{more} have no partner, expected names that end in the same numbers in left "
        f"and right."
    )


def _last_number(path: Path) -> int:
    """The last number in a name, -1 without any."""
    return int(([-1] + re.findall(r"[0-9]+", path.stem))[-1])


def _stamps_of_names(left: list[Path], right: list[Path]) -> tuple[Int[np.ndarray, "n"], bool]:
    """Time stamps of sorted images, and whether they are nominal: their names, if all step like nanoseconds."""
    nominal = np.arange(len(left)) * _NOMINAL_STEP_NS
    if not all(p.stem.isdecimal() and int(p.stem) < 2**63 for p in (*left, *right)):
        return nominal, True
    stamps = np.array([int(p.stem) for p in left], dtype=np.int64)
    if len(stamps) < 2 or np.diff(stamps).min() < _SHORTEST_STEP_NS:
        return nominal, True
    return stamps, False


def _image_files(
    timestamp_ns: Int[np.ndarray, "n"], is_nominal: bool, left: list[Path], right: list[Path]
) -> ImagePairs:
    return ImagePairs(
        timestamp_ns,
        is_nominal,
        lambda k: read_image(left[k]),
        lambda k: read_image(right[k]),
        lambda k: (left[k], right[k]),
    )


def _read_videos(left_path: Path, right_path: Path) -> ImagePairs:
    left, right = _Video(left_path), _Video(right_path)
    if left.count != right.count:
        raise RecordingError(
            f"{left_path.parent}: {left_path.name} has {left.count} images and {right_path.name} has {right.count}, "
            f"expected synchronous videos."
        )
    stamps = np.round(np.arange(left.count) * (1e9 / left.fps)).astype(np.int64)
    return ImagePairs(stamps, True, left.read, right.read, lambda _: (left_path, right_path))


class _Video:
    """A video read forwards; going back starts it anew, as jumping to a picture is not exact in every container."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._open()
        self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        if not self._capture.isOpened() or self.count < 1 or not self.fps > 0:
            raise RecordingError(f"{path} is not a video that can be decoded.")

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0

    def read(self, k: int) -> GreyOrColour | str:
        if k < self._next:
            self._capture.release()
            self._open()
        for _ in range(k - self._next):
            self._capture.grab()
        self._next = k + 1
        ok, image = self._capture.read()
        return np.asarray(image, dtype=np.uint8) if ok else f"{self.path}: image {k} cannot be decoded."


def _some(stamps: list[int]) -> str:
    """The first few of many, for a message."""
    shown = ", ".join(map(str, stamps[:5]))
    if len(stamps) == 1:
        return f"time stamp {shown} is"
    return f"time stamps {shown}{f' and {len(stamps) - 5} more' if len(stamps) > 5 else ''} are"
