"""What became of the frames of a run, as arrays to be drawn, and from where to look at them. Knows no Step, no file."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.records import ReferenceMap, TargetState

_FLAT = 0.1  # targets lie flat if they extend no further than this across their plane, of their extent along it
_UPRIGHT = 0.3  # length of the mean of unit vectors from which on they have a direction in common


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """What became of n frames, in the order of the recording."""

    frame: Int[np.ndarray, "n"]
    """Number of the frame."""
    outcome: Sequence[str]
    """Name of the reason of each refused frame; "positioned" for the others."""
    points: Int[np.ndarray, "n"]
    """Points seen."""
    matched: Int[np.ndarray, "n"]
    """Points identified."""
    residual_mm: Float[np.ndarray, "n"]
    """Rms residual of the identified points (mm); NaN where refused."""
    position_mm: Float[np.ndarray, "n 3"]
    """Where the sensor was, world coordinates (mm); NaN where refused."""
    down: Float[np.ndarray, "n 3"]
    """Where its images' lower edge was, unit vectors in world coordinates; NaN where refused."""
    forward: Float[np.ndarray, "n 3"]
    """Where it looked, unit vectors in world coordinates; NaN where refused."""

    @property
    def is_positioned(self) -> Bool[np.ndarray, "n"]:
        """Which frames have a pose."""
        return np.asarray(np.isfinite(self.position_mm[:, 0]))


def object_axes(course: Course, targets: ReferenceMap) -> Float[np.ndarray, "3 3"]:
    """Unit vectors to the right of the object, down, and away from who stands in front of it, as rows.

    Down is where the sensor held its images' lower edge, on average. Targets that lie flat are seen along their normal,
    others as the first pose looks at them.
    """
    found = np.flatnonzero(course.is_positioned)
    if not len(found):
        return np.eye(3)
    mean_down = course.down[found].mean(axis=0)
    down = mean_down if np.linalg.norm(mean_down) > _UPRIGHT else course.down[found[0]]
    xyz = targets.xyz_mm[targets.state == TargetState.trusted]
    away = course.forward[found[0]]
    if len(xyz) > 3:
        _, extent, along = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)
        if extent[2] < _FLAT * extent[1]:
            is_behind = along[2] @ course.forward[found].mean(axis=0) < 0
            away = -along[2] if is_behind else along[2]
            down = _across(course.down[found[0]] if abs(away @ _unit(down)) > 1 - _FLAT else down, away)
            return np.stack([np.cross(down, away), down, away])
    down = _unit(down)
    away = _across(away if abs(away @ down) < 1 - _FLAT else course.down[found[0]], down)
    return np.stack([np.cross(down, away), down, away])


def _across(v: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The unit vector along the part of ``v`` that is perpendicular to a unit vector."""
    return _unit(v - (v @ axis) * axis)


def _unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return np.asarray(v / np.linalg.norm(v))
