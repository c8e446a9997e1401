"""Hypotheses -> a fix, or a refusal with its reason (the paper's part P9, put on a probability).

A pose is accepted when the agreement of the *whole* frame with the map cannot be chance, and when no second pose
explains the frame about as well: never because three residuals are small. The evidence is a likelihood ratio whose
mean is at most one for a wrong pose, so that by Markov's inequality its inverse, times the number of false hypotheses
to be reckoned with, bounds the probability of accepting a wrong one. The three points that made the hypothesis count in
that number, as a triangle that chance would seldom match needs less confirmation, and by how well their sides agree.
The last motion is evidence too, and so are targets that should be seen and are not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.geometry.alignment import point_jacobian
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.index import ANYWHERE_UP_TO, Candidates, MapIndex, frame_triangles
from trifix.kernels import floats
from trifix.kernels import positioning as kernels
from trifix.kernels.stereo import prepare_dots
from trifix.labels import contradict
from trifix.records import (
    Fix,
    Identification,
    NoFix,
    Orientations,
    PositionedReason,
    Prediction,
    Reason,
    ReferenceMap,
    Rival,
    SensorPoints,
    SingleDots,
    StereoDots,
    StereoMatches,
    TargetState,
)

_NO_ROWS = np.zeros(0, np.int64)


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
    label_error: float = 1.0
    """Probability that a label is wrong, by which those that contradict their targets' speak against a rival; 1: labels
    never decide between rivals."""
    max_solutions: int = 12
    """Rivals to work out in full at most."""
    max_rivals: int = 20_000
    """Places to look for rivals at most."""

    def __post_init__(self) -> None:
        if not 0 < self.max_p_chance < 1:
            raise ConfigError(f"verify.max_p_chance is {self.max_p_chance}, expected a probability between 0 and 1.")
        if self.min_rival_odds < 1:
            raise ConfigError(f"verify.min_rival_odds is {self.min_rival_odds}, expected at least 1.")
        if min(self.counterpart_mm, self.max_residual_mm) <= 0:
            raise ConfigError("verify.counterpart_mm and verify.max_residual_mm must be positive.")
        if not 0 < self.label_error <= 1:
            raise ConfigError(f"verify.label_error is {self.label_error}, expected a probability above 0.")
        if min(self.gate_sigmas, self.max_sigma_mm, self.max_sigma_deg, self.max_solutions) <= 0:
            raise ConfigError("verify.gate_sigmas, max_sigma_mm, max_sigma_deg and max_solutions must be positive.")


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a frame shows of the map, as it is weighed: its points, and its dots where it has some."""

    points: SensorPoints
    """The points."""
    left: Int[np.ndarray, "n"]
    """Row of the left dot of each point; -1 where points were given."""
    right: Int[np.ndarray, "n"]
    """Row of the right dot."""
    dots: StereoDots | None = None
    """The dots, of which one camera alone may have seen some."""
    rig: StereoRig | None = None
    """The stereo geometry that saw them."""
    noise_scale: float = 1.0
    """Factor on the dots' standard deviations."""
    is_whole: bool = True
    """Whether all targets in view should be among the points, as in a frame; a part of another map shows but some."""

    @staticmethod
    def of(
        points: SensorPoints,
        matches: StereoMatches | None = None,
        dots: StereoDots | None = None,
        rig: StereoRig | None = None,
        noise_scale: float = 1.0,
        is_whole: bool = True,
    ) -> "Evidence":
        """The evidence of points, and of the pairs of dots that they were triangulated from."""
        if matches is None:
            none = np.full(len(points), -1)
            return Evidence(points, none, none, is_whole=is_whole)
        left, right = matches.left[points.match].astype(np.int64), matches.right[points.match].astype(np.int64)
        return Evidence(points, left, right, dots, rig, noise_scale)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A hypothesis worked out over all evidence."""

    T_world_sensor: Pose
    """The pose, from all its pairs."""
    cov: Float[np.ndarray, "6 6"]
    """Its covariance, as in ``Fix``."""
    matched: Int[np.ndarray, "n"]
    """Row of the target of each point, negative for none."""
    dot_target: Int[np.ndarray, "d"]
    """Row of the target of each dot that no point claims, negative for none."""
    point: Int[np.ndarray, "c"]
    """Rows of the points that found a target."""
    residual_mm: Float[np.ndarray, "c"]
    """Their distances from it (mm)."""
    spacing_mm: Float[np.ndarray, "c"]
    """Spacing of the targets around it (mm)."""
    log_likelihood: float
    """ln of the likelihood of all evidence at this pose against chance: for comparison among solutions."""
    log_ratio: float
    """ln of the likelihood ratio of the points against chance, each predicted from those before it; motion aside."""
    p_chance: float
    """Bound of the probability that the agreement is chance."""
    contradicted: int = 0
    """Points whose label is not that of their target, where labels decide between rivals."""
    labelled: int = 0
    """Points that have a label, as their targets have, there."""

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals (mm)."""
        return float(np.sqrt(np.mean(self.residual_mm**2))) if len(self.point) else float("nan")

    def as_rival(self) -> Rival:
        """What is told of it in an ambiguous frame."""
        return Rival(self.T_world_sensor, self.log_likelihood, len(self.point))


_QUICK_NEIGHBOURS = 12  # of each of the three points, for the first look
_CARRIED_OFF = 1e-3  # ε: probability that the sensor is not where its motion leads
_WORKED_OUT = 6  # solutions in search of the best one
_WIDEST_SLOPE = 2.0  # a target farther to the side than twice its depth is not looked for
_DEPTH_MARGIN = 0.15  # a sensor sees somewhat farther, and nearer, than any one frame shows
_MARGIN_PX = 10.0  # nearer to the image's edge a target may well go unseen
_WINDOW_POINTS = 4  # of given points, to say what the sensor's field of view is
_WIDER, _SAMPLE = 6.0, 12  # tolerances so much wider, for so many triangles, tell what chance would bring
_LOOKS = 1500  # places of rivals to look at, those where the three points fit best
_THICK = 10.0  # standard deviations of points, rms about a plane, in which points that agree do not lie in it
_SCALE_SIGMAS = 3.0  # of the size of what agrees, beyond which another size is tried
_MOSTLY = 0.8  # of the points explained, their own triangles are those of all points
_TRIPLES = 2_500  # of points, to be sought all over the map
_LABELS_HOLD = 1e-3  # probability of so many wrong labels, below which they are not what they are said to be
_OWN_ODDS = 100.0  # a rival that explains many points is one only if they are evidence of it, motion aside
_NOWHERE = (np.eye(3), np.zeros(3), np.zeros((6, 6)))
_NO_DOTS = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))
_NO_CAMERAS = (np.zeros((2, 3, 3)), np.zeros((2, 3)))
_VALID = np.ones(1, dtype=np.bool_)


def verify(
    evidence: Evidence,
    map: ReferenceMap,
    index: MapIndex,
    identification: Identification,
    orientations: Orientations,
    earlier: Sequence[Identification] = (),
    prediction: Prediction | None = None,
    asks_dots: bool = False,
    options: VerifyOptions = VerifyOptions(),
    target_label: Int[np.ndarray, "k"] = _NO_ROWS,
) -> Fix | NoFix:
    """The one pose that the frame proves, or why there is none.

    ``index`` is that of the map as it is now. ``earlier`` are the hypotheses that this frame has cost before these.
    ``target_label`` are the labels of the targets, -1 where unknown; they prove nothing, but may speak against rivals.

    Every hypothesis gets a first look; the best are worked out over all points, until one is proven. Then its rivals
    are sought: all poses that could explain so many points that the frame would be ambiguous. Of two points that share
    a dot, one at most is matched. With ``asks_dots``, dots that no point claims are evidence as well.
    """
    if len(identification) == 0:
        return NoFix(Reason.no_candidate)
    enough = np.log(max(sum(len(each) for each in earlier) + len(identification), 1) / options.max_p_chance)
    weighed = _Weighed(evidence, map, index, prediction, options, target_label)
    if asks_dots:
        weighed.ask_dots()
    found = weighed.candidates(identification, orientations, earlier, enough)
    if not found:
        return NoFix(Reason.no_candidate, "Every hypothesis looks at targets from behind or has its points on a line.")
    best = min(found, key=lambda each: each.p_chance)
    if best.p_chance > options.max_p_chance:
        detail = _agreement(best, len(evidence.points))
        return NoFix(Reason.not_proven, detail, best.p_chance, len(best.point), best.rms_mm)
    found += weighed.rivals(found, best)
    weighed.doubt_labels(found)
    best = max(found, key=weighed.odds)
    rivals = [each for each in found if each is not best and weighed.is_rival(best, each)]
    if rivals or best.p_chance > options.max_p_chance:
        rivals = sorted(rivals or found, key=lambda each: -weighed.odds(each))
        told = tuple(each.as_rival() for each in [best, *(each for each in rivals if each is not best)])
        explained = ", ".join(str(each.matched) for each in told[:4])
        detail = f"{len(told)} poses explain {explained} points."
        return NoFix(Reason.ambiguous, detail, best.p_chance, len(best.point), best.rms_mm, told)
    if distorted := weighed.is_distorted(best):
        detail = f"{len(best.point)} points agree with the map; {distorted}, more would."
        return NoFix(Reason.not_proven, detail, 1.0, len(best.point), best.rms_mm)
    fix = weighed.fix(weighed.with_single_dots(best))
    seen_mm = map.xyz_mm[np.concatenate([fix.target, fix.single.target])]
    sigma_mm, sigma_deg = pose_sigma(fix.cov, fix.T_world_sensor.inverse().apply(seen_mm))
    if sigma_mm > options.max_sigma_mm or sigma_deg > options.max_sigma_deg:
        detail = f"The pose is known to {sigma_mm:.2f} mm and {sigma_deg:.3f} degrees only."
        return NoFix(Reason.weak_geometry, detail, fix.p_chance, len(fix.point), best.rms_mm, weak=fix)
    return fix


class _Weighed:
    """A frame's evidence beside the map, in the form that the compiled loops take."""

    def __init__(
        self,
        evidence: Evidence,
        map: ReferenceMap,
        index: MapIndex,
        prediction: Prediction | None,
        options: VerifyOptions,
        target_label: Int[np.ndarray, "k"] = _NO_ROWS,
    ) -> None:
        self._evidence, self._map, self._index = evidence, map, index
        self._target_label = target_label if options.label_error < 1 else _NO_ROWS
        self._log_label_error = float(np.log(options.label_error))
        self._prediction, self._options = prediction, options
        points = evidence.points
        self._frame = (points.xyz_mm, points.cov_mm2, evidence.left, evidence.right)
        self._scene = (
            map.xyz_mm,
            map.cov_mm2,
            map.view,
            map.state,
            map.sightings,
            map.misses,
            index.neighbour,
        )
        self._near = kernels.nearest(points.xyz_mm, max(min(_QUICK_NEIGHBOURS, len(points) - 1), 0))
        self._windows = _windows(evidence)
        self._dots: tuple[np.ndarray, ...] = _NO_DOTS
        self._cameras, self._alive = _NO_CAMERAS, _NO_ROWS
        self._prior = _NOWHERE
        if prediction is not None:
            T = prediction.T_world_sensor
            self._prior = (T.R, T.t_mm, np.linalg.inv(prediction.cov))

    def ask_dots(self) -> None:
        """From now on, dots that no point claims count as well."""
        self._dots, self._cameras = _all_dots(self._evidence)
        self._alive = np.flatnonzero(self._map.alive)
        if self._prediction is not None:  # those ahead, of a map that may be large
            ahead = self._prediction.T_world_sensor.inverse().apply(self._map.xyz_mm[self._alive])
            self._alive = self._alive[np.abs(ahead[:, :2]).max(axis=1) < _WIDEST_SLOPE * ahead[:, 2]]

    def candidates(
        self,
        identification: Identification,
        orientations: Orientations,
        earlier: Sequence[Identification],
        enough: float,
        needed: int = 0,
        known: Sequence[Solution] = (),
    ) -> list[Solution]:
        """The different solutions of some hypotheses; those beside the ``known`` ones that explain enough points."""
        n = len(self._evidence.points)
        most = self._options.max_solutions if needed else _WORKED_OUT
        s, R, t, cov, matched, mm, dot_target, spacing, log_ratio, log_likelihood = kernels.solve(
            orientations.R,
            orientations.t_mm,
            orientations.cov,
            orientations.is_valid,
            _side_evidence(identification, orientations),
            identification.point,
            identification.target,
            self._near,
            self._frame,
            self._dots,
            self._cameras,
            self._alive,
            self._scene,
            self._index.grid,
            self._windows,
            self._prior,
            self._options.gate_sigmas,
            (float(enough), needed, most),
            np.stack([each.matched for each in known]) if known else np.zeros((0, n), np.int64),
        )
        solutions = []
        for k in range(s):
            T, point = Pose(R[k], t[k]), np.flatnonzero(matched[k] >= 0)
            gain = self._motion_gain(T, spacing[k, point])
            # a hypothesis of fewer than three pairs rests on the motion itself: it has been counted
            evidence = log_ratio[k] + (gain if identification.point.shape[1] >= 3 else 0.0)
            p_chance = self._p_chance(evidence, matched[k], identification, earlier)
            contradicted, labelled = self._labels(point, matched[k, point])
            solutions.append(
                Solution(
                    T_world_sensor=T,
                    cov=cov[k],
                    matched=matched[k],
                    dot_target=dot_target[k],
                    point=point,
                    residual_mm=mm[k, point],
                    spacing_mm=spacing[k, point],
                    log_likelihood=float(log_likelihood[k] + gain),
                    log_ratio=float(log_ratio[k]),
                    p_chance=p_chance,
                    contradicted=contradicted,
                    labelled=labelled,
                )
            )
        return solutions

    def _labels(self, point: Int[np.ndarray, "c"], target: Int[np.ndarray, "c"]) -> tuple[int, int]:
        """How many points bear another label than their target, and how many any, if labels decide between rivals."""
        if not len(self._target_label):
            return 0, 0
        label, known = self._evidence.points.label[point], self._target_label[target]
        return int(contradict(label, known).sum()), int(((label >= 0) & (known >= 0)).sum())

    def odds(self, solution: Solution) -> float:
        """ln of the likelihood of a solution, labels included: for comparison among solutions."""
        return solution.log_likelihood + solution.contradicted * self._log_label_error

    def doubt_labels(self, found: Sequence[Solution]) -> None:
        """From now on, labels mean nothing if they contradict even the best solution more often than they may err."""
        best = max(found, key=self.odds)
        wrong = best.contradicted
        if comb(best.labelled, wrong) * np.exp(wrong * self._log_label_error) < _LABELS_HOLD:
            self._log_label_error = 0.0

    def _p_chance(
        self,
        evidence: float,
        matched: Int[np.ndarray, "n"],
        identification: Identification,
        earlier: Sequence[Identification],
    ) -> float:
        """Bound of the probability that chance brought so much evidence, with all hypotheses of the frame paid for.

        There are two ways to a hypothesis where a motion is known, and either may err.
        """
        ways = 1.0 if self._prediction is None else 2.0
        if identification.point.shape[1] == 0:
            return float(np.clip(ways * np.exp(-max(evidence, 0.0)), 1e-300, 1.0))
        every = [each for each in (*earlier, identification) if each.point.shape[1]]
        others = sum(false_hypotheses(each, matched) for each in every)
        expected = sum(each.expected_by_chance for each in every)
        number = sum(len(each) for each in every)

        def bound(expected: float) -> float:
            false = min(max(others, expected), number)
            return float(np.clip(ways * np.exp(min(np.log(max(false, 1e-300)) - evidence, 0.0)), 1e-300, 1.0))

        p_chance = bound(expected)
        limit = self._options.max_p_chance
        if others < expected and p_chance > limit and bound(others) <= limit:
            p_chance = min(p_chance, bound(self._expected_by_chance(every)))
        return p_chance

    def _expected_by_chance(self, every: Sequence[Identification]) -> float:
        """Hypotheses that chance would bring, from how many there would be if lengths agreed far more often.

        If tolerances were k times as wide, chance would bring k³ times as many, and the true ones would hardly count.
        """
        points = self._evidence.points
        every = [each for each in every if each.point.shape[1] == 3]
        if not every:
            return np.inf
        triangles = np.unique(np.sort(np.concatenate([each.point for each in every]), axis=1), axis=0)[:_SAMPLE]
        looked_up = sum(max(each.comparisons, len(each)) for each in every)
        search = self._index.any if self._index.targets <= ANYWHERE_UP_TO else self._index.local
        sigmas = _WIDER * (max(each.max_sigmas for each in every) or self._options.gate_sigmas)
        wide = search(points, self._map, triangles, sigmas, 0.0, self._options.max_rivals)
        return looked_up * (len(wide) + 1) / (max(wide.tried, 1) * _WIDER**3)

    def _motion_gain(self, T_world_sensor: Pose, spacing_mm: Float[np.ndarray, "c"]) -> float:
        """What the last motion adds to the log ratio of a pose."""
        if self._prediction is None or len(spacing_mm) == 0:
            return 0.0
        area_mm2 = self._index.targets * float(np.mean(spacing_mm**2))
        return motion_log_ratio(T_world_sensor, self._prediction, area_mm2)

    def rivals(self, found: list[Solution], best: Solution) -> list[Solution]:
        """Solutions that could come too near the best one, beside those that have been found.

        Whatever pose explains m points of the frame explains three of one group, if the points are parted into groups
        of which there are fewer than m / 2: so a few triples find every pose that can come near enough.
        """
        points, options = self._evidence.points, self._options
        most_gain = (
            0.0 if self._prediction is None else self._motion_gain(self._prediction.T_world_sensor, best.spacing_mm)
        )
        least = self.odds(best) - most_gain - np.log(options.min_rival_odds)
        by_odds = int(np.ceil(least / self._index.largest_evidence(points, self._map)))
        needed = max(3, min(int(np.ceil(options.max_rival_share * len(best.point))), by_odds))
        if len(points) < needed:
            return []
        candidates = self._congruent(needed, best)
        if len(candidates) == 0:
            return []
        p, q = candidates.point, candidates.target
        at = kernels.orient_triangles(points.xyz_mm, points.cov_mm2, p, self._map.xyz_mm, self._map.cov_mm2, q)
        if len(p) > _LOOKS:  # of the many triangles of a pose that explains many points, some agree well
            best_fitting = np.argsort(at[4], kind="stable")[:_LOOKS]
            p, q, at = p[best_fitting], q[best_fitting], tuple(each[best_fitting] for each in at)
        hypotheses = Identification(p, q, candidates.tried, candidates.expected_by_chance)
        orientations = Orientations(*at)
        return self.candidates(hypotheses, orientations, (), np.inf, needed, found)

    def _congruent(self, needed: int, best: Solution) -> Candidates:
        """Where in the map a pose that explains so many points can lie.

        Where there is too much to search, near triangles have to do. They are sought among the points that the best one
        explains, too: a look-alike explains the same, and points that are no targets may lie between them.
        """
        points, limits = self._evidence.points, (self._options.gate_sigmas, 0.0, self._options.max_rivals)
        groups = max(1, (needed - 1) // 2)
        size = len(points) / groups
        is_small = groups * size**3 / 6 <= _TRIPLES and self._index.targets <= ANYWHERE_UP_TO
        if is_small:
            triples = kernels.covering_triples(points.xyz_mm, needed)
            found = self._index.any(points, self._map, triples, *limits)
            if not found.is_cut and found.tried == len(triples):
                return found
        triangles = frame_triangles(points.xyz_mm, points.cov_mm2, 6)
        p = best.point
        if len(p) < _MOSTLY * len(points):
            own = p[frame_triangles(points.xyz_mm[p], points.cov_mm2[p], 8)]
            triangles = np.concatenate([own, triangles])
            first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1]
            triangles = triangles[np.sort(first)]
        return self._index.local(points, self._map, triangles, *limits)

    def is_rival(self, best: Solution, other: Solution) -> bool:
        """Whether another solution puts the points elsewhere and yet comes too near the best in explaining them.

        Elsewhere is beyond the noise for one that is nearly as likely, and beyond half the way to the next target for
        one that explains as many points and is no chance itself: such is the mark of a pattern that repeats itself.
        """
        points, options = self._evidence.points, self._options
        p = best.point if len(best.point) else other.point
        if len(p) == 0:
            return False
        apart = (best.T_world_sensor.inverse() @ other.T_world_sensor).apply(points.xyz_mm[p]) - points.xyz_mm[p]
        d2 = np.einsum("ni,ni->n", apart, np.linalg.solve(points.cov_mm2[p], apart[:, :, None])[:, :, 0])
        is_elsewhere = np.median(d2) > options.gate_sigmas**2
        is_near = self.odds(best) - self.odds(other) < np.log(options.min_rival_odds)
        if is_elsewhere and is_near:
            return True
        best_share, share = (
            len(each.point) - (each.contradicted if self._log_label_error else 0) for each in (best, other)
        )
        explains_as_many = share >= options.max_rival_share * best_share
        if not explains_as_many or other.log_ratio < np.log(_OWN_ODDS) or len(best.point) == 0:
            return False
        return bool(np.median(np.linalg.norm(apart, axis=1) / best.spacing_mm) > 0.5)

    def is_distorted(self, best: Solution) -> str:
        """What would have to be done to the frame to explain more of it, if that is so; empty otherwise.

        Every triangle is its own mirror image in its plane, and so is all that lies in that plane. In another size, a
        small part of a constellation still agrees. Neither is chance, and yet both prove nothing.
        """
        points, c = self._evidence.points, len(best.point)
        if c < 3 or c == len(points):
            return ""
        xyz_mm, target_mm = points.xyz_mm[best.point], self._map.xyz_mm[best.matched[best.point]]
        centre = xyz_mm.mean(axis=0)
        offset = xyz_mm - centre
        size2_mm2 = float((offset**2).sum())
        scale = float((offset @ best.T_world_sensor.R.T * (target_mm - target_mm.mean(axis=0))).sum()) / size2_mm2
        variance_mm2 = np.trace(points.cov_mm2[best.point], axis1=1, axis2=2).max()
        sigma_mm = np.sqrt(variance_mm2 + np.trace(self._map.cov_mm2[best.matched[best.point]], axis1=1, axis2=2).max())
        if abs(scale - 1) > _SCALE_SIGMAS * sigma_mm / np.sqrt(size2_mm2) and self._is_better(
            best, centre, scale * np.eye(3)
        ):
            return f"{scale:.4f} times as large"
        _, size, axes = np.linalg.svd(offset, full_matrices=False)
        if size[2] / np.sqrt(c) > _THICK * np.sqrt(variance_mm2):
            return ""  # what agrees lies in no plane
        if self._is_better(best, centre, np.eye(3) - 2 * np.outer(axes[2], axes[2])):
            return "in a mirror"
        return ""

    def _is_better(self, best: Solution, centre: Float[np.ndarray, "3"], A: Float[np.ndarray, "3 3"]) -> bool:
        """Whether the pose explains more if the points are distorted about a centre."""
        points = self._evidence.points
        xyz_mm = np.ascontiguousarray((points.xyz_mm - centre) @ A.T + centre)
        none, T = np.zeros((1, 0), dtype=np.int64), best.T_world_sensor
        as_it_is = Orientations(T.R[None], T.t_mm[None], best.cov[None], _VALID, np.zeros(1))
        distorted = replace(self._evidence, points=replace(points, xyz_mm=xyz_mm, cov_mm2=A @ points.cov_mm2 @ A.T))
        weighed = _Weighed(distorted, self._map, self._index, None, self._options)
        found = weighed.candidates(Identification(none, none), as_it_is, (), 0.0)
        return any(len(each.point) > len(best.point) and each.log_likelihood > best.log_likelihood for each in found)

    def with_single_dots(self, best: Solution) -> Solution:
        """A solution and the dots of a single camera that it takes to trusted targets: these hold the pose as well."""
        if self._evidence.dots is None or self._evidence.rig is None or len(self._dots[0]) or len(best.point) < 3:
            return best
        self._dots, self._cameras = _all_dots(self._evidence)
        T, matched = best.T_world_sensor, best.matched.copy()
        trusted = np.flatnonzero(self._map.state == TargetState.trusted)
        ahead = T.inverse().apply(self._map.xyz_mm[trusted])
        trusted = trusted[np.abs(ahead[:, :2]).max(axis=1, initial=0.0) < _WIDEST_SLOPE * ahead[:, 2]]
        R, t, cov, cell_mm = T.R.copy(), T.t_mm.copy(), best.cov.copy(), self._index.grid[3]
        dot_target, _, residual_mm = kernels.add_dots(
            R,
            t,
            cov,
            self._frame,
            matched,
            self._dots,
            self._cameras,
            self._scene,
            trusted,
            cell_mm,
            self._options.gate_sigmas,
        )
        point = np.flatnonzero(matched >= 0)
        if not (dot_target >= 0).any() or len(point) < len(best.point):  # a dot that drives out a point is none
            return best
        return replace(
            best,
            T_world_sensor=Pose(R, t),
            cov=cov,
            dot_target=dot_target,
            residual_mm=residual_mm[point],
        )

    def fix(self, best: Solution) -> Fix:
        """A solution as the answer."""
        fix = Fix(
            T_world_sensor=best.T_world_sensor,
            cov=best.cov,
            point=best.point,
            target=best.matched[best.point],
            residual_mm=best.residual_mm,
            p_chance=best.p_chance,
        )
        seen = np.flatnonzero(best.dot_target >= 0)
        evidence = self._evidence
        if len(seen) and evidence.dots is not None and evidence.rig is not None:
            camera, dot = self._dots[0][seen], self._dots[1][seen]
            target, T = best.dot_target[seen], best.T_world_sensor
            sensed = evidence.dots, evidence.rig, T, self._map, evidence.noise_scale
            fix = replace(fix, single=SingleDots.of(camera, dot, target, *sensed))
        if len(best.point) < 3:
            detail = f"{len(best.point)} points and {len(seen)} dots of a single camera, near where the motion leads."
            fix = replace(fix, reason=PositionedReason.few_points, detail=detail)
        return fix


def _agreement(best: Solution, points: int) -> str:
    """What agrees with the map and yet proves nothing, in words."""
    count, single = len(best.point), int((best.dot_target >= 0).sum())
    dots = f"{single} {'dot' if single == 1 else 'dots'} of a single camera"
    if count == 0:
        return f"Only {dots} agree with the map." if single else "No point agrees with the map." if points else ""
    what = f"{count} of {points} points{f' and {dots}' if single else ''} agree with the map to {best.rms_mm:.2f} mm"
    if best.p_chance < 1:
        return f"{what}; by chance so in up to {best.p_chance:.1e} of such frames."
    return f"{what}, as by chance they may."


def fewest_points(index: MapIndex, points: SensorPoints, map: ReferenceMap, options: VerifyOptions) -> int:
    """Points that a pose must explain to be proven without any motion: three, and the evidence of the others."""
    return 3 + max(1, int(np.ceil(-np.log(options.max_p_chance) / index.largest_evidence(points, map))))


def _side_evidence(identification: Identification, orientations: Orientations) -> Float[np.ndarray, "h"]:
    """How well the sides of each hypothesis' triangle agree, against anyhow within the tolerance: ln of N(Δ) · volume.

    False ones fill the box of ± k standard deviations evenly, true ones lie about its middle.
    """
    if identification.max_sigmas == 0 or identification.point.shape[1] != 3:
        return np.zeros(len(identification))
    volume = 3 * np.log(2 * identification.max_sigmas) - 1.5 * np.log(2 * np.pi)
    return np.asarray(volume - 0.5 * np.nan_to_num(orientations.d2))


def false_hypotheses(identification: Identification, matched: Int[np.ndarray, "n"]) -> int:
    """Hypotheses that do not belong to a solution: each was one more chance for chance.

    If the solution is right, they are the false ones; if it is wrong, they tell how many false ones there are.
    """
    return int((matched[identification.point] != identification.target).any(axis=1).sum())


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


def _windows(evidence: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a target must be to be seen: for each camera its rotation, its translation, limits of slopes and depth.

    The depths that the frame's points fill, and somewhat more, stand for the sensor's; without a rig, their slopes
    stand for the field of view.
    """
    xyz = evidence.points.xyz_mm
    if len(xyz) < _WINDOW_POINTS or not evidence.is_whole:
        return np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 6))
    near_mm, far_mm = (1 - _DEPTH_MARGIN) * xyz[:, 2].min(), (1 + _DEPTH_MARGIN) * xyz[:, 2].max()
    if evidence.rig is None:
        slope = xyz[:, :2] / xyz[:, 2:]
        low, high = slope.min(axis=0), slope.max(axis=0)
        limits = np.array([[low[0], high[0], low[1], high[1], near_mm, far_mm]])
        return np.eye(3)[None], np.zeros((1, 3)), limits
    rig = evidence.rig
    R, t = np.stack([np.eye(3), rig.T_right_left.R]), np.stack([np.zeros(3), rig.T_right_left.t_mm])
    limits = np.array([[*_inner_slopes(rig.left), near_mm, far_mm], [*_inner_slopes(rig.right), 0.0, np.inf]])
    return R, t, limits


@lru_cache(maxsize=64)
def _inner_slopes(camera: Camera) -> tuple[float, float, float, float]:
    """Limits of the slopes (x low, x high, y low, y high) that are well inside the image whatever the other slope."""
    u = np.linspace(_MARGIN_PX, camera.width_px - 1 - _MARGIN_PX, 9)
    v = np.linspace(_MARGIN_PX, camera.height_px - 1 - _MARGIN_PX, 9)

    def slopes(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return camera.unproject(np.stack(np.broadcast_arrays(u, v), axis=1).astype(float))

    return (
        float(np.nanmax(slopes(u[:1], v)[:, 0])),
        float(np.nanmin(slopes(u[-1:], v)[:, 0])),
        float(np.nanmax(slopes(u, v[:1])[:, 1])),
        float(np.nanmin(slopes(u, v[-1:])[:, 1])),
    )


def _all_dots(evidence: Evidence) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, np.ndarray]]:
    """All dots as (camera, row, slopes, covariance of the slopes), and the cameras' rotations and translations."""
    rig, dots = evidence.rig, evidence.dots
    assert rig is not None, "dots come with the rig that saw them"
    assert dots is not None, "asked before"
    camera, row, xy, cov = [], [], [], []
    for side, (seen, by) in enumerate(((dots.left, rig.left), (dots.right, rig.right))):
        prepared = prepare_dots(floats(seen.uv_px), floats(seen.cov_px2), by.parameters)
        slopes, C = prepared[:, :2], evidence.noise_scale**2 * prepared[:, [[2, 3], [3, 4]]]
        good = np.flatnonzero(np.isfinite(slopes).all(axis=1) & np.isfinite(C).all(axis=(1, 2)))
        camera.append(np.full(len(good), side))
        row.append(good)
        xy.append(slopes[good])
        cov.append(C[good])
    cameras = np.stack([np.eye(3), rig.T_right_left.R]), np.stack([np.zeros(3), rig.T_right_left.t_mm])
    return tuple(np.concatenate(each) for each in (camera, row, xy, cov)), cameras
