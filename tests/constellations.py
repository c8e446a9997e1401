"""Made constellations, and what a sensor sees of them: shared by the tests of the stages and of the whole."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose, exp_rotation
from trifix.index import MapIndex
from trifix.records import (
    Dots,
    Fix,
    Frame,
    Identification,
    NoFix,
    ReferenceMap,
    SensorPoints,
    StereoDots,
)

MAP_COLUMNS = tuple(name for name in ReferenceMap.__slots__ if name != "joint_mm2")
"""What a map has for each target; its joint covariance is of all of them."""

LEFT = Camera(1400.0, 1401.0, 646.0, 507.0, 1280, 1024, "radtan", (-0.08, 0.04, 0.0004, -0.0003))
RIGHT = Camera(1410.0, 1411.0, 634.0, 514.0, 1280, 1024, "radtan", (-0.081, 0.039, -0.0002, 0.0005))
RIG = StereoRig(LEFT, RIGHT, Pose.exp(np.array([-142.0, 1.0, 24.0, 0.003, 0.33, -0.002])))
"""Baseline 144 mm; the axes cross half a metre away."""

PINHOLE = Camera(1000.0, 1000.0, 639.5, 511.5, 1280, 1024)
PARALLEL = StereoRig(PINHOLE, PINHOLE, Pose(np.eye(3), np.array([-120.0, 0.0, 0.0])))
"""Epipolar lines are rows."""

STEP_NS = 50_000_000


def scattered(
    rng: np.random.Generator, n: int, size_mm: Sequence[float] = (150.0, 120.0, 60.0), apart_mm: float = 10.0
) -> np.ndarray:
    """Places of n targets (mm) in a box about the origin, none nearer to another than ``apart_mm``."""
    xyz = np.zeros((0, 3))
    while len(xyz) < n:
        new = (rng.random(3) - 0.5) * size_mm
        if not len(xyz) or np.linalg.norm(xyz - new, axis=1).min() >= apart_mm:
            xyz = np.vstack([xyz, new])
    return xyz


def looking(rng: np.random.Generator, tilt_rad: float = 0.5, distance_mm: float = 470.0) -> Pose:
    """T_world_sensor of a sensor before the origin, on the side of negative z, tilted at random and of any roll."""
    about = rng.normal(size=2)
    tilt = tilt_rad * np.sqrt(rng.random()) * about / np.linalg.norm(about)
    R = exp_rotation(np.array([*tilt, 0.0])) @ exp_rotation(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    middle = np.array([70.0, 0.0, distance_mm * rng.uniform(0.95, 1.05)])
    return Pose(R, -R @ middle + rng.normal(0, 5.0, 3))


def sensor_covariances(xyz_mm: np.ndarray, across_mm: float = 0.03, along_mm: float = 0.1) -> np.ndarray:
    """Covariances (mm²) as of a stereo sensor: longer along the ray."""
    ray = xyz_mm / np.linalg.norm(xyz_mm, axis=1, keepdims=True)
    return across_mm**2 * np.eye(3) + (along_mm**2 - across_mm**2) * ray[:, :, None] * ray[:, None, :]


def points_of(xyz_mm: np.ndarray, cov_mm2: np.ndarray) -> SensorPoints:
    """Given points in sensor coordinates."""
    n = len(xyz_mm)
    return SensorPoints(xyz_mm, cov_mm2, np.full(n, -1), np.full(n, -1), np.arange(n))


def seen_points(xyz_world_mm: np.ndarray, T_world_sensor: Pose, rng: np.random.Generator) -> SensorPoints:
    """The targets as points with the noise that their covariances state."""
    xyz = T_world_sensor.inverse().apply(xyz_world_mm)
    cov = sensor_covariances(xyz)
    return points_of(xyz + noise(rng, cov), cov)


def indexed(map: ReferenceMap) -> MapIndex:
    """The index of a map."""
    index = MapIndex()
    index.follow(map)
    return index


def noise(rng: np.random.Generator, cov: np.ndarray) -> np.ndarray:
    """A draw (n, d) from n covariances (n, d, d)."""
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=cov.shape[:2])))


def seen_dots(
    xyz_sensor_mm: np.ndarray, rng: np.random.Generator, sigma_px: float = 0.1, rig: StereoRig = RIG
) -> StereoDots:
    """The targets as dots of both images, row by row the same ones; the dots state their noise."""
    uv_left = rig.left.project(xyz_sensor_mm)
    uv_right = rig.right.project(rig.T_right_left.apply(xyz_sensor_mm))
    return StereoDots(
        *(Dots.of(uv + sigma_px * rng.normal(size=uv.shape), max(sigma_px, 1e-3)) for uv in (uv_left, uv_right))
    )


def some_dots(dots: Dots, rows: np.ndarray) -> Dots:
    """Some of the dots in another order, numbered anew."""
    return Dots(dots.uv_px[rows], dots.cov_px2[rows], dots.ellipse[rows], dots.label[rows], np.arange(len(rows)))


def some_points(points: SensorPoints, rows: np.ndarray) -> SensorPoints:
    """Some of the points in another order, numbered anew."""
    n = len(rows)
    return SensorPoints(points.xyz_mm[rows], points.cov_mm2[rows], points.match[rows], points.label[rows], np.arange(n))


def frame_of(k: int, content: StereoDots | SensorPoints, rig: StereoRig | None = RIG) -> Frame:
    """The k-th frame of a recording."""
    return Frame(k, k * STEP_NS, rig, content)


def front_map(xyz_mm: np.ndarray, sigma_mm: float = 0.0) -> ReferenceMap:
    """A given map of targets that face the side of negative z, where ``looking`` stands."""
    k = len(xyz_mm)
    return ReferenceMap.given(
        xyz_mm.copy(), np.tile(sigma_mm**2 * np.eye(3), (k, 1, 1)), np.tile([0.0, 0.0, -1.0], (k, 1)), np.arange(k)
    )


def firm_triple(xyz_mm: np.ndarray) -> list[int]:
    """Rows of the three places whose triangle has the largest smallest altitude: they hold a pose best."""
    triples = np.array(list(combinations(range(len(xyz_mm)), 3)))
    a, b, c = xyz_mm[triples].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - a, c - b)], axis=0)
    return triples[np.argmax(area / longest)].tolist()


def saying(*pairs: Sequence[tuple[int, int]]) -> Identification:
    """Hypotheses, each as its pairs of (point, target)."""
    table = np.array(pairs, dtype=np.int64).reshape(len(pairs), -1, 2)
    point, target = np.ascontiguousarray(table.transpose(2, 0, 1))
    return Identification(point, target)


def fixed(fix: Fix | NoFix) -> Fix:
    """The fix that there must be."""
    assert isinstance(fix, Fix), f"{fix.why}: {fix.detail}"
    return fix


def nees(T: Pose, cov: np.ndarray, T_true: Pose) -> float:
    """δᵀ C⁻¹ δ with T_true = T · exp(δ)."""
    delta = (T.inverse() @ T_true).log()
    return float(delta @ np.linalg.solve(cov, delta))


def chi2_limits(freedoms: int, tail: float = 1e-3) -> tuple[float, float]:
    """Values that a chi-square of so many degrees of freedom lies below, or above, with probability ``tail``."""
    from scipy.special import chdtri

    return float(chdtri(freedoms, 1 - tail)), float(chdtri(freedoms, tail))
