"""Maps and frames at the level of points, made by the thousand: shared by the benchmarks.

A batch of frames is drawn at once, as arrays padded to ``MOST`` points, for a few dozen microseconds a frame: the
program under test is what takes the time. Each frame knows which target each of its points truly is, and a fix is
judged by that alone. Truth is computed by nothing that is under test but the absolute orientation of true pairs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from trifix.geometry.alignment import align, align_weighted, spread_off_line_mm
from trifix.geometry.pose import Pose
from trifix.records import Fix, Frame, ReferenceMap, SensorPoints

MOST = 30
"""Points of the largest frame."""
WRONG_MM, WRONG_DEG, WRONG_SIGMAS = 3.0, 0.5, 5.0
"""A fix is wrong when it is off by more than one of the first two, and by more than the third."""
OFF_LINE_MM = 3.0
"""True pairs that lie nearer to one line than this (rms) say nothing about the pose."""
GAP_NS = 1_000_000_000
"""Time between frames: too long for the motion to say anything, so that every frame starts from nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A surface with targets, and the map of them that the program is given."""

    map: ReferenceMap
    """What the program knows: the first targets, with the errors that their covariances state."""
    xyz_mm: Float[np.ndarray, "a 3"]
    """Where all targets really are; row numbers below ``len(map)`` are those of the map."""
    normal: Float[np.ndarray, "a 3"]
    """Direction in which each of them faces."""
    tree: cKDTree
    """Finds the neighbours of a place."""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """f frames of one world, each with its truth."""

    xyz_mm: Float[np.ndarray, "f m 3"]
    """Points in sensor coordinates (mm); of the padding, anything."""
    cov_mm2: Float[np.ndarray, "f m 3 3"]
    """Their covariances (mm²)."""
    label: Int[np.ndarray, "f m"]
    """Row of the target in the map that a point is; -1 for none."""
    count: Int[np.ndarray, "f"]
    """Points of the frame; the rest of its row is padding."""
    part: Int[np.ndarray, "f"]
    """Variety of the frame within its kind."""

    def __len__(self) -> int:
        return len(self.count)

    def points(self, k: int) -> SensorPoints:
        """The points of one frame."""
        n = int(self.count[k])
        none = np.full(n, -1)
        return SensorPoints(self.xyz_mm[k, :n], self.cov_mm2[k, :n], none, none, np.arange(n))

    def frames(self) -> Iterator[Frame]:
        """The frames one after another, too far apart in time for a prediction."""
        for k in range(len(self)):
            yield Frame(k, k * GAP_NS, None, self.points(k))

    def labelled(self, k: int) -> Int[np.ndarray, "c"]:
        """Rows of the frame's points that are targets of the map."""
        return np.flatnonzero(self.label[k, : self.count[k]] >= 0)

    def is_positionable(self, k: int, map: ReferenceMap) -> bool:
        """Whether the frame's true labels say what its pose is."""
        return spread_off_line_mm(map.xyz_mm[self.label[k, self.labelled(k)]]) >= OFF_LINE_MM

    def pose_of_labels(self, k: int, map: ReferenceMap) -> tuple[Pose, Float[np.ndarray, "6 6"], float] | None:
        """The pose that the frame's true labels give against the map, and its covariance; None if they give none.

        The last value is their chi-square per freedom. Where it exceeds one, the points' errors are larger than stated,
        as those of a sensor of wrong scale, and so is sigma: ``trifix evaluate`` reckons the same way.
        """
        if not self.is_positionable(k, map):
            return None
        point = self.labelled(k)
        target = self.label[k, point]
        b, a = self.xyz_mm[k, point], map.xyz_mm[target]
        C_b, C_a = self.cov_mm2[k, point], map.cov_mm2[target]
        T, cov = align_weighted(b, a, C_b, C_a, initial=align(b, a))
        r = T.apply(b) - a
        chi2 = float(np.einsum("ni,ni->", r, np.linalg.solve(T.R @ C_b @ T.R.T + C_a, r[:, :, None])[:, :, 0]))
        return T, cov, chi2 / (3 * len(b) - 6)

    def true_pairs(self, k: int, fix: Fix) -> int:
        """How many of the fix's points are the targets that it says."""
        return int((self.label[k, fix.point] == fix.target).sum())

    def is_right(self, k: int, T_world_sensor: Pose, map: ReferenceMap) -> bool:
        """Whether a pose is, within the limits, the one that the frame's true labels give against the map."""
        truth = self.pose_of_labels(k, map)
        if truth is None:
            return False
        T_true, cov, variance = truth
        offset = T_true.inverse() @ T_world_sensor
        delta = offset.log()
        is_near = np.linalg.norm(offset.t_mm) <= WRONG_MM and np.degrees(np.linalg.norm(delta[3:])) <= WRONG_DEG
        return bool(is_near or delta @ np.linalg.solve(cov, delta) <= WRONG_SIGMAS**2 * max(variance, 1.0))


def made_world(
    rng: np.random.Generator, n: int, spacing_mm: float, sigma_mm: float = 0.03, relief: float = 0.06
) -> World:
    """n targets scattered over a gently curved surface; ``relief`` is its height by its wave length, 0 for a plane.

    No two targets are nearer to one another than 0.3 of the mean spacing.
    """
    drawn = int(1.4 * n) + 20  # about a quarter has too near a neighbour
    side_mm = spacing_mm * np.sqrt(n)
    xy = rng.uniform(0, side_mm * np.sqrt(drawn / n / 1.3), (drawn, 2))
    near = cKDTree(xy).query_pairs(0.3 * spacing_mm, output_type="ndarray")
    keep = np.ones(drawn, dtype=bool)
    keep[near.max(axis=1)] = False
    xy = xy[keep]
    middle = xy.mean(axis=0)
    xy = xy[np.argsort(np.abs(xy - middle).max(axis=1), kind="stable")[:n]]
    return _on_surface(rng, xy, n, sigma_mm, relief)


def made_grid(rng: np.random.Generator, n: int, spacing_mm: float, jitter_mm: float, sigma_mm: float = 0.03) -> World:
    """A square grid whose targets are all a little off; the map holds n of them, the rest lies around it."""
    inner = int(np.ceil(np.sqrt(n)))
    margin = 6  # rows of targets beyond the map
    steps = np.arange(-margin, inner + margin)
    ij = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    is_inner = ((ij >= 0) & (ij < inner)).all(axis=1)
    ij = ij[np.argsort(~is_inner, kind="stable")]
    xy = ij * spacing_mm + rng.normal(0, jitter_mm, ij.shape)
    return _on_surface(rng, xy, min(n, int(is_inner.sum())), sigma_mm, relief=0.0, rough_mm=jitter_mm)


def _on_surface(
    rng: np.random.Generator,
    xy_mm: Float[np.ndarray, "a 2"],
    n: int,
    sigma_mm: float,
    relief: float,
    rough_mm: float = 0.0,
) -> World:
    """Places in a plane, laid on waves and turned at random; the first n make the map."""
    wave = 2 * np.pi / rng.uniform(150.0, 400.0, 2)  # rad/mm
    phase = rng.uniform(0, 2 * np.pi, 2)
    height = relief / wave * 2 * np.pi
    x, y = (xy_mm * wave + phase).T
    z = height[0] * np.sin(x) + height[1] * np.sin(y) + rng.normal(0, rough_mm, len(xy_mm))
    # the normal of z(x, y) on the side of negative z
    normal = np.stack([height[0] * wave[0] * np.cos(x), height[1] * wave[1] * np.cos(y), -np.ones(len(z))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    R = _rotations(rng, 1)[0]
    xyz, normal = np.column_stack([xy_mm, z]) @ R.T, normal @ R.T
    told = xyz[:n] + rng.normal(0, sigma_mm, (n, 3))
    cov = np.tile(sigma_mm**2 * np.eye(3), (n, 1, 1))
    return World(ReferenceMap.given(told, cov, normal[:n].copy()), xyz, normal, cKDTree(xyz))


def near_targets(
    rng: np.random.Generator, world: World, centre: Int[np.ndarray, "f"], count: Int[np.ndarray, "f"], most: int = MOST
) -> Int[np.ndarray, "f m"]:
    """Rows of ``count`` targets around each centre, in random order, then -1; a fifth of the nearest is passed over."""
    k = min(int(1.25 * most) + 2, len(world.xyz_mm))
    _, near = world.tree.query(world.xyz_mm[centre], k=k)
    rank = np.arange(k)
    # the count nearest, but that each may be missed
    sequence = np.argsort(rank + 0.25 * count[:, None] * rng.random((len(centre), k)), axis=1)
    rows = np.take_along_axis(near, sequence, axis=1)[:, :most]
    return np.where(np.arange(rows.shape[1]) < count[:, None], rows, -1)


def looking_at(
    rng: np.random.Generator, xyz_mm: Float[np.ndarray, "f 3"], normal: Float[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "f 3 3"], Float[np.ndarray, "f 3"]]:
    """R and t of ``T_world_sensor`` of sensors half a metre before places, tilted by up to 30 degrees, of any roll."""
    f = len(xyz_mm)
    aside = rng.normal(size=(f, 3))
    aside -= (aside * normal).sum(axis=1, keepdims=True) * normal
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    tilt = np.radians(30.0) * np.sqrt(rng.random((f, 1)))
    z = -np.cos(tilt) * normal + np.sin(tilt) * aside
    across = np.cross(z, aside)
    x = across / np.linalg.norm(across, axis=1, keepdims=True)
    roll = rng.uniform(0, 2 * np.pi, (f, 1))
    x = np.cos(roll) * x + np.sin(roll) * np.cross(z, x)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    return R, xyz_mm - rng.uniform(420.0, 540.0, (f, 1)) * z + rng.normal(0, 10.0, (f, 3))


def in_sensor(
    R: Float[np.ndarray, "f 3 3"], t_mm: Float[np.ndarray, "f 3"], xyz_mm: Float[np.ndarray, "f m 3"]
) -> Float[np.ndarray, "f m 3"]:
    """World coordinates to those of the sensors."""
    return (xyz_mm - t_mm[:, None]) @ R


def seen(
    rng: np.random.Generator, world: World, rows: Int[np.ndarray, "f m"], centre: Int[np.ndarray, "f"]
) -> Float[np.ndarray, "f m 3"]:
    """Targets around centres in the coordinates of sensors that look there."""
    R, t_mm = looking_at(rng, world.xyz_mm[centre], world.normal[centre])
    return in_sensor(R, t_mm, world.xyz_mm[rows])


def strays(
    rng: np.random.Generator, around_mm: Float[np.ndarray, "f m 3"], is_target: Bool[np.ndarray, "f m"]
) -> Float[np.ndarray, "f m 3"]:
    """Points that are no target, spread like the targets of their frame and up to 10 mm more in depth."""
    number = np.maximum(is_target.sum(axis=1), 1)[:, None]
    middle = (around_mm * is_target[..., None]).sum(axis=1) / number
    offset = np.where(is_target[..., None], around_mm - middle[:, None], 0.0)
    spread = np.sqrt((offset**2).sum(axis=1) / number) + [5.0, 5.0, 10.0]
    return middle[:, None] + rng.normal(size=around_mm.shape) * spread[:, None]


def measured(
    rng: np.random.Generator,
    xyz_mm: Float[np.ndarray, "f m 3"],
    label: Int[np.ndarray, "f m"],
    count: Int[np.ndarray, "f"],
    part: Int[np.ndarray, "f"],
    across_mm: tuple[float, float] = (0.02, 0.1),
    elongation: tuple[float, float] = (2.0, 5.0),
) -> Batch:
    """What a stereo sensor makes of points: errors longer along the ray, each frame with a scale of its own.

    ``across_mm`` and ``elongation`` are the limits between which that scale, and how much longer, are drawn.
    """
    f, m = label.shape
    order = np.argsort(rng.random((f, m)) + (np.arange(m) >= count[:, None]), axis=1)
    xyz_mm = np.take_along_axis(xyz_mm, order[..., None], axis=1)
    label = np.take_along_axis(label, order, axis=1)
    across = np.exp(rng.uniform(*np.log(across_mm), (f, 1, 1)))
    along = across * rng.uniform(*elongation, (f, 1, 1))
    ray = xyz_mm / np.linalg.norm(xyz_mm, axis=2, keepdims=True)
    normal = rng.normal(size=xyz_mm.shape)
    error = across * normal + (along - across) * (normal * ray).sum(axis=2, keepdims=True) * ray
    cov = (across**2)[..., None] * np.eye(3) + (along**2 - across**2)[..., None] * ray[..., None] * ray[..., None, :]
    return Batch(xyz_mm + error, cov, label, count, part)


def _rotations(rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 3 3"]:
    """Rotations, all alike probable (from normal quaternions)."""
    q = rng.normal(size=(n, 4))
    return np.array([Pose.from_quaternion(each, np.zeros(3)).R for each in q])
