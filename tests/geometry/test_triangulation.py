import cv2
import numpy as np
import pytest
from scipy.special import chdtri
from strategies import RIGS, points_before

from trifix.geometry.camera import StereoRig
from trifix.geometry.epipolar import essential_matrix
from trifix.geometry.pose import Pose
from trifix.geometry.triangulation import Method, linear, midpoint, optimal, triangulate, with_covariance

EACH = pytest.mark.parametrize("rig", list(RIGS.values()), ids=list(RIGS))
SIGMA = 0.3 / 900


def slopes(rig: StereoRig, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    in_right = rig.T_right_left.apply(xyz_mm)
    return xyz_mm[:, :2] / xyz_mm[:, 2:], in_right[:, :2] / in_right[:, 2:]


def noisy(rig: StereoRig, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xyz = points_before(rng, n)
    left, right = slopes(rig, xyz)
    return xyz, left + rng.normal(0, SIGMA, left.shape), right + rng.normal(0, SIGMA, right.shape)


def equal_cov(n: int) -> np.ndarray:
    return np.tile(np.eye(2) * SIGMA**2, (n, 1, 1))


@EACH
def test_every_method_finds_exact_points(rig: StereoRig) -> None:
    xyz = points_before(np.random.default_rng(1), 50)
    left, right = slopes(rig, xyz)
    for found in (
        midpoint(rig, left, right),
        linear(rig, left, right),
        optimal(rig, left, right),
        triangulate(rig, left, right, equal_cov(50), equal_cov(50))[0],
    ):
        np.testing.assert_allclose(found, xyz, atol=1e-6)


@EACH
def test_midpoint_halves_the_shortest_segment(rig: StereoRig) -> None:
    _, left, right = noisy(rig, 50, 2)
    middle = midpoint(rig, left, right)
    d_left = np.c_[left, np.ones(50)]
    d_right = np.c_[right, np.ones(50)] @ rig.T_right_left.R
    normal = np.cross(d_left, d_right)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    to_left = -(middle * normal).sum(axis=1)
    to_right = ((rig.right_centre_mm - middle) * normal).sum(axis=1)
    np.testing.assert_allclose(to_left, -to_right, atol=1e-9)
    # its feet lie on the rays
    assert np.abs(np.cross(middle + to_left[:, None] * normal, d_left)).max() < 1e-6
    assert np.abs(np.cross(middle + to_right[:, None] * normal - rig.right_centre_mm, d_right)).max() < 1e-6


@EACH
def test_linear_is_opencvs_and_midpoint_is_near(rig: StereoRig) -> None:
    _, left, right = noisy(rig, 100, 3)
    P_right = np.c_[rig.T_right_left.R, rig.T_right_left.t_mm / rig.baseline_mm]
    X = cv2.triangulatePoints(np.eye(3, 4), P_right, left.T.copy(), right.T.copy())
    theirs = (X[:3] / X[3]).T * rig.baseline_mm
    np.testing.assert_allclose(linear(rig, left, right), theirs, atol=1e-6)
    distance = np.linalg.norm(midpoint(rig, left, right) - theirs, axis=1)
    assert np.median(distance) < 0.02
    assert distance.max() < 0.5


@EACH
def test_optimal_is_opencvs_corrected_pair(rig: StereoRig) -> None:
    _, left, right = noisy(rig, 60, 4)
    left2, right2 = cv2.correctMatches(essential_matrix(rig), left[None], right[None])
    theirs = midpoint(rig, left2[0], right2[0])
    np.testing.assert_allclose(optimal(rig, left, right), theirs, atol=1e-4)


@EACH
def test_weighted_triangulation_with_equal_weights_is_optimal(rig: StereoRig) -> None:
    _, left, right = noisy(rig, 60, 5)
    xyz, _ = triangulate(rig, left, right, equal_cov(60), equal_cov(60), iterations=4)
    np.testing.assert_allclose(xyz, optimal(rig, left, right), atol=2e-4)


@EACH
def test_two_iterations_suffice(rig: StereoRig) -> None:
    _, left, right = noisy(rig, 200, 6)
    two, _ = triangulate(rig, left, right, equal_cov(200), equal_cov(200))
    many, _ = triangulate(rig, left, right, equal_cov(200), equal_cov(200), iterations=10)
    assert np.abs(two - many).max() < 2e-3


LEFT_COV = np.array([[2.0, 0.6], [0.6, 0.5]]) * SIGMA**2
RIGHT_COV = np.array([[0.7, -0.2], [-0.2, 1.1]]) * SIGMA**2


@EACH
@pytest.mark.parametrize(("method", "n"), [(None, 4000), (midpoint, 4000), (linear, 4000), (optimal, 400)])
def test_covariance_is_that_of_noisy_dots(rig: StereoRig, method: Method | None, n: int) -> None:
    rng = np.random.default_rng(7)
    xyz = points_before(rng, n)
    left, right = slopes(rig, xyz)
    left = left + rng.multivariate_normal(np.zeros(2), LEFT_COV, n)
    right = right + rng.multivariate_normal(np.zeros(2), RIGHT_COV, n)
    given = rig, left, right, np.tile(LEFT_COV, (n, 1, 1)), np.tile(RIGHT_COV, (n, 1, 1))
    found, cov = triangulate(*given) if method is None else with_covariance(method, *given)
    error = found - xyz
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    # the sum of n chi-square variables of 3 degrees, both tails at one in ten thousand
    assert chdtri(3 * n, 1 - 5e-5) < nees.sum() < chdtri(3 * n, 5e-5)
    for tail in (0.05, 0.95):
        assert abs((nees > chdtri(3, tail)).mean() - tail) < 4 * np.sqrt(0.05 * 0.95 / n)


@EACH
def test_no_method_claims_to_be_better_than_the_weighted_one(rig: StereoRig) -> None:
    _, left, right = noisy(rig, 100, 8)
    given = rig, left, right, np.tile(LEFT_COV, (100, 1, 1)), np.tile(RIGHT_COV, (100, 1, 1))
    least = triangulate(*given, iterations=4)[1]
    for method in (midpoint, linear, optimal):
        more = with_covariance(method, *given)[1] - least
        # less than a part in a hundred below: the covariances are taken at points that differ by the noise
        assert (np.linalg.eigvalsh(more)[:, 0] > -0.01 * np.linalg.eigvalsh(least)[:, 2]).all()


@EACH
def test_propagated_covariance_of_the_optimum_is_that_of_least_squares(rig: StereoRig) -> None:
    xyz = points_before(np.random.default_rng(9), 50)
    given = rig, *slopes(rig, xyz), equal_cov(50), equal_cov(50)
    np.testing.assert_allclose(with_covariance(optimal, *given)[1], triangulate(*given)[1], rtol=1e-3, atol=1e-6)


def test_parallel_and_diverging_rays_give_nan() -> None:
    rig = RIGS["parallel"]
    left = np.array([[0.1, 0.0], [0.1, 0.0], [0.1, 0.0], [np.nan, 0.0]])
    right = np.array([[0.1, 0.0], [0.2, 0.0], [-0.1, 0.0], [0.0, 0.0]])
    xyz, cov = triangulate(rig, left, right, equal_cov(4), equal_cov(4))
    assert np.isfinite(xyz).all(axis=1).tolist() == [False, False, True, False]
    assert np.isfinite(cov).all(axis=(1, 2)).tolist() == [False, False, True, False]
    assert np.isnan(midpoint(rig, left, right)[0]).all()
    for method in (linear, optimal):
        assert np.isnan(method(rig, left, right)[3]).all()


def test_no_pairs_give_no_points() -> None:
    none = np.zeros((0, 2))
    xyz, cov = triangulate(RIGS["convergent"], none, none, equal_cov(0), equal_cov(0))
    assert xyz.shape == (0, 3)
    assert cov.shape == (0, 3, 3)
    for method in (midpoint, linear, optimal):
        assert method(RIGS["convergent"], none, none).shape == (0, 3)


def test_nearly_parallel_rays_of_a_far_point_stay_in_front() -> None:
    rig = RIGS["parallel"]
    xyz = np.array([[1e3, -2e3, 1e7]])
    left, right = slopes(rig, xyz)
    for method in (midpoint, linear, optimal):
        assert abs(method(rig, left, right)[0, 2] / 1e7 - 1) < 1e-3


def test_sensor_coordinates_are_the_left_cameras() -> None:
    rig = StereoRig(RIGS["parallel"].left, RIGS["parallel"].right, Pose(np.eye(3), np.array([-100.0, 0.0, 0.0])))
    xyz = midpoint(rig, np.array([[0.1, 0.2]]), np.array([[-0.1, 0.2]]))
    np.testing.assert_allclose(xyz, [[50.0, 100.0, 500.0]], atol=1e-9)
