"""Steps made by hand: a bumpy plate of targets passed by a stereo sensor, judged without any of the stages."""

from collections.abc import Iterator

import numpy as np

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.geometry.triangulation import triangulate
from trifix.records import (
    Dots,
    Event,
    Fix,
    Frame,
    Identification,
    NoFix,
    PositionedReason,
    Reason,
    ReferenceMap,
    Rival,
    SensorPoints,
    Step,
    StereoDots,
    StereoImages,
    StereoMatches,
    Unusable,
)

SIGMA_PX = 0.15


def rig() -> StereoRig:
    camera = Camera(560.0, 560.0, 319.5, 239.5, 640, 480, "radtan", (-0.05, 0.02, 0.0, 0.0))
    return StereoRig(camera, camera, Pose(np.eye(3), np.array([-120.0, 0.0, 0.0])))


def targets(count: int, rng: np.random.Generator) -> ReferenceMap:
    xy = rng.uniform((-420, -300), (420, 300), (count, 2))
    z = 700 + 60 * np.sin(xy[:, 0] / 130) * np.cos(xy[:, 1] / 110)
    state = np.ones(count, dtype=np.int64)
    state[-4:-1], state[-1] = 0, 2
    return ReferenceMap.given(
        np.c_[xy, z],
        cov_mm2=np.tile(np.eye(3) * 0.004, (count, 1, 1)),
        view=np.tile([0.0, 0.0, -1.0], (count, 1)),
        id=np.arange(count) + 100,
        sightings=rng.integers(3, 200, count),
        state=state,
    )


def pose(k: int) -> Pose:
    a = k / 25
    position = np.array([230 * np.sin(a), 120 * np.sin(2 * a), 60 * (1 - np.cos(a))])
    return Pose.exp(np.array([0, 0, 0, 0.1 * np.sin(a), 0.2 * np.sin(a), 0.3 * np.sin(a / 2)])) @ Pose(
        np.eye(3), position
    )


def steps(count: int, level: str = "dots", seed: int = 0, n_targets: int = 90) -> Iterator[Step]:
    """Frames of one recording; the first defines the world, some are refused, one of these with rivals."""
    rng = np.random.default_rng(seed)
    world = targets(n_targets, rng)
    for k in range(count):
        yield step(k, level, rng, world)


def step(k: int, level: str, rng: np.random.Generator, world: ReferenceMap) -> Step:
    sensor, T = rig(), pose(k)
    seen = T.inverse().apply(world.xyz_mm)
    in_right = sensor.T_right_left.apply(seen)
    visible = np.flatnonzero(sensor.left.sees(seen, 4.0) & sensor.right.sees(in_right, 4.0))
    if k % 37 == 30:
        visible = visible[:2]
    n = len(visible)

    def with_clutter(uv: np.ndarray, camera: Camera) -> Dots:
        clutter = rng.uniform((0, 0), (camera.width_px, camera.height_px), (12, 2))
        centres = np.r_[uv + rng.normal(0, SIGMA_PX, uv.shape), clutter]
        return Dots.of(centres, SIGMA_PX, diameter_px=np.full(len(centres), 7.0))

    left = with_clutter(sensor.left.project(seen[visible]), sensor.left)
    right = with_clutter(sensor.right.project(in_right[visible]), sensor.right)
    both = np.arange(n + 3)  # three false pairs of clutter
    matches = StereoMatches(both, both, rng.normal(0, 0.2, n + 3), np.full(n + 3, 0.2))
    xy_left, xy_right = sensor.left.unproject(left.uv_px[both]), sensor.right.unproject(right.uv_px[both])
    cov = np.tile(np.eye(2) * (SIGMA_PX / 560) ** 2, (n + 3, 1, 1))
    xyz, cov_mm2 = triangulate(sensor, xy_left, xy_right, cov, cov)
    xyz[n:], cov_mm2[n:] = [0.0, 0.0, 500.0], np.eye(3)
    points = SensorPoints(xyz, cov_mm2, both, np.full(n + 3, -1), both.copy())

    known = np.arange(int(n * 0.9))
    fix = judged(k, T, points, known, visible[known], world)
    frame = Frame(k, 1_000_000_000 + 40_000_000 * k, sensor, StereoDots(left, right))
    timings = {"match": 0.4, "triangulate": 0.3, "identify": 2.0 + k % 7, "verify": 0.5, "update": 0.2}
    matched: StereoMatches | None = matches
    dots: StereoDots | None = StereoDots(left, right)
    match level:
        case "images":
            images = StereoImages(image(left, rng), image(right, rng))
            frame = Frame(frame.index, frame.timestamp_ns, sensor, images)
            timings = {"detect": 9.0 + k % 3, **timings}
        case "points":
            given = SensorPoints(xyz, cov_mm2, np.full(n + 3, -1), points.label, 1000 * k + both)
            frame, points = Frame(frame.index, frame.timestamp_ns, None, given), given
            dots = matched = None
            timings = {"identify": 2.0, "verify": 0.5, "update": 0.2}
        case _:
            assert isinstance(frame.content, StereoDots)
    events = () if k % 50 != 20 else (Event("target_moved", 102, 'by 3.1 mm, "far"'), Event("island_founded", None))
    if k % 41 == 40 and level != "points":
        frame = Frame(k, frame.timestamp_ns, sensor, Unusable(Reason.unreadable_image, "left image, cut short"))
        fix = NoFix(Reason.unreadable_image, "left image, cut short")
        return Step(frame, None, None, None, None, fix, np.zeros(0, dtype=np.int64), world, 1.1, events, {})
    none = np.zeros(0, dtype=np.int64)
    return Step(
        frame, dots, matched, points, Identification(known[None], visible[known][None]), fix, none, world, 1.1, events,
        timings, centres=dots,
    )  # fmt: skip


def judged(
    k: int, T: Pose, points: SensorPoints, point: np.ndarray, target: np.ndarray, world: ReferenceMap
) -> Fix | NoFix:
    if len(point) < 3:
        return NoFix(Reason.too_few_points, f"{len(points)} points")
    if k % 29 == 13:
        rivals = (Rival(T, 41.5, 5), Rival(T @ Pose.exp(np.array([9.0, 0, 0, 0, 0, 1.0])), 40.9, 5))
        return NoFix(Reason.ambiguous, "2 poses", 1e-4, 5, 0.21, rivals)
    if 52 <= k % 90 < 60:
        return NoFix(Reason.not_proven, "", 0.02, 3, 0.4)
    residual = np.linalg.norm(T.apply(points.xyz_mm[point]) - world.xyz_mm[target], axis=1)
    if k == 0:
        return Fix(
            T, np.zeros((6, 6)), point, target, np.zeros(len(point)), float("nan"), PositionedReason.defines_world
        )
    cov = np.diag([0.01, 0.01, 0.03, 1e-7, 1e-7, 2e-8])
    return Fix(T, cov, point, target, residual, 10.0 ** -len(point))


def image(dots: Dots, rng: np.random.Generator) -> np.ndarray:
    """Bright discs on a dim background, 8 bit."""
    vv, uu = np.mgrid[0:480, 0:640]
    canvas = np.linspace(40, 90, 640)[None] + rng.normal(0, 4, (480, 640))
    for u, v in dots.uv_px:
        u0, v0 = int(u), int(v)
        rows, columns = slice(max(v0 - 6, 0), v0 + 7), slice(max(u0 - 6, 0), u0 + 7)
        distance = np.hypot(uu[rows, columns] - u, vv[rows, columns] - v)
        canvas[rows, columns] += 140 * np.clip(4 - distance, 0, 1)
    return canvas.clip(0, 255).astype(np.uint8)
