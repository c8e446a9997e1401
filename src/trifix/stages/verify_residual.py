"""Hypotheses -> a fix, or a refusal, by the residuals alone: the paper's part P9 as it stands (Khoury 2006, section 1).

A pose is applied to all points of the frame; E holds those with exactly one target nearby (eq. 1-3, 1-4); the error
over E above a threshold rejects the pose. How probable such agreement is by chance is not asked: three points suffice.
"""

import numpy as np
from jaxtyping import Bool, Float

from trifix.geometry.alignment import align_weighted
from trifix.geometry.pose import Pose
from trifix.kernels import matching
from trifix.records import Fix, NoFix, Orientations, Reason, ReferenceMap, Rival, SensorPoints

_RIVALS_TOLD = 12


def verify_residual(
    points: SensorPoints,
    map: ReferenceMap,
    orientations: Orientations,
    counterpart_mm: float,
    max_residual_mm: float,
) -> Fix | NoFix:
    """The pose that brings most points to a target, or why there is none.

    A point has a counterpart where exactly one target lies within ``counterpart_mm``; of two points with the same
    target the nearer keeps it. Each pose is estimated again from its counterparts until they stay the same. Poses whose
    rms error exceeds ``max_residual_mm`` are rejected; when two that put the points elsewhere have equally many
    counterparts, the frame is ambiguous.
    """
    if len(orientations.R) == 0:
        return NoFix(Reason.no_candidate)
    alive = np.flatnonzero(map.alive)
    axis = int(np.argmax(np.ptp(map.xyz_mm[alive], axis=0)))
    rows = alive[np.argsort(map.xyz_mm[alive, axis], kind="stable")]
    targets = map.xyz_mm[rows]
    R, t, count, rms_mm = matching.settle(
        orientations.R, orientations.t_mm, orientations.is_valid, points.xyz_mm, targets, axis, counterpart_mm
    )
    by_merit = np.lexsort((rms_mm, -count, ~((count >= 3) & (rms_mm <= max_residual_mm))))
    best = by_merit[0]
    if count[best] < 3:
        return NoFix(Reason.residual, f"No pose brings three points within {counterpart_mm:.2f} mm of one target each.")
    matched = np.empty(len(points), dtype=np.int64)
    matching.counterparts(R[best], t[best], points.xyz_mm, targets, axis, counterpart_mm, matched)
    point = np.flatnonzero(matched >= 0)
    target = rows[matched[point]]
    start = Pose(R[best], t[best])
    try:
        T, cov = align_weighted(
            points.xyz_mm[point], map.xyz_mm[target], points.cov_mm2[point], map.cov_mm2[target], initial=start
        )
    except np.linalg.LinAlgError:
        return NoFix(Reason.weak_geometry, "The points with a counterpart lie on one line.", matched=len(point))
    residual_mm = np.linalg.norm(map.xyz_mm[target] - T.apply(points.xyz_mm[point]), axis=1)
    total_mm = float(np.sqrt(np.mean(residual_mm**2)))
    if total_mm > max_residual_mm:
        detail = f"{len(point)} points agree with the map to {total_mm:.2f} mm, more than {max_residual_mm:.2f} mm."
        return NoFix(Reason.residual, detail, matched=len(point), residual_mm=total_mm)
    equals = by_merit[(count[by_merit] == count[best]) & (rms_mm[by_merit] <= max_residual_mm)]
    different = _different(R[equals], t[equals], points.xyz_mm[point], counterpart_mm)
    if different.sum() > 1:
        rivals = equals[different][:_RIVALS_TOLD]
        return NoFix(
            Reason.ambiguous,
            f"{different.sum()} poses explain {count[best]} points each.",
            matched=len(point),
            residual_mm=total_mm,
            rivals=tuple(Rival(Pose(R[h], t[h]), float("nan"), int(count[h])) for h in rivals),
        )
    return Fix(T, cov, point, target, residual_mm, p_chance=float("nan"))


def _different(
    R: Float[np.ndarray, "h 3 3"], t: Float[np.ndarray, "h 3"], xyz_mm: Float[np.ndarray, "n 3"], apart_mm: float
) -> Bool[np.ndarray, "h"]:
    """Marks the poses that put some point farther than ``apart_mm`` from where each pose marked before puts it."""
    placed = xyz_mm @ np.swapaxes(R, 1, 2) + t[:, None]
    is_different = np.zeros(len(R), dtype=np.bool_)
    is_left = np.ones(len(R), dtype=np.bool_)
    while is_left.any():
        first = int(np.argmax(is_left))
        is_different[first] = True
        is_left &= np.linalg.norm(placed - placed[first], axis=2).max(axis=1) > apart_mm
    return is_different
