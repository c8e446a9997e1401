"""The map's growth: known targets are averaged, new ones enter, ghosts go, and nothing is renamed."""

from dataclasses import replace
from math import sqrt

import numpy as np
import pytest

from constellations import (
    MAP_COLUMNS,
    PARALLEL,
    RIG,
    chi2_limits,
    front_map,
    looking,
    noise,
    points_of,
    scattered,
    seen_points,
    sensor_covariances,
    some_points,
)
from trifix.errors import ConfigError
from trifix.geometry.pose import Pose, skew
from trifix.records import Fix, ReferenceMap, SensorPoints, StereoMatches, TargetState
from trifix.stages.update import UpdateOptions, found_map, update


def fix_of(T: Pose, point: list[int], target: list[int], sigma_mm: float = 1e-6, sigma_rad: float = 1e-9) -> Fix:
    cov = np.diag([sigma_mm**2] * 3 + [sigma_rad**2] * 3)
    return Fix(T, cov, np.array(point, dtype=np.int64), np.array(target, dtype=np.int64), np.zeros(len(point)), 1e-20)


def spheres(n: int, sigma_mm: float) -> np.ndarray:
    return np.tile(sigma_mm**2 * np.eye(3), (n, 1, 1))


def columns(map: ReferenceMap) -> dict[str, np.ndarray]:
    return {name: getattr(map, name) for name in MAP_COLUMNS}


# --- known targets ---------------------------------------------------------------------------------------------------


def test_a_target_and_its_sighting_are_weighted_by_their_covariances():
    world = np.array([[0.0, 0, 0], [50, 0, 0], [0, 60, 0]])
    C_map = spheres(3, 0.2) + np.diag([0.3, 0.0, 0.0])
    C_seen = spheres(3, 0.1) + np.diag([0.0, 0.0, 0.5])
    T = Pose(np.eye(3), np.array([0.0, 0, -450]))
    seen = world + [0.3, -0.2, 0.1]
    map = ReferenceMap.given(world, C_map)
    after, added = update(
        map, points_of(T.inverse().apply(seen), C_seen), None, fix_of(T, [0, 1, 2], [0, 1, 2]), 5, None, 3
    )
    W_map, W_seen = np.linalg.inv(C_map[0]), np.linalg.inv(C_seen[0])
    C = np.linalg.inv(W_map + W_seen)
    np.testing.assert_allclose(after.xyz_mm, (C @ (W_map @ world.T + W_seen @ seen.T)).T, atol=1e-6)
    np.testing.assert_allclose(after.cov_mm2, np.tile(C, (3, 1, 1)), atol=1e-6)
    np.testing.assert_array_equal(after.sightings, 1)
    np.testing.assert_array_equal(after.last_seen, 5)
    assert len(added) == 0


def test_the_pose_adds_its_share_to_the_sighting():
    """A pose that is known to 1 mm adds little to a map that is known to 0.1 mm."""
    world = np.array([[0.0, 0, 0], [50, 0, 0], [0, 60, 0]])
    T = Pose(np.eye(3), np.array([0.0, 0, -450]))
    points = points_of(T.inverse().apply(world + [1.0, 0, 0]), spheres(3, 0.1))
    fix = fix_of(T, [0, 1, 2], [0, 1, 2], sigma_mm=1.0)
    after, _ = update(ReferenceMap.given(world, spheres(3, 0.1)), points, None, fix, 1, None, 3)
    moved = after.xyz_mm[:, 0] - world[:, 0]
    np.testing.assert_allclose(moved, 0.01 / (0.01 + 0.01 + 1.0), rtol=1e-3)


def test_errors_of_the_map_follow_its_covariances():
    """Targets seen from 25 known poses: chi-square of three degrees of freedom a target."""
    rng = np.random.default_rng(1)
    total, freedoms = 0.0, 0
    for _ in range(12):
        world = scattered(rng, 20)
        rows = list(range(20))
        map = ReferenceMap.given(world, spheres(20, 0.2))
        map.xyz_mm[:] += noise(rng, map.cov_mm2)
        for k in range(25):
            T = looking(rng)
            map, _ = update(map, seen_points(world, T, rng), None, fix_of(T, rows, rows), k, None, 20)
        r = map.xyz_mm - world
        total += float(np.einsum("ni,ni->", r, np.linalg.solve(map.cov_mm2, r[:, :, None])[:, :, 0]))
        freedoms += 60
        assert float(np.sqrt(np.trace(map.cov_mm2, axis1=1, axis2=2)).max()) < 0.05
    low, high = chi2_limits(freedoms)
    assert low < total < high


def test_the_view_of_a_target_is_the_mean_direction_to_the_sensor():
    world = np.array([[0.0, 0, 0], [40, 0, 0], [0, 40, 0]])
    map = ReferenceMap.given(world, spheres(3, 0.1))
    for x in (-300.0, 300.0):
        T = Pose(np.eye(3), np.array([x, 0.0, -400.0]))
        points = points_of(T.inverse().apply(world), spheres(3, 0.1))
        map, _ = update(map, points, None, fix_of(T, [0, 1, 2], [0, 1, 2]), 0, None, 3)
    np.testing.assert_allclose(map.view[0], [0, 0, -1], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(map.view, axis=1), 1.0)


def test_a_target_is_trusted_after_enough_sightings():
    rng = np.random.default_rng(2)
    world = scattered(rng, 8) + [60, 0, 450]
    rows = list(range(8))
    map, _ = found_map(seen_points(world, Pose.identity(), rng), 0)
    states = [map.state.copy()]
    for k in range(1, 5):
        map, _ = update(
            map, seen_points(world, Pose.identity(), rng), None, fix_of(Pose.identity(), rows, rows), k, None, 8,
            UpdateOptions(trusted_after=4),
        )  # fmt: skip
        states.append(map.state.copy())
    assert [bool((s == TargetState.trusted).all()) for s in states] == [False, False, False, True, True]
    assert [bool((s == TargetState.provisional).all()) for s in states] == [True, True, True, False, False]


# --- new targets -----------------------------------------------------------------------------------------------------


def test_the_first_frame_is_the_map():
    rng = np.random.default_rng(3)
    points = seen_points(scattered(rng, 9) + [60, 0, 450], Pose.identity(), rng)
    map, added = found_map(points, 17)
    np.testing.assert_array_equal(map.xyz_mm, points.xyz_mm)
    np.testing.assert_allclose(map.cov_mm2, points.cov_mm2)
    np.testing.assert_array_equal(map.id, np.arange(9))
    np.testing.assert_array_equal(added, np.arange(9))
    np.testing.assert_array_equal(map.last_seen, 17)
    np.testing.assert_array_equal(map.sightings, 1)
    toward = -points.xyz_mm / np.linalg.norm(points.xyz_mm, axis=1, keepdims=True)
    np.testing.assert_allclose(map.view, toward)


def test_new_points_enter_with_the_uncertainty_of_the_pose():
    """Monte Carlo: places of a new target as many poses of the stated covariance would make them."""
    rng = np.random.default_rng(4)
    world = scattered(rng, 5)
    T = looking(rng)
    # the sensor turns about the targets rather than about itself: translation and rotation go together
    B = np.eye(6)
    B[:3, 3:] = skew(T.inverse().apply(np.zeros((1, 3)))[0])
    B = B @ np.diag([0.03] * 3 + [2e-3] * 3)
    total = 0.0
    trials = 400
    for _ in range(trials):
        fix = replace(fix_of(T @ Pose.exp(B @ rng.normal(size=6)), [0, 1, 2], [0, 1, 2]), cov=B @ B.T)
        after, added = update(front_map(world[:3], 0.05), seen_points(world, T, rng), None, fix, 1, None, 100)
        np.testing.assert_array_equal(added, [3, 4])
        np.testing.assert_array_equal(after.id[added], [100, 101])
        assert (after.state[added] == TargetState.provisional).all()
        r = after.xyz_mm[3] - world[3]
        total += float(r @ np.linalg.solve(after.cov_mm2[3], r))
    assert abs(total / (3 * trials) - 1) < 4 * sqrt(2 / (3 * trials))


def test_a_point_that_may_be_a_known_target_is_not_new():
    world = np.array([[0.0, 0, 0], [50, 0, 0], [0, 60, 0], [40, 40, 0]])
    T = Pose(np.eye(3), np.array([0.0, 0, -450]))
    map = ReferenceMap.given(world, spheres(4, 0.1))
    for offset_mm, is_new in ((0.5, False), (3.0, True)):
        xyz = np.vstack([world[:3], world[3] + [offset_mm, 0, 0]])
        after, added = update(
            map, points_of(T.inverse().apply(xyz), spheres(4, 0.1)), None, fix_of(T, [0, 1, 2], [0, 1, 2]), 1, None, 4
        )
        assert len(added) == is_new
        assert len(after) == 4 + is_new


def test_a_point_that_shares_a_dot_with_an_identified_one_does_not_enter():
    rng = np.random.default_rng(5)
    world = scattered(rng, 6)
    T = looking(rng)
    points = seen_points(world, T, rng)
    points = SensorPoints(points.xyz_mm, points.cov_mm2, np.arange(6), points.label, points.row)
    # point 3 shares its left dot with point 0, point 4 its right dot with point 1, point 5 none
    matches = StereoMatches(np.array([0, 1, 2, 0, 4, 5]), np.array([0, 1, 2, 3, 1, 5]), np.zeros(6), np.full(6, 0.1))
    after, added = update(front_map(world[:3], 0.05), points, matches, fix_of(T, [0, 1, 2], [0, 1, 2]), 1, RIG, 3)
    assert len(added) == 1
    np.testing.assert_allclose(after.xyz_mm[added[0]], T.apply(points.xyz_mm[5:])[0], atol=1e-9)


def test_a_map_that_sees_itself_again_does_not_grow():
    rng = np.random.default_rng(6)
    world = scattered(rng, 20) + [60, 0, 450]
    rows = list(range(20))
    map, _ = found_map(seen_points(world, Pose.identity(), rng), 0)
    for k in range(1, 8):
        map, added = update(
            map, seen_points(world, Pose.identity(), rng), None, fix_of(Pose.identity(), rows[:12], rows[:12]), k,
            None, 20,
        )  # fmt: skip
        assert len(added) == 0
    assert len(map) == 20


# --- ghosts and names ------------------------------------------------------------------------------------------------


def ghost_story(max_misses: int, frames: int) -> ReferenceMap:
    """A first frame of eight targets and a ghost among them, which no later frame sees."""
    rng = np.random.default_rng(7)
    world = scattered(rng, 9) + [60, 0, 450]
    order = [*range(9)]
    order[8] = int(np.argmin(np.linalg.norm(world - world.mean(axis=0), axis=1)))  # in the middle of the others
    order[order[8]] = 8
    world = world[order]
    map, _ = found_map(seen_points(world, Pose.identity(), rng), 0)
    rows = list(range(8))
    for k in range(1, frames + 1):
        points = some_points(seen_points(world, Pose.identity(), rng), np.arange(8))
        map, _ = update(
            map, points, None, fix_of(Pose.identity(), rows, rows), k, RIG, 9, UpdateOptions(max_misses=max_misses)
        )
    return map


def test_a_ghost_is_dropped():
    assert ghost_story(5, 5).state[8] == TargetState.provisional
    after = ghost_story(5, 6)
    assert after.state[8] == TargetState.removed
    assert not after.alive[8]
    assert after.alive[:8].all()


def test_a_ghost_may_be_kept():
    assert ghost_story(0, 40).state[8] == TargetState.provisional


def test_a_trusted_target_is_not_dropped():
    rng = np.random.default_rng(8)
    world = scattered(rng, 9) + [60, 0, 450]
    map = ReferenceMap.given(world, spheres(9, 0.05), np.tile([0.0, 0.0, -1.0], (9, 1)))
    rows = list(range(8))
    for k in range(60):
        points = some_points(seen_points(world, Pose.identity(), rng), np.arange(8))
        map, _ = update(map, points, None, fix_of(Pose.identity(), rows, rows), k, RIG, 9)
    assert map.state[8] == TargetState.trusted


@pytest.mark.parametrize("rig", [PARALLEL, None], ids=["with rig", "without"])
def test_what_could_not_be_seen_is_not_missed(rig):
    rng = np.random.default_rng(9)
    seen = scattered(rng, 8, (150, 120, 60)) + [60, 0, 450]
    unseen = np.array([[60, 0, 450], [2000, 0, 450], [60, 0, -450]])  # turned away, beside the image, behind
    world = np.vstack([seen, unseen])
    view = np.tile([0.0, 0.0, -1.0], (11, 1))
    view[8] = [0, 0, 1]
    map = ReferenceMap.given(
        world, spheres(11, 0.05), view, sightings=np.ones(11, dtype=np.int64), state=np.zeros(11, dtype=np.int64)
    )
    rows = list(range(8))
    for k in range(20):
        points = seen_points(seen, Pose.identity(), rng)
        map, _ = update(map, points, None, fix_of(Pose.identity(), rows, rows), k, rig, 11)
    np.testing.assert_array_equal(map.misses, 0)
    assert map.alive.all()


def test_rows_stay_and_no_name_is_given_twice():
    """Random coming and going: a row is the same target for as long as it lives, and then gets another name."""
    rng = np.random.default_rng(10)
    world = scattered(rng, 12) + [60, 0, 450]
    map, added = found_map(seen_points(world, Pose.identity(), rng), 0)
    next_id, rows = 12, list(range(12))
    place: dict[int, np.ndarray] = dict(zip(map.id.tolist(), map.xyz_mm.copy(), strict=True))
    row_of: dict[int, int] = dict(zip(map.id.tolist(), range(12), strict=True))
    gone: set[int] = set()
    reused = 0
    for k in range(1, 60):
        ghosts = rng.uniform([0, -60, 430], [120, 60, 470], (2, 3))
        near = np.linalg.norm(ghosts[:, None] - world, axis=2).min(axis=1) < 5
        points = seen_points(np.vstack([world, ghosts[~near]]), Pose.identity(), rng)
        length = len(map)
        map, added = update(
            map, points, None, fix_of(Pose.identity(), rows, rows), k, RIG, next_id, UpdateOptions(max_misses=2)
        )
        np.testing.assert_array_equal(np.sort(map.id[added]), np.arange(next_id, next_id + len(added)))
        next_id += len(added)
        reused += int((added < length).sum())
        for row in added.tolist():
            place[int(map.id[row])], row_of[int(map.id[row])] = map.xyz_mm[row].copy(), row
        alive = set(map.id[map.alive].tolist())
        gone |= set(row_of) - alive
        assert not gone & alive
        for row in np.flatnonzero(map.alive).tolist():
            assert row_of[int(map.id[row])] == row
            assert np.linalg.norm(place[int(map.id[row])] - map.xyz_mm[row]) < 1.0
    assert map.alive[:12].all()
    assert gone
    assert reused  # rows of the dropped are used again


def test_the_given_map_is_left_as_it_was():
    rng = np.random.default_rng(11)
    world = scattered(rng, 10)
    T = looking(rng)
    map = front_map(world[:6], 0.05)
    before = columns(map.copy())
    for array in columns(map).values():
        array.flags.writeable = False
    points = seen_points(world, T, rng)
    rows = list(range(6))
    after, _ = update(map, points, None, fix_of(T, rows, rows), 1, RIG, 6)
    for name, array in columns(map).items():
        np.testing.assert_array_equal(array, before[name])
    assert len(after) == 10


def test_without_new_points_nothing_enters():
    rng = np.random.default_rng(12)
    world = scattered(rng, 4)
    T = looking(rng)
    rows = list(range(4))
    after, added = update(front_map(world, 0.05), seen_points(world, T, rng), None, fix_of(T, rows, rows), 1, None, 4)
    assert len(added) == 0
    assert len(after) == 4


def test_covariances_stay_symmetric_and_positive():
    rng = np.random.default_rng(13)
    world = scattered(rng, 6)
    rows = list(range(6))
    map = ReferenceMap.given(world, spheres(6, 5.0))
    for k in range(300):
        T = looking(rng)
        xyz = T.inverse().apply(world)
        map, _ = update(map, points_of(xyz, sensor_covariances(xyz)), None, fix_of(T, rows, rows), k, None, 6)
    np.testing.assert_array_equal(map.cov_mm2, np.swapaxes(map.cov_mm2, 1, 2))
    assert np.linalg.eigvalsh(map.cov_mm2).min() > 0


@pytest.mark.parametrize(
    "values", [{"trusted_after": 0}, {"max_misses": -1}, {"new_target_sigmas": -1.0}], ids=lambda v: next(iter(v))
)
def test_impossible_options_are_refused(values):
    with pytest.raises(ConfigError, match=r"update\.trusted_after"):
        UpdateOptions(**values)
