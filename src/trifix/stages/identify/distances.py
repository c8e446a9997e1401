"""Distances (the paper's technique M2): every distance of the frame against every distance of the map.

Similar distances vote for pairs of point and target. Votes contradict one another; what agrees with least of the
others is given up until what remains agrees throughout: one set of pairs. Prefer it to triangles never; it is what they
are measured against.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.geometry.pose import Pose
from trifix.kernels import matching
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.congruence import NO_TRIANGLES, IdentifyOptions, widest_triangles

_CANDIDATES = 200  # pairs to reconcile, those with most votes


class Distances:
    """Holds nothing but the number of targets: distances are compared as they are computed."""

    def __init__(self, options: IdentifyOptions) -> None:
        self._options = options
        self._targets = 0

    def identify(
        self, points: SensorPoints, map: ReferenceMap, prediction: Pose | None = None
    ) -> Iterator[Identification]:
        """The widest triangles of the pairs that agree, if three do; comparisons are D(M) · D(N)."""
        alive = np.flatnonzero(map.alive)
        n = len(points)
        axis = int(np.argmax(np.ptp(map.xyz_mm[alive], axis=0))) if len(alive) else 0
        rows = alive[np.argsort(map.xyz_mm[alive, axis], kind="stable")]
        pair = np.stack(np.triu_indices(n, 1), axis=1)
        length, var = _lengths(points.xyz_mm, points.cov_mm2, pair)
        by_length = np.argsort(length, kind="stable")
        votes = matching.vote(
            pair[by_length],
            length[by_length],
            var[by_length],
            n,
            map.xyz_mm[rows],
            map.cov_mm2[rows],
            axis,
            self._options.max_sigmas,
            self._options.tolerance_mm,
        )
        # a true pair has a vote from each of the other pairs, of which there must be two
        strongest = np.argsort(-votes, axis=None, kind="stable")[:_CANDIDATES]
        strongest = strongest[votes.ravel()[strongest] >= 2]
        point, target = strongest // max(len(rows), 1), rows[strongest % max(len(rows), 1)]
        kept = _reconciled(self._agreement(points, map, point, target))
        point, target = point[kept], target[kept]
        comparisons = len(pair) * len(rows) * (len(rows) - 1) // 2
        yield widest_triangles(points, point, target, comparisons)

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Counts the targets."""
        self._targets = int(map.alive.sum())

    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """None."""
        return NO_TRIANGLES

    @property
    def size(self) -> int:
        """D(N) = N (N − 1) / 2 distances."""
        return self._targets * (self._targets - 1) // 2

    def _agreement(
        self, points: SensorPoints, map: ReferenceMap, point: Int[np.ndarray, "c"], target: Int[np.ndarray, "c"]
    ) -> Bool[np.ndarray, "c c"]:
        """Which candidates can be true together: other points, other targets, the same distance between them."""
        i, j = np.triu_indices(len(point), 1)
        length, var = _lengths(points.xyz_mm, points.cov_mm2, np.stack([point[i], point[j]], axis=1))
        map_length, map_var = _lengths(map.xyz_mm, map.cov_mm2, np.stack([target[i], target[j]], axis=1))
        tolerance = self._options.tolerance_mm + self._options.max_sigmas * np.sqrt(var + map_var)
        agree = np.zeros((len(point), len(point)), dtype=np.bool_)
        agree[i, j] = (np.abs(length - map_length) <= tolerance) & (point[i] != point[j]) & (target[i] != target[j])
        return np.asarray(agree | agree.T)


def _reconciled(agree: Bool[np.ndarray, "c c"]) -> Int[np.ndarray, "r"]:
    """Candidates that all agree: the one that agrees with fewest others goes, weakest first, until none contradicts."""
    support = agree.sum(axis=1)
    is_kept = np.ones(len(agree), dtype=np.bool_)
    for left in range(len(agree), 0, -1):
        fewest = support[is_kept].min()
        if fewest == left - 1:
            break
        weakest = np.flatnonzero(is_kept & (support == fewest))[-1]  # candidates come strongest first
        is_kept[weakest] = False
        support -= agree[weakest]
    return np.flatnonzero(is_kept)


def _lengths(
    xyz_mm: Float[np.ndarray, "n 3"], cov_mm2: Float[np.ndarray, "n 3 3"], pair: Int[np.ndarray, "d 2"]
) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d"]]:
    """Distances between pairs of points and their variances."""
    a, b = pair.T
    v = xyz_mm[b] - xyz_mm[a]
    length = np.linalg.norm(v, axis=1)
    u = v / np.maximum(length, 1e-12)[:, None]
    return length, np.einsum("di,dij,dj->d", u, cov_mm2[a] + cov_mm2[b], u)
