"""Orientation: poses and covariances of hypotheses against truth."""

from math import sqrt

import numpy as np
import pytest

from constellations import (
    chi2_limits,
    front_map,
    looking,
    nees,
    noise,
    points_of,
    saying,
    scattered,
    seen_points,
    sensor_covariances,
)
from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap
from trifix.stages.orient import orient


def same(*rows: int) -> list[tuple[int, int]]:
    return [(row, row) for row in rows]


@pytest.mark.parametrize("count", [3, 4, 9])
def test_exact_pairs_give_the_exact_pose(count: int):
    rng = np.random.default_rng(1)
    world = scattered(rng, 9)
    T = looking(rng)
    xyz = T.inverse().apply(world)
    found = orient(points_of(xyz, sensor_covariances(xyz)), front_map(world, 0.1), saying(same(*range(count))))
    assert found.is_valid.all()
    np.testing.assert_allclose(found.R[0], T.R, atol=1e-9)
    np.testing.assert_allclose(found.t_mm[0], T.t_mm, atol=1e-6)


def test_each_hypothesis_gets_a_pose_of_its_own():
    rng = np.random.default_rng(2)
    world = scattered(rng, 6)
    T = looking(rng)
    points = seen_points(world, T, rng)
    map = front_map(world, 0.05)
    hypotheses = [same(0, 1, 2), [(0, 1), (1, 2), (2, 0)], same(3, 4, 5)]
    together = orient(points, map, saying(*hypotheses))
    for k, hypothesis in enumerate(hypotheses):
        alone = orient(points, map, saying(hypothesis))
        np.testing.assert_array_equal(together.R[k], alone.R[0])
        np.testing.assert_array_equal(together.t_mm[k], alone.t_mm[0])
        np.testing.assert_array_equal(together.cov[k], alone.cov[0])


def test_rotations_are_proper_even_for_mirrored_pairs():
    rng = np.random.default_rng(3)
    world = scattered(rng, 5)
    xyz = world * [1, 1, -1] + [0, 0, 450]
    found = orient(
        points_of(xyz, sensor_covariances(xyz)), front_map(world), saying(same(0, 1, 2), same(2, 3, 4), same(1, 2, 4))
    )
    np.testing.assert_allclose(np.linalg.det(found.R), 1.0, atol=1e-9)
    np.testing.assert_allclose(found.R @ np.swapaxes(found.R, 1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-9)


@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.parametrize("map_sigma_mm", [0.0, 0.08])
def test_errors_follow_their_covariance(count: int, map_sigma_mm: float):
    """Chi-square of six degrees of freedom, in the mean and in both tails."""
    rng = np.random.default_rng(4)
    trials = 1200 if count == 3 else 400
    places = np.array([[-60.0, -40, 10], [70, -30, -20], [5, 60, 25], [30, 20, 0], [-40, 30, -15], [10, -55, 12]])
    places = places[:count]
    errors = np.empty(trials)
    for k in range(trials):
        T = looking(rng)
        points = seen_points(places, T, rng)
        map = front_map(places, map_sigma_mm)
        if map_sigma_mm:
            map.xyz_mm[:] += noise(rng, map.cov_mm2)
        found = orient(points, map, saying(same(*range(count))))
        errors[k] = nees(Pose(found.R[0], found.t_mm[0]), found.cov[0], T)
    low, high = chi2_limits(6 * trials)
    assert low < errors.sum() < high
    below, above = chi2_limits(6, 0.05)
    for share in (np.mean(errors < below), np.mean(errors > above)):
        assert abs(share - 0.05) < 4 * sqrt(0.05 * 0.95 / trials)


@pytest.mark.parametrize("count", [3, 4])
def test_pairs_on_one_line_determine_no_pose(count: int):
    xyz = np.outer(np.arange(5.0), [30.0, 5.0, 2.0]) + [-50, 0, 450]
    points = points_of(xyz, sensor_covariances(xyz))
    found = orient(points, ReferenceMap.given(xyz), saying(same(*range(count))))
    assert not found.is_valid.any()


def test_a_pair_twice_determines_no_pose():
    rng = np.random.default_rng(5)
    world = scattered(rng, 4)
    points = seen_points(world, looking(rng), rng)
    assert not orient(points, front_map(world, 0.1), saying(same(0, 1, 1))).is_valid.any()


def test_one_invalid_hypothesis_leaves_the_others_alone():
    xyz = np.vstack([np.outer(np.arange(3.0), [30.0, 5.0, 2.0]), [[10.0, 60.0, 5.0]]]) + [-50, 0, 450]
    points = points_of(xyz, sensor_covariances(xyz))
    found = orient(points, ReferenceMap.given(xyz), saying(same(0, 1, 3), same(0, 1, 2), same(1, 2, 3)))
    np.testing.assert_array_equal(found.is_valid, [True, False, True])
    np.testing.assert_allclose(found.t_mm[[0, 2]], 0, atol=1e-6)


def test_without_hypotheses_there_are_no_poses():
    rng = np.random.default_rng(6)
    world = scattered(rng, 4)
    none = Identification(np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.int64))
    found = orient(seen_points(world, looking(rng), rng), front_map(world), none)
    assert found.R.shape == (0, 3, 3)
    assert found.cov.shape == (0, 6, 6)
