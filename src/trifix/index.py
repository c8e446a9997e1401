"""The map's index: what lies where, and which targets form a triangle with given sides.

Kept beside the map and updated in step with it, never made anew: a target that comes, goes or moves costs the same
whether the map holds a hundred others or a million. Finds congruent triangles; does not know what they prove.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from trifix.kernels import index as kernels
from trifix.records import ReferenceMap, SensorPoints, TargetState

ANYWHERE_UP_TO = 300
"""Targets of a map in which triangles of any size are worth a search; near ones have to do in larger maps."""

_ALIVE = int(TargetState.trusted)  # states up to this one are indexed
_SAMPLE = 64  # targets from which the spacing is judged
_SPACING_RATIO = 1.5  # a spacing that is off by more is corrected
_STEPS_PER_CELL = 96  # of distance, to one cell of space
_SLACK_CELLS = 1 / 800  # of a cell's width: what a target moves by once it was seen a few times
_FLOAT32_STEP = 2.0**-22  # anchors must not leave their slack by rounding


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """h pairs of congruent triangles, in the order of the frame's triangles."""

    point: Int[np.ndarray, "h 3"]
    """Rows of the points."""
    target: Int[np.ndarray, "h 3"]
    """Rows of the targets that they would be, vertex by vertex."""
    triangle: Int[np.ndarray, "h"]
    """Row of the frame's triangle."""
    tried: int
    """Triangles of the frame that were looked up."""
    expected_by_chance: float
    """Pairs that chance alone would bring, from how many triangles have sides not far from those looked up. True ones
    are among these; that handedness refuses some is left aside."""
    is_cut: bool = False
    """True where the search was given up before its end."""

    def __len__(self) -> int:
        return len(self.point)


class MapIndex:
    """The index of one reference map, empty until it follows one."""

    def __init__(self) -> None:
        self._store = kernels.new_store(0, 0, 1.0, 0.0)
        self._targets = 0
        self._triangles = 0
        self._scaled_for = 0  # targets when the scales and the tables' sizes were chosen
        self._widest_mm2 = 0.0  # no target's covariance has a larger trace
        self._given = 0  # rows looked at since all were
        self._version = 0
        self._evidence: tuple[int, int, float] | None = None  # found at this version, for variances of this octave
        self._pairs: tuple[int, kernels.PairTable] | None = None  # made at this version

    def follow(self, map: ReferenceMap, rows: Int[np.ndarray, "r"] | None = None) -> None:
        """Brings the index up to date with the map; ``rows`` are the only ones that may have changed, if given.

        Once as many were given as there are, all are looked at: the bound on their covariances is renewed.
        """
        self._make_room(len(map))
        store = self._store
        self._given += 0 if rows is None else len(rows)
        if rows is None or self._given > len(map):
            rows = np.arange(len(store.id))
            self._given = 0
            self._widest_mm2 = 0.0
        changed, widest = kernels.changed_rows(store, rows, map.id, map.state, map.xyz_mm, map.cov_mm2, _ALIVE)
        self._widest_mm2 = max(self._widest_mm2, widest)
        if len(changed) == 0:
            return
        self._version += 1
        if 4 * len(changed) > self._targets:
            self._build(map)
            return
        self._targets, self._triangles = kernels.index_rows(
            store, changed, map.id, map.state, map.xyz_mm, _ALIVE, self._targets, self._triangles
        )
        if not self._scaled_for / 4 <= self._targets <= 2 * self._scaled_for:
            self._rescale(map)

    def local(
        self,
        points: SensorPoints,
        map: ReferenceMap,
        frame_triangles: Int[np.ndarray, "t 3"],
        max_sigmas: float,
        tolerance_mm: float,
        limit: int,
    ) -> Candidates:
        """Pairs of the frame's triangles with congruent ones among near neighbours in the map that was followed last.

        Triangles are congruent when their sides agree within ``tolerance_mm`` and ``max_sigmas`` standard deviations,
        and they are not known to be seen from different sides. Every order of vertices in which they do counts. The
        search ends after the triangle at which ``limit`` pairs are reached.
        """
        (point, target, row), tried, by_chance = kernels.match_local(
            self._store,
            frame_triangles,
            points.xyz_mm,
            points.cov_mm2,
            map.xyz_mm,
            map.cov_mm2,
            map.view,
            self._reckoned_mm2(map),
            max_sigmas,
            tolerance_mm,
            limit,
        )
        return Candidates(point, target, row, tried, by_chance)

    def largest_evidence(self, points: SensorPoints, map: ReferenceMap) -> float:
        """ln of the likelihood ratio against chance that one of these points can reach at most, on any target.

        Reached by a point that is exactly at the target that lies most alone.
        """
        variance = kernels.smallest_variance(points.cov_mm2)
        octave = int(np.floor(np.log2(variance))) if np.isfinite(variance) and variance > 0 else 0
        if self._evidence is None or self._evidence[:2] != (self._version, octave):
            self._evidence = self._version, octave, kernels.largest_evidence(self._store, map.xyz_mm, 2.0**octave)
        return self._evidence[2]

    def all_triangles(self) -> Int[np.ndarray, "t 3"]:
        """Rows of the targets of every local triangle."""
        return np.asarray(kernels.all_triangles(self._store))

    def any(
        self,
        points: SensorPoints,
        map: ReferenceMap,
        frame_triangles: Int[np.ndarray, "t 3"],
        max_sigmas: float,
        tolerance_mm: float,
        limit: int,
        max_comparisons: int = 20_000_000,
    ) -> Candidates:
        """The same with any three targets of the map, however far apart; given up after so many comparisons.

        Prefer ``local`` where targets lie close: this one looks at all pairs of targets that are no farther apart than
        the frame's triangles are long, and keeps them until the next change of the index.
        """
        table = self._pairs_within(
            self._longest_mm(points, map, frame_triangles, max_sigmas, tolerance_mm), max_comparisons
        )
        if table is None:
            none = np.zeros((0, 3), dtype=np.int64)
            return Candidates(none, none, none[:, 0], 0, 0.0, is_cut=True)
        (point, target, row), tried, by_chance, is_cut = kernels.match_any(
            self._store,
            table,
            frame_triangles,
            points.xyz_mm,
            points.cov_mm2,
            map.xyz_mm,
            map.cov_mm2,
            map.view,
            self._reckoned_mm2(map),
            max_sigmas,
            tolerance_mm,
            limit,
            max_comparisons,
        )
        return Candidates(point, target, row, tried, by_chance, is_cut)

    @property
    def grid(
        self,
    ) -> tuple[Int32[np.ndarray, "c"], Int32[np.ndarray, "cap"], Float32[np.ndarray, "cap 3"], float, float]:
        """Cells over the targets: first row of each bucket, next row in it, anchors (mm), cell width, slack (mm)."""
        store = self._store
        return store.cell_head, store.cell_next, store.anchor, store.cell_mm, store.slack_mm

    @property
    def neighbour(self) -> Int32[np.ndarray, "cap 8"]:
        """Rows of the eight nearest others of each target within four cells, nearest first; -1 where fewer."""
        return self._store.neighbour

    @property
    def targets(self) -> int:
        """Targets in the index."""
        return self._targets

    @property
    def triangles(self) -> int:
        """Triangles in the index."""
        return self._triangles

    @property
    def bytes(self) -> int:
        """Memory that the index takes, without the pairs that ``any`` keeps for a while."""
        return sum(part.nbytes for part in self._store if isinstance(part, np.ndarray))

    @property
    def version(self) -> int:
        """Grows whenever something is indexed anew."""
        return self._version

    def _reckoned_mm2(self, map: ReferenceMap) -> float:
        """The largest trace of a target's covariance that look-ups reckon with, so that no vague target widens all.

        A target four times as vague as most is found where it agrees as if it were not.
        """
        return min(self._widest_mm2, float(kernels.largest_usual_trace(self._store, map.cov_mm2)))

    def _longest_mm(
        self,
        points: SensorPoints,
        map: ReferenceMap,
        triangles: Int[np.ndarray, "t 3"],
        max_sigmas: float,
        tolerance_mm: float,
    ) -> float:
        """How far apart two targets can be that agree with a side of the frame's triangles."""
        if len(triangles) == 0:
            return 0.0
        corners = points.xyz_mm[triangles]
        longest = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max()
        widest_mm2 = np.trace(points.cov_mm2, axis1=1, axis2=2).max() + self._reckoned_mm2(map)
        return float(longest + tolerance_mm + max_sigmas * np.sqrt(2 * widest_mm2) + 2 * self._store.slack_mm)

    def _pairs_within(self, reach_mm: float, max_comparisons: int) -> kernels.PairTable | None:
        """All pairs of targets up to this distance, None where there are too many to compare."""
        store = self._store
        step_mm = store.cell_mm / _STEPS_PER_CELL
        rows = np.flatnonzero(store.id >= 0)
        size_mm = np.ptp(store.anchor[rows], axis=0) if len(rows) else np.zeros(3)
        steps = int(min(reach_mm, float(np.linalg.norm(size_mm))) / step_mm) + 2  # no two are farther apart
        if self._pairs and self._pairs[0] == self._version and len(self._pairs[1].start) > steps:
            return self._pairs[1]
        self._pairs = None
        axis = int(np.argmax(size_mm))
        rows = rows[np.argsort(store.anchor[rows, axis], kind="stable")]
        start, compared = kernels.count_pairs(store.anchor, rows, axis, steps, step_mm, max_comparisons)
        if compared > max_comparisons:
            return None
        self._pairs = self._version, kernels.list_pairs(store.anchor, rows, axis, start, step_mm)
        return self._pairs[1]

    def _make_room(self, rows: int) -> None:
        cap = len(self._store.id)
        if rows <= cap:
            return
        store = self._store
        grown = kernels.new_store(max(rows, cap + cap // 2), 0, store.cell_mm, store.slack_mm)
        for old, new in zip(store[:5], grown[:5], strict=True):  # what has an entry or several a row
            new[: len(old)] = old
        self._store = grown._replace(cell_head=store.cell_head, side_head=store.side_head, side_mm=store.side_mm)

    def _build(self, map: ReferenceMap) -> None:
        """Indexes everything anew, on scales that suit the map."""
        alive = np.flatnonzero(map.alive)
        cell_mm = _spacing_mm(map.xyz_mm, alive)
        if self._scaled_for and self._suits(cell_mm):
            cell_mm = self._store.cell_mm  # what is found depends on the map, and as little as can be on its past
        rounding_mm = _FLOAT32_STEP * float(np.abs(map.xyz_mm[alive]).max(initial=0.0))
        slack_mm = max(cell_mm * _SLACK_CELLS, rounding_mm)
        self._store = kernels.new_store(len(self._store.id), len(alive), cell_mm, slack_mm)
        self._scaled_for = len(alive)
        self._targets, self._triangles = kernels.index_rows(
            self._store, alive, map.id, map.state, map.xyz_mm, _ALIVE, 0, 0
        )

    def _suits(self, spacing_mm: float) -> bool:
        """Whether the cells are about as wide as the targets are apart."""
        return 1 / _SPACING_RATIO < spacing_mm / self._store.cell_mm < _SPACING_RATIO

    def _rescale(self, map: ReferenceMap) -> None:
        """Resizes the tables to the number of targets, and the cells where these have come to lie otherwise."""
        spacing_mm = _spacing_mm(map.xyz_mm, np.flatnonzero(map.alive))
        if not self._suits(spacing_mm):
            self._build(map)
            return
        self._scaled_for = self._targets
        self._store = kernels.with_empty_tables(self._store, self._targets)
        kernels.link_all(self._store)


def frame_triangles(
    xyz_mm: Float[np.ndarray, "n 3"], cov_mm2: Float[np.ndarray, "n 3 3"], neighbours: int = kernels.NEIGHBOURS
) -> Int[np.ndarray, "t 3"]:
    """A frame's triangles of the kind that the index holds, among so many nearest neighbours, most promising first.

    Promising are those of the nearest neighbours, as these are neighbours in the map, too, whatever else the frame
    sees or misses; among them, those whose sides are well known for their length. All points take turns, so that one
    which is no target spoils no more than its share of any stretch.
    """
    triangles, place = kernels.frame_triangles(xyz_mm, cov_mm2, neighbours)
    triangles = triangles[np.argsort(place, kind="stable")]
    return np.asarray(triangles[np.argsort(kernels.turns(triangles, len(xyz_mm)), kind="stable")])


def _spacing_mm(xyz_mm: Float[np.ndarray, "k 3"], rows: Int[np.ndarray, "a"]) -> float:
    """The typical distance from a target to the third nearest; that of all where there are fewer."""
    if len(rows) < 4:
        apart = np.ptp(xyz_mm[rows], axis=0) if len(rows) else np.zeros(3)
        return float(np.linalg.norm(apart)) or 1.0
    every = -(-len(rows) // _SAMPLE)
    return max(float(np.median(kernels.distances_to_third(xyz_mm, rows, every))), 1e-3)
