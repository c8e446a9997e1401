"""What must not matter: the order of the dots, and where the world is."""

from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from constellations import fixed, frame_of, looking, scattered, seen_dots, seen_points, some_dots, some_points
from trifix.geometry.pose import Pose
from trifix.positioner import Positioner
from trifix.records import Fix, Frame, ReferenceMap, SensorPoints, Step, StereoDots, StereoImages
from trifix.sources.simulation import simulate_frames


def steps_of(frames: Iterable[Frame], map: ReferenceMap | None = None, is_map_frozen: bool = False) -> list[Step]:
    return list(Positioner(map=map, is_map_frozen=is_map_frozen, is_noise_stated=True).run(frames))


# --- order -----------------------------------------------------------------------------------------------------------


def shuffled(frames: Iterable[Frame], rng: np.random.Generator) -> tuple[list[Frame], list[tuple[np.ndarray, ...]]]:
    """The same frames with their dots or points in another order, and which old rows stand in the new ones."""
    out, orders = [], []
    for frame in frames:
        content = frame.content
        assert not isinstance(content, StereoImages)
        if isinstance(content, SensorPoints):
            order: tuple[np.ndarray, ...] = (rng.permutation(len(content)),)
            content = some_points(content, order[0])
        else:
            order = (rng.permutation(len(content.left)), rng.permutation(len(content.right)))
            content = StereoDots(some_dots(content.left, order[0]), some_dots(content.right, order[1]))
        orders.append(order)
        out.append(Frame(frame.index, frame.timestamp_ns, frame.rig, content))
    return out, orders


def said(step: Step, order: Sequence[np.ndarray] | None) -> dict[tuple[int, ...], np.ndarray]:
    """Where each identified point, or pair of dots, of the frame stands in the map, by the rows before the shuffle."""
    if not isinstance(step.fix, Fix):
        return {}
    p = step.fix.point
    rows = [p]
    if step.matches is not None:
        pair = step.points.match[p]
        rows = [step.matches.left[pair], step.matches.right[pair]]
    if order is not None:
        rows = [one[row] for one, row in zip(order, rows, strict=True)]
    keys = zip(*(row.tolist() for row in rows), strict=True)
    return dict(zip(keys, step.map.xyz_mm[step.fix.target], strict=True))


@pytest.mark.parametrize(
    ("scene", "level", "frames"), [("demo", "dots", 15), ("clutter", "dots", 25), ("mirror", "points", 25)]
)
def test_the_order_of_dots_and_points_means_nothing(scene, level, frames):
    recording = simulate_frames(scene, 3, level, frames).frames
    mixed, orders = shuffled(recording, np.random.default_rng(0))
    positioned = 0
    for one, other, order in zip(steps_of(recording), steps_of(mixed), orders, strict=True):
        assert type(one.fix) is type(other.fix)
        assert len(one.map) == len(other.map)
        if not isinstance(one.fix, Fix):
            assert one.fix.why == other.fix.why
            continue
        positioned += 1
        np.testing.assert_allclose(other.fix.T_world_sensor.R, one.fix.T_world_sensor.R, rtol=0, atol=1e-9)
        np.testing.assert_allclose(other.fix.T_world_sensor.t_mm, one.fix.T_world_sensor.t_mm, rtol=0, atol=1e-6)
        before, after = said(one, None), said(other, order)
        assert before.keys() == after.keys()
        for key, xyz in before.items():
            np.testing.assert_allclose(after[key], xyz, rtol=0, atol=1e-6)
    assert positioned > 0.8 * frames


def test_the_order_of_a_given_map_means_nothing():
    rng = np.random.default_rng(1)
    world = scattered(rng, 30)
    order = rng.permutation(30)
    frames = [frame_of(k, seen_points(world, looking(rng), rng)) for k in range(10)]
    for one, other in zip(
        steps_of(frames, ReferenceMap.given(world), True),
        steps_of(frames, ReferenceMap.given(world[order]), True),
        strict=True,
    ):
        a, b = fixed(one.fix), fixed(other.fix)
        np.testing.assert_allclose(b.T_world_sensor.t_mm, a.T_world_sensor.t_mm, rtol=0, atol=1e-6)
        assert dict(zip(a.point.tolist(), a.target.tolist(), strict=True)) == dict(
            zip(b.point.tolist(), order[b.target].tolist(), strict=True)
        )


# --- place -----------------------------------------------------------------------------------------------------------


def moved(map: ReferenceMap, T: Pose) -> ReferenceMap:
    return ReferenceMap.given(T.apply(map.xyz_mm), T.R @ map.cov_mm2 @ T.R.T, map.view @ T.R.T, map.id)


@pytest.mark.parametrize("is_map_frozen", [True, False])
@pytest.mark.parametrize("level", ["dots", "points"])
def test_moving_the_world_moves_the_fix_and_nothing_else(level, is_map_frozen):
    rng = np.random.default_rng(2)
    world = scattered(rng, 25)
    cov = np.tile(np.diag([0.05, 0.02, 0.08]) ** 2, (25, 1, 1))
    map = ReferenceMap.given(world, cov, np.tile([0.0, 0.0, -1.0], (25, 1)))
    frames = []
    for k in range(10):
        T = looking(rng)
        seen = seen_dots(T.inverse().apply(world), rng) if level == "dots" else seen_points(world, T, rng)
        frames.append(frame_of(k, seen))
    T_new_old = Pose.exp(np.array([812.0, -3455.0, 97.0, 1.1, -0.7, 2.0]))
    here = steps_of(frames, map.copy(), is_map_frozen)
    there = steps_of(frames, moved(map, T_new_old), is_map_frozen)
    for one, other in zip(here, there, strict=True):
        a, b = fixed(one.fix), fixed(other.fix)
        np.testing.assert_array_equal(b.point, a.point)
        np.testing.assert_array_equal(b.target, a.target)
        expected = T_new_old @ a.T_world_sensor
        np.testing.assert_allclose(b.T_world_sensor.R, expected.R, rtol=0, atol=1e-9)
        np.testing.assert_allclose(b.T_world_sensor.t_mm, expected.t_mm, rtol=0, atol=1e-6)
        np.testing.assert_allclose(b.cov, a.cov, rtol=1e-4, atol=1e-15)  # in sensor coordinates, which did not move
        np.testing.assert_allclose(b.residual_mm, a.residual_mm, rtol=0, atol=1e-6)
        assert np.log(b.p_chance) == pytest.approx(np.log(a.p_chance), abs=0.05)
        np.testing.assert_allclose(other.map.xyz_mm, T_new_old.apply(one.map.xyz_mm), rtol=0, atol=1e-6)
