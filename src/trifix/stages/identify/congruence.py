"""What the techniques share: options, triangles of the frame, congruence (Khoury 2006, section 3)."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.kernels import matching, positioning
from trifix.records import Identification, ReferenceMap, SensorPoints

Technique = Literal["index", "frequency", "minimal", "delaunay", "triangles", "hashing", "distances", "icp"]
FrameTriangles = Literal["auto", "all", "local"]
Start = Literal["auto", "prediction", "nothing"]


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """Which technique, and when two triangles are congruent."""

    technique: Technique = "index"
    """Local triangles from the map's index (index). Or one of the paper's: triangles of the map by pairs most often
    seen together (frequency), by nearest neighbours (minimal), on the convex surface (delaunay) or all (triangles; in a
    hash table: hashing); distances; closest points (icp)."""
    start: Start = "auto"
    """Where to look: where the motion leads first and then from nothing (auto), or in one of the two ways alone."""
    frame_triangles: FrameTriangles = "auto"
    """Triangles formed in the frame, unless the technique has its own: all of them, those among near neighbours
    (local), or all up to 40 points (auto)."""
    neighbours: int = 14
    """Local triangles join each point with pairs of this many nearest ones."""
    max_sigmas: float = 3.0
    """Lengths agree within this many standard deviations of their difference."""
    tolerance_mm: float = 0.0
    """Added to the tolerance of every length (mm); with max_sigmas = 0, one tolerance for all."""
    portion: int = 1000
    """Triangles of the map to compare before what was found is verified, likeliest first."""
    max_hypotheses: int = 10_000
    """Hypotheses to try at most, likeliest first; a frame that needs more is refused."""
    widens: bool = True
    """What the technique does not find is sought among all triangles, near or wide, in maps of up to 300 targets."""
    max_comparisons: int = 3_000_000
    """Pairs of targets to look at most in that wider search."""
    max_points: int = 2000
    """A frame of more points, false pairs among them, is refused: it could not be searched in time."""
    max_step_mm: float = 30.0
    """Closest points pair across at most this distance from where the last pose puts them (mm)."""

    def __post_init__(self) -> None:
        if self.neighbours < 2:
            raise ConfigError(f"identify.neighbours is {self.neighbours}, expected at least 2.")
        if self.max_sigmas < 0 or self.tolerance_mm < 0 or self.max_sigmas + self.tolerance_mm == 0:
            raise ConfigError("identify.max_sigmas and identify.tolerance_mm must not be negative nor both zero.")
        if min(self.portion, self.max_hypotheses) < 1:
            raise ConfigError("identify.portion and identify.max_hypotheses must be at least 1.")
        if self.max_points < 3:
            raise ConfigError(f"identify.max_points is {self.max_points}, expected at least 3.")
        if self.max_step_mm <= 0:
            raise ConfigError(f"identify.max_step_mm is {self.max_step_mm}, expected a positive length.")


NO_TRIANGLES = np.zeros((0, 3), dtype=np.int64)
FORMED_AT_MOST = 2_000_000  # pairs of triangles held in memory before the likeliest are kept
_SAMPLE = 60  # triangles of either side from which chance is judged
_ALL_TRIANGLES_UP_TO = 40  # points: 9880 triangles
_CORNERS = 8  # points of a set of pairs among which its widest triangles are sought
_WIDEST = 10
_EDGE_ON_SINE = float(np.sin(np.radians(20.0)))  # nearer to edge-on the handedness of a triangle is not trusted

Described = tuple[
    Int[np.ndarray, "t 3"], Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"], Int[np.ndarray, "t"]
]  # vertices in canonical order, sorted sides, their variances, handedness


def all_frame_triangles(points: SensorPoints, options: IdentifyOptions) -> Int[np.ndarray, "t 3"]:
    """Triangles of a frame's points: all of them, or those among near neighbours."""
    n = len(points)
    form_all = options.frame_triangles == "all" or (options.frame_triangles == "auto" and n <= _ALL_TRIANGLES_UP_TO)
    return triangles_among_nearest(points.xyz_mm, n - 1 if form_all else min(options.neighbours, n - 1))


def triangles_among_nearest(xyz_mm: Float[np.ndarray, "n 3"], k: int) -> Int[np.ndarray, "t 3"]:
    """Triangles of each point with two of its k nearest, each once; all there are when k = n − 1."""
    if k < 2:
        return NO_TRIANGLES
    return np.asarray(positioning.local_triangles(positioning.nearest(xyz_mm, k)))


def describe_frame(points: SensorPoints, triangles: Int[np.ndarray, "t 3"]) -> Described:
    """The frame's triangles in the form in which they are compared; the sensor sees them from the origin."""
    return _described(points.xyz_mm, points.cov_mm2, -points.xyz_mm, triangles)


def describe_map(map: ReferenceMap, triangles: Int[np.ndarray, "t 3"]) -> Described:
    """The map's triangles in the form in which they are compared, sorted by nothing."""
    return _described(map.xyz_mm, map.cov_mm2, map.view, triangles)


def congruent_triangles(
    points: SensorPoints,
    map: ReferenceMap,
    frame_triangles: Int[np.ndarray, "f 3"],
    map_triangles: Int[np.ndarray, "t 3"],
    options: IdentifyOptions,
    rank: Int[np.ndarray, "t"] | None = None,
) -> Iterator[Identification]:
    """Pairs of triangles whose three sides agree, those whose map triangle ranks highest first.

    Sides agree within a tolerance that follows from the covariances of the four points; vertices pair by the sides
    opposite to them, or, in isosceles triangles, by the side from which the triangle is seen; equilateral ones are
    refused. The map's triangles are taken in portions, so that whoever finds an answer in the first need not await the
    others. The comparisons are those of each triangle of the frame with each of the portion, as the paper counts them;
    sorting by the longest side spares most of them.
    """
    frame = describe_frame(points, frame_triangles)
    by_rank = np.arange(len(map_triangles)) if rank is None else np.argsort(-rank, kind="stable")
    for first in range(0, len(by_rank), options.portion):
        portion = map_triangles[by_rank[first : first + options.portion]]
        order, side, var, hand = describe_map(map, portion)
        by_length = np.argsort(side[:, 2], kind="stable")
        point, target, row = matching.match_sorted(
            *frame,
            order[by_length],
            side[by_length],
            var[by_length],
            hand[by_length],
            options.max_sigmas,
            options.tolerance_mm,
            FORMED_AT_MOST,
        )
        likeliest = np.argsort(by_length[row], kind="stable")[: options.max_hypotheses]
        yield Identification(
            point[likeliest],
            target[likeliest],
            comparisons=len(frame_triangles) * len(portion),
            expected_by_chance=expected_by_chance(frame[1:3], (side, var), options),
        )


def expected_by_chance(
    frame: tuple[np.ndarray, np.ndarray], map_: tuple[np.ndarray, np.ndarray], options: IdentifyOptions
) -> float:
    """How many pairs of triangles would agree if those of frame and map had nothing to do with one another.

    Each of a sample of pairs is moved at random by a normal step many tolerances wide, along each of its three sides:
    the probability that it then agrees, summed, and scaled to all pairs.
    """
    (frame_side, frame_var), (map_side, map_var) = (
        (side[:: len(side) // _SAMPLE + 1], var[:: len(side) // _SAMPLE + 1]) for side, var in (frame, map_)
    )
    if len(frame_side) == 0 or len(map_side) == 0:
        return 0.0
    tolerance = options.tolerance_mm + options.max_sigmas * np.sqrt(frame_var[:, None] + map_var[None])
    step_mm = np.maximum(0.2 * np.median(frame_side), 3 * tolerance)
    apart = (frame_side[:, None] - map_side[None]) / step_mm
    chance = np.minimum(2 * tolerance / (np.sqrt(2 * np.pi) * step_mm) * np.exp(-0.5 * apart**2), 1.0).prod(axis=2)
    return float(chance.mean()) * len(frame[0]) * len(map_[0])


def widest_triangles(
    points: SensorPoints, point: Int[np.ndarray, "c"], target: Int[np.ndarray, "c"], comparisons: int
) -> Identification:
    """A set of pairs as hypotheses of three pairs each, the largest triangles first.

    Three are enough to place the sensor; the others are left to be evidence.
    """
    corners = point[_farthest(points.xyz_mm[point], _CORNERS)]
    which = {int(p): int(q) for p, q in zip(point, target, strict=True)}
    triangle = np.array(list(combinations(corners.tolist(), 3)), dtype=np.int64).reshape(-1, 3)
    a, b, c = (points.xyz_mm[triangle[:, v]] for v in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    widest = np.argsort(-area, kind="stable")[:_WIDEST]
    triangle = triangle[widest[area[widest] > 0]]
    found = np.array([which[p] for p in triangle.ravel().tolist()], dtype=np.int64).reshape(-1, 3)
    return Identification(triangle, found, comparisons)


def _farthest(xyz_mm: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, "c"]:
    """Rows of up to ``count`` points, each as far as possible from those before it."""
    rows: list[int] = []
    distance = np.linalg.norm(xyz_mm - xyz_mm.mean(axis=0), axis=1) if len(xyz_mm) else np.zeros(0)
    for _ in range(min(count, len(xyz_mm))):
        rows.append(int(np.argmax(distance)))
        to_last = np.linalg.norm(xyz_mm - xyz_mm[rows[-1]], axis=1)
        distance = to_last if len(rows) == 1 else np.minimum(distance, to_last)
    return np.array(rows, dtype=np.int64)


def _described(
    xyz_mm: Float[np.ndarray, "n 3"],
    cov_mm2: Float[np.ndarray, "n 3 3"],
    towards_sensor: Float[np.ndarray, "n 3"],
    triangles: Int[np.ndarray, "t 3"],
) -> Described:
    order, side, var, hand = positioning.describe_triangles(xyz_mm, cov_mm2, towards_sensor, triangles, _EDGE_ON_SINE)
    return order, side, var, hand
