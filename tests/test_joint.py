"""The joint covariance of a map's targets: exact where they are held, never too small where they are put away."""

from dataclasses import replace

import numpy as np
import pytest

from constellations import chi2_limits, nees, points_of, sensor_covariances
from constellations import noise as drawn
from trifix.geometry.alignment import align_weighted, point_jacobian
from trifix.geometry.pose import Pose
from trifix.joint import JointMap
from trifix.records import Fix, PositionedReason, ReferenceMap, SensorPoints, SingleDots, TargetState
from trifix.stages.update import UpdateOptions, found_map, update

OPTIONS = UpdateOptions(max_misses=0, new_target_sigmas=0.0)
MANY = 10_000


class Walk:
    """A sensor that sees some targets in every frame, knows which they are, and maps them."""

    def __init__(self, world: np.ndarray, rng: np.random.Generator, capacity: int) -> None:
        self.world, self.rng = world, rng
        self.joint = JointMap(capacity)
        self.map = ReferenceMap.empty()
        self.row_of = np.full(len(world), -1)
        self.seen: list[tuple[np.ndarray, SensorPoints]] = []
        self.errors: list[float] = []
        self.T_true: Pose | None = None

    def see(self, targets: np.ndarray, T: Pose) -> None:
        """One frame, of which the map learns; what it is told of it is compared with the truth."""
        xyz = T.inverse().apply(self.world[targets])
        cov = sensor_covariances(xyz)
        points = points_of(xyz + drawn(self.rng, cov), cov)
        self.seen.append((targets, points))
        k = len(self.seen)
        if self.T_true is None:
            self.T_true = T
            self.map, added = found_map(points, 0, 0, self.joint)
            self.row_of[targets] = added
            return
        rows = self.row_of[targets]
        point = np.flatnonzero(rows >= 0)
        target = rows[point]
        T_est, cov = align_weighted(
            points.xyz_mm[point], self.map.xyz_mm[target], points.cov_mm2[point], self.map.cov_mm2[target]
        )
        fix = Fix(T_est, cov, point, target, np.zeros(len(point)), 1e-20)
        told, told_cov = self.joint.settle(self.map, points, fix)
        self.errors.append(nees(told, told_cov, self.T_true.inverse() @ T))
        self.map, added = update(self.map, points, None, fix, k, None, len(self.map), OPTIONS, self.joint)
        self.row_of[targets[rows < 0]] = added

    def errors_of_targets(self) -> np.ndarray:
        """By how much known targets are wrong (mm), row by row."""
        assert self.T_true is not None
        known = np.flatnonzero(self.row_of >= 0)
        out = np.zeros((len(self.map), 3))
        out[self.row_of[known]] = self.T_true.inverse().apply(self.world[known]) - self.map.xyz_mm[self.row_of[known]]
        return out


def strip(rng: np.random.Generator, n: int, apart_mm: float = 20.0) -> np.ndarray:
    """Targets along x, on a band 120 mm wide and 40 mm deep."""
    return np.stack([apart_mm * np.arange(n), rng.uniform(-60, 60, n), 450 + rng.uniform(-20, 20, n)], axis=1)


def along(world: np.ndarray, x_mm: float) -> tuple[np.ndarray, Pose]:
    """The targets within 150 mm of a place along the strip, and a sensor before it."""
    return np.flatnonzero(np.abs(world[:, 0] - x_mm) < 150.0), Pose.exp(
        np.array([x_mm, 5.0, 0.0, 0.0, 0.0, 1e-3 * x_mm])
    )


def there_and_back(walk: Walk, end_mm: float, steps: int) -> None:
    way = np.concatenate([np.linspace(0, end_mm, steps), np.linspace(end_mm, 0, steps)[1:]])
    for x_mm in way:
        walk.see(*along(walk.world, float(x_mm)))


def all_at_once(walk: Walk) -> tuple[np.ndarray, np.ndarray]:
    """Positions and their covariance by least squares over all frames, the first one's pose being exact."""
    k, f = len(walk.map), len(walk.seen)
    xyz = walk.map.xyz_mm.copy()
    poses = [Pose.identity()] * f
    for i, (targets, points) in enumerate(walk.seen[1:], start=1):
        rows = walk.row_of[targets]
        poses[i] = align_weighted(points.xyz_mm, xyz[rows], points.cov_mm2, np.zeros_like(points.cov_mm2))[0]
    cov = np.zeros((0, 0))
    for _ in range(4):
        A, g = np.zeros((3 * k + 6 * f, 3 * k + 6 * f)), np.zeros(3 * k + 6 * f)
        for i, (targets, points) in enumerate(walk.seen):
            T, rows = poses[i], walk.row_of[targets]
            seen = T.inverse().apply(xyz[rows])
            J = point_jacobian(seen)
            for j, row in enumerate(rows):
                at = np.concatenate([np.arange(3 * row, 3 * row + 3), 3 * k + np.arange(6 * i, 6 * i + 6)])
                D = np.hstack([T.R.T, -J[j]])  # of the place in sensor coordinates, by the place and by δ
                W = np.linalg.inv(points.cov_mm2[j])
                A[np.ix_(at, at)] += D.T @ W @ D
                g[at] += D.T @ W @ (points.xyz_mm[j] - seen[j])
        free = np.concatenate([np.arange(3 * k), np.arange(3 * k + 6, 3 * k + 6 * f)])
        cov = np.linalg.inv(A[np.ix_(free, free)])
        step = np.zeros(3 * k + 6 * f)
        step[free] = cov @ g[free]
        xyz += step[: 3 * k].reshape(-1, 3)
        poses = [T @ Pose.exp(step[3 * k + 6 * i : 3 * k + 6 * i + 6]) for i, T in enumerate(poses)]
    return xyz, cov[: 3 * k, : 3 * k]


def test_what_is_held_equals_least_squares_over_all_frames():
    walk = Walk(strip(np.random.default_rng(1), 24), np.random.default_rng(2), MANY)
    there_and_back(walk, 400.0, 9)
    xyz, cov = all_at_once(walk)
    filtered = walk.joint.covariance(np.arange(len(walk.map)))
    sigma = np.sqrt(np.diag(cov))
    assert np.abs(filtered - cov).max() < 0.01 * (sigma.max() ** 2)
    np.testing.assert_allclose(np.sqrt(np.diag(filtered)), sigma, rtol=0.01)
    assert np.abs((walk.map.xyz_mm - xyz).ravel() / sigma).max() < 0.05


@pytest.mark.parametrize(("capacity", "least"), [(MANY, 0.8), (30, 0.3)])
def test_poses_there_and_back_are_off_by_what_they_state(capacity, least):
    """Held, errors are as stated; put away and taken back, no larger, though covariances pay for what was dropped."""
    trials, last, half = 20, [], []
    for k in range(trials):
        rng = np.random.default_rng([3, k])
        walk = Walk(strip(rng, 60), rng, capacity)
        there_and_back(walk, 1000.0, 11)
        half.append(walk.errors[9])
        last.append(walk.errors[-1])
    low, high = chi2_limits(6 * trials)
    for errors in (half, last):
        assert least * low < sum(errors) < high


def test_a_loop_that_closes_stays_consistent():
    """Once round a ring of targets, the ends meet within what the covariance allows for, and are corrected."""
    trials, before, after = 16, [], []
    for k in range(trials):
        rng = np.random.default_rng([5, k])
        angle = 2 * np.pi * np.arange(48) / 48
        radius, height = 300 + rng.uniform(-20, 20, 48), rng.uniform(-60, 60, 48)
        world = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)
        walk = Walk(world, rng, 24)
        for turn in np.linspace(0, 2 * np.pi, 25):
            outwards = np.array([np.cos(turn), 0.0, np.sin(turn)])
            R = np.stack([np.cross([0.0, 1.0, 0.0], -outwards), np.array([0.0, 1.0, 0.0]), -outwards], axis=1)
            near = np.flatnonzero(np.abs((angle - turn + np.pi) % (2 * np.pi) - np.pi) < 0.7)
            walk.see(near, Pose(R, 750.0 * outwards))
        before.append(walk.errors[17])
        after.append(walk.errors[-1])
    low, high = chi2_limits(6 * trials)
    assert 0.3 * low < sum(before) < high
    assert 0.3 * low < sum(after) < high


def test_nothing_becomes_too_sure_by_being_put_away():
    """The covariance with some targets put away is nowhere below the exact one."""
    held, away = (Walk(strip(np.random.default_rng(1), 60), np.random.default_rng(2), n) for n in (MANY, 30))
    for walk in (held, away):
        for x_mm in np.linspace(0, 1000, 12):
            walk.see(*along(walk.world, float(x_mm)))
    rows = np.arange(len(held.map))
    exact, bound = held.joint.covariance(rows), away.joint.covariance(rows)
    less = np.linalg.eigvalsh(bound - exact)[0]
    assert less > -0.1 * np.sqrt(np.diag(exact)).min() ** 2
    assert np.sqrt(np.trace(bound) / np.trace(exact)) < 2.0


def test_a_rescaled_noise_scales_all_covariances():
    walk = Walk(strip(np.random.default_rng(1), 40), np.random.default_rng(2), 20)
    there_and_back(walk, 500.0, 8)
    rows = np.arange(len(walk.map))
    before = walk.joint.covariance(rows)
    walk.joint.rescale(1.5)
    np.testing.assert_allclose(walk.joint.covariance(rows), 2.25 * before, rtol=1e-12)


def test_what_others_do_to_the_map_is_followed():
    """A target that was moved is less sure by that; one that has left is unknown, and its row's next one is another."""
    walk = Walk(strip(np.random.default_rng(1), 20), np.random.default_rng(2), MANY)
    walk.see(*along(walk.world, 100.0))
    walk.see(*along(walk.world, 110.0))
    before = walk.joint.covariance(np.arange(3))
    xyz, state = walk.map.xyz_mm.copy(), walk.map.state.copy()
    xyz[1] += [0.0, 0.0, 2.0]
    state[2] = TargetState.removed
    map = replace(walk.map, xyz_mm=xyz, state=state)
    walk.joint.follow(map)
    after = walk.joint.covariance(np.arange(3))
    assert after[5, 5] == pytest.approx(before[5, 5] + 4.0)
    np.testing.assert_allclose(after[:3, :3], before[:3, :3])
    assert not after[6:].any()


def test_a_pose_that_single_dots_carry_owes_the_map_what_its_targets_share():
    walk = Walk(strip(np.random.default_rng(1), 40), np.random.default_rng(2), MANY)
    for x_mm in np.linspace(0, 600, 8):
        walk.see(*along(walk.world, float(x_mm)))
    targets, points = walk.seen[-1]
    rows = walk.row_of[targets]
    own = 1e-6 * np.eye(6)
    none = np.zeros(0, dtype=np.int64)
    c = len(rows)
    sides = np.zeros(c, np.int64), np.arange(c)
    dots = SingleDots(*sides, rows, np.zeros(c), np.zeros((c, 3)), np.tile(np.eye(3), (c, 1, 1)))
    fix = Fix(walk.T_true, own, none, none, np.zeros(0), 1e-20, PositionedReason.few_points, single=dots)
    T, cov = walk.joint.settle(walk.map, points, fix)
    assert T is fix.T_world_sensor
    absolute = walk.joint.covariance(rows)
    assert np.trace(cov) > np.trace(own)
    assert cov[0, 0] < 30 * np.trace(absolute)
    assert np.linalg.eigvalsh(cov - own)[0] > -1e-12


def test_to_tell_a_pose_holds_no_more_targets_than_before():
    walk = Walk(strip(np.random.default_rng(1), 60), np.random.default_rng(2), 30)
    for x_mm in np.linspace(0, 1000, 12):
        walk.see(*along(walk.world, float(x_mm)))
    unknowns, before = walk.joint.unknowns, walk.joint.covariance(np.arange(len(walk.map)))
    for targets, points in walk.seen:
        rows = walk.row_of[targets]
        T = align_weighted(points.xyz_mm, walk.map.xyz_mm[rows], points.cov_mm2, np.zeros_like(points.cov_mm2))[0]
        fix = Fix(T, np.eye(6), np.arange(len(rows)), rows, np.zeros(len(rows)), 1e-20)
        walk.joint.settle(walk.map, points, fix)
    assert walk.joint.unknowns == unknowns
    np.testing.assert_array_equal(walk.joint.covariance(np.arange(len(walk.map))), before)


def test_the_told_map_has_the_errors_that_all_targets_share():
    walk = Walk(strip(np.random.default_rng(1), 60), np.random.default_rng(2), 30)
    for x_mm in np.linspace(0, 900, 12):
        walk.see(*along(walk.world, float(x_mm)))
    told = walk.joint.told(walk.map)
    whole = walk.joint.covariance(np.arange(len(walk.map)))
    for row in (0, len(told) // 2, len(told) - 1):
        block = whole[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]
        np.testing.assert_allclose(told.cov_mm2[row], block, rtol=1e-9)
    assert np.trace(told.cov_mm2[-1]) > 2 * np.trace(walk.map.cov_mm2[-1])
    assert told.xyz_mm is walk.map.xyz_mm
    error = walk.errors_of_targets()
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(told.cov_mm2), error) / 3
    assert 0.1 < np.mean(nees) < 2.5
