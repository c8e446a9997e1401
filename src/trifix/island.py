"""A map that grows by itself: the world is one, and so is every part of the object that nothing connects to it yet.

What belongs to such a map goes with it: the memory of the matching technique and the motion of the sensor across it.
Knows no image and no other island, but for the moment in which it absorbs one.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter
from typing import assert_never

import numpy as np
from jaxtyping import Int

from trifix.config import Config
from trifix.geometry.alignment import spread_off_line_mm
from trifix.geometry.pose import Pose
from trifix.index import MapIndex
from trifix.joint import JointMap
from trifix.labels import TargetLabels, by_label
from trifix.records import (
    Event,
    Fix,
    Frame,
    Identification,
    NoFix,
    PositionedReason,
    Prediction,
    Reason,
    ReferenceMap,
    SensorPoints,
    StereoMatches,
)
from trifix.stages.identify import AS_PREDICTED, any_triangles, identifier, pairs_as_predicted
from trifix.stages.orient import orient
from trifix.stages.predict import Motion, follow, predict
from trifix.stages.tend import Care, Hand
from trifix.stages.update import distinct, found_map, update
from trifix.stages.verify import Evidence, fewest_points, verify
from trifix.stages.verify_residual import verify_residual

_UNDECIDED = (Reason.no_candidate, Reason.not_proven, Reason.residual)
NOTHING = np.zeros(0, dtype=np.int64)
FEW_POINTS = ("No point.", "One point.", "Two points.")


class Island:
    """One map, and everything that is remembered with it."""

    def __init__(
        self,
        number: int,
        config: Config,
        map: ReferenceMap,
        is_frozen: bool = False,
        T_world_island: Prediction | None = None,
    ) -> None:
        self.number = number
        self.map = map
        self.frames = 0
        self.absorbed_by: Island | None = None
        self.T_world_island = T_world_island
        """Where the island lies if the sensor moved on as it did before it was founded."""
        self.removed = NOTHING
        """Identities of the targets that the last lesson took out of the map."""
        self.events: list[Event] = []
        """What tending the map found after the last lesson."""
        self._care = Care(config.tend)
        move = config.predict
        self._hand = Hand(move.acceleration_mm_s2, move.angular_acceleration_rad_s2, move.max_gap_s)
        self._joint: JointMap | None = None
        if config.update.method == "joint" and not is_frozen:
            self._joint = JointMap(config.update.joint_targets)
            self._joint.adopt(map, np.flatnonzero(map.alive))
        self.labels = TargetLabels()
        self.motion: Motion | None = None
        self._config = config
        self._is_frozen = is_frozen
        self.index = MapIndex()
        self.index.follow(map)
        self.identifier = identifier(config.identify, self.index)
        self.identifier.learn(map, NOTHING)

    def predicted(self, timestamp_ns: int) -> Prediction | None:
        """Where the sensor should be at a time, if it was here not long before."""
        return predict(self.motion, timestamp_ns, self._config.predict)

    def position(
        self, evidence: Evidence, prediction: Prediction | None, clock: "Stopwatch"
    ) -> tuple[Identification | None, Fix | NoFix]:
        """Points to hypotheses to poses to the one that is proven; where points leave it open, single dots decide."""
        budget = self._config.identify.max_hypotheses
        best, likeliest, tried = NoFix(Reason.no_candidate), None, list[Identification]()
        target_label = self.labels.of(self.map)
        portions = self._hypotheses(evidence.points, target_label, prediction)
        while True:
            with clock("identify"):
                portion = next(portions, None)
            if portion is None:
                break
            fix = self._judge(evidence, portion, tried, prediction, clock)
            if isinstance(fix, Fix) or fix.why not in _UNDECIDED:
                return portion, fix
            tried.append(portion)
            if likeliest is None or not fix.p_chance >= best.p_chance:
                best, likeliest = fix, portion
            if (number := sum(len(each) for each in tried)) >= budget:
                detail = f"{number} hypotheses were tried, and at most {budget} are. {best.detail}".strip()
                return likeliest, replace(best, why=Reason.out_of_time, detail=detail)
        if evidence.dots is not None and likeliest is not None:
            by_motion = [each for each in tried if each.point.shape[1] < 3]
            for portion in {id(each): each for each in (likeliest, *by_motion)}.values():
                others = [each for each in tried if each is not portion]
                fix = self._judge(evidence, portion, others, prediction, clock, asks_dots=True)
                if isinstance(fix, Fix):
                    return portion, fix
        return likeliest, best

    def _hypotheses(
        self, points: SensorPoints, target_label: Int[np.ndarray, "k"], prediction: Prediction | None
    ) -> Iterator[Identification]:
        """Where the motion leads, first; then from nothing: those of the technique, and then any triangle at all."""
        options, gate = self._config.identify, self._config.verify.gate_sigmas
        if prediction is not None and options.start != "nothing" and self._config.verify.method == "probability":
            yield AS_PREDICTED
            if 0 < len(points) < 3:
                yield pairs_as_predicted(points, self.map, prediction.turned or prediction, gate)
        if options.start == "prediction" or len(points) < 3:
            return
        for portion in self.identifier.identify(points, self.map, self.motion.newest if self.motion else None):
            yield from by_label(portion, points, target_label)
        if options.widens:
            needed = fewest_points(self.index, points, self.map, self._config.verify)
            for portion in any_triangles(points, self.map, self.index, needed, options):
                yield from by_label(portion, points, target_label)

    def _judge(
        self,
        evidence: Evidence,
        identification: Identification,
        earlier: Sequence[Identification],
        prediction: Prediction | None,
        clock: "Stopwatch",
        asks_dots: bool = False,
    ) -> Fix | NoFix:
        """Hypotheses to poses to the one that is proven, by the method that the options name."""
        options, points = self._config.verify, evidence.points
        if prediction is not None and 0 < identification.point.shape[1] < 3:
            prediction = prediction.turned or prediction
        with clock("orient"):
            orientations = orient(points, self.map, identification, prediction)
        with clock("verify"):
            match options.method:
                case "probability":
                    scene = evidence, self.map, self.index
                    label = self.labels.of(self.map)
                    return verify(*scene, identification, orientations, earlier, prediction, asks_dots, options, label)
                case "residual":
                    limits = options.counterpart_mm, options.max_residual_mm
                    return verify_residual(points, self.map, orientations, *limits)
                case _:
                    assert_never(options.method)

    def learn(
        self,
        frame: Frame,
        points: SensorPoints,
        matches: StereoMatches | None,
        fix: Fix,
        next_id: int,
    ) -> Int[np.ndarray, "a"]:
        """A fix to a better map; returns the rows of the targets that are new."""
        self.frames += 1
        self.removed = NOTHING
        self.events = []
        self.follow(frame.timestamp_ns, fix)
        if self._is_frozen or fix.reason is PositionedReason.few_points:
            self.identifier.learn(self.map, fix.target)
            if fix.reason is not PositionedReason.few_points:
                self.labels.learn(self.map, points, fix.point, fix.target)
            return NOTHING
        if fix.reason is PositionedReason.defines_world:
            self.map, added = found_map(points, frame.index, next_id, self._joint)
        else:
            before = self.map
            self.map, added = update(
                self.map, points, matches, fix, frame.index, frame.rig, next_id, self._config.update, self._joint
            )
            gone = np.flatnonzero(before.alive)
            self.removed = before.id[gone[before.id[gone] != np.where(self.map.alive, self.map.id, -1)[gone]]]
            known = before.rows(fix.target)
            self.map, self.events = self._care.tend(known, self.map, added, points, fix, frame, self._hand)
        self._follow_map(np.unique(np.concatenate([fix.target, added])))
        self.labels.learn(self.map, points, fix.point, fix.target)
        self.labels.enter(self.map, points, fix.T_world_sensor, np.setdiff1d(added, fix.target))
        return added

    def told(self, points: SensorPoints, fix: Fix) -> Fix:
        """The fix by all that is known of the map before it learns from it: what the world is told of it.

        Verification takes the targets' errors for independent, as those that they have in common are nothing to it.
        """
        if self._joint is None or fix.reason is PositionedReason.defines_world:
            return fix
        T, cov = self._joint.settle(self.map, points, fix)
        residual_mm = np.linalg.norm(self.map.xyz_mm[fix.target] - T.apply(points.xyz_mm[fix.point]), axis=1)
        return replace(fix, T_world_sensor=T, cov=cov, residual_mm=residual_mm)

    def told_map(self) -> ReferenceMap:
        """The map by all that is known of it, as ``told`` has the fixes; with storage of its own."""
        return (self.map if self._joint is None else self._joint.told(self.map)).copy()

    def rescale(self, ratio: float) -> None:
        """Follows a change of the noise scale: all covariances are in proportion to its square."""
        if self._joint is not None:
            self._joint.rescale(ratio)
        self._care.rescale(ratio)
        self.map = replace(self.map, cov_mm2=self.map.cov_mm2 * ratio**2)

    def follow(self, timestamp_ns: int, fix: Fix) -> None:
        """Takes note of where the sensor was, for the next prediction."""
        self.motion = follow(self.motion, timestamp_ns, fix.T_world_sensor)

    def rest(self) -> None:
        """Forgets the motion."""
        self.motion = None

    def bridge(
        self, other: "Island", T_other_sensor: Pose, prediction: Prediction | None, clock: "Stopwatch"
    ) -> Fix | None:
        """The pose here of a sensor whose pose is known there, if all that the other island shows it proves one.

        The other island's targets, as the sensor would see them, are a frame like any other, but a better one. The
        points of the fix are rows of the living targets there.
        """
        rows = other.facing(T_other_sensor)
        if len(self.map) == 0 or len(rows) < 3:
            return None
        _, fix = self.position(Evidence.of(other.seen_from(T_other_sensor, rows), is_whole=False), prediction, clock)
        if isinstance(fix, NoFix) or len(fix.point) < 3:
            return None
        return replace(fix, point=np.searchsorted(np.flatnonzero(other.map.alive), rows[fix.point]))

    def absorb(self, other: "Island", T_other_sensor: Pose, bridge: Fix, frame: Frame, next_id: int) -> int:
        """Takes over the other island's living targets across a bridge; returns how many of them are new here."""
        points = other.seen_from(T_other_sensor, np.flatnonzero(other.map.alive))
        self.map, added = update(
            self.map, points, None, bridge, frame.index, None, next_id, self._config.update, self._joint
        )
        self.frames += other.frames
        other.absorbed_by = self
        self._follow_map(np.unique(np.concatenate([bridge.target, added])))
        self.labels.learn(self.map, points, bridge.point, bridge.target)
        self.labels.enter(self.map, points, bridge.T_world_sensor, added)
        return len(added)

    def _follow_map(self, seen: Int[np.ndarray, "s"]) -> None:
        """Index and technique take note of the map as it is now."""
        self.index.follow(self.map)
        self.identifier.learn(self.map, seen)

    def facing(self, T_world_sensor: Pose) -> Int[np.ndarray, "r"]:
        """Rows of living targets that turn towards the sensor and lie before it."""
        towards = T_world_sensor.t_mm - self.map.xyz_mm
        cosine = (self.map.view * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        depth = T_world_sensor.inverse().apply(self.map.xyz_mm)[:, 2]
        return np.flatnonzero(self.map.alive & ~(cosine < 0.5) & (depth > 0))

    def seen_from(self, T_world_sensor: Pose, rows: Int[np.ndarray, "r"]) -> SensorPoints:
        """Some targets as points in the coordinates of a sensor."""
        R = T_world_sensor.R
        return SensorPoints(
            xyz_mm=T_world_sensor.inverse().apply(self.map.xyz_mm[rows]),
            cov_mm2=R.T @ self.map.cov_mm2[rows] @ R,
            match=np.full(len(rows), -1),
            label=self.labels.of(self.map)[rows],
            row=np.arange(len(rows)),
        )


class Stopwatch:
    """Milliseconds per stage."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Times what happens inside."""
        start = perf_counter()
        yield
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (perf_counter() - start)


def define_world(points: SensorPoints) -> Fix | NoFix:
    """The first frame is where the world begins, if its points could ever be recognised."""
    if len(points) < 3:
        return NoFix(Reason.too_few_points, FEW_POINTS[len(points)])
    spread_mm = spread_off_line_mm(points.xyz_mm)
    if spread_mm < 3.0:
        return NoFix(Reason.weak_geometry, "The points lie within 3 mm of one line.")
    sigma_mm = float(np.sqrt(np.median(np.trace(points.cov_mm2, axis1=1, axis2=2))))
    if spread_mm < 3.0 * sigma_mm:
        detail = f"The points lie within {spread_mm:.0f} mm of one line, and are known to {sigma_mm:.0f} mm only."
        return NoFix(Reason.weak_geometry, detail)
    rows = distinct(points, np.arange(len(points)))
    if len(rows) < 3:
        return NoFix(
            Reason.weak_geometry, f"{len(rows)} of {len(points)} points are known to a tenth of their distance."
        )
    return Fix(
        T_world_sensor=Pose.identity(),
        cov=np.zeros((6, 6)),
        point=rows,
        target=np.arange(len(rows)),
        residual_mm=np.zeros(len(rows)),
        p_chance=float("nan"),
        reason=PositionedReason.defines_world,
    )
