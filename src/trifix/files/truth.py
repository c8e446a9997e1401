"""The truth beside a recording, in millimetres and radians. Knows no result; whoever compares them reads both."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.errors import RecordingError
from trifix.files.tables import LINE, read_table, refuse_where
from trifix.files.trajectories import read_tum
from trifix.geometry.pose import Pose

_MM_PER_M = 1000.0
_SAME_TIME_NS = 1_000  # a time in seconds may have gone through a double


@dataclass(frozen=True, slots=True, eq=False)
class TrueFrames:
    """What is known of each frame, counted on truth alone (formats.md, *Truth*)."""

    index: Int[np.ndarray, "n"]
    """Number of the frame in its recording."""
    timestamp_ns: Int[np.ndarray, "n"]
    """Time of the exposure (ns)."""
    T_map_sensor: tuple[Pose, ...]
    """The pose of each frame."""
    visible_left: Int[np.ndarray, "n"]
    """Targets seen by camera 0."""
    visible_right: Int[np.ndarray, "n"]
    """Targets seen by camera 1."""
    visible_both: Int[np.ndarray, "n"]
    """Targets seen by both cameras."""
    known_both: Int[np.ndarray, "n"]
    """Targets seen by both cameras that were so in at least two earlier frames."""
    positionable: Bool[np.ndarray, "n"]
    """At least three of these are not on one line."""
    reachable_online: Bool[np.ndarray, "n"]
    """Shares three such targets with a map that grows frame by frame from the first usable one."""
    reachable_offline: Bool[np.ndarray, "n"]
    """Belongs to the largest set of frames linked in any order."""
    kidnapped: Bool[np.ndarray, "n"]
    """The sensor leapt since the frame before."""
    blank: Bool[np.ndarray, "n"]
    """Nothing could be seen."""
    sigma_position_mm: Float[np.ndarray, "n"]
    """Expected error of the position given the true map and the dots' noise; NaN where unknown."""
    sigma_rotation_rad: Float[np.ndarray, "n"]
    """Expected error of the rotation; NaN where unknown."""

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, slots=True, eq=False)
class TrueTargets:
    """The targets as they are, in map coordinates."""

    id: Int[np.ndarray, "k"]
    """Identity; a target that moves gets a new one."""
    xyz_mm: Float[np.ndarray, "k 3"]
    """Position (mm)."""
    normal: Float[np.ndarray, "k 3"]
    """Unit normal, away from the surface; NaN where unknown."""
    valid_from: Int[np.ndarray, "k"]
    """First frame in which the target is there."""
    valid_to: Int[np.ndarray, "k"]
    """First frame in which it is there no longer."""
    frames_seen_both: Int[np.ndarray, "k"]
    """Frames in which both cameras saw it."""

    def __len__(self) -> int:
        return len(self.id)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """All that is known of a recording besides what it recorded."""

    path: Path
    """The folder."""
    frames: TrueFrames
    """Every frame."""
    targets: TrueTargets
    """Every target."""
    id_of_dot: Int[np.ndarray, "d"] | None
    """Of each row of dots.csv, the target's id or -1; None if there is no such table."""
    id_of_point: Int[np.ndarray, "p"] | None
    """Of each row of points.csv, the target's id or -1; None if there is no such table."""


def read_truth(path: Path) -> Truth:
    """The truth in a folder.

    Raises:
        RecordingError: a file is missing (the tables of labels may be), broken, or contradicts another.
    """
    if not path.is_dir():
        raise RecordingError(f"{path} is not a folder, expected the truth of a recording.")
    frames, targets = _read_frames(path), _read_targets(path / "map.csv")
    return Truth(
        path,
        frames,
        targets,
        _read_labels(path / "labels_dots.csv", frames, targets),
        _read_labels(path / "labels_points.csv", frames, targets),
    )


def _read_frames(path: Path) -> TrueFrames:
    file, trajectory = path / "frames_truth.csv", path / "trajectory.tum"
    counts = ("n_visible_cam0", "n_visible_cam1", "n_visible_both", "n_known_both")
    flags = ("positionable", "reachable_online", "reachable_offline", "kidnapped", "blank")
    table = read_table(
        file,
        dict.fromkeys(("frame", "timestamp_ns", *counts, *flags), int),
        {"sigma_pos_mm": float, "sigma_rot_deg": float},
    )
    for name in flags:
        refuse_where((table[name] != 0) & (table[name] != 1), file, table, name, "0 or 1")
    stamps, poses = read_tum(trajectory)
    n = len(table["frame"])
    if len(poses) != n:
        raise RecordingError(
            f"{trajectory} has {len(poses)} poses, expected one for each of the {n} frames of {file.name}."
        )
    apart = np.abs(stamps - table["timestamp_ns"]) > _SAME_TIME_NS
    if apart.any():
        row = int(apart.argmax())
        raise RecordingError(
            f"{file}, line {table[LINE][row]}: frame {table['frame'][row]} has time stamp "
            f"{table['timestamp_ns'][row]}, in {trajectory.name} it has {stamps[row]}."
        )
    unknown = np.full(n, np.nan)
    return TrueFrames(
        index=table["frame"],
        timestamp_ns=table["timestamp_ns"],
        T_map_sensor=tuple(poses),
        visible_left=table["n_visible_cam0"],
        visible_right=table["n_visible_cam1"],
        visible_both=table["n_visible_both"],
        known_both=table["n_known_both"],
        positionable=table["positionable"] == 1,
        reachable_online=table["reachable_online"] == 1,
        reachable_offline=table["reachable_offline"] == 1,
        kidnapped=table["kidnapped"] == 1,
        blank=table["blank"] == 1,
        sigma_position_mm=table.get("sigma_pos_mm", unknown),
        sigma_rotation_rad=np.radians(table.get("sigma_rot_deg", unknown)),
    )


def _read_targets(file: Path) -> TrueTargets:
    xyz, normal, frames = ("x", "y", "z"), ("nx", "ny", "nz"), ("valid_from", "valid_to", "frames_seen_both")
    table = read_table(
        file, {"id": int} | dict.fromkeys(xyz, float) | dict.fromkeys(frames, int), dict.fromkeys(normal, float)
    )
    unknown = np.full(len(table["id"]), np.nan)
    return TrueTargets(
        id=table["id"],
        xyz_mm=np.stack([table[name] for name in xyz], axis=1) * _MM_PER_M,
        normal=np.stack([table.get(name, unknown) for name in normal], axis=1),
        valid_from=table["valid_from"],
        valid_to=table["valid_to"],
        frames_seen_both=table["frames_seen_both"],
    )


def _read_labels(file: Path, frames: TrueFrames, targets: TrueTargets) -> Int[np.ndarray, "r"] | None:
    """The id of each row, in the order of the rows; None if there is no such file."""
    if not file.exists():
        return None
    table = read_table(file, {"row": int, "frame": int, "id": int})
    row, line = table["row"], table[LINE]
    order = np.argsort(row, kind="stable")
    wrong = np.flatnonzero(row[order] != np.arange(len(row)))
    if len(wrong):
        at = order[wrong[0]]
        raise RecordingError(
            f"{file}, line {line[at]}: found row {row[at]}, expected each of 0 to {len(row) - 1} once."
        )
    refuse_where(~np.isin(table["frame"], frames.index), file, table, "frame", "a frame of frames_truth.csv")
    refuse_where(~np.isin(table["id"], [*targets.id, -1]), file, table, "id", "-1 or a target of map.csv")
    return np.asarray(table["id"][order])
