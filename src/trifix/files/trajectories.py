"""Trajectories: TUM files (seconds and metres) and poses.csv. Knows how poses are written, and not whose they are."""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import RecordingError
from trifix.files.tables import (
    LINE,
    Table,
    fixed,
    from_upper_triangle,
    read_bare_table,
    read_table,
    significant,
    upper_triangle,
)
from trifix.geometry.pose import Pose

_NS_PER_S = 1_000_000_000
_MM_PER_M = 1000.0
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length: three printed digits
_QUATERNION = ("qx", "qy", "qz", "qw")
_XYZ = ("x_mm", "y_mm", "z_mm")
_COVARIANCE = tuple(f"c{row}{column}" for row in range(6) for column in range(row, 6))

POSES_HEADER = ",".join(["frame", "timestamp_ns", *_XYZ, *_QUATERNION, *_COVARIANCE])
"""Header of poses.csv."""


def read_tum(path: Path) -> tuple[Int[np.ndarray, "n"], list[Pose]]:
    """Time stamps (ns, exact to the last digit) and poses (mm) of a TUM trajectory.

    Raises:
        RecordingError: the file is missing or a line does not hold eight numbers, the last four a unit quaternion.
    """
    position = ("tx", "ty", "tz")
    columns = {"timestamp": str} | dict.fromkeys((*position, *_QUATERNION), float)
    table = read_bare_table(path, columns, delimiter=" ")
    stamps = []
    for text, line in zip(table["timestamp"], table[LINE], strict=True):
        try:
            stamps.append(np.int64(round(Decimal(text) * _NS_PER_S)))
        except (InvalidOperation, ValueError, OverflowError):
            raise RecordingError(f"{path}, line {line}: found the time '{text}', expected seconds.") from None
    t_mm = np.stack([table[name] for name in position], axis=1) * _MM_PER_M
    return np.array(stamps, dtype=np.int64), _poses(path, table, t_mm)


def tum_row(timestamp_ns: int, pose: Pose) -> str:
    """A line of a TUM trajectory: seconds, metres to the nanometre, quaternion with w ≥ 0; without line end."""
    sign, ns = "-" if timestamp_ns < 0 else "", abs(int(timestamp_ns))
    seconds = f"{sign}{ns // _NS_PER_S}.{ns % _NS_PER_S:09d}"
    metres = [fixed(t / _MM_PER_M, 9) for t in pose.t_mm]
    return " ".join([seconds, *metres, *(fixed(q, 12) for q in pose.quaternion_xyzw)])


def read_poses(
    path: Path,
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], list[Pose], Float[np.ndarray, "n 6 6"]]:
    """Numbers of the frames, time stamps (ns), poses (mm) and covariances (mm, rad) of a poses.csv.

    Raises:
        RecordingError: the file is missing or broken.
    """
    table = read_table(
        path, {"frame": int, "timestamp_ns": int} | dict.fromkeys((*_XYZ, *_QUATERNION, *_COVARIANCE), float)
    )
    poses = _poses(path, table, np.stack([table[name] for name in _XYZ], axis=1))
    cov = from_upper_triangle(np.stack([table[name] for name in _COVARIANCE], axis=1))
    return table["frame"], table["timestamp_ns"], poses, cov


def poses_row(index: int, timestamp_ns: int, pose: Pose, cov: Float[np.ndarray, "6 6"]) -> str:
    """A line of poses.csv, without line end."""
    numbers = [*map(fixed, pose.t_mm), *(fixed(q, 12) for q in pose.quaternion_xyzw)]
    return ",".join([str(index), str(timestamp_ns), *numbers, *map(significant, upper_triangle(cov[None])[0])])


def _poses(path: Path, table: Table, t_mm: Float[np.ndarray, "n 3"]) -> list[Pose]:
    q = np.stack([table[name] for name in _QUATERNION], axis=1)
    length = np.linalg.norm(q, axis=1)
    off = np.abs(length - 1) > _UNIT_TOLERANCE
    if off.any():
        row = int(off.argmax())
        raise RecordingError(
            f"{path}, line {table[LINE][row]}: the quaternion qx, qy, qz, qw has length {length[row]:.4g}, expected 1."
        )
    return [Pose.from_quaternion(q_xyzw, t) for q_xyzw, t in zip(q, t_mm, strict=True)]
