"""Reference map x fix -> reference map (the paper's parts P6 and P10).

Known targets are averaged with the new sighting by covariance (a Kalman filter a target), new points enter, and what
was seen once and never again although it should have been, goes. Knows no image.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.kernels import floats, integers
from trifix.kernels.mapping import distinct_points, enter_points, new_points, teach
from trifix.kernels.stereo import expected_targets
from trifix.records import Fix, ReferenceMap, SensorPoints, StereoMatches

_NO_RIG = np.zeros(0)


@dataclass(frozen=True, slots=True)
class UpdateOptions:
    """How the map grows and what it drops."""

    method: Literal["kalman", "mean"] = "kalman"
    """A sighting counts by its covariance (Smith, Self and Cheeseman 1990), or as much as every other one; prefer the
    mean only to see what the covariances are worth."""
    trusted_after: int = 3
    """Sightings after which a target is trusted."""
    new_target_sigmas: float = 6.0
    """A point enters as a new target only if it is farther than this from every known one (Mahalanobis)."""
    max_misses: int = 8
    """Frames that may miss a provisional target before it is dropped; 0 keeps everything."""

    def __post_init__(self) -> None:
        if self.trusted_after < 1 or self.max_misses < 0 or self.new_target_sigmas < 0:
            raise ConfigError("update.trusted_after must be at least 1, max_misses and new_target_sigmas at least 0.")


def found_map(points: SensorPoints, frame_index: int, next_id: int = 0) -> tuple[ReferenceMap, Int[np.ndarray, "a"]]:
    """The map of the first frame, whose sensor coordinates become the world's, and the rows of its targets."""
    rows = distinct(points, np.arange(len(points)))
    map = stored(ReferenceMap.empty(), len(rows))
    return _entered(map, 0, points, rows, Pose.identity(), np.zeros((6, 6)), frame_index, next_id)


def update(
    map: ReferenceMap,
    points: SensorPoints,
    matches: StereoMatches | None,
    fix: Fix,
    frame_index: int,
    rig: StereoRig | None,
    next_id: int,
    options: UpdateOptions = UpdateOptions(),
) -> tuple[ReferenceMap, Int[np.ndarray, "a"]]:
    """The map after a fix, and the rows of the targets that entered it; the given map is left as it was."""
    k, T = len(map), fix.T_world_sensor
    map = stored(map, len(points))
    xyz, cov = floats(points.xyz_mm), floats(points.cov_mm2)
    pose = floats(T.R), floats(T.t_mm), floats(fix.cov)
    point, target = integers(fix.point), integers(fix.target)
    is_expected = expected_targets(
        map.xyz_mm[:k],
        map.view[:k],
        map.state[:k],
        *pose[:2],
        xyz,
        _NO_RIG if rig is None else rig.parameters,
        10.0,
    )
    teach(
        map.xyz_mm,
        map.cov_mm2,
        map.view,
        map.sightings,
        map.last_seen,
        map.misses,
        map.state,
        is_expected,
        xyz,
        cov,
        point,
        target,
        *pose,
        frame_index,
        options.method == "mean",
        options.trusted_after,
        options.max_misses,
    )
    none = np.zeros(0, dtype=np.int64)
    dots = (none, none) if matches is None else (integers(matches.left), integers(matches.right))
    new = new_points(
        map.xyz_mm,
        map.cov_mm2,
        map.state,
        k,
        xyz,
        cov,
        point,
        integers(points.match),
        *dots,
        *pose,
        float(options.new_target_sigmas),
    )
    return _entered(map, k, points, new, T, fix.cov, frame_index, next_id)


def distinct(points: SensorPoints, rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "d"]:
    """Those of some points that are not the same measurement as an earlier one."""
    return np.asarray(distinct_points(floats(points.xyz_mm), integers(rows)))


def stored(map: ReferenceMap, extra: int = 0) -> ReferenceMap:
    """The same targets in storage of their own, as compiled loops take it, with rows to spare."""

    def copied(array: np.ndarray, dtype: type) -> np.ndarray:
        out = np.empty((len(array) + extra, *array.shape[1:]), dtype=dtype)
        out[: len(array)] = array
        return out

    return ReferenceMap(
        copied(map.id, np.int64),
        copied(map.xyz_mm, np.float64),
        copied(map.cov_mm2, np.float64),
        copied(map.view, np.float64),
        copied(map.sightings, np.int64),
        copied(map.last_seen, np.int64),
        copied(map.misses, np.int64),
        copied(map.state, np.int64),
    )


def _entered(
    map: ReferenceMap,
    k: int,
    points: SensorPoints,
    new: Int[np.ndarray, "a"],
    T: Pose,
    cov: Float[np.ndarray, "6 6"],
    frame_index: int,
    next_id: int,
) -> tuple[ReferenceMap, Int[np.ndarray, "a"]]:
    """The map of the first k rows with some points as new provisional targets, and their rows."""
    columns = (map.id, map.xyz_mm, map.cov_mm2, map.view, map.sightings, map.last_seen, map.misses, map.state)
    rows = enter_points(
        *columns,
        k,
        floats(points.xyz_mm),
        floats(points.cov_mm2),
        new,
        floats(T.R),
        floats(T.t_mm),
        floats(cov),
        frame_index,
        next_id,
    )
    k = max(k, int(rows.max(initial=-1)) + 1)
    return ReferenceMap(*(column[:k] for column in columns)), rows
