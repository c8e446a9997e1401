"""Closest points (the paper's technique M1; Besl and McKay 1992): each point is the target nearest to where the last
pose puts it.

Pairs and pose are found in turn until the pairs stay the same. It can only follow: without a last pose there is no
candidate, and a sensor that has moved farther than half the distance between targets is lost to it.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.alignment import align, spread_off_line_mm
from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.congruence import NO_TRIANGLES, IdentifyOptions, widest_triangles

_ITERATIONS = 50
_SCALES = 4.0  # pairs farther apart than this many times the median are left out of the next pose
_MIN_SCALE_MM = 0.2
_MIN_SPREAD_MM = 1e-3  # across the line that fits best; less determines no pose


class ClosestPoints:
    """Holds nothing: all it needs is the last pose."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """The widest triangles of the pairs, if three points have a target nearby; a comparison is a nearest sought."""
        alive = np.flatnonzero(map.alive)
        if prediction is None or len(alive) < 3 or len(points) < 3:
            return
        from scipy.spatial import cKDTree

        tree = cKDTree(map.xyz_mm[alive])
        T, reach_mm = prediction, self._options.max_step_mm
        pairs = np.zeros((2, 0), dtype=np.int64)
        comparisons = 0
        for _ in range(_ITERATIONS):
            comparisons += len(points)
            distance, nearest = tree.query(T.apply(points.xyz_mm))
            # of two points with the same target the nearer one keeps it
            by_distance = np.argsort(distance, kind="stable")
            _, first = np.unique(nearest[by_distance], return_index=True)
            point = by_distance[first]
            point = np.sort(point[distance[point] <= reach_mm])
            before, pairs = pairs, np.stack([point, alive[nearest[point]]])
            if len(point) < 3 or spread_off_line_mm(points.xyz_mm[point]) <= _MIN_SPREAD_MM:
                return
            if np.array_equal(pairs, before):
                break
            # Geman and McClure's weights: points whose target is not in the map must not drag the others along
            scale_mm = max(float(np.median(distance[point])), _MIN_SCALE_MM)
            weight = 1 / (1 + (distance[point] / scale_mm) ** 2) ** 2
            T = align(points.xyz_mm[pairs[0]], map.xyz_mm[pairs[1]], weight)
            reach_mm = min(reach_mm, _SCALES * scale_mm)
        yield widest_triangles(points, pairs[0], pairs[1], comparisons)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Needs no note."""

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """None."""
        return NO_TRIANGLES

    @property
    def size(self) -> int:
        """Nothing is kept."""
        return 0
