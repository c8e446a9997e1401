"""Mirror images: what cannot be, is refused, although every distance agrees."""

import numpy as np
import pytest

from constellations import RIG, fixed, frame_of, front_map, looking, scattered, seen_dots, seen_points
from trifix.geometry.pose import Pose, exp_rotation
from trifix.positioner import Positioner
from trifix.records import NoFix, ReferenceMap

MIRROR = np.array([-1.0, 1.0, 1.0])


def seen(level: str, xyz_world_mm: np.ndarray, T: Pose, rng: np.random.Generator):
    return seen_dots(T.inverse().apply(xyz_world_mm), rng) if level == "dots" else seen_points(xyz_world_mm, T, rng)


@pytest.mark.parametrize("level", ["dots", "points"])
def test_a_mirrored_constellation_is_refused(level):
    """From the front and with no views known; the right one is positioned."""
    rng = np.random.default_rng(1)
    for k in range(12):
        world = scattered(rng, 18)
        for map in (front_map(world), ReferenceMap.given(world)):
            mirrored = Positioner(map=map, is_map_frozen=True, is_noise_stated=True)
            assert isinstance(mirrored.step(frame_of(k, seen(level, world * MIRROR, looking(rng), rng))).fix, NoFix)
            right = Positioner(map=map, is_map_frozen=True, is_noise_stated=True)
            fixed(right.step(frame_of(k, seen(level, world, looking(rng), rng))).fix)


@pytest.mark.parametrize("level", ["dots", "points"])
def test_a_mirrored_object_is_another_object_to_a_map_that_grew(level):
    rng = np.random.default_rng(2)
    world = scattered(rng, 18)
    positioner = Positioner(is_noise_stated=True)
    for k in range(5):
        fixed(positioner.step(frame_of(k, seen(level, world, looking(rng, 0.2), rng))).fix)
    for k in range(5, 12):
        assert isinstance(positioner.step(frame_of(k, seen(level, world * MIRROR, looking(rng, 0.2), rng))).fix, NoFix)
    fixed(positioner.step(frame_of(12, seen(level, world, looking(rng, 0.2), rng))).fix)


@pytest.mark.parametrize("level", ["dots", "points"])
def test_a_planar_constellation_is_not_recognised_from_behind(level):
    """What is seen from behind is the mirror image, which a proper rotation turns into the original."""
    rng = np.random.default_rng(3)
    turn = Pose(exp_rotation(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    for k in range(10):
        world = scattered(rng, 18, (150, 120, 0))
        T = looking(rng)
        behind = frame_of(k, seen(level, world, turn @ T, rng))
        before = frame_of(k, seen(level, world, T, rng))
        facing = front_map(world, 0.02)
        assert isinstance(Positioner(map=facing, is_map_frozen=True, is_noise_stated=True).step(behind).fix, NoFix)
        fixed(Positioner(map=facing, is_map_frozen=True, is_noise_stated=True).step(before).fix)


def test_a_planar_map_that_grew_knows_its_front():
    rng = np.random.default_rng(4)
    turn = Pose(exp_rotation(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    world = scattered(rng, 18, (150, 120, 0))
    positioner = Positioner(is_noise_stated=True)
    for k in range(5):
        fixed(positioner.step(frame_of(k, seen("dots", world, looking(rng, 0.3), rng), RIG)).fix)
    for k in range(5, 12):
        assert isinstance(
            positioner.step(frame_of(k, seen("dots", world, turn @ looking(rng, 0.3), rng), RIG)).fix, NoFix
        )
