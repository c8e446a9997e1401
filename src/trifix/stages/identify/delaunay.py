"""Delaunay triangles (the paper's technique M4): the outer facets of the Delaunay tetrahedra, in frame and map.

Facets shared by two tetrahedra are internal and removed. What remains is the convex surface of the scatter: points
inside it stand in no triangle, and on planes the noise decides which points are outside. All is computed anew when a
target is added or has moved. Qhull finds the tetrahedra (Barber, Dobkin, Huhdanpaa 1996).
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.changes import Moved
from trifix.stages.identify.congruence import NO_TRIANGLES, IdentifyOptions, congruent_triangles


class DelaunayTriangles:
    """The outer triangles of the map."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._moved = Moved()
        self._triangles = NO_TRIANGLES

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Pairs of congruent triangles, in no order."""
        return congruent_triangles(points, map, outer_triangles(points.xyz_mm), self._triangles, self._options)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Computes the triangles anew if the map has changed."""
        if self._moved.since_last(map).any():
            alive = np.flatnonzero(map.alive)
            self._triangles = np.asarray(alive[outer_triangles(map.xyz_mm[alive])])

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """The outer triangles."""
        return self._triangles

    @property
    def size(self) -> int:
        """Their number."""
        return len(self._triangles)


def outer_triangles(xyz_mm: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "t 3"]:
    """Facets of the Delaunay tetrahedra that belong to one tetrahedron only; no triangle of points on one line.

    Points in one plane have no tetrahedra; their Delaunay triangles in that plane are all outer.
    """
    if len(xyz_mm) < 3:
        return NO_TRIANGLES
    from scipy.spatial import Delaunay, QhullError

    centred = xyz_mm - xyz_mm.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    flat = 1e-9 * spread[0]
    if spread[1] <= flat:
        return NO_TRIANGLES
    if len(xyz_mm) > 3 and spread[2] > flat:
        try:
            delaunay = Delaunay(centred)
        except QhullError:
            pass  # flat within Qhull's own precision
        else:
            tetrahedron, opposite = np.nonzero(delaunay.neighbors == -1)
            facets = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[opposite]
            return np.asarray(np.take_along_axis(delaunay.simplices[tetrahedron], facets, axis=1), dtype=np.int64)
    try:
        return np.asarray(Delaunay(centred @ axes[:2].T).simplices, dtype=np.int64)
    except QhullError:
        return NO_TRIANGLES
