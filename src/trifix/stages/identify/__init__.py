"""Points x reference map -> hypotheses of which point is which target, likeliest first (the paper's part P7).

One file a technique. A technique keeps whatever it needs of the map's past (pair counts, an index) beside the map and
is told of every change. Hypotheses are not answers: verification decides. Only closest points ask where the sensor was.
"""

from collections.abc import Iterator
from typing import Protocol, assert_never, runtime_checkable

import numpy as np
from jaxtyping import Int

from trifix.geometry.pose import Pose
from trifix.index import MapIndex
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.congruence import IdentifyOptions
from trifix.stages.identify.delaunay import DelaunayTriangles
from trifix.stages.identify.distances import Distances
from trifix.stages.identify.frequency import FrequencyTriangles
from trifix.stages.identify.hashing import HashedTriangles
from trifix.stages.identify.icp import ClosestPoints
from trifix.stages.identify.index import IndexedTriangles, any_triangles, pairs_as_predicted
from trifix.stages.identify.minimal import MinimalTriangles
from trifix.stages.identify.triangles import AllTriangles

__all__ = [
    "AS_PREDICTED",
    "AllTriangles",
    "ClosestPoints",
    "DelaunayTriangles",
    "Distances",
    "FrequencyTriangles",
    "HashedTriangles",
    "Identifier",
    "IdentifyOptions",
    "IndexedTriangles",
    "MinimalTriangles",
    "any_triangles",
    "identifier",
    "pairs_as_predicted",
]


AS_PREDICTED = Identification(np.zeros((1, 0), dtype=np.int64), np.zeros((1, 0), dtype=np.int64), 0, 1.0)
"""The hypothesis that names no pair: the sensor is where its motion leads."""


@runtime_checkable
class Identifier(Protocol):
    """A technique with its memory."""

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Hypotheses in portions, likeliest first; the later ones are worked out only if asked for.

        ``prediction`` is the ``T_world_sensor`` of the last fix, None before there was one.
        """
        ...

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Takes note of the map as it is now, after a frame in which the targets ``seen`` (rows) were seen."""
        ...

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """The map's triangles that frames are compared with (rows of targets), none where none are formed."""
        ...

    @property
    def size(self) -> int:
        """Triangles or distances of the map that frames are compared with."""
        ...


def identifier(options: IdentifyOptions, index: MapIndex | None = None) -> Identifier:
    """The technique that the options name, with an empty memory; ``index`` is that of the map, kept by its owner."""
    match options.technique:
        case "index":
            return IndexedTriangles(options, index)
        case "icp":
            return ClosestPoints(options)
        case "distances":
            return Distances(options)
        case "triangles":
            return AllTriangles(options)
        case "delaunay":
            return DelaunayTriangles(options)
        case "minimal":
            return MinimalTriangles(options)
        case "frequency":
            return FrequencyTriangles(options)
        case "hashing":
            return HashedTriangles(options)
        case _:
            assert_never(options.technique)
