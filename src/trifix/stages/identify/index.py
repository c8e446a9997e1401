"""Local triangles from the map's index: the default technique.

Each target forms triangles with its eight nearest; the index finds those with given sides among a million in less time
than it takes to tell. It is kept in step with the map, never built anew. The paper's frequencies live on in the order
of trial: of the triangles that agree, those whose targets were seen most often come first.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.alignment import point_jacobian
from trifix.geometry.pose import Pose
from trifix.index import ANYWHERE_UP_TO, MapIndex, frame_triangles
from trifix.kernels.positioning import covering_triples
from trifix.records import Identification, Prediction, ReferenceMap, SensorPoints
from trifix.stages.identify.congruence import IdentifyOptions

_NEIGHBOURS = (6, 12)  # of a point, with pairs of which it forms triangles: the map's eight, fewer first, then more
_SPARSE_UP_TO = 40  # points; a frame of more has near ones
_ALL_UP_TO = 12  # points of which all triangles are sought, in case that few and the motion prove a pose
_FIRST_PORTION = 16  # pairs of triangles; eight times as many in each that follows


class IndexedTriangles:
    """Looks up the frame's local triangles in the index of the map."""

    def __init__(self, options: IdentifyOptions, index: MapIndex | None) -> None:
        self._options = options
        self._index = index or MapIndex()
        self._follows = index is None

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """Pairs of congruent triangles: a few first, which mostly is enough, then more and more."""
        options, portion = self._options, _FIRST_PORTION
        for neighbours in _NEIGHBOURS:
            triangles = frame_triangles(points.xyz_mm, points.cov_mm2, neighbours)
            while len(triangles):
                found = self._index.local(points, map, triangles, options.max_sigmas, options.tolerance_mm, portion)
                triangles, portion = triangles[found.tried :], min(8 * portion, options.max_hypotheses)
                often = map.sightings[found.target].min(axis=1)
                likeliest = np.argsort(-often, kind="stable")
                chance = found.expected_by_chance
                yield Identification(
                    found.point[likeliest], found.target[likeliest], found.tried, chance, options.max_sigmas
                )

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Brings the index up to date, where it is nobody else's."""
        if self._follows:
            self._index.follow(map)

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """The triangles in the index."""
        return self._index.all_triangles()

    @property
    def size(self) -> int:
        """Their number."""
        return self._index.triangles


def any_triangles(
    points: SensorPoints, map: ReferenceMap, index: MapIndex, needed: int, options: IdentifyOptions
) -> Iterator[Identification]:
    """Pairs of congruent triangles however far apart their targets are, when near ones have found nothing.

    None in maps that are too large for it. Only triangles of which every pose that explains ``needed`` points must
    contain one: fewer would prove nothing.
    """
    if index.targets > ANYWHERE_UP_TO or len(points) > _SPARSE_UP_TO:
        return
    triples = covering_triples(points.xyz_mm, 3 if len(points) <= _ALL_UP_TO else needed)
    portion = options.max_hypotheses
    while len(triples):
        found = index.any(
            points, map, triples, options.max_sigmas, options.tolerance_mm, portion, options.max_comparisons
        )
        yield Identification(found.point, found.target, found.tried, found.expected_by_chance, options.max_sigmas)
        triples = triples[found.tried :]
        if found.is_cut:
            return


def pairs_as_predicted(
    points: SensorPoints, map: ReferenceMap, prediction: Prediction, max_sigmas: float
) -> Identification:
    """Every point with every target near which the motion leads it, one pair a hypothesis.

    For frames of fewer points than a triangle needs, where the prediction alone leaves open which target is which.
    """
    T, alive = prediction.T_world_sensor, np.flatnonzero(map.alive)
    J = point_jacobian(points.xyz_mm)
    C = T.R @ (points.cov_mm2 + J @ prediction.cov @ np.swapaxes(J, 1, 2)) @ T.R.T
    r = map.xyz_mm[alive] - T.apply(points.xyz_mm)[:, None]
    d2 = np.einsum("nki,nki->nk", r, np.linalg.solve(C[:, None] + map.cov_mm2[alive], r[..., None])[..., 0])
    point, target = np.nonzero(d2 <= max_sigmas**2)
    return Identification(point[:, None], alive[target][:, None], len(points) * len(alive), float(len(point)))
