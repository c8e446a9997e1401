"""Recordings: folders of images, dots or points, handed out one frame at a time. Knows no stage and no result.

A fault of the whole recording is a ``RecordingError`` or ``CalibrationError`` when it is opened; a fault of a single
frame makes that frame ``Unusable`` and leaves the others alone. Tables are parsed once; images are decoded only when
their frame is asked for.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import CalibrationError, RecordingError
from trifix.files.calibrations import read_rig
from trifix.files.images import ImagePairs, holds_images, read_image_pairs
from trifix.files.tables import (
    COVARIANCE,
    LINE,
    Table,
    fixed,
    from_upper_triangle,
    read_table,
    refuse_where,
    significant,
    upper_triangle,
    write_table,
)
from trifix.geometry.camera import StereoRig
from trifix.records import Dots, Frame, Reason, SensorPoints, StereoDots, StereoImages, Unusable

Level = Literal["images", "dots", "points"]

LEVELS: tuple[Level, ...] = ("images", "dots", "points")
"""The levels, richest first."""

_LATERAL_PER_MM = 1e-3  # sigma of a point across its ray, without a rig: as seen with a focal length of 1000 px
_NEAREST_MM = 5.0  # no sensor sees targets nearer than this
_LENGTHENING = 5.0  # and along the ray, in units of that


Content = StereoImages | StereoDots | SensorPoints | Unusable


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A recording at one level; iterate over its frames, as often as needed."""

    path: Path
    """The folder."""
    level: Level
    """Which of its levels this is."""
    index: Int[np.ndarray, "n"]
    """Numbers of the frames, ascending; not necessarily without gaps."""
    timestamp_ns: Int[np.ndarray, "n"]
    """Times of the exposures (ns)."""
    is_noise_stated: bool
    """Whether the file states the error of each dot or point; otherwise it awaits the recording's noise scale."""
    rig: StereoRig | None
    """The rig of all frames that have none of their own."""
    rigs: Mapping[int, StereoRig]
    """The rigs of frames that have one of their own, by position."""
    content: Callable[[int, StereoRig | None], Content]
    """Reads what the k-th frame saw with its rig."""

    def __len__(self) -> int:
        return len(self.index)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(k) for k in range(len(self)))

    def frame(self, k: int) -> Frame:
        """The k-th frame, counted from 0 whatever its index; negative counts from the end."""
        k = range(len(self))[k]
        rig = self.rigs.get(k, self.rig)
        stamp = int(self.timestamp_ns[k])
        if rig is None and self.level != "points":
            detail = f"{self.path / 'calibrations' / f'{stamp}.yaml'} does not exist, and there is no calibration.yaml."
            return Frame(int(self.index[k]), stamp, None, Unusable(Reason.no_calibration, detail))
        return Frame(int(self.index[k]), stamp, rig, self.content(k, rig))


def read_recording(path: Path | str, level: Level | None = None, sigma_px: float = 0.3) -> Recording:
    """The recording in a folder, at its richest level unless another is asked for.

    ``sigma_px`` is the standard deviation per axis of dots whose table states none, and of the dots behind points
    whose table states none.

    Raises:
        RecordingError: the folder holds no recording, or one that is incomplete or contradicts itself.
        CalibrationError: the calibration is broken, or dots and images come without any.
    """
    path = Path(path)
    if not path.is_dir():
        raise RecordingError(f"{path} is not a folder, expected a recording.")
    present = {
        "images": holds_images(path),
        "dots": (path / "dots.csv").exists(),
        "points": (path / "points.csv").exists(),
    }
    found: list[Level] = [name for name in LEVELS if present[name]]
    if not found or (level is not None and level not in found):
        raise RecordingError(
            f"{path} holds no {level or 'recording'}: found {' and '.join(found) or 'neither images nor tables'}, "
            f"expected cam0 and cam1, left and right (folders or videos), dots.csv or points.csv."
        )
    match level or found[0]:
        case "images":
            return _open_images(path)
        case "dots":
            return _open_dots(path, sigma_px)
        case "points":
            return _open_points(path, sigma_px)


def _open_images(path: Path) -> Recording:
    pairs = read_image_pairs(path)
    index, timestamp_ns = np.arange(len(pairs.timestamp_ns)), pairs.timestamp_ns
    if (path / "frames.csv").exists():
        index, timestamp_ns = _read_frames(path)
        if len(index) != len(pairs.timestamp_ns):
            raise RecordingError(
                f"{path / 'frames.csv'} has {len(index)} frames, expected one for each of the "
                f"{len(pairs.timestamp_ns)} image pairs."
            )
        other = np.flatnonzero(timestamp_ns != pairs.timestamp_ns)
        if len(other) and not pairs.is_nominal:
            k = other[0]
            raise RecordingError(
                f"{path / 'frames.csv'}: frame {index[k]} has time stamp {timestamp_ns[k]}, its images have "
                f"{pairs.timestamp_ns[k]}."
            )
    source = _Images(pairs)
    rig, rigs = _read_rigs(path, timestamp_ns, is_needed=True)
    rig_of = {k: own for k in range(len(index)) if (own := rigs.get(k, rig)) is not None}
    _check_first_sizes(source, rig_of)
    return Recording(path, "images", index, timestamp_ns, False, rig, rigs, source.content)


def _open_dots(path: Path, sigma_px: float) -> Recording:
    index, timestamp_ns = _read_frames(path)
    file = path / "dots.csv"
    sizes = ("sigma_px", "diameter_px", "a_px", "b_px", "theta_rad")
    table = read_table(
        file,
        {"frame": int, "timestamp_ns": int, "camera": int, "u": float, "v": float},
        dict.fromkeys(sizes, float) | {"label": int},
        may_be_nan=("u", "v", *sizes),
    )
    position = _positions(file, table, index, timestamp_ns)
    camera = table["camera"]
    refuse_where((camera != 0) & (camera != 1), file, table, "camera", "0 (left) or 1 (right)")
    _all_or_none(file, table, ("a_px", "b_px", "theta_rad"))
    for name in ("sigma_px", "diameter_px", "a_px", "b_px"):
        if name in table:
            refuse_where(table[name] <= 0, file, table, name, "a positive number")
    n = len(position)
    stated = table.get("sigma_px", np.full(n, np.nan))
    is_noise_stated = not np.isnan(stated).all()
    sigma = np.where(np.isnan(stated), sigma_px, stated)  # an empty cell states nothing
    image = 2 * position + camera
    order = np.argsort(image, kind="stable")
    dots = Dots(
        uv_px=np.stack([table["u"], table["v"]], axis=1)[order],
        cov_px2=np.where(np.eye(2) > 0, sigma[order, None, None] ** 2, 0.0),
        ellipse=_ellipses(table)[order],
        label=table.get("label", np.full(n, -1))[order],
        row=order,
    )
    source = _DotTable(
        dots,
        start=np.searchsorted(image[order], np.arange(2 * len(index) + 1)),
        faults=_faults(file, {**table, "sigma_px": sigma}, ("u", "v", "sigma_px"), position),
    )
    rig, rigs = _read_rigs(path, timestamp_ns, is_needed=True)
    return Recording(path, "dots", index, timestamp_ns, is_noise_stated, rig, rigs, source.content)


def _open_points(path: Path, sigma_px: float) -> Recording:
    index, timestamp_ns = _read_frames(path)
    file = path / "points.csv"
    xyz = ("x_mm", "y_mm", "z_mm")
    table = read_table(
        file,
        {"frame": int, "timestamp_ns": int} | dict.fromkeys(xyz, float),
        dict.fromkeys(COVARIANCE, float) | {"label": int},
        may_be_nan=(*xyz, *COVARIANCE),
    )
    position = _positions(file, table, index, timestamp_ns)
    is_noise_stated = _all_or_none(file, table, COVARIANCE)
    faults = _faults(file, table, (*xyz, *COVARIANCE), position)
    n = len(position)
    cov = np.full((n, 3, 3), np.nan)
    if is_noise_stated:
        cov = from_upper_triangle(np.stack([table[name] for name in COVARIANCE], axis=1))
        finite = np.isfinite(cov).all(axis=(1, 2))
        smallest = np.ones(n)
        smallest[finite] = np.linalg.eigvalsh(cov[finite])[:, 0]
        refuse_where(smallest <= 0, file, table, "xx", "a covariance xx ... zz that is positive definite")
    else:  # a default grows with the distance: it needs one
        for row in np.flatnonzero(table["z_mm"] <= 0):
            found = f"{file.name}, line {table[LINE][row]}, column 'z_mm': found {table['z_mm'][row]}"
            faults.setdefault(int(position[row]), f"{found}, expected a point before the sensor.")
    xyz_mm = np.stack([table[name] for name in xyz], axis=1)
    _refuse_metres(file, xyz_mm)
    order = np.argsort(position, kind="stable")
    points = SensorPoints(
        xyz_mm=xyz_mm[order],
        cov_mm2=cov[order],
        match=np.full(n, -1),
        label=table.get("label", np.full(n, -1))[order],
        row=order,
        is_cov_known=is_noise_stated,
    )
    start = np.searchsorted(position[order], np.arange(len(index) + 1))
    rig, rigs = _read_rigs(path, timestamp_ns, is_needed=False)
    source = _PointTable(points, start, faults, sigma_px)
    return Recording(path, "points", index, timestamp_ns, is_noise_stated, rig, rigs, source.content)


def _refuse_metres(file: Path, xyz_mm: Float[np.ndarray, "n 3"]) -> None:
    """Refuses points of which half lie where no target can be seen: they are not in millimetres."""
    distance = np.linalg.norm(xyz_mm[np.isfinite(xyz_mm).all(axis=1)], axis=1)
    if len(distance) and np.median(distance) < _NEAREST_MM:
        raise RecordingError(
            f"{file}: half of the points lie within {np.median(distance):.3g} mm of the sensor, expected at least "
            f"{_NEAREST_MM:g}; are x_mm, y_mm, z_mm in metres? Multiply them by 1000, and a covariance by 1000000."
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """Frames that are image pairs."""

    pairs: ImagePairs

    def content(self, k: int, rig: StereoRig | None) -> StereoImages | Unusable:
        assert rig is not None  # a frame without calibration is refused before its images are decoded
        images = self.decode(k)
        if isinstance(images, str):
            return Unusable(Reason.unreadable_image, images)
        fault = _size_fault(images, rig, self.pairs.files(k))
        return Unusable(Reason.unreadable_image, fault) if fault else images

    def decode(self, k: int) -> StereoImages | str:
        """The images, or why they cannot be had."""
        left, right = self.pairs.left(k), self.pairs.right(k)
        if isinstance(left, str):
            return left
        return right if isinstance(right, str) else StereoImages(left, right)


@dataclass(frozen=True, slots=True, eq=False)
class _DotTable:
    """Frames that are dots, sorted by frame and camera."""

    dots: Dots
    start: Int[np.ndarray, "m"]
    """First row of each image's dots: left of frame 0, right of frame 0, left of frame 1 ..., end."""
    faults: Mapping[int, str]
    """What is wrong with a frame, by position."""

    def content(self, k: int, rig: StereoRig | None) -> StereoDots | Unusable:
        if k in self.faults:
            return Unusable(Reason.bad_points, self.faults[k])
        return StereoDots(left=self._image(2 * k), right=self._image(2 * k + 1))

    def _image(self, i: int) -> Dots:
        at, d = slice(self.start[i], self.start[i + 1]), self.dots
        return Dots(d.uv_px[at], d.cov_px2[at], d.ellipse[at], d.label[at], d.row[at])


@dataclass(frozen=True, slots=True, eq=False)
class _PointTable:
    """Frames that are points, sorted by frame."""

    points: SensorPoints
    start: Int[np.ndarray, "m"]
    """First row of each frame's points, end."""
    faults: Mapping[int, str]
    """What is wrong with a frame, by position."""
    sigma_px: float
    """Error of the dots behind the points (px), for a covariance where none is stated."""

    def content(self, k: int, rig: StereoRig | None) -> SensorPoints | Unusable:
        if k in self.faults:
            return Unusable(Reason.bad_points, self.faults[k])
        at, p = slice(self.start[k], self.start[k + 1]), self.points
        cov = p.cov_mm2[at] if p.is_cov_known else _default_cov(p.xyz_mm[at], rig, self.sigma_px)
        return SensorPoints(p.xyz_mm[at], cov, p.match[at], p.label[at], p.row[at], p.is_cov_known)


def _default_cov(
    xyz_mm: Float[np.ndarray, "n 3"], rig: StereoRig | None, sigma_px: float
) -> Float[np.ndarray, "n 3 3"]:
    """Covariance (mm²) of points before the sensor: that of two dots in the rig, or a guess longer along the ray."""
    if rig is not None:
        J_left = rig.left.project_jacobian(xyz_mm)
        J_right = rig.right.project_jacobian(rig.T_right_left.apply(xyz_mm)) @ rig.T_right_left.R
        information = np.swapaxes(J_left, 1, 2) @ J_left + np.swapaxes(J_right, 1, 2) @ J_right
        return np.asarray(sigma_px**2 * np.linalg.inv(information))
    ray = xyz_mm / np.linalg.norm(xyz_mm, axis=1, keepdims=True)
    lateral_mm = sigma_px * _LATERAL_PER_MM * xyz_mm[:, 2]
    along = ray[:, :, None] * ray[:, None, :]
    return np.asarray(lateral_mm[:, None, None] ** 2 * (np.eye(3) + (_LENGTHENING**2 - 1) * along))


def _read_frames(path: Path) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Numbers and times of frames.csv."""
    file = path / "frames.csv"
    table = read_table(file, {"frame": int, "timestamp_ns": int})
    index, timestamp_ns = table["frame"], table["timestamp_ns"]
    if not len(index):
        raise RecordingError(f"{file} lists no frame.")
    not_after = np.flatnonzero(np.diff(index, prepend=-1) <= 0)
    if len(not_after):
        row = not_after[0]
        raise RecordingError(
            f"{file}, line {table[LINE][row]}: frame {index[row]} "
            + (f"follows frame {index[row - 1]}" if row else "comes first")
            + ", expected ascending numbers from 0."
        )
    return index, timestamp_ns


def _read_rigs(
    path: Path, timestamp_ns: Int[np.ndarray, "n"], is_needed: bool
) -> tuple[StereoRig | None, dict[int, StereoRig]]:
    """The rig of all frames, and by position those of frames with one of their own."""
    file, folder = path / "calibration.yaml", path / "calibrations"
    rig = read_rig(file) if file.exists() else None
    own = [(k, folder / f"{stamp}.yaml") for k, stamp in enumerate(timestamp_ns) if folder.is_dir()]
    rigs = {k: read_rig(own_file) for k, own_file in own if own_file.exists()}
    if folder.is_dir() and not rigs:
        raise CalibrationError(f"{folder}: no file belongs to a frame, expected names like {timestamp_ns[0]}.yaml.")
    if is_needed and rig is None and not rigs:
        raise CalibrationError(
            f"{path} has no calibration: expected calibration.yaml, or calibrations/<timestamp_ns>.yaml of each frame."
        )
    return rig, rigs


def _size_fault(images: StereoImages, rig: StereoRig, files: tuple[Path, Path]) -> str:
    """What is wrong with the sizes of a pair; empty if nothing is."""
    cameras = (("left", images.left, rig.left), ("right", images.right, rig.right))
    for file, (side, image, camera) in zip(files, cameras, strict=True):
        height, width = image.shape[:2]
        if (width, height) != (camera.width_px, camera.height_px):
            return (
                f"the {side} image {file} is {width} x {height} pixels, its calibration is for {camera.width_px} x "
                f"{camera.height_px}."
            )
    return ""


def _check_first_sizes(source: _Images, rigs: Mapping[int, StereoRig]) -> None:
    """Refuses a recording whose first two readable pairs have wrong sizes; a single odd one is its frame's fault."""
    faults: list[str] = []
    for k, rig in rigs.items():
        images = source.decode(k)
        if isinstance(images, StereoImages):
            fault = _size_fault(images, rig, source.pairs.files(k))
            if not fault:
                return
            faults.append(f"image pair {k}: {fault}")
            if len(faults) == 2:
                break
    if faults:
        raise RecordingError(faults[0])


def _positions(
    file: Path, table: Table, index: Int[np.ndarray, "n"], timestamp_ns: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """Position in the recording of the frame of each row."""
    frame = table["frame"]
    position = np.searchsorted(index, frame).clip(max=len(index) - 1)
    refuse_where(index[position] != frame, file, table, "frame", "a frame of frames.csv")
    other = np.flatnonzero(timestamp_ns[position] != table["timestamp_ns"])
    if len(other):
        row = other[0]
        raise RecordingError(
            f"{file}, line {table[LINE][row]}: frame {frame[row]} has time stamp {table['timestamp_ns'][row]}, in "
            f"frames.csv it has {timestamp_ns[position[row]]}."
        )
    return np.asarray(position)


def _all_or_none(file: Path, table: Table, names: tuple[str, ...]) -> bool:
    """Whether a group of columns is there; refuses a part of it."""
    missing = [name for name in names if name not in table]
    if missing and len(missing) < len(names):
        raise RecordingError(
            f"{file}: column {' and '.join(missing)} is missing, expected all of {', '.join(names)} or none."
        )
    return not missing


def _faults(file: Path, table: Table, names: tuple[str, ...], position: Int[np.ndarray, "m"]) -> dict[int, str]:
    """By position of the frame, the first value of these columns that is not finite."""
    faults: dict[int, str] = {}
    present = [name for name in names if name in table]
    wrong = ~np.isfinite(np.stack([table[name] for name in present], axis=1))
    for row in np.flatnonzero(wrong.any(axis=1)):
        name = present[int(wrong[row].argmax())]
        found = f"{file.name}, line {table[LINE][row]}, column '{name}': found {table[name][row]}"
        faults.setdefault(int(position[row]), f"{found}, expected a finite number.")
    return faults


def _ellipses(table: Table) -> Float[np.ndarray, "m 3"]:
    """Semi-axes a ≥ b and angle of each row: as stated, else the circle of the diameter, else NaN."""
    radius = table["diameter_px"] / 2 if "diameter_px" in table else np.full(len(table[LINE]), np.nan)
    circle = np.stack([radius, radius, np.zeros(len(radius))], axis=1)
    if "a_px" not in table:
        return circle
    a, b, theta = table["a_px"], table["b_px"], table["theta_rad"]
    stated = np.stack([np.maximum(a, b), np.minimum(a, b), np.where(b > a, theta + np.pi / 2, theta)], axis=1)
    return np.where(np.isfinite(stated).all(axis=1, keepdims=True), stated, circle)


def write_frames(path: Path, index: Int[np.ndarray, "n"], timestamp_ns: Int[np.ndarray, "n"]) -> None:
    """Writes frames.csv: every frame, also those in which nothing was seen."""
    write_table(path, {"frame": _integers(index), "timestamp_ns": _integers(timestamp_ns)})


def write_dots(
    path: Path,
    index: Int[np.ndarray, "m"],
    timestamp_ns: Int[np.ndarray, "m"],
    camera: Int[np.ndarray, "m"],
    uv_px: Float[np.ndarray, "m 2"],
    *,
    sigma_px: Float[np.ndarray, "m"] | None = None,
    diameter_px: Float[np.ndarray, "m"] | None = None,
    ellipse: Float[np.ndarray, "m 3"] | None = None,
    label: Int[np.ndarray, "m"] | None = None,
) -> None:
    """Writes dots.csv, a row a dot; the optional columns only where they are given."""
    write_table(path, _dot_columns(index, timestamp_ns, camera, uv_px, sigma_px, diameter_px, ellipse, label))


def write_points(
    path: Path,
    index: Int[np.ndarray, "m"],
    timestamp_ns: Int[np.ndarray, "m"],
    xyz_mm: Float[np.ndarray, "m 3"],
    *,
    cov_mm2: Float[np.ndarray, "m 3 3"] | None = None,
    label: Int[np.ndarray, "m"] | None = None,
) -> None:
    """Writes points.csv, a row a point; covariance and label only where they are given."""
    columns = {"frame": _integers(index), "timestamp_ns": _integers(timestamp_ns)}
    columns |= {name: _decimals(xyz_mm[:, i]) for i, name in enumerate(("x_mm", "y_mm", "z_mm"))}
    if cov_mm2 is not None:
        entries = upper_triangle(cov_mm2)
        columns |= {name: [significant(x) for x in entries[:, i]] for i, name in enumerate(COVARIANCE)}
    if label is not None:
        columns["label"] = _labels(label)
    write_table(path, columns)


DOTS_HEADER = "frame,timestamp_ns,camera,u,v,sigma_px,diameter_px,a_px,b_px,theta_rad,label"
"""Header of ``dots_rows``."""


def dots_rows(index: int, timestamp_ns: int, dots: StereoDots) -> list[str]:
    """The rows of dots.csv of one frame, left dots before right ones, for a file that grows with the frames."""
    left, right = dots.left, dots.right
    camera = np.repeat([0, 1], [len(left), len(right)])
    columns = _dot_columns(
        np.full(len(camera), index),
        np.full(len(camera), timestamp_ns),
        camera,
        np.concatenate([left.uv_px, right.uv_px]),
        np.sqrt(np.trace(np.concatenate([left.cov_px2, right.cov_px2]), axis1=1, axis2=2) / 2),
        np.concatenate([left.diameter_px, right.diameter_px]),
        np.concatenate([left.ellipse, right.ellipse]),
        np.concatenate([left.label, right.label]),
    )
    return [",".join(row) for row in zip(*columns.values(), strict=True)]


def _dot_columns(
    index: Int[np.ndarray, "m"],
    timestamp_ns: Int[np.ndarray, "m"],
    camera: Int[np.ndarray, "m"],
    uv_px: Float[np.ndarray, "m 2"],
    sigma_px: Float[np.ndarray, "m"] | None,
    diameter_px: Float[np.ndarray, "m"] | None,
    ellipse: Float[np.ndarray, "m 3"] | None,
    label: Int[np.ndarray, "m"] | None,
) -> dict[str, list[str]]:
    """The columns of dots.csv as text."""
    columns = {
        "frame": _integers(index),
        "timestamp_ns": _integers(timestamp_ns),
        "camera": _integers(camera),
        "u": _decimals(uv_px[:, 0]),
        "v": _decimals(uv_px[:, 1]),
    }
    if sigma_px is not None:
        columns["sigma_px"] = _decimals(sigma_px)
    if diameter_px is not None:
        columns["diameter_px"] = _decimals(diameter_px)
    if ellipse is not None:
        columns |= {name: _decimals(ellipse[:, i]) for i, name in enumerate(("a_px", "b_px", "theta_rad"))}
    if label is not None:
        columns["label"] = _labels(label)
    return columns


def _integers(values: Int[np.ndarray, "m"]) -> list[str]:
    return [str(x) for x in values.tolist()]


def _decimals(values: Float[np.ndarray, "m"]) -> list[str]:
    return [fixed(x) for x in values.tolist()]


def _labels(values: Int[np.ndarray, "m"]) -> list[str]:
    return [str(x) if x >= 0 else "" for x in values.tolist()]
