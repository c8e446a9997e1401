"""Scatters of targets, and frames that see parts of them: made here with numpy alone, truth known."""

from dataclasses import dataclass

import numpy as np

from trifix.geometry.pose import Pose
from trifix.records import Frame, ReferenceMap, SensorPoints


@dataclass(frozen=True)
class Scatter:
    """Targets on a surface, with the direction from which each is seen."""

    xyz_mm: np.ndarray
    normal: np.ndarray


def sphere(n: int, rng: np.random.Generator, radius_mm: float = 150.0) -> Scatter:
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Scatter(radius_mm * normal, normal)


def plane(n: int, rng: np.random.Generator, side_mm: float = 600.0) -> Scatter:
    xyz = np.zeros((n, 3))
    xyz[:, :2] = side_mm * rng.uniform(-0.5, 0.5, size=(n, 2))
    return Scatter(xyz, np.tile([0.0, 0.0, 1.0], (n, 1)))


def looking_at(target_mm: np.ndarray, from_mm: np.ndarray, roll_rad: float = 0.0) -> Pose:
    """``T_world_sensor`` of a sensor at one place whose z axis points to another."""
    z = target_mm - from_mm
    z = z / np.linalg.norm(z)
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    return Pose(R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.asarray(from_mm, dtype=float))


def seen(scatter: Scatter, T: Pose, sigma_mm: float, rng: np.random.Generator) -> tuple[SensorPoints, np.ndarray]:
    """The points of the targets that face the sensor within 70 degrees, in random order, and which target each is."""
    towards = T.t_mm - scatter.xyz_mm
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    target = rng.permutation(np.flatnonzero((towards * scatter.normal).sum(axis=1) > 0.34))
    return points_at(T.inverse().apply(scatter.xyz_mm[target]), sigma_mm, rng), target


def points_at(xyz_mm: np.ndarray, sigma_mm: float, rng: np.random.Generator) -> SensorPoints:
    """Measured points, with errors of a standard deviation across the view and three times that along it."""
    n = len(xyz_mm)
    sigma = sigma_mm * np.array([1.0, 1.0, 3.0])
    return SensorPoints(
        xyz_mm=xyz_mm + sigma * rng.normal(size=(n, 3)),
        cov_mm2=np.tile(np.diag(sigma**2), (n, 1, 1)),
        match=np.full(n, -1),
        label=np.full(n, -1),
        row=np.arange(n),
    )


def map_of(scatter: Scatter) -> ReferenceMap:
    return ReferenceMap.given(scatter.xyz_mm, view=scatter.normal)


def around_sphere(scatter: Scatter, frames: int, step_rad: float, rng: np.random.Generator) -> list[tuple[Frame, Pose]]:
    """A sensor that circles a sphere at 450 mm, a little up and down, rolling as it goes."""
    out = []
    for k in range(frames):
        a = k * step_rad
        place = 450.0 * np.array([np.cos(a), np.sin(a), 0.3 * np.sin(1.7 * a)])
        T = looking_at(np.zeros(3), place, roll_rad=0.3 * np.sin(a))
        points, _ = seen(scatter, T, 0.02, rng)
        out.append((Frame(k, k * 33_000_000, None, points), T))
    return out


def over_plane(scatter: Scatter, frames: int, step_mm: float, rng: np.random.Generator) -> list[tuple[Frame, Pose]]:
    """A sensor that slides along a plane 400 mm above it and sees a window of it."""
    out = []
    for k in range(frames):
        x = (k - frames / 2) * step_mm
        T = looking_at(np.array([x + 30.0, 10.0, 0.0]), np.array([x, 0.0, 400.0]))
        xyz = T.inverse().apply(scatter.xyz_mm)
        target = rng.permutation(np.flatnonzero((np.abs(xyz[:, :2] / xyz[:, 2:]) < 0.45).all(axis=1)))
        out.append((Frame(k, k * 33_000_000, None, points_at(xyz[target], 0.02, rng)), T))
    return out
