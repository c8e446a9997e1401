"""Frequency triangles (the paper's technique M6): in the map, each target with the three it was seen with most often.

Targets often seen together will be seen together again. In the frame, which has no past, all triangles are formed up
to forty points, local ones beyond.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.kernels import positioning as kernels
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.congruence import IdentifyOptions, congruent_triangles


class FrequencyTriangles:
    """Counts of pairs seen in the same frame, and the triangles that follow from them."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._id = np.full(0, -1)  # (k) identity under which each row has been counted, -1 for none
        self._head = np.full(0, -1)  # (k) first half-edge of each target
        self._best = np.full((0, 3), -1)  # (k, 3) the three targets seen most often with each
        # half-edges: the other target, the count, the distance at the first common sighting, the next half-edge
        self._other = np.zeros(0, dtype=np.int64)
        self._count = np.zeros(0, dtype=np.int64)
        self._distance_mm = np.zeros(0)
        self._following = np.zeros(0, dtype=np.int64)
        self._free, self._n_free = -1, 0

    def identify(self, points: SensorPoints, map: ReferenceMap) -> Iterator[Identification]:
        """Pairs of congruent triangles, those of targets most often seen together first."""
        triangles = self.triangles()
        rarest = kernels.rarest_pairs(triangles, self._head, self._other, self._count, self._following)
        return congruent_triangles(points, map, triangles, rarest, self._options)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Counts every pair of ``seen`` once and forgets targets that have left the map."""
        new_rows = len(map) - len(self._id)
        self._id = np.pad(self._id, (0, new_rows), constant_values=-1)
        self._head = np.pad(self._head, (0, new_rows), constant_values=-1)
        self._best = np.pad(self._best, ((0, new_rows), (0, 0)), constant_values=-1)
        is_gone = (self._id >= 0) & ((self._id != map.id) | ~map.alive)
        if is_gone.any():
            self._free, freed = kernels.forget_targets(is_gone, *self._edges(), self._free, self._best)
            self._n_free += freed
            self._id[is_gone] = -1
        self._reserve(len(seen) * (len(seen) - 1))
        self._free, taken = kernels.count_pairs(
            seen.astype(np.int64), map.xyz_mm, *self._edges(), self._free, self._best
        )
        self._n_free -= taken
        self._id[seen] = map.id[seen]
        self._join_uncounted(map)

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """(p, a, b), (p, a, c) and (p, b, c) of every target p and its three partners, each triangle once."""
        p = np.arange(len(self._best))
        a, b, c = self._best.T
        table = np.concatenate([np.stack(x, axis=1) for x in ((p, a, b), (p, a, c), (p, b, c))])
        return np.unique(np.sort(table[(table >= 0).all(axis=1)], axis=1), axis=0)

    def _join_uncounted(self, map: ReferenceMap) -> None:
        """Joins targets that were given, and never seen yet, with their nearest ones: all counts are equal, at zero."""
        uncounted = np.flatnonzero((self._head < 0) & map.alive & (self._best[:, 0] < 0))
        alive = np.flatnonzero(map.alive)
        if len(uncounted) == 0 or len(alive) < 4:
            return
        from scipy.spatial import cKDTree

        _, nearest = cKDTree(map.xyz_mm[alive]).query(map.xyz_mm[uncounted], k=4)
        self._best[uncounted] = alive[nearest[:, 1:]]

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
