"""The stereo rig as Kalibr writes it (camchain YAML, metres). Knows no recording and no image.

A camchain is refused at its first impossible value: a wrong calibration yields poses that look right.
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar, get_args

import numpy as np
import yaml
from jaxtyping import Float

from trifix.errors import CalibrationError
from trifix.files.tables import read_text
from trifix.geometry.camera import Camera, DistortionModel, StereoRig
from trifix.geometry.pose import Pose

_MM_PER_M = 1000.0
_ROTATION_TOLERANCE = 1e-4  # four printed decimals; below it the rotation is rounded, above it something else
_SHORTEST_BASELINE_MM = 1e-3
_MODELS: tuple[DistortionModel, ...] = get_args(DistortionModel)
_COEFFICIENTS: Mapping[DistortionModel, tuple[int, ...]] = {"none": (0,), "radtan": (4, 5), "equidistant": (4,)}

Choice = TypeVar("Choice", bound=str)


def read_rig(path: Path) -> StereoRig:
    """The rig of a Kalibr camchain: ``cam0`` is the left camera, ``cam1`` the right one; other keys are ignored.

    Raises:
        CalibrationError: the file is missing, is no camchain, or holds an impossible value.
    """
    try:
        content: object = yaml.load(read_text(path, CalibrationError), Loader=yaml.CSafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as fault:  # ValueError: a date or a number that cannot be
        raise CalibrationError(f"{path} is not YAML: {' '.join(str(fault).split())}.") from None
    chain = _mapping(content, path, "the file")
    cameras = [_mapping(_get(chain, name, path, ""), path, name) for name in ("cam0", "cam1")]
    return StereoRig(
        left=_camera(cameras[0], path, "cam0"),
        right=_camera(cameras[1], path, "cam1"),
        T_right_left=_pose(cameras[1], path),
    )


def write_rig(rig: StereoRig, path: Path) -> None:
    """Writes a rig as a Kalibr camchain, with all its digits."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rig.T_right_left.R, rig.T_right_left.t_mm / _MM_PER_M
    chain = {
        "cam0": _camera_yaml(rig.left),
        "cam1": {"T_cn_cnm1": T.tolist()} | _camera_yaml(rig.right),
    }
    path.write_text(yaml.safe_dump(chain, sort_keys=False, default_flow_style=None, width=1000), encoding="utf-8")


def _camera_yaml(camera: Camera) -> dict[str, str | list[float] | list[int]]:
    return {
        "camera_model": "pinhole",
        "intrinsics": [float(x) for x in (camera.fu_px, camera.fv_px, camera.pu_px, camera.pv_px)],
        "distortion_model": camera.model,
        "distortion_coeffs": [float(x) for x in camera.coefficients],
        "resolution": [int(camera.width_px), int(camera.height_px)],
    }


def _camera(camera: Mapping[str, object], path: Path, name: str) -> Camera:
    _choice(camera, "camera_model", ("pinhole",), path, name)
    model = _choice(camera, "distortion_model", _MODELS, path, name)
    coefficients = (
        _numbers(camera, "distortion_coeffs", _COEFFICIENTS[model], path, name)
        if "distortion_coeffs" in camera or model != "none"
        else []
    )
    fu, fv, pu, pv = _numbers(camera, "intrinsics", (4,), path, name)
    if fu <= 0 or fv <= 0:
        raise CalibrationError(
            f"{path}, {name}.intrinsics: found focal lengths fu = {fu:g}, fv = {fv:g} px, expected positive ones "
            f"(the order is fu, fv, pu, pv)."
        )
    width, height = _numbers(camera, "resolution", (2,), path, name)
    if width < 1 or height < 1 or width % 1 or height % 1:
        raise CalibrationError(
            f"{path}, {name}.resolution: found [{width:g}, {height:g}], expected width and height in whole pixels."
        )
    return Camera(fu, fv, pu, pv, int(width), int(height), model, tuple(coefficients))


def _pose(camera: Mapping[str, object], path: Path) -> Pose:
    """``T_right_left`` (mm) of the 4x4 matrix ``T_cn_cnm1`` (metres)."""
    key = "cam1.T_cn_cnm1"
    rows = _sequence(_get(camera, "T_cn_cnm1", path, "cam1."), path, key)
    if len(rows) != 4:
        raise CalibrationError(f"{path}, {key}: found {len(rows)} rows, expected 4 of 4 numbers.")
    T = np.array([_number_list(row, (4,), path, f"{key}, row {i}") for i, row in enumerate(rows)])
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise CalibrationError(f"{path}, {key}: the last row is {T[3].tolist()}, expected [0, 0, 0, 1].")
    R = T[:3, :3]
    off = float(np.abs(R.T @ R - np.eye(3)).max())
    if off > _ROTATION_TOLERANCE:
        raise CalibrationError(
            f"{path}, {key}: the upper left 3x3 is no rotation, its columns are off from orthonormal by {off:.2g}, "
            f"expected at most {_ROTATION_TOLERANCE:g}."
        )
    if np.linalg.det(R) < 0:
        raise CalibrationError(
            f"{path}, {key}: the upper left 3x3 is mirrored (determinant {np.linalg.det(R):.3f}), expected a rotation."
        )
    t_mm = T[:3, 3] * _MM_PER_M
    if np.linalg.norm(t_mm) < _SHORTEST_BASELINE_MM:
        raise CalibrationError(f"{path}, {key}: the baseline is zero, expected two cameras that stand apart.")
    return Pose(_nearest_rotation(R), t_mm)


def _nearest_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to one that was rounded for printing."""
    U, _, Vt = np.linalg.svd(R)
    return np.asarray(U @ Vt)


def _get(mapping: Mapping[str, object], key: str, path: Path, prefix: str) -> object:
    if key not in mapping:
        raise CalibrationError(
            f"{path}: key '{prefix}{key}' is missing, found {', '.join(map(str, mapping)) or 'none'}; "
            f"expected a Kalibr camchain with cam0 and cam1."
        )
    return mapping[key]


def _mapping(value: object, path: Path, name: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise CalibrationError(f"{path}: {name} holds {_short(value)}, expected keys and values of a Kalibr camchain.")
    return value


def _sequence(value: object, path: Path, name: str) -> Sequence[object]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise CalibrationError(f"{path}, {name}: found {_short(value)}, expected a list.")
    return value


def _choice(camera: Mapping[str, object], key: str, known: tuple[Choice, ...], path: Path, name: str) -> Choice:
    value = _get(camera, key, path, f"{name}.")
    if isinstance(value, str) and value in known:
        return known[known.index(value)]
    near = difflib.get_close_matches(str(value), known, n=1, cutoff=0.0)[0]
    raise CalibrationError(
        f"{path}, {name}.{key}: found {_short(value)}, expected {' or '.join(known)}"
        + (f"; the nearest is {near}." if len(known) > 1 else ".")
    )


def _numbers(camera: Mapping[str, object], key: str, counts: tuple[int, ...], path: Path, name: str) -> list[float]:
    return _number_list(_get(camera, key, path, f"{name}."), counts, path, f"{name}.{key}")


def _number_list(value: object, counts: tuple[int, ...], path: Path, name: str) -> list[float]:
    """The finite numbers of a list that has one of these lengths."""
    values = _sequence(value, path, name)
    if len(values) not in counts:
        raise CalibrationError(
            f"{path}, {name}: found {len(values)} numbers, expected {' or '.join(map(str, counts))}."
        )
    return [_number(x, path, name) for x in values]


def _number(value: object, path: Path, name: str) -> float:
    """A finite number; text too, as YAML 1.1 takes 1e-05 (no point) for text."""
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, str | int | float) else float(value)
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise CalibrationError(f"{path}, {name}: found {_short(value)}, expected finite numbers.")
    return number


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
