"""What the triangle techniques share: options, triangles of the frame, congruence (Khoury 2006, section 3)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Int

from trifix.errors import ConfigError
from trifix.kernels import positioning as kernels
from trifix.records import Identification, ReferenceMap, SensorPoints

Technique = Literal["frequency"]
FrameTriangles = Literal["auto", "all", "local"]


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """Which technique, and when two triangles are congruent."""

    technique: Technique = "frequency"
    """frequency: the map's triangles of targets most often seen together (Khoury 2006)."""
    frame_triangles: FrameTriangles = "auto"
    """Triangles formed in the frame: all of them, those among near neighbours (local), or all up to 40 points."""
    neighbours: int = 14
    """Local triangles join each point with pairs of this many nearest ones."""
    max_sigmas: float = 3.0
    """Sides agree within this many standard deviations of their difference."""
    tolerance_mm: float = 0.0
    """Added to the tolerance of every side (mm)."""
    max_hypotheses: int = 10_000
    """Hypotheses to try at most of each thousand triangles of the map, likeliest first."""

    def __post_init__(self) -> None:
        if self.neighbours < 2:
            raise ConfigError(f"identify.neighbours is {self.neighbours}, expected at least 2.")
        if self.max_sigmas < 0 or self.tolerance_mm < 0 or self.max_sigmas + self.tolerance_mm == 0:
            raise ConfigError("identify.max_sigmas and identify.tolerance_mm must not be negative nor both zero.")
        if self.max_hypotheses < 1:
            raise ConfigError(f"identify.max_hypotheses is {self.max_hypotheses}, expected at least 1.")


_ALL_TRIANGLES_UP_TO = 40  # points: 9880 triangles
_PORTION = 1000  # triangles of the map at a time
_FORMED_AT_MOST = 2_000_000  # pairs of triangles held in memory before the likeliest are kept
_EDGE_ON_SINE = float(np.sin(np.radians(20.0)))  # nearer to edge-on the handedness of a triangle is not trusted


def frame_triangles(points: SensorPoints, options: IdentifyOptions) -> Int[np.ndarray, "t 3"]:
    """Triangles of a frame's points: all of them, or those among near neighbours."""
    n = len(points)
    form_all = options.frame_triangles == "all" or (options.frame_triangles == "auto" and n <= _ALL_TRIANGLES_UP_TO)
    k = n - 1 if form_all else min(options.neighbours, n - 1)
    if k < 2:
        return np.zeros((0, 3), dtype=np.int64)
    return np.asarray(kernels.local_triangles(kernels.nearest(points.xyz_mm, k)))


def congruent_triangles(
    points: SensorPoints,
    map: ReferenceMap,
    map_triangles: Int[np.ndarray, "t 3"],
    rank: Int[np.ndarray, "t"],
    options: IdentifyOptions,
) -> Iterator[Identification]:
    """Pairs of triangles whose three sides agree, those whose map triangle ranks highest first.

    Sides agree within a tolerance that follows from the covariances of the four points; vertices pair by the sides
    opposite to them, or, in isosceles triangles, by the side from which the triangle is seen. The map's triangles are
    taken in portions, so that whoever finds an answer in the first need not await the others.
    """
    order, side, var, hand = kernels.describe_triangles(
        points.xyz_mm, points.cov_mm2, -points.xyz_mm, frame_triangles(points, options), _EDGE_ON_SINE
    )
    by_rank = np.argsort(-rank, kind="stable")
    for first in range(0, len(by_rank), _PORTION):
        portion = by_rank[first : first + _PORTION]
        map_order, map_side, map_var, map_hand = kernels.describe_triangles(
            map.xyz_mm, map.cov_mm2, map.view, map_triangles[portion], _EDGE_ON_SINE
        )
        by_length = np.argsort(map_side[:, 2], kind="stable")
        point, target, row, comparisons = kernels.match_triangles(
            order,
            side,
            var,
            hand,
            map_order[by_length],
            map_side[by_length],
            map_var[by_length],
            map_hand[by_length],
            options.max_sigmas,
            options.tolerance_mm,
            _FORMED_AT_MOST,
        )
        likeliest = np.argsort(by_length[row], kind="stable")[: options.max_hypotheses]
        yield Identification(point[likeliest], target[likeliest], int(comparisons))
