"""Frequency triangles (the paper's technique M6): in the map, each target with the three it was seen with most often.

Targets often seen together will be seen together again. Of a target p and its three partners a, b, c the triangles
are (p, a, b), (p, a, c), (p, b, c); only those that a newly counted pair changes are formed anew. In the frame, which
has no past, all triangles are formed up to forty points, local ones beyond.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.pose import Pose
from trifix.kernels import matching
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.changes import Moved, NearestThree, TriangleSet
from trifix.stages.identify.congruence import IdentifyOptions, all_frame_triangles, congruent_triangles

_THREE = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3]])  # of (p, a, b, c)


class FrequencyTriangles:
    """Counts of pairs seen in the same frame, and the triangles that follow from them."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._id = np.full(0, -1)  # (k) identity under which each row has been counted or joined, -1 for none
        self._head = np.full(0, -1)  # (k) first half-edge of each target
        self._best = np.full((0, 3), -1)  # (k, 3) the three targets seen most often with each
        self._formed = np.full((0, 3), -1)  # (k, 3) the same when the triangles were last formed
        # half-edges: the other target, the count, the distance at the first common sighting, the next half-edge
        self._other = np.zeros(0, dtype=np.int64)
        self._count = np.zeros(0, dtype=np.int64)
        self._distance_mm = np.zeros(0)
        self._following = np.zeros(0, dtype=np.int64)
        self._free, self._n_free = -1, 0
        self._moved = Moved()
        self._nearest = NearestThree()
        self._triangles = TriangleSet()
        self._rarest = np.zeros(0, dtype=np.int64)  # of each triangle, the count of its rarest pair

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Pairs of congruent triangles, those of targets most often seen together first."""
        frame = all_frame_triangles(points, self._options)
        return congruent_triangles(points, map, frame, self.triangles(), self._options, self._rarest)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Counts every pair of ``seen`` once, forgets targets that have left the map, and forms what that changes."""
        new_rows = len(map) - len(self._id)
        self._id = np.pad(self._id, (0, new_rows), constant_values=-1)
        self._head = np.pad(self._head, (0, new_rows), constant_values=-1)
        self._best = np.pad(self._best, ((0, new_rows), (0, 0)), constant_values=-1)
        self._formed = np.pad(self._formed, ((0, new_rows), (0, 0)), constant_values=-1)
        is_gone = (self._id >= 0) & ((self._id != map.id) | ~map.alive)
        if is_gone.any():
            self._free, freed = matching.forget_targets(is_gone, self._id, *self._edges(), self._free, self._best)
            self._n_free += freed
            self._id[is_gone] = -1
            self._best[is_gone] = -1
        self._id[map.alive] = map.id[map.alive]
        self._reserve(len(seen) * (len(seen) - 1))
        self._free, taken = matching.count_pairs(
            seen.astype(np.int64), map.xyz_mm, self._id, *self._edges(), self._free, self._best
        )
        self._n_free -= taken
        self._join_uncounted(map)
        self._form_changed(seen)

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """(p, a, b), (p, a, c) and (p, b, c) of every target p and its three partners, each triangle once."""
        return self._triangles.table

    @property
    def size(self) -> int:
        """Their number."""
        return len(self._triangles)

    def _join_uncounted(self, map: ReferenceMap) -> None:
        """Joins targets that were given, and never seen yet, with their nearest ones: all counts are equal, at zero."""
        is_uncounted = (self._head < 0) & map.alive
        if is_uncounted.any():
            self._nearest.renew(map, self._moved.since_last(map))
            self._best[is_uncounted] = self._nearest.row[is_uncounted]

    def _form_changed(self, seen: Int[np.ndarray, "s"]) -> None:
        """Forms the triangles of targets whose partners changed, and ranks those whose pairs were counted."""
        rows = np.flatnonzero((self._best != self._formed).any(axis=1))
        new_slots = self._triangles.replace(_triangles(rows, self._formed[rows]), _triangles(rows, self._best[rows]))
        self._formed[rows] = self._best[rows]
        table = self._triangles.table
        self._rarest = np.pad(self._rarest[: len(table)], (0, max(len(table) - len(self._rarest), 0)))
        is_seen = np.zeros(len(self._id), dtype=np.bool_)
        is_seen[seen] = True
        is_due = is_seen[table].sum(axis=1) >= 2
        is_due[new_slots] = True
        self._rarest[is_due] = matching.rarest_pairs(
            table[is_due], self._head, self._other, self._count, self._following
        )

    def _edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self._head, self._other, self._count, self._distance_mm, self._following

    def _reserve(self, need: int) -> None:
        """Makes room for ``need`` more half-edges, doubling the store."""
        if self._n_free >= need:
            return
        used = len(self._other)
        more = max(need, used, 1024)
        chain = np.arange(used + 1, used + more + 1)  # each new half-edge leads to the next, the last to the old ones
        chain[-1] = self._free
        self._other = np.pad(self._other, (0, more))
        self._count = np.pad(self._count, (0, more))
        self._distance_mm = np.pad(self._distance_mm, (0, more))
        self._following = np.concatenate([self._following, chain])
        self._free, self._n_free = used, self._n_free + more


def _triangles(rows: Int[np.ndarray, "r"], partners: Int[np.ndarray, "r 3"]) -> Int[np.ndarray, "t 3"]:
    return np.concatenate([rows[:, None], partners], axis=1)[:, _THREE].reshape(-1, 3)
