"""Verification by residuals alone: which points are in E, and why a pose or a frame is rejected."""

import numpy as np
import pytest

from trifix.geometry.pose import Pose
from trifix.records import Fix, NoFix, Orientations, Reason, ReferenceMap, SensorPoints
from trifix.stages.verify_residual import verify_residual

T_TRUE = Pose.exp(np.array([100.0, -40, 30, 0.4, -0.3, 0.8]))


def points_of(xyz_world_mm: np.ndarray, sigma_mm: float = 0.1) -> SensorPoints:
    n = len(xyz_world_mm)
    return SensorPoints(
        T_TRUE.inverse().apply(xyz_world_mm),
        np.tile(np.eye(3) * sigma_mm**2, (n, 1, 1)),
        np.full(n, -1),
        np.full(n, -1),
        np.arange(n),
    )


def hypotheses(*poses: Pose) -> Orientations:
    h = len(poses)
    return Orientations(
        np.array([T.R for T in poses]).reshape(h, 3, 3),
        np.array([T.t_mm for T in poses]).reshape(h, 3),
        np.zeros((h, 6, 6)),
        np.ones(h, dtype=np.bool_),
        np.zeros(h),
    )


def scatter(n: int = 20, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-100, 100, size=(n, 3))


def verified(points: SensorPoints, map: ReferenceMap, *poses: Pose, max_residual_mm: float = 1.0) -> Fix | NoFix:
    return verify_residual(points, map, hypotheses(*poses), counterpart_mm=3.0, max_residual_mm=max_residual_mm)


def test_a_rough_pose_is_estimated_again_from_all_points_that_have_a_counterpart() -> None:
    xyz = scatter()
    noise = 0.05 * np.random.default_rng(2).normal(size=(8, 3))
    rough = T_TRUE @ Pose.exp(np.array([0.8, -0.5, 0.6, 0.006, 0.004, -0.005]))
    fix = verified(points_of(xyz[:8] + noise), ReferenceMap.given(xyz), rough)
    assert isinstance(fix, Fix)
    assert fix.point.tolist() == fix.target.tolist() == list(range(8))
    assert fix.T_world_sensor.distance_mm(T_TRUE) < 0.2
    assert 0.02 < fix.rms_mm < 0.1
    assert np.isnan(fix.p_chance)
    assert (np.linalg.eigvalsh(fix.cov) > 0).all()


def test_a_point_with_two_counterparts_is_left_out() -> None:
    xyz = scatter()
    crowded = np.concatenate([xyz, xyz[2:3] + np.array([1.0, 0.0, 0.0])])
    fix = verified(points_of(xyz[:6]), ReferenceMap.given(crowded), T_TRUE)
    assert isinstance(fix, Fix)
    assert fix.point.tolist() == [0, 1, 3, 4, 5]


def test_of_two_points_with_one_target_the_nearer_keeps_it() -> None:
    xyz = scatter()
    aside = np.array([1.0, 0.0, 0.0])
    points = points_of(np.concatenate([xyz[:1] + 0.4 * aside, xyz[1:5], xyz[:1] + 0.1 * aside]))
    fix = verified(points, ReferenceMap.given(xyz), T_TRUE)
    assert isinstance(fix, Fix)
    assert fix.point.tolist() == [1, 2, 3, 4, 5]
    assert fix.target.tolist() == [1, 2, 3, 4, 0]


def test_targets_that_are_not_alive_are_no_counterparts() -> None:
    xyz = scatter()
    map = ReferenceMap.given(xyz, state=np.where(np.arange(20) == 3, 2, 1))
    fix = verified(points_of(xyz[:6]), map, T_TRUE)
    assert isinstance(fix, Fix)
    assert fix.point.tolist() == [0, 1, 2, 4, 5]


def test_a_false_pose_is_rejected_and_a_true_one_among_false_ones_is_found() -> None:
    xyz = scatter()
    points, map = points_of(xyz[:8]), ReferenceMap.given(xyz)
    rng = np.random.default_rng(3)
    false = [T_TRUE @ Pose.exp(np.concatenate([rng.normal(size=3) * 50, rng.normal(size=3)])) for _ in range(50)]
    refusal = verified(points, map, *false)
    assert isinstance(refusal, NoFix)
    assert refusal.why is Reason.residual
    fix = verified(points, map, *false, T_TRUE)
    assert isinstance(fix, Fix)
    assert len(fix.point) == 8


def test_residuals_above_the_threshold_reject() -> None:
    xyz = scatter()
    points = points_of(xyz[:8] + np.random.default_rng(4).normal(size=(8, 3)) * 0.6)
    refusal = verified(points, ReferenceMap.given(xyz), T_TRUE, max_residual_mm=0.5)
    assert isinstance(refusal, NoFix)
    assert refusal.why is Reason.residual
    assert refusal.residual_mm > 0.5
    assert isinstance(verified(points, ReferenceMap.given(xyz), T_TRUE, max_residual_mm=2.0), Fix)


def test_two_poses_that_explain_as_many_points_are_ambiguous() -> None:
    xyz = scatter(6)
    elsewhere = Pose.exp(np.array([800.0, 0, 0, 0.5, 0.2, -1.0]))
    twice = ReferenceMap.given(np.concatenate([xyz, elsewhere.apply(xyz)]))
    refusal = verified(points_of(xyz), twice, T_TRUE, elsewhere @ T_TRUE, T_TRUE)
    assert isinstance(refusal, NoFix)
    assert refusal.why is Reason.ambiguous
    assert len(refusal.rivals) == 2
    assert {rival.matched for rival in refusal.rivals} == {6}
    # one more point on one side settles it
    more = ReferenceMap.given(np.concatenate([xyz, elsewhere.apply(xyz)[:5]]))
    assert isinstance(verified(points_of(xyz), more, elsewhere @ T_TRUE, T_TRUE), Fix)


@pytest.mark.parametrize("count", [2, 3, 8])
def test_fewer_than_three_counterparts_or_counterparts_on_one_line_are_no_pose(count: int) -> None:
    line = np.linspace(0, 100, 8)[:, None] * [1.0, 0.5, 0.2]
    refusal = verified(points_of(line[:count]), ReferenceMap.given(line), T_TRUE)
    assert isinstance(refusal, NoFix)
    assert refusal.why is Reason.residual


def test_no_hypothesis_is_no_candidate() -> None:
    xyz = scatter()
    refusal = verified(points_of(xyz[:5]), ReferenceMap.given(xyz))
    assert isinstance(refusal, NoFix)
    assert refusal.why is Reason.no_candidate
