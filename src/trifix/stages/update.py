"""Reference map x fix -> reference map (the paper's parts P6 and P10).

Known targets are averaged with the new sighting by covariance (a Kalman filter a target), new points enter, and what
was seen once and never again although it should have been, goes. Knows no image.
"""

from dataclasses import dataclass
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.errors import ConfigError
from trifix.geometry.alignment import point_jacobian
from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.records import Fix, ReferenceMap, SensorPoints, StereoMatches, TargetState


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
    return _with_points(ReferenceMap.empty(), points, rows, Pose.identity(), None, frame_index, next_id)


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
    map = map.copy()
    T = fix.T_world_sensor
    p, q = fix.point, fix.target
    cov_world = world_covariance(points.xyz_mm[p], points.cov_mm2[p], T, fix.cov)

    sighting = T.apply(points.xyz_mm[p])
    match options.method:
        case "kalman":
            map.xyz_mm[q], map.cov_mm2[q] = _filtered(map.xyz_mm[q], map.cov_mm2[q], sighting, cov_world)
        case "mean":
            n = np.maximum(map.sightings[q], 1)  # a position that was given counts as one sighting
            map.xyz_mm[q], map.cov_mm2[q] = _averaged(n, map.xyz_mm[q], map.cov_mm2[q], sighting, cov_world)
        case _:
            assert_never(options.method)
    towards = _unit(T.t_mm - map.xyz_mm[q])
    seen = map.sightings[q, None]
    map.view[q] = _unit(np.where(np.isfinite(map.view[q]), map.view[q] * np.maximum(seen, 1), 0.0) + towards)
    map.sightings[q] += 1
    map.last_seen[q] = frame_index
    is_proven = (map.state[q] == TargetState.provisional) & (map.sightings[q] >= options.trusted_after)
    map.state[q[is_proven]] = TargetState.trusted

    missed = expected(map, points, T, rig)
    missed[q] = False
    map.misses[missed] += 1
    if options.max_misses:
        is_ghost = (map.state == TargetState.provisional) & (map.misses > options.max_misses * map.sightings)
        map.state[is_ghost] = TargetState.removed

    new = _new_points(map, points, matches, fix, options)
    return _with_points(map, points, new, T, fix.cov, frame_index, next_id)


def _filtered(
    xyz_mm: Float[np.ndarray, "c 3"],
    cov_mm2: Float[np.ndarray, "c 3 3"],
    sighting_mm: Float[np.ndarray, "c 3"],
    sighting_cov_mm2: Float[np.ndarray, "c 3 3"],
) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "c 3 3"]]:
    """Positions and covariances after one Kalman update each: K = C (C + C_seen)⁻¹."""
    K = np.swapaxes(np.linalg.solve(cov_mm2 + sighting_cov_mm2, cov_mm2), 1, 2)
    cov = cov_mm2 - K @ cov_mm2
    return xyz_mm + (K @ (sighting_mm - xyz_mm)[:, :, None])[:, :, 0], 0.5 * (cov + np.swapaxes(cov, 1, 2))


def _averaged(
    n: Int[np.ndarray, "c"],
    xyz_mm: Float[np.ndarray, "c 3"],
    cov_mm2: Float[np.ndarray, "c 3 3"],
    sighting_mm: Float[np.ndarray, "c 3"],
    sighting_cov_mm2: Float[np.ndarray, "c 3 3"],
) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "c 3 3"]]:
    """Means of n sightings and one more, and the covariances of such means: (n² C + C_seen) / (n + 1)²."""
    after = n[:, None] + 1.0
    cov = (n[:, None, None] ** 2 * cov_mm2 + sighting_cov_mm2) / after[:, :, None] ** 2
    return xyz_mm + (sighting_mm - xyz_mm) / after, cov


def world_covariance(
    xyz_mm: Float[np.ndarray, "n 3"], cov_mm2: Float[np.ndarray, "n 3 3"], T: Pose, cov: Float[np.ndarray, "6 6"] | None
) -> Float[np.ndarray, "n 3 3"]:
    """Covariance in world coordinates of points seen from an uncertain pose: R (C + J P Jᵀ) Rᵀ with J = [I, −[p]×]."""
    total = cov_mm2
    if cov is not None:
        J = point_jacobian(xyz_mm)
        total = cov_mm2 + J @ cov @ np.swapaxes(J, 1, 2)
    return np.asarray(T.R @ total @ T.R.T)


def expected(
    map: ReferenceMap,
    points: SensorPoints,
    T_world_sensor: Pose,
    rig: StereoRig | None,
) -> Bool[np.ndarray, "k"]:
    """Which living targets the frame should have seen: facing the sensor, in the image of both cameras.

    Without a rig, the box of slopes and depths that the frame's points fill stands for the field of view.
    """
    xyz = T_world_sensor.inverse().apply(map.xyz_mm)
    facing = np.einsum("ni,ni->n", map.view, _unit(T_world_sensor.t_mm - map.xyz_mm))
    out = map.alive & ~(facing < 0.5)
    if rig is not None:
        out &= rig.left.sees(xyz, margin_px=10) & rig.right.sees(rig.T_right_left.apply(xyz), margin_px=10)
    depth = points.xyz_mm[:, 2]
    out &= (xyz[:, 2] >= depth.min(initial=np.inf)) & (xyz[:, 2] <= depth.max(initial=-np.inf))
    if rig is None and len(points):
        slope, seen = xyz[:, :2] / xyz[:, 2:], points.xyz_mm[:, :2] / points.xyz_mm[:, 2:]
        out &= ((slope >= seen.min(axis=0)) & (slope <= seen.max(axis=0))).all(axis=1)
    return np.asarray(out)


def _new_points(
    map: ReferenceMap,
    points: SensorPoints,
    matches: StereoMatches | None,
    fix: Fix,
    options: UpdateOptions,
) -> Int[np.ndarray, "a"]:
    """Points that are no known target and share no dot with one that is."""
    from scipy.spatial import cKDTree

    is_free = np.ones(len(points), dtype=np.bool_)
    is_free[fix.point] = False
    if matches is not None:
        left, right = matches.left[points.match], matches.right[points.match]
        is_free &= ~np.isin(left, left[fix.point]) & ~np.isin(right, right[fix.point])
    new = distinct(points, np.flatnonzero(is_free))
    alive = np.flatnonzero(map.alive)
    if len(new) == 0 or len(alive) == 0:
        return new
    world = fix.T_world_sensor.apply(points.xyz_mm[new])
    C = world_covariance(points.xyz_mm[new], points.cov_mm2[new], fix.T_world_sensor, fix.cov)
    _, nearest = cKDTree(map.xyz_mm[alive]).query(world, k=min(4, len(alive)))
    nearest = alive[np.asarray(nearest).reshape(len(new), -1)]
    r = map.xyz_mm[nearest] - world[:, None]
    d2 = np.einsum("nki,nki->nk", r, np.linalg.solve(C[:, None] + map.cov_mm2[nearest], r[..., None])[..., 0])
    return np.asarray(new[(d2 > options.new_target_sigmas**2).all(axis=1)])


def distinct(points: SensorPoints, rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "d"]:
    """Those of some points that are not the same measurement as an earlier one."""
    _, first = np.unique(points.xyz_mm[rows].round(6), axis=0, return_index=True)
    return rows[np.sort(first)]


def _with_points(
    map: ReferenceMap,
    points: SensorPoints,
    new: Int[np.ndarray, "a"],
    T: Pose,
    cov: Float[np.ndarray, "6 6"] | None,
    frame_index: int,
    next_id: int,
) -> tuple[ReferenceMap, Int[np.ndarray, "a"]]:
    """The map with some points as new provisional targets, in the rows of removed ones first."""
    vacant = np.flatnonzero(map.state == TargetState.removed)[: len(new)]
    rows = np.concatenate([vacant, np.arange(len(map), len(map) + len(new) - len(vacant))])
    extra = len(new) - len(vacant)
    map = ReferenceMap(
        *(
            np.concatenate([a, np.zeros((extra, *a.shape[1:]), dtype=a.dtype)]) if extra else a
            for a in (
                map.id,
                map.xyz_mm,
                map.cov_mm2,
                map.view,
                map.sightings,
                map.last_seen,
                map.misses,
                map.state,
            )
        )
    )
    map.id[rows] = np.arange(next_id, next_id + len(new))
    map.xyz_mm[rows] = T.apply(points.xyz_mm[new])
    map.cov_mm2[rows] = world_covariance(points.xyz_mm[new], points.cov_mm2[new], T, cov)
    map.view[rows] = _unit(T.t_mm - map.xyz_mm[rows])
    map.sightings[rows] = 1
    map.last_seen[rows] = frame_index
    map.misses[rows] = 0
    map.state[rows] = TargetState.provisional
    return map, rows


def _unit(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12))
