"""Reference map after an update -> a clean one: what moved, went, is there twice, or was learnt from a false pose.

A target that stays where it is, is seen whenever it should be, and its residuals scatter about zero. What does not
leaves the map's living part, and the map tells why. A miss counts only from where the target was seen before, and only
beside three others that stood there when it was last seen: neither a rim nor drift removes anything.
Knows no image and no matching technique.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.geometry.pose import Pose
from trifix.kernels import floats, integers
from trifix.kernels import tending as kernels
from trifix.kernels.tending import FIRST, HITS, ID, LAST, MISSED, TRIES, TURNED, WEIGHED
from trifix.records import Event, Fix, Frame, ReferenceMap, SensorPoints, TargetState


@dataclass(frozen=True, slots=True)
class TendOptions:
    """How the map is kept clean."""

    tends: bool = True
    """Whether it is; false keeps everything, as in the paper."""
    min_turn_deg: float = 1.0
    """Directions to the sensor must differ by this for a target to be trusted (degrees)."""
    max_p_still: float = 1e-12
    """A target is quarantined when its residuals would be so biased with this probability, had it not moved."""
    min_shift_sigmas: float = 1.5
    """Shifts below so many standard deviations of a single sighting are no move, however sure they are."""
    moved_after: int = 5
    """Frames that must miss a target beside which a new one has appeared before it has moved."""
    max_move_mm: float = 100.0
    """A target that is gone has moved if a new one has appeared within this distance (mm)."""
    removed_after: float = 40.0
    """Sightings that should have been, and were not, before a trusted target is removed."""
    removed_directions: int = 3
    """Directions, about 11° wide, from which they must have been missed."""
    merged_after: int = 6
    """Frames that show one of two near targets and not the other before they are one."""
    min_apart: float = 0.4
    """Two targets nearer than this share of the smallest distance ever seen in one frame cannot both be there."""
    explained_sigmas: float = 4.0
    """Nor can two that their covariances do not tell apart (Mahalanobis)."""
    remembered: int = 20
    """Updates that can still be undone; 0 for none."""
    max_p_hand: float = 1e-12
    """Updates are undone if a hand would have moved there and back with this probability."""

    def __post_init__(self) -> None:
        if not (0 < self.max_p_still < 1 and 0 < self.max_p_hand < 1):
            raise ConfigError("tend.max_p_still and tend.max_p_hand must be probabilities between 0 and 1.")
        if min(self.moved_after, self.merged_after, self.removed_after, self.removed_directions) < 1:
            raise ConfigError(
                "tend.moved_after, merged_after, removed_after and removed_directions must be at least 1."
            )
        if min(self.min_turn_deg, self.min_shift_sigmas, self.max_move_mm, self.explained_sigmas, self.remembered) < 0:
            raise ConfigError("tend: no angle, distance, number of sigmas or of updates may be negative.")
        if not 0 <= self.min_apart < 1:
            raise ConfigError(f"tend.min_apart is {self.min_apart}, expected a share of a distance, below 1.")


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """One update of the map: enough to take it back."""

    frame: int
    """Index of its frame."""
    timestamp_ns: int
    """Time of its frame (ns)."""
    fix: Fix
    """The pose that it relied on."""
    row: Int[np.ndarray, "c"]
    """Rows of the targets that it touched, those that it brought last."""
    before: ReferenceMap
    """The known ones before it."""
    after: ReferenceMap
    """All of them after it."""

    @property
    def pose(self) -> Pose:
        """``T_world_sensor``."""
        return self.fix.T_world_sensor

    def since(self, other: "Lesson") -> float:
        """Seconds from the other lesson's frame to this one's."""
        return 1e-9 * (self.timestamp_ns - other.timestamp_ns)


@dataclass(frozen=True, slots=True)
class Hand:
    """How fast the sensor may change its motion."""

    acceleration_mm_s2: float
    """Standard deviation of the acceleration along each axis (mm/s²)."""
    angular_acceleration_rad_s2: float
    """Standard deviation of the angular acceleration about each axis (rad/s²)."""
    max_gap_s: float
    """Beyond this, nothing is said of the motion (s)."""

    def reach(self, time_s2: float) -> Float[np.ndarray, "6"]:
        """Standard deviations of δ = (translation mm, rotation rad) that the accelerations make over a time squared."""
        return time_s2 * np.repeat([self.acceleration_mm_s2, self.angular_acceleration_rad_s2], 3)


_PROVISIONAL, _TRUSTED = int(TargetState.provisional), int(TargetState.trusted)  # an enum's own names are slow
_QUARANTINED, _REMOVED = int(TargetState.quarantined), int(TargetState.removed)
_FORGETTING = 0.9  # λ: a bias is that of the last ten sightings
_MIN_WEIGHED = 5  # residuals before a bias is believed
_MIN_HITS = 10  # sightings before that: a place that was never well known cannot have been left
_REACH_SIGMAS = 8.0  # a point so near a missed target speaks of its bias though the fix did not take it
_AGREEMENT = 1e-3  # probability below which a pose does not follow from the earlier ones
_MAX_STRAYS = 5  # frames in a row that may have been positioned falsely
_MIN_TURNS = 2  # frames that must show one of two targets alone even where other pairs lie apart alike
_ALIKE = 0.3  # share of their distance by which two pairs may lie apart differently
_RESTLESS = 0.25  # share of the largest allowed χ² of a bias, seldom reached where the map is sound
_FEW = 0.05  # share of a frame's targets that may reach it: where more do, the map drifts or the calibration is off
_CLEAR_SIGMAS = 6.0  # two targets are clearly apart beyond this, were the covariances right
_EXACT_MM2 = 1e-12  # what a covariance of zero is taken for
_AT_MOST = 3.0  # standard deviations that the farthest place stands for which can be reached at the pace that was
_SWEEP = 1000  # lessons between two sweeps of what is remembered of targets that are gone
_CROWD = 2  # witnesses to each target that has moved: where more go together, it is the map that drifted


class Care:
    """What is remembered of a map's targets, and the judgement by it."""

    def __init__(self, options: TendOptions = TendOptions()) -> None:
        from scipy.special import chdtri

        self._options = options
        self._max_bias = float(chdtri(3, options.max_p_still))
        self._min_turn_cos = float(np.cos(np.radians(options.min_turn_deg)))
        self._lessons = 0
        self._newest_frame = -1
        self._apart_mm = np.inf
        self._turns: dict[tuple[int, int], int] = {}
        self._arrived: set[int] = set()
        self._strayed = np.zeros(0, dtype=np.int64)
        self._is_calm = True
        self._journal: deque[Lesson] = deque(maxlen=options.remembered)
        self._misses = np.zeros(0, dtype=np.int64)
        self._count = np.zeros((0, kernels.COLUMNS), dtype=np.int64)
        self._cells = np.zeros((0, 2, kernels.CELLS), dtype=np.uint64)
        self._first = np.zeros((0, 3))
        self._bias = np.zeros((0, 12))

    def tend(
        self,
        before: ReferenceMap,
        map: ReferenceMap,
        added: Int[np.ndarray, "a"],
        points: SensorPoints,
        fix: Fix,
        frame: Frame,
        hand: Hand,
    ) -> tuple[ReferenceMap, list[Event]]:
        """The map as it should be after an update, and what happened to it.

        ``before`` holds the targets of the fix as they were before the update, ``added`` the rows that it brought.
        Frames older than one already learnt from add their sightings; they tell nothing of what has changed since.
        """
        options = self._options
        if not options.tends:
            return map, []
        self._lessons += 1
        if self._lessons % _SWEEP == 0:
            self._forget_gone(map)
        self._grow(len(map))
        seen, pose = fix.target, fix.T_world_sensor
        changed = map.misses != self._misses[: len(map)]
        changed[fix.single.target] = False  # one camera saw them
        is_late, self._newest_frame = frame.index <= self._newest_frame, max(self._newest_frame, frame.index)
        missed = np.flatnonzero(changed) if not is_late else np.zeros(0, dtype=np.int64)
        missed = missed[map.state[missed] <= _TRUSTED]
        witnesses = kernels.witness(
            self._lessons,
            floats(pose.t_mm),
            integers(seen),
            missed,
            integers(added),
            self._min_turn_cos,
            map.id,
            map.xyz_mm,
            map.state,
            self._count,
            self._cells,
            self._first,
            self._bias,
        )
        row = np.concatenate([seen, added])
        self._journal.append(Lesson(frame.index, frame.timestamp_ns, fix, row, before, map.rows(row)))
        map = self._trusted_from_several_sides(before, map, seen)
        self._misses[: len(map)] = map.misses
        if is_late:
            return map, []
        missed, witnesses = missed[witnesses >= 0], witnesses[witnesses >= 0]
        map, biased = self._find_biased(before, map, points, fix, missed[witnesses >= kernels.WITNESSES])
        found_again = self._find_again(map, seen) if len(self._strayed) else []
        map, gone = self._compare(map, seen, missed, witnesses)
        map, undone = self._undo_strays(map, hand)
        return map, [*biased, *found_again, *gone, *undone]

    def rescale(self, ratio: float) -> None:
        """Follows a change of the noise scale: all covariances are in proportion to its square."""
        self._bias[:, :9] /= ratio**2
        self._journal = deque(
            (
                replace(each, before=_rescaled(each.before, ratio), after=_rescaled(each.after, ratio))
                for each in self._journal
            ),
            maxlen=self._options.remembered,
        )

    def _forget_gone(self, map: ReferenceMap) -> None:
        """Drops what is remembered of targets that no row of the map holds any more."""
        here = set(map.id.tolist())
        self._arrived &= here
        self._turns = {pair: turns for pair, turns in self._turns.items() if here.issuperset(pair)}

    def _grow(self, rows: int) -> None:
        if rows <= len(self._count):
            return
        more = max(rows, 2 * len(self._count)) - len(self._count)
        self._misses = np.pad(self._misses, (0, more))
        self._count = np.pad(self._count, ((0, more), (0, 0)))
        self._count[-more:, ID] = -1
        self._cells = np.pad(self._cells, ((0, more), (0, 0), (0, 0)))
        self._first = np.pad(self._first, ((0, more), (0, 0)))
        self._bias = np.pad(self._bias, ((0, more), (0, 0)))

    def _trusted_from_several_sides(
        self, before: ReferenceMap, map: ReferenceMap, seen: Int[np.ndarray, "c"]
    ) -> ReferenceMap:
        """The map without trust in targets that were seen often, but always from the same direction."""
        was_provisional = before.state == _PROVISIONAL
        if not was_provisional.any():
            return map
        rows = seen[was_provisional & (map.state[seen] == _TRUSTED) & (self._count[seen, TURNED] == 0)]
        return _in_state(map, rows, _PROVISIONAL) if len(rows) else map

    def _find_biased(
        self,
        before: ReferenceMap,
        map: ReferenceMap,
        points: SensorPoints,
        fix: Fix,
        missed: Int[np.ndarray, "m"],
    ) -> tuple[ReferenceMap, list[Event]]:
        """Puts aside targets whose residuals over several frames all point the same way, if those of others do not.

        It may have moved, or never have been one place: a false pair of dots slides as the sensor goes on.
        """
        options, T = self._options, fix.T_world_sensor
        found = kernels.weigh(
            floats(T.R),
            floats(T.t_mm),
            floats(fix.cov),
            floats(points.xyz_mm),
            floats(points.cov_mm2),
            integers(fix.point),
            integers(fix.target),
            before.xyz_mm,
            before.cov_mm2,
            missed,
            map.xyz_mm,
            map.cov_mm2,
            _REACH_SIGMAS,
            _FORGETTING,
            self._count,
            self._bias,
        )
        chi2 = found[:, 0]
        is_biased, is_restless = chi2 > self._max_bias, chi2 > _RESTLESS * self._max_bias
        self._is_calm = bool(is_restless.sum() <= 1 + _FEW * len(chi2))
        if not (self._is_calm and is_biased.any()):
            return map, []
        row = np.concatenate([fix.target, missed])
        is_sure = (
            is_biased
            & (self._count[row, WEIGHED] >= _MIN_WEIGHED)
            & (self._count[row, HITS] >= _MIN_HITS)
            & (map.state[row] == _TRUSTED)
            & (found[:, 2] > options.min_shift_sigmas)
        )
        suspect = np.flatnonzero(is_sure)
        events: list[Event] = []
        for k in suspect.tolist():
            target = int(map.id[row[k]])
            detail = f"its residuals are biased by about {found[k, 1]:.2f} mm (χ² {chi2[k]:.0f})"
            events.append(Event("target_quarantined", target, detail))
        self._strayed = np.concatenate([self._strayed, row[suspect]])
        return _in_state(map, row[suspect], _QUARANTINED), events

    def _find_again(self, map: ReferenceMap, seen: Int[np.ndarray, "c"]) -> list[Event]:
        """Tells which of the targets put aside have moved: one that came since and stays is beside their place."""
        count = self._count
        new = integers(seen[(map.state[seen] == _TRUSTED) & (count[seen, HITS] >= _MIN_HITS)])
        apart_mm = self._options.min_apart * self._apart_mm if np.isfinite(self._apart_mm) else 0.0
        events: list[Event] = []
        for a, b in kernels.near_pairs(self._strayed, apart_mm, new, 0.0, map.xyz_mm, map.cov_mm2):
            is_told = a not in self._strayed or int(map.id[b]) in self._arrived
            if not is_told and count[b, FIRST] > count[a, LAST]:
                self._strayed = self._strayed[self._strayed != a]
                events.append(self._moved(map, a, b))
        return events

    def _compare(
        self,
        map: ReferenceMap,
        seen: Int[np.ndarray, "c"],
        missed: Int[np.ndarray, "m"],
        witnesses: Int[np.ndarray, "m"],
    ) -> tuple[ReferenceMap, list[Event]]:
        """What missed targets, and those seen near them, tell of one another.

        Of two that cannot both be there, one has moved if it was missed ever since the other came, while what stood
        around it stayed; if they take turns, or if more went than stayed, they are one. A target missed often enough
        has moved to where the nearest one came since, or is gone.
        """
        options, count = self._options, self._count
        seen = integers(seen[map.state[seen] <= _TRUSTED])
        place = (map.xyz_mm, map.cov_mm2)
        self._apart_mm, together = kernels.seen_together(
            seen, self._apart_mm, options.min_apart, options.explained_sigmas, *place, map.state
        )
        for a, b in together:
            self._turns[_pair(map, a, b)] = -1
        is_trusted = map.state[missed] == _TRUSTED  # others that are missed may never have been
        missed, witnesses = missed[is_trusted], witnesses[is_trusted]
        if len(missed) == 0:
            return map, []
        apart_mm = options.min_apart * self._apart_mm if np.isfinite(self._apart_mm) else 0.0
        near = kernels.near_pairs(missed, apart_mm, seen, options.explained_sigmas, *place)
        misses = np.where(witnesses >= kernels.WITNESSES, count[missed, MISSED], 0)
        due = misses * (count[missed, HITS] + 1.0) / (count[missed, TRIES] + 2.0)
        is_missing = due >= 0.5 * options.removed_after
        if not near and not is_missing.any():
            return map, []
        map, events = map.copy(), list[Event]()
        if near:
            pairs = np.array(near, dtype=np.int64)
            d2 = _mahalanobis2(map, pairs)
            d_mm = np.linalg.norm(map.xyz_mm[pairs[:, 0]] - map.xyz_mm[pairs[:, 1]], axis=1)
            is_one = (d2 < options.explained_sigmas**2) | (d_mm < apart_mm)
            pairs, is_clear = pairs[is_one], d2[is_one] > _CLEAR_SIGMAS**2
            k = np.searchsorted(missed, pairs[:, 0])
            came_since = count[pairs[:, 1], FIRST] > count[pairs[:, 0], LAST]
            has_moved = (
                self._is_calm & is_clear & came_since & (_CROWD * np.unique(pairs[came_since, 0]).size <= witnesses[k])
            )
            events += self._merge(map, pairs[~has_moved])
            is_due = has_moved & (misses[k] >= options.moved_after)
            for a, b in pairs[is_due].tolist():
                both_trusted = map.state[a] == map.state[b] == _TRUSTED
                if both_trusted and int(map.id[b]) not in self._arrived:
                    events += self._move(map, a, b)
        is_missing &= map.state[missed] == _TRUSTED
        is_missing[is_missing] = kernels.directions(self._cells[missed[is_missing]]) >= options.removed_directions
        for k in np.flatnonzero(is_missing).tolist():
            a = int(missed[k])
            b = self._successor(map, a)
            if b is not None:
                events += self._move(map, a, b)
            elif due[k] >= options.removed_after:
                map.state[a] = _REMOVED
                detail = f"missed in {misses[k]} frames that should have seen it, after frame {map.last_seen[a]}"
                events.append(Event("target_removed", int(map.id[a]), detail))
        return map, events

    def _successor(self, map: ReferenceMap, row: int) -> int | None:
        """The row of the target that a missing one has become: of those that came since, each the other's nearest."""
        count = self._count[: len(map)]
        is_known = (map.state == _TRUSTED) & (count[:, ID] == map.id)
        came = np.flatnonzero(is_known & (count[:, FIRST] > count[row, LAST]))
        came = came[[int(each) not in self._arrived for each in map.id[came]]]
        d_mm = np.linalg.norm(map.xyz_mm[came] - map.xyz_mm[row], axis=1)
        if d_mm.min(initial=np.inf) > self._options.max_move_mm:
            return None
        new = int(came[np.argmin(d_mm)])
        left = np.flatnonzero(is_known & (count[:, LAST] < count[new, FIRST]))
        nearest = left[np.argmin(np.linalg.norm(map.xyz_mm[left] - map.xyz_mm[new], axis=1))]
        return new if nearest == row else None

    def _move(self, map: ReferenceMap, a: int, b: int) -> list[Event]:
        """Puts aside the target that has become another."""
        map.state[a] = _QUARANTINED
        return [self._moved(map, a, b), Event("target_quarantined", int(map.id[a]), "it has moved")]

    def _moved(self, map: ReferenceMap, a: int, b: int) -> Event:
        """Tells of a move; no target can be where two have gone."""
        self._arrived.add(int(map.id[b]))
        moved_mm = float(np.linalg.norm(map.xyz_mm[b] - map.xyz_mm[a]))
        detail = f"by {moved_mm:.2f} mm, after frame {map.last_seen[a]}; it is target {map.id[b]} now"
        return Event("target_moved", int(map.id[a]), detail)

    def _merge(self, map: ReferenceMap, pairs: Int[np.ndarray, "m 2"]) -> list[Event]:
        """Makes one of two targets of which often enough one was seen and not the other; the older one stays.

        Pairs that lie apart alike speak for one another: that is how a map looks whose ends have met.
        """
        events: list[Event] = []
        count = self._count
        keys = [_pair(map, a, b) for a, b in pairs.tolist()]
        turns = np.array([self._turns.get(key, 0) for key in keys])
        turns[turns >= 0] += 1
        self._turns.update(zip(keys, turns.tolist(), strict=True))
        older = np.sign(count[pairs[:, 1], FIRST] - count[pairs[:, 0], FIRST])
        apart = (map.xyz_mm[pairs[:, 1]] - map.xyz_mm[pairs[:, 0]]) * older[:, None]
        d_mm = np.linalg.norm(apart, axis=1)
        is_alike = np.linalg.norm(apart[:, None] - apart, axis=2) < _ALIKE * np.maximum(d_mm[:, None], d_mm)
        together = is_alike @ np.maximum(turns, 0)
        for j in np.flatnonzero((turns >= _MIN_TURNS) & (together >= self._options.merged_after)).tolist():
            a, b = pairs[j].tolist()
            if not map.alive[[a, b]].all():
                continue
            del self._turns[keys[j]]
            stays, goes = sorted((a, b), key=lambda row: int(map.id[row]))
            detail = f"into target {map.id[stays]}, {d_mm[j]:.2f} mm away"
            events.append(Event("target_merged", int(map.id[goes]), detail))
            _unite(map, stays, goes, self._options.explained_sigmas)
            self._cells[stays, 0] |= self._cells[goes, 0]
            self._cells[stays, 1] = 0
            count[stays, [HITS, TRIES]] += count[goes, [HITS, TRIES]]
            count[stays, FIRST] = count[[a, b], FIRST].max()  # it is no witness of what was before
            count[stays, LAST], count[stays, MISSED], count[stays, WEIGHED] = self._lessons, 0, 0
            self._bias[stays] = 0.0
        return events

    def _undo_strays(self, map: ReferenceMap, hand: Hand) -> tuple[ReferenceMap, list[Event]]:
        """The map without what the frames taught that were positioned where no hand can have been."""
        found, chi2 = strays(self._journal, hand, self._options.max_p_hand)
        events = []
        for lesson in found:
            self._journal.remove(lesson)
            map = without(map, lesson)
            detail = f"frame {lesson.frame}: no hand moves there and back between the frames around it (χ² {chi2:.0f})"
            events.append(Event("update_undone", None, detail))
        return map, events


def strays(journal: Sequence[Lesson], hand: Hand, max_p: float) -> tuple[list[Lesson], float]:
    """Lessons before the newest from poses that those around them, agreeing with one another, rule out; and the χ².

    The newest pose must follow from the two before the strays at an even pace. The strays must lie off the way between,
    and the leaps out and back be farther than accelerations or turning round carry a hand, each with the root of
    ``max_p``.
    """
    from scipy.special import chdtri

    if len(journal) < 4 or not _leaps(journal, hand):
        return [], 0.0
    agreement, limit = float(chdtri(6, _AGREEMENT)), float(chdtri(6, np.sqrt(max_p)))
    newest = journal[-1]
    for run in range(1, min(_MAX_STRAYS, len(journal) - 3) + 1):
        before, last, between = journal[-run - 3], journal[-run - 2], [journal[k] for k in range(-run - 1, -1)]
        gap_s, step_s = newest.since(last), last.since(before)
        if not (0 < gap_s <= hand.max_gap_s and 0 < step_s <= hand.max_gap_s):
            break
        pace = (before.pose.inverse() @ last.pose).log() / step_s
        if _misfit(last, newest, pace, hand.reach(0.5 * gap_s * (gap_s + step_s))) > agreement:
            continue
        way = (last.pose.inverse() @ newest.pose).log() / gap_s
        turned = np.repeat([np.linalg.norm(pace[:3]), np.linalg.norm(pace[3:])], 3) / _AT_MOST
        off = []
        for each in between:
            s = each.since(last)
            sigma = np.hypot(hand.reach(0.5 * s * (gap_s - s)), turned * min(s, gap_s - s))
            off.append(_misfit(last, each, way, sigma))
        out_s, back_s = between[0].since(last), newest.since(between[-1])
        out = _misfit(last, between[0], pace, np.hypot(hand.reach(0.5 * out_s * (out_s + step_s)), turned * out_s))
        back = _misfit(
            newest, between[-1], way, np.hypot(hand.reach(0.5 * back_s * (back_s + step_s)), turned * back_s)
        )
        if min(off) > agreement and min(out, back) > limit:
            return between, min(out, back)
    return [], 0.0


def _leaps(journal: Sequence[Lesson], hand: Hand) -> bool:
    """Whether the newest pose may lie off the way of the two before it: a first, quick look."""
    a, b, c = journal[-3], journal[-2], journal[-1]
    first_s, second_s = b.since(a), c.since(b)
    if not (first_s > 0 and second_s > 0):
        return False
    leap_mm = (c.pose.t_mm - b.pose.t_mm) - (b.pose.t_mm - a.pose.t_mm) * (second_s / first_s)
    turn_cos = 0.5 * (float(np.vdot(b.pose.R, c.pose.R)) - 1.0)
    reach_s2 = 5.0 * first_s * second_s
    return bool(
        leap_mm @ leap_mm > (reach_s2 * hand.acceleration_mm_s2) ** 2
        or turn_cos < np.cos(min(0.5 * reach_s2 * hand.angular_acceleration_rad_s2, np.pi))
    )


def _misfit(one: Lesson, other: Lesson, pace: Float[np.ndarray, "6"], sigma: Float[np.ndarray, "6"]) -> float:
    """χ² of six degrees of the other pose, had the sensor gone there at a pace, give or take its freedom."""
    there = one.pose @ Pose.exp(pace * other.since(one))
    delta = (there.inverse() @ other.pose).log()
    return float(delta @ np.linalg.solve(one.fix.cov + other.fix.cov + np.diag(sigma**2), delta))


def without(map: ReferenceMap, lesson: Lesson) -> ReferenceMap:
    """The map as if a lesson had not been: exactly so where sightings were filtered, in information form."""
    map = map.copy()
    known = len(lesson.before)
    for k, row in enumerate(lesson.row.tolist()):
        if map.id[row] != lesson.after.id[k] or map.state[row] == _REMOVED:
            continue
        map.sightings[row] -= 1
        if map.sightings[row] <= 0:
            map.state[row] = _REMOVED
            continue
        if (
            k < known
            and lesson.before.state[k] < lesson.after.state[k]
            and map.sightings[row] < lesson.after.sightings[k]
        ):
            map.state[row] = lesson.before.state[k]
        kept = _information(map, row)
        gained = _information(lesson.after, k)
        given = _information(lesson.before, k) if k < known else (np.zeros((3, 3)), np.zeros(3))
        if kept is None or gained is None or given is None:
            continue
        A = kept[0] - gained[0] + given[0]
        if np.linalg.eigvalsh(A)[0] > 0:
            C = np.linalg.inv(A)
            map.xyz_mm[row], map.cov_mm2[row] = C @ (kept[1] - gained[1] + given[1]), 0.5 * (C + C.T)
    return map


def _information(map: ReferenceMap, row: int) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    """C⁻¹ and C⁻¹ x of a target; None for one that is known exactly."""
    C = map.cov_mm2[row]
    if np.linalg.eigvalsh(C)[0] <= 0:
        return None
    A = np.linalg.inv(C)
    return A, A @ map.xyz_mm[row]


def _mahalanobis2(map: ReferenceMap, pairs: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "m"]:
    """Squared distances of pairs of targets in standard deviations."""
    r = map.xyz_mm[pairs[:, 0]] - map.xyz_mm[pairs[:, 1]]
    C = map.cov_mm2[pairs[:, 0]] + map.cov_mm2[pairs[:, 1]] + _EXACT_MM2 * np.eye(3)
    return np.asarray(np.einsum("ni,ni->n", r, np.linalg.solve(C, r[:, :, None])[:, :, 0]))


def _unite(map: ReferenceMap, stays: int, goes: int, explained_sigmas: float) -> None:
    """Puts two rows of a map into the first, by covariance, which grows where it does not explain how they lie."""
    pair = [stays, goes]
    C, x, n = map.cov_mm2[pair], map.xyz_mm[pair], map.sightings[pair]
    total = C[0] + C[1] + _EXACT_MM2 * np.eye(3)
    K, r = C[0] @ np.linalg.inv(total), x[1] - x[0]
    cov = C[0] - K @ C[0]
    if r @ np.linalg.solve(total, r) > explained_sigmas**2:  # anywhere between: half their distance is 1 sigma
        cov = cov + (r @ r) / 4.0 * np.eye(3)
    map.xyz_mm[stays], map.cov_mm2[stays] = x[0] + K @ r, 0.5 * (cov + cov.T)
    view = np.nan_to_num(map.view[pair]).T @ np.maximum(n, 1)
    map.view[stays] = view / max(float(np.linalg.norm(view)), 1e-12)
    map.sightings[stays], map.last_seen[stays] = n.sum(), map.last_seen[pair].max()
    map.state[stays] = map.state[pair].max()
    map.state[goes] = _REMOVED


def _pair(map: ReferenceMap, a: int, b: int) -> tuple[int, int]:
    """The identities of two rows, in order."""
    one, other = int(map.id[a]), int(map.id[b])
    return (one, other) if one < other else (other, one)


def _rescaled(map: ReferenceMap, ratio: float) -> ReferenceMap:
    return replace(map, cov_mm2=map.cov_mm2 * ratio**2)


def _in_state(map: ReferenceMap, rows: Int[np.ndarray, "r"], state: int) -> ReferenceMap:
    states = map.state.copy()
    states[rows] = state
    return replace(map, state=states)
