"""Hypotheses -> a fix, or a refusal with its reason (the paper's part P9, put on a probability).

A pose is accepted when the agreement of the *whole* frame with the map cannot be chance, and when no second pose
explains the frame about as well: never because three residuals are small. The evidence is a likelihood ratio whose
mean is at most one for a wrong pose, so that by Markov's inequality its inverse, times the number of false hypotheses
to be reckoned with, bounds the probability of accepting a wrong one. The three points that made the hypothesis count in
that number alone: a triangle that chance would seldom match needs less confirmation. The last motion is evidence too.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.geometry.alignment import align_weighted, point_jacobian
from trifix.geometry.pose import Pose
from trifix.kernels import positioning as kernels
from trifix.records import (
    Fix,
    Identification,
    NoFix,
    Orientations,
    Prediction,
    Reason,
    ReferenceMap,
    Rival,
    SensorPoints,
    StereoMatches,
)


@dataclass(frozen=True, slots=True)
class VerifyOptions:
    """When a pose is believed."""

    method: Literal["probability", "residual"] = "probability"
    """By the probability that the agreement is chance, or by the residuals alone (Khoury 2006); the latter needs all
    hypotheses at once: let identify.portion be large."""
    counterpart_mm: float = 3.0
    """residual: a point has found its target if it is the only one within this distance (mm)."""
    max_residual_mm: float = 1.0
    """residual: largest rms distance of the points from their targets (mm)."""
    max_p_chance: float = 1e-9
    """Largest bound on the probability that the agreement is chance."""
    min_rival_odds: float = 1e6
    """A second pose less than this many times less likely makes the frame ambiguous."""
    max_rival_share: float = 0.6
    """So does one that explains at least this share of the points that the best one explains."""
    gate_sigmas: float = 4.0
    """A point has found its target within this many standard deviations (Mahalanobis)."""
    max_sigma_mm: float = 1.0
    """Largest standard deviation of the identified points as the pose places them, rms over them (mm)."""
    max_sigma_deg: float = 0.17
    """Largest standard deviation of the rotation about any axis (degrees)."""
    max_solutions: int = 12
    """Different solutions to work out in full, best first."""

    def __post_init__(self) -> None:
        if not 0 < self.max_p_chance < 1:
            raise ConfigError(f"verify.max_p_chance is {self.max_p_chance}, expected a probability between 0 and 1.")
        if self.min_rival_odds < 1:
            raise ConfigError(f"verify.min_rival_odds is {self.min_rival_odds}, expected at least 1.")
        if min(self.counterpart_mm, self.max_residual_mm) <= 0:
            raise ConfigError("verify.counterpart_mm and verify.max_residual_mm must be positive.")
        if min(self.gate_sigmas, self.max_sigma_mm, self.max_sigma_deg, self.max_solutions) <= 0:
            raise ConfigError("verify.gate_sigmas, max_sigma_mm, max_sigma_deg and max_solutions must be positive.")


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A hypothesis worked out over all points of the frame."""

    T_world_sensor: Pose
    """The pose, from all its pairs."""
    cov: Float[np.ndarray, "6 6"]
    """Its covariance, as in ``Fix``."""
    point: Int[np.ndarray, "c"]
    """Rows of the points that found a target."""
    target: Int[np.ndarray, "c"]
    """Rows of those targets."""
    log_ratio: float
    """ln of the likelihood ratio against chance."""


_QUICK_NEIGHBOURS = 12  # of each of the three points, for the first look
_CARRIED_OFF = 1e-3  # ε: probability that the sensor is not where its motion leads
_SURROUNDING = 5  # neighbours of a target that tell how targets lie around it


def verify(
    points: SensorPoints,
    map: ReferenceMap,
    identification: Identification,
    orientations: Orientations,
    matches: StereoMatches | None = None,
    tried: float = 0.0,
    prediction: Prediction | None = None,
    options: VerifyOptions = VerifyOptions(),
) -> Fix | NoFix:
    """The one pose that the frame proves, or why there is none.

    ``tried`` counts the hypotheses that this frame has cost so far, these included (their number, unless told).

    Every hypothesis gets a first look over the neighbours of its three points; the best are worked out over all points
    until ``max_solutions`` different ones are known. Of two points that share a dot, one at most is matched.
    """
    if len(identification) == 0:
        return NoFix(Reason.no_candidate)
    spread, spacing_mm = surroundings(map)
    solutions = solve(points, map, identification, orientations, matches, spread, options)
    if prediction is not None:
        area_mm2 = float((spacing_mm**2).sum())
        gain = [motion_log_ratio(s.T_world_sensor, prediction, area_mm2) for s in solutions]
        solutions = [replace(s, log_ratio=s.log_ratio + g) for s, g in zip(solutions, gain, strict=True)]
        solutions.sort(key=lambda s: -s.log_ratio)
    if not solutions:
        return NoFix(Reason.no_candidate, "Every hypothesis looks at targets from behind or has its points on a line.")
    return judge(solutions, points, map, spacing_mm, tried + false_hypotheses(identification, solutions[0]), options)


def solve(
    points: SensorPoints,
    map: ReferenceMap,
    identification: Identification,
    orientations: Orientations,
    matches: StereoMatches | None,
    spread: Float[np.ndarray, "k 3 3"],
    options: VerifyOptions,
) -> list[Solution]:
    """The different solutions that the hypotheses lead to, best first."""
    n = len(points)
    left, right = _dots_of(points, matches)
    alive = np.flatnonzero(map.alive)
    sigma2 = np.trace(points.cov_mm2, axis1=1, axis2=2)
    target_sigma2 = np.trace(map.cov_mm2[alive], axis1=1, axis2=2)
    cell_mm = max(2.0 * options.gate_sigmas * float(np.sqrt(np.median(sigma2) + np.median(target_sigma2))), 1e-3)
    grid = kernels.build_grid(map.xyz_mm, alive, cell_mm)
    scene = (map.xyz_mm, map.cov_mm2, map.view, spread)
    neighbours = kernels.nearest(points.xyz_mm, min(_QUICK_NEIGHBOURS, n - 1))
    score = kernels.score_hypotheses(
        orientations.R,
        orientations.t_mm,
        orientations.cov,
        orientations.is_valid,
        identification.point,
        identification.target,
        neighbours,
        points.xyz_mm,
        points.cov_mm2,
        left,
        right,
        *scene,
        *grid,
        cell_mm,
        options.gate_sigmas,
    )
    solutions: list[Solution] = []
    for h in np.argsort(-score, kind="stable"):
        if not np.isfinite(score[h]) or len(solutions) == options.max_solutions:
            break
        seed_point, seed_target = identification.point[h], identification.target[h]
        if any(_is_part_of(seed_point, seed_target, s) for s in solutions):
            continue
        R, t, P = orientations.R[h].copy(), orientations.t_mm[h].copy(), orientations.cov[h].copy()
        centre = points.xyz_mm[seed_point].mean(axis=0)
        sequence = np.argsort(((points.xyz_mm - centre) ** 2).sum(axis=1), kind="stable")
        sequence = sequence[~np.isin(sequence, seed_point)]
        matched = np.full(n, -1)
        matched[seed_point] = seed_target
        used_left, used_right = _marks(left, left[seed_point]), _marks(right, right[seed_point])
        used_target = _marks(np.arange(len(map)), seed_target)
        log_ratio = np.zeros(len(kernels.CLUTTER_SHARES))
        for _ in range(2):  # the second time, those that were too vague or had two counterparts
            kernels.grow(
                R,
                t,
                P,
                sequence,
                points.xyz_mm,
                points.cov_mm2,
                left,
                right,
                used_left,
                used_right,
                *scene,
                used_target,
                *grid,
                cell_mm,
                options.gate_sigmas,
                matched,
                log_ratio,
            )
            sequence = sequence[matched[sequence] == -2]
        point = np.flatnonzero(matched >= 0)
        solution = _refined(Pose(R, t), point, matched[point], points, map, kernels.log_mean(log_ratio), options)
        if solution is not None:
            solutions.append(solution)
    return sorted(solutions, key=lambda s: -s.log_ratio)


def judge(
    solutions: list[Solution],
    points: SensorPoints,
    map: ReferenceMap,
    spacing_mm: Float[np.ndarray, "k"],
    tried: float,
    options: VerifyOptions,
) -> Fix | NoFix:
    """Accepts the best solution if it is proven, without rival and firmly held."""
    best = solutions[0]
    p_chance = float(np.clip(np.exp(np.log(max(tried, 1e-300)) - best.log_ratio), 1e-300, 1.0))
    residual = map.xyz_mm[best.target] - best.T_world_sensor.apply(points.xyz_mm[best.point])
    residual_mm = np.linalg.norm(residual, axis=1)
    rms_mm = float(np.sqrt(np.mean(residual_mm**2)))

    def refuse(why: Reason, detail: str, rivals: tuple[Rival, ...] = ()) -> NoFix:
        return NoFix(why, detail, p_chance, len(best.point), rms_mm, rivals)

    if p_chance > options.max_p_chance:
        return refuse(
            Reason.not_proven,
            f"{len(best.point)} of {len(points)} points agree with the map to {rms_mm:.2f} mm; "
            f"by chance so in up to {p_chance:.1e} of such frames.",
        )
    rivals = [s for s in solutions if s is best or _is_rival(best, s, points, spacing_mm, options)]
    if len(rivals) > 1:
        return refuse(
            Reason.ambiguous,
            f"{len(rivals)} poses explain {', '.join(str(len(s.point)) for s in rivals[:4])} points.",
            tuple(Rival(s.T_world_sensor, s.log_ratio, len(s.point)) for s in rivals),
        )
    fix = Fix(
        T_world_sensor=best.T_world_sensor,
        cov=best.cov,
        point=best.point,
        target=best.target,
        residual_mm=residual_mm,
        p_chance=p_chance,
    )
    sigma_mm, sigma_deg = pose_sigma(best.cov, points.xyz_mm[best.point])
    if sigma_mm > options.max_sigma_mm or sigma_deg > options.max_sigma_deg:
        detail = f"The pose is known to {sigma_mm:.2f} mm and {sigma_deg:.3f} degrees only."
        return replace(refuse(Reason.weak_geometry, detail), weak=fix)
    return fix


def false_hypotheses(identification: Identification, best: Solution) -> float:
    """How many false hypotheses must be reckoned with: each is one more chance for chance.

    Those that do not belong to the best solution are false if it is right, and tell how many there are if it is wrong.
    Where they are few, what the technique expects of chance stands in for them, if that is less than all.
    """
    target_of = np.full(int(identification.point.max()) + 1, -1)
    known = best.point[best.point < len(target_of)]
    target_of[known] = best.target[: len(known)]
    others = int((target_of[identification.point] != identification.target).any(axis=1).sum())
    return min(max(others, identification.expected_by_chance), len(identification))


def motion_log_ratio(T_world_sensor: Pose, prediction: Prediction, area_mm2: float) -> float:
    """ln of the likelihood of a pose if the sensor moved on as predicted, against any pose that the map admits.

    A wrong pose lays the frame's points on the surface of the targets somewhere else: anywhere on its area, turned by
    any angle. Only these three degrees of freedom count. A sensor can be carried off unseen: with probability ε it may
    be anywhere, so that the prediction can hold against a pose by that much and no more.
    """
    delta = (prediction.T_world_sensor.inverse() @ T_world_sensor).log()
    sigma = np.sqrt(np.diag(prediction.cov))
    d2 = float(delta @ np.linalg.solve(prediction.cov, delta))
    peak = 2 * np.pi * area_mm2 / ((2 * np.pi) ** 1.5 * sigma[0] * sigma[1] * sigma[5])
    if peak <= 1:
        return 0.0  # the prediction says less than the map
    return float(np.log((1 - _CARRIED_OFF) * peak * np.exp(-0.5 * d2) + _CARRIED_OFF))


def pose_sigma(cov: Float[np.ndarray, "6 6"], xyz_mm: Float[np.ndarray, "c 3"]) -> tuple[float, float]:
    """Standard deviation of a pose at some points (mm, rms) and about its worst axis (degrees)."""
    J = point_jacobian(xyz_mm)
    variance = np.einsum("nij,jk,nik->n", J, cov, J)
    return float(np.sqrt(variance.mean())), float(np.degrees(np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1])))


def surroundings(
    map: ReferenceMap,
) -> tuple[Float[np.ndarray, "k 3 3"], Float[np.ndarray, "k"]]:
    """Around each living target: the mean square offsets of its five nearest (mm²), and the spacing (mm)."""
    from scipy.spatial import cKDTree

    alive = np.flatnonzero(map.alive)
    spread, spacing_mm = np.zeros((len(map), 3, 3)), np.zeros(len(map))
    k = min(_SURROUNDING, len(alive) - 1)
    if k >= 1:
        xyz = map.xyz_mm[alive]
        distance, nearest = cKDTree(xyz).query(xyz, k=k + 1)
        offset = xyz[nearest[:, 1:]] - xyz[:, None]
        spread[alive] = np.einsum("nki,nkj->nij", offset, offset) / k
        spacing_mm[alive] = distance[:, -1] * np.sqrt(np.pi / k)
    return spread, spacing_mm


def _refined(
    T: Pose,
    point: Int[np.ndarray, "c"],
    target: Int[np.ndarray, "c"],
    points: SensorPoints,
    map: ReferenceMap,
    log_ratio: float,
    options: VerifyOptions,
) -> Solution | None:
    """The solution with its pose from all pairs that stay within the gate; None if too few do."""
    cov = np.zeros((6, 6))
    for _ in range(2):
        if len(point) < 3:
            return None
        C_point, C_target = points.cov_mm2[point], map.cov_mm2[target]
        try:
            T, cov = align_weighted(points.xyz_mm[point], map.xyz_mm[target], C_point, C_target, initial=T)
        except np.linalg.LinAlgError:
            return None
        r = map.xyz_mm[target] - T.apply(points.xyz_mm[point])
        S = T.R @ C_point @ T.R.T + C_target
        d2 = np.einsum("ni,ni->n", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
        keep = d2 <= options.gate_sigmas**2
        if keep.all():
            break
        point, target = point[keep], target[keep]
    if len(point) < 3:
        return None
    return Solution(T, cov, point, target, log_ratio)


def _is_rival(
    best: Solution,
    other: Solution,
    points: SensorPoints,
    spacing_mm: Float[np.ndarray, "k"],
    options: VerifyOptions,
) -> bool:
    """Whether another solution puts the points elsewhere and yet comes too near the best in explaining them.

    Elsewhere is beyond the noise for one that is nearly as likely, and beyond half the way to the next target for one
    that explains as many points: such is the mark of a pattern that repeats itself.
    """
    p = best.point
    apart = (best.T_world_sensor.inverse() @ other.T_world_sensor).apply(points.xyz_mm[p]) - points.xyz_mm[p]
    d2 = np.einsum("ni,ni->n", apart, np.linalg.solve(points.cov_mm2[p], apart[:, :, None])[:, :, 0])
    is_elsewhere = np.median(d2) > options.gate_sigmas**2
    is_on_others = np.median(np.linalg.norm(apart, axis=1) / spacing_mm[best.target]) > 0.5
    is_near = other.log_ratio > best.log_ratio - np.log(options.min_rival_odds)
    explains_as_many = len(other.point) >= options.max_rival_share * len(best.point)
    return bool((is_elsewhere and is_near) or (is_on_others and explains_as_many))


def _is_part_of(point: Int[np.ndarray, "3"], target: Int[np.ndarray, "3"], solution: Solution) -> bool:
    where = np.searchsorted(solution.point, point)
    where = np.minimum(where, len(solution.point) - 1)
    return bool(np.all((solution.point[where] == point) & (solution.target[where] == target)))


def _dots_of(points: SensorPoints, matches: StereoMatches | None) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """The two dots of each point; -1 where the points were given."""
    if matches is None:
        none = np.full(len(points), -1)
        return none, none.copy()
    return matches.left[points.match].astype(np.int64), matches.right[points.match].astype(np.int64)


def _marks(values: Int[np.ndarray, "n"], marked: Int[np.ndarray, "m"]) -> np.ndarray:
    out = np.zeros(int(values.max(initial=-1)) + 2, dtype=np.bool_)
    out[marked[marked >= 0]] = True
    return out
