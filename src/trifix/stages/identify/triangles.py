"""All triangles (the paper's technique M3): those of the frame against those of the map, without choosing.

T(N) = N (N − 1)(N − 2) / 6 grows fast. Up to 60 targets (34 220 triangles) all are formed; of a larger map, those of
each target with two of its 24 nearest. Prefer it where the map is small and a frame may see any part of it.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.changes import Moved
from trifix.stages.identify.congruence import (
    NO_TRIANGLES,
    IdentifyOptions,
    all_frame_triangles,
    congruent_triangles,
    triangles_among_nearest,
)

_ALL_UP_TO = 60
_NEIGHBOURS = 24


class AllTriangles:
    """Every triangle of the map, or of its neighbourhoods."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._moved = Moved()
        self._triangles = NO_TRIANGLES

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Pairs of congruent triangles, in no order."""
        return congruent_triangles(
            points, map, all_frame_triangles(points, self._options), self._triangles, self._options
        )

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Forms the triangles anew if the map has changed."""
        if self._moved.since_last(map).any():
            self._triangles = map_triangles(map)

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """All triangles, or beyond 60 targets those of the neighbourhoods."""
        return self._triangles

    @property
    def size(self) -> int:
        """Their number."""
        return len(self._triangles)


def map_triangles(map: ReferenceMap) -> Int[np.ndarray, "t 3"]:
    """All triangles up to 60 targets; beyond, those of each target with two of its 24 nearest."""
    alive = np.flatnonzero(map.alive)
    k = len(alive) - 1 if len(alive) <= _ALL_UP_TO else _NEIGHBOURS
    return np.asarray(alive[triangles_among_nearest(map.xyz_mm[alive], k)])
