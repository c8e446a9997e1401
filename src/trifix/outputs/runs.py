"""A results folder, read back: the one reader for all who look at a run when it is over. Judges nothing again."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, Int

from trifix.errors import RecordingError
from trifix.files.maps import read_map
from trifix.files.tables import Table, read_table
from trifix.files.trajectories import read_poses
from trifix.geometry.pose import Pose
from trifix.outputs.course import Course
from trifix.outputs.summary import Summary
from trifix.records import PositionedReason, ReferenceMap


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What a results folder holds."""

    path: Path
    """The folder."""
    summary: Summary
    """The run in numbers."""
    course: Course
    """What became of every frame."""
    timestamp_ns: Int[np.ndarray, "n"]
    """When each of them was taken (ns)."""
    reason: tuple[str, ...]
    """Why each was refused, or what is special about its pose; mostly empty."""
    detail: tuple[str, ...]
    """What else is to be said of each; mostly empty."""
    p_chance: Float[np.ndarray, "n"]
    """Bound of the probability that it is chance, NaN where none is told."""
    residual_mm: Float[np.ndarray, "n"]
    """Rms residual of the identified points (mm), of refused frames too; NaN where there is none."""
    poses: Mapping[int, Pose]
    """``T_world_sensor`` of each positioned frame, by its number."""
    cov: Mapping[int, Float[np.ndarray, "6 6"]]
    """Covariance of each pose (mm, rad)."""
    map: ReferenceMap
    """The targets."""
    sightings: Table
    """Which target each identified point or dot was: ``frame``, ``kind``, ``row``, ``target``, residuals."""

    @property
    def world(self) -> int | None:
        """Number of the frame that defines the world; None if the map was given, or nothing was found."""
        name = PositionedReason.defines_world.name
        return int(self.course.frame[self.reason.index(name)]) if name in self.reason else None

    def identified(self) -> tuple[Int[np.ndarray, "_"], ...]:
        """Identities of the targets that each frame showed, each once."""
        frame, target = np.unique(np.stack([self.sightings["frame"], self.sightings["target"]]), axis=1)
        first = np.searchsorted(frame, self.course.frame)
        end = np.searchsorted(frame, self.course.frame, side="right")
        return tuple(target[a:b] for a, b in zip(first.tolist(), end.tolist(), strict=True))


def read_run(path: Path) -> Run:
    """What a results folder holds.

    Raises:
        RecordingError: it is no results folder, or something in it is missing or broken.
    """
    summary = _read_summary(path / "summary.json")
    columns = {"frame": int, "timestamp_ns": int, "status": str, "points": int, "matched": int}
    others = {"reason": str, "detail": str, "residual_mm": float, "p_chance": float}
    table = read_table(path / "frames.csv", columns, others)
    n, nowhere = len(table["frame"]), np.full(3, np.nan)
    no_words, no_numbers = np.full(n, "", dtype=object), np.full(n, np.nan)
    reasons, residual_mm = table.get("reason", no_words), table.get("residual_mm", no_numbers)
    frames, _, poses, covs = read_poses(path / "poses.csv")
    by_frame = dict(zip(frames.tolist(), poses, strict=True))
    of_frame = [by_frame.get(frame) for frame in table["frame"].tolist()]
    outcome = [
        reason if status == "refused" else "positioned" for status, reason in zip(table["status"], reasons, strict=True)
    ]
    course = Course(
        frame=table["frame"],
        outcome=outcome,
        points=table["points"],
        matched=table["matched"],
        residual_mm=np.where([T is None for T in of_frame], np.nan, residual_mm),
        position_mm=np.array([nowhere if T is None else T.t_mm for T in of_frame]).reshape(n, 3),
        down=np.array([nowhere if T is None else T.R[:, 1] for T in of_frame]).reshape(n, 3),
        forward=np.array([nowhere if T is None else T.R[:, 2] for T in of_frame]).reshape(n, 3),
    )
    return Run(
        path=path,
        summary=summary,
        course=course,
        timestamp_ns=table["timestamp_ns"],
        reason=tuple(reasons.tolist()),
        detail=tuple(table.get("detail", no_words).tolist()),
        p_chance=table.get("p_chance", no_numbers),
        residual_mm=residual_mm,
        poses=by_frame,
        cov=dict(zip(frames.tolist(), covs, strict=True)),
        map=read_map(path / "map.csv"),
        sightings=read_table(
            path / "sightings.csv",
            {"frame": int, "kind": str, "row": int, "target": int},
            {"residual_mm": float, "residual_px": float},
        ),
    )


def _read_summary(file: Path) -> Summary:
    folder = file.parent
    if not folder.is_dir():
        raise RecordingError(f"{folder} is not a folder, expected results that `trifix run` wrote.")
    try:
        return msgspec.json.decode(file.read_bytes(), type=Summary)
    except FileNotFoundError:
        raise RecordingError(f"{folder} holds no {file.name}: expected results that `trifix run` wrote.") from None
    except OSError as fault:
        raise RecordingError(f"{file} cannot be read: {fault.strerror}.") from None
    except msgspec.DecodeError as fault:
        raise RecordingError(f"{file} is no summary of a run ({fault}): run the recording again.") from None
