"""Reference map x fix -> reference map (the paper's parts P6 and P10).

Known targets are averaged with the new sighting by covariance, new points enter, and what was seen once and never again
although it should have been, goes. Knows no image.

A target's own covariance is what tells it from its neighbours: identification needs no more, as an error that they have
in common moves the pose alone. What they have in common is known to the joint map, where there is one.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.joint import JointMap
from trifix.kernels import floats, integers
from trifix.kernels.mapping import distinct_points, enter_points, new_points, teach
from trifix.kernels.stereo import expected_targets
from trifix.records import Fix, ReferenceMap, SensorPoints, StereoMatches

_NO_RIG = np.zeros(0)


@dataclass(frozen=True, slots=True)
class UpdateOptions:
    """How the map grows and what it drops."""

    method: Literal["joint", "kalman", "mean"] = "joint"
    """All targets at once, with what their errors have in common (Smith, Self and Cheeseman 1990); each for itself, a
    sighting counting by its covariance, which leaves poses overconfident; or as much as every other one: prefer the
    mean only to see what covariances are worth."""
    joint_targets: int = 100
    """joint: of so many targets, those seen last, all correlations are kept."""
    trusted_after: int = 3
    """Sightings after which a target is trusted."""
    new_target_sigmas: float = 6.0
    """A point enters as a new target only if it is farther than this from every known one (Mahalanobis)."""
    max_misses: int = 8
    """Frames that may miss a provisional target before it is dropped; 0 keeps everything."""

    def __post_init__(self) -> None:
        if self.trusted_after < 1 or self.max_misses < 0 or self.new_target_sigmas < 0:
            raise ConfigError("update.trusted_after must be at least 1, max_misses and new_target_sigmas at least 0.")
        if self.joint_targets < 10:
            raise ConfigError(f"update.joint_targets is {self.joint_targets}, expected at least 10.")


def found_map(
    points: SensorPoints, frame_index: int, next_id: int = 0, joint: JointMap | None = None
) -> tuple[ReferenceMap, Int[np.ndarray, "a"]]:
    """The map of the first frame, whose sensor coordinates become the world's, and the rows of its targets."""
    rows = distinct(points, np.arange(len(points)))
    map = stored(ReferenceMap.empty(), len(rows))
    map, added = _entered(map, 0, points, rows, Pose.identity(), np.zeros((6, 6)), frame_index, next_id)
    if joint is not None:
        joint.adopt(map, added)
    return map, added


def update(
    map: ReferenceMap,
    points: SensorPoints,
    matches: StereoMatches | None,
    fix: Fix,
    frame_index: int,
    rig: StereoRig | None,
    next_id: int,
    options: UpdateOptions = UpdateOptions(),
    joint: JointMap | None = None,
) -> tuple[ReferenceMap, Int[np.ndarray, "a"]]:
    """The map after a fix, and the rows of the targets that entered it; the given map is left as it was.

    The joint map, where there is one, learns as well, and says where the targets are.
    """
    k = len(map)
    map = stored(map, len(points))
    known = None if joint is None else joint.learn(_first(map, k), points, fix)
    T = fix.T_world_sensor if known is None else known.T_world_sensor
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
        joint is not None,
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
    map, added = _entered(map, k, points, new, T, fix.cov, frame_index, next_id)
    if joint is not None and known is not None:
        joint.enter(map, points, new, added, known)
    return map, added


def distinct(points: SensorPoints, rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "d"]:
    """Those of some points that could be targets: not the same measurement as an earlier one, and not too vague."""
    return np.asarray(distinct_points(floats(points.xyz_mm), floats(points.cov_mm2), integers(rows)))


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
    return _first(map, k), rows


def _first(map: ReferenceMap, k: int) -> ReferenceMap:
    """The first k rows, in the same storage."""
    columns = (map.id, map.xyz_mm, map.cov_mm2, map.view, map.sightings, map.last_seen, map.misses, map.state)
    return ReferenceMap(*(column[:k] for column in columns))
