"""Minimal triangles (the paper's technique M5): each point with its nearest and with those nearest to these.

With n1, n2 the nearest of p, and ni1, ni2 the nearest of ni other than p, the triangles are (p, ni, nij): four a point,
small, so that a frame is likely to hold them. Formed in the frame as in the map. When targets change, only the
triangles that rest on them are formed anew. Prefer it where pair counts cannot be trusted.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.changes import Moved, NearestThree, TriangleSet
from trifix.stages.identify.congruence import IdentifyOptions, congruent_triangles


class MinimalTriangles:
    """The minimal triangles of the map."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._moved = Moved()
        self._nearest = NearestThree()
        self._of_target = np.full((0, 4, 3), -1)
        self._triangles = TriangleSet()

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Pairs of congruent triangles, in no order."""
        frame = MinimalTriangles(self._options)
        frame.learn(ReferenceMap.given(points.xyz_mm), np.arange(len(points)))
        return congruent_triangles(points, map, frame.triangles(), self.triangles(), self._options)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Forms the triangles of the targets that changed, and of those that they are or were near to."""
        is_renewed = self._nearest.renew(map, self._moved.since_last(map))
        nearest = self._nearest.row
        self._of_target = np.pad(
            self._of_target, ((0, len(map) - len(self._of_target)), (0, 0), (0, 0)), constant_values=-1
        )
        # the triangles of p rest on the neighbours of p and on those of its first two
        first_two = nearest[:, :2]
        rows = np.flatnonzero(is_renewed | (is_renewed[first_two] & (first_two >= 0)).any(axis=1))
        formed = minimal_triangles(nearest, rows)
        self._triangles.replace(self._of_target[rows].reshape(-1, 3), formed.reshape(-1, 3))
        self._of_target[rows] = formed

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """The minimal triangles, each once."""
        return self._triangles.table

    @property
    def size(self) -> int:
        """Their number."""
        return len(self._triangles)


def minimal_triangles(nearest: Int[np.ndarray, "k 3"], rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "r 4 3"]:
    """(p, ni, nij) of each of some points p; -1 where a neighbour is missing."""
    out = np.full((len(rows), 4, 3), -1)
    for i in range(2):
        n = nearest[rows, i]
        # the two nearest of n other than p: its first two, or without p among them one further
        others = nearest[n]
        before_p = np.cumsum(others == rows[:, None], axis=1) == 0
        for j in range(2):
            nij = np.where(before_p[:, j], others[:, j], others[:, j + 1])
            is_whole = (n >= 0) & (nij >= 0)
            out[is_whole, 2 * i + j] = np.stack([rows, n, nij], axis=1)[is_whole]
    return out
