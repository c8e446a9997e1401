"""A fix keeps what it says when its map is cut down or moves on."""

from dataclasses import replace

import numpy as np

from constellations import RIG, front_map, looking, points_of, scattered, seen_dots
from trifix.records import Fix, ReferenceMap, SingleDots, TargetState


def fix_with_single_dots(rng: np.random.Generator) -> tuple[Fix, ReferenceMap]:
    """Points 0 to 3 are targets 5 to 8; the left camera alone sees target 2, the right one 4 and 9."""
    map, T = front_map(scattered(rng, 10)), looking(rng)
    dots = seen_dots(T.inverse().apply(map.xyz_mm), rng)
    target = np.array([2, 9, 4])
    single = SingleDots.of(np.array([0, 1, 1]), target, target, dots, RIG, T, map)
    return Fix(T, np.eye(6), np.arange(4), np.arange(5, 9), np.zeros(4), 1e-20, single=single), map


def test_single_dots_measure_how_far_they_are_from_their_targets() -> None:
    rng = np.random.default_rng(1)
    map, T = front_map(scattered(rng, 30)), looking(rng)
    dots = seen_dots(T.inverse().apply(map.xyz_mm), rng, sigma_px=0.1)
    camera, rows = np.tile([0, 1], 15), np.arange(30)
    single = SingleDots.of(camera, rows, rows, dots, RIG, T, map)
    assert 0.1 < np.sqrt(np.mean(single.residual_px**2)) < 0.2  # 0.1 px an axis went in
    assert SingleDots.of(camera, rows, np.roll(rows, 1), dots, RIG, T, map).residual_px.min() > 5


def test_a_fix_on_a_map_of_its_own_targets_means_the_same_ones() -> None:
    fix, map = fix_with_single_dots(np.random.default_rng(2))
    own, targets = fix.with_targets_of(map)
    assert targets.id[own.target].tolist() == map.id[fix.target].tolist()
    assert targets.id[own.single.target].tolist() == map.id[fix.single.target].tolist() == [2, 9, 4]
    assert own.single.dot.tolist() == fix.single.dot.tolist()


def test_a_fix_follows_its_targets_and_leaves_out_those_that_are_gone() -> None:
    rng = np.random.default_rng(3)
    fix, map = fix_with_single_dots(rng)
    own, targets = fix.with_targets_of(map)
    later = map.rows(rng.permutation(10))
    gone = np.isin(later.id, [6, 9])
    later.state[gone] = TargetState.removed
    later.xyz_mm[later.id == 4] += fix.T_world_sensor.R @ [1.0, 0.0, 0.0]
    in_sensor = fix.T_world_sensor.inverse().apply(map.xyz_mm)
    points = points_of(in_sensor[5:9], np.tile(np.eye(3), (4, 1, 1)))
    dots = seen_dots(in_sensor, rng, sigma_px=0.0)
    there = own.moved_to(targets, later, points, dots, RIG)
    assert (later.id[there.target].tolist(), there.point.tolist()) == ([5, 7, 8], [0, 2, 3])
    assert np.abs(there.residual_mm).max() < 1e-9
    assert (later.id[there.single.target].tolist(), there.single.camera.tolist()) == ([2, 4], [0, 1])
    assert there.single.residual_px[0] < 1e-6
    assert 1.5 < there.single.residual_px[1] < 4.5  # a millimetre across, seen from less than half a metre
    assert len(own.moved_to(targets, later, points, None, None).single) == 0


def test_a_copy_of_a_map_shares_the_joint_covariance_that_never_changes() -> None:
    map = front_map(scattered(np.random.default_rng(4), 6), 0.1)
    joint = np.eye(18)
    own = replace(map, joint_mm2=joint).copy()
    assert own.joint_mm2 is joint
    own.xyz_mm[0] += 1.0
    assert not np.array_equal(own.xyz_mm, map.xyz_mm)
