"""Geometric hashing (the paper's technique M7): all triangles of the map in a hash table by their three sides.

A triangle of the frame is compared only with those whose sides fall into the same cells. The table must be built anew
whenever the list changes, for which the paper set the technique aside. All triangles up to 60 targets, a sample beyond:
those of each target with two of its 24 nearest. Prefer it where a map is given and stays as it is.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.pose import Pose
from trifix.kernels import matching
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.changes import Moved
from trifix.stages.identify.congruence import (
    FORMED_AT_MOST,
    NO_TRIANGLES,
    IdentifyOptions,
    all_frame_triangles,
    describe_frame,
    describe_map,
    expected_by_chance,
)
from trifix.stages.identify.triangles import map_triangles


class HashedTriangles:
    """Every triangle of the map, found by its sides."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._moved = Moved()
        self._triangles = NO_TRIANGLES
        self._described = describe_map(ReferenceMap.empty(), NO_TRIANGLES)
        self._cell_mm = 1.0
        self._table = matching.hash_sides(self._described[1], self._cell_mm)

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Pairs of congruent triangles in one portion, in no order; the comparisons are those really made."""
        frame = describe_frame(points, all_frame_triangles(points, self._options))
        point, target, _, comparisons = matching.match_hashed(
            *frame,
            *self._described,
            *self._table,
            self._cell_mm,
            self._options.max_sigmas,
            self._options.tolerance_mm,
            FORMED_AT_MOST,
        )
        kept = slice(self._options.max_hypotheses)
        chance = expected_by_chance(frame[1:3], self._described[1:3], self._options)
        yield Identification(point[kept], target[kept], int(comparisons), chance)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Builds the table anew if the map has changed."""
        if not self._moved.since_last(map).any():
            return
        self._triangles = map_triangles(map)
        self._described = describe_map(map, self._triangles)
        _, side, var, _ = self._described
        if len(side) == 0:
            return
        # Cells as wide as the tolerance among targets; what a frame adds to it makes a look-up visit some cells more.
        tolerance_mm = self._options.tolerance_mm + self._options.max_sigmas * float(np.sqrt(2 * np.median(var)))
        self._cell_mm = max(2 * tolerance_mm, 0.01 * float(side.max()))
        self._table = matching.hash_sides(side, self._cell_mm)

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """The triangles in the table."""
        return self._triangles

    @property
    def size(self) -> int:
        """Their number."""
        return len(self._triangles)
