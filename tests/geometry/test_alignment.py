import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtri
from strategies import LAW, points_before, poses

from trifix.geometry.alignment import align, align_weighted, spread_off_line_mm
from trifix.geometry.pose import Pose

MIRROR = np.diag([1.0, 1.0, -1.0])


def assert_proper(T: Pose) -> None:
    np.testing.assert_allclose(T.R @ T.R.T, np.eye(3), atol=1e-12)
    assert abs(np.linalg.det(T.R) - 1) < 1e-12


def covariances(rng: np.random.Generator, n: int, sigma_mm: float) -> np.ndarray:
    """Long along one direction, as a stereo sensor's are."""
    A = rng.normal(0, sigma_mm, (n, 3, 3)) * [0.3, 0.3, 1.0]
    return A @ np.swapaxes(A, 1, 2) + np.eye(3) * (0.2 * sigma_mm) ** 2


@LAW
@given(T=poses(), n=st.integers(3, 12), flatness=st.sampled_from([1.0, 1e-3, 1e-6, 0.0]), seed=st.integers(0, 99))
def test_exact_pairs_give_the_exact_pose_planar_ones_too(T: Pose, n: int, flatness: float, seed: int) -> None:
    p = np.random.default_rng(seed).uniform(-100, 100, (n, 3)) * [1, 1, flatness]
    found = align(p, T.apply(p))
    assert_proper(found)
    np.testing.assert_allclose(found.apply(p), T.apply(p), atol=1e-9)
    np.testing.assert_allclose(found.R, T.R, atol=1e-10)


@LAW
@given(T=poses(), seed=st.integers(0, 99))
def test_a_mirrored_constellation_is_never_answered_by_a_reflection(T: Pose, seed: int) -> None:
    p = np.random.default_rng(seed).uniform(-100, 100, (6, 3))
    found = align(p @ MIRROR, T.apply(p))
    assert_proper(found)
    assert np.abs(found.apply(p @ MIRROR) - T.apply(p)).max() > 1.0


def test_the_mirror_image_of_a_plane_is_the_view_from_behind() -> None:
    p = np.random.default_rng(1).uniform(-100, 100, (6, 3)) * [1, 1, 0]
    found = align(p * [-1, 1, 1], p)
    assert_proper(found)
    np.testing.assert_allclose(found.R, np.diag([-1.0, 1.0, -1.0]), atol=1e-12)


@LAW
@given(T=poses(), seed=st.integers(0, 99))
def test_collinear_and_coincident_points_still_give_a_motion(T: Pose, seed: int) -> None:
    p = np.outer(np.random.default_rng(seed).uniform(-100, 100, 4), [0.6, 0.0, 0.8])
    for points in (p, p * 0):
        found = align(points, T.apply(points))
        assert_proper(found)
        np.testing.assert_allclose(found.apply(points), T.apply(points), atol=1e-9)


def test_the_pose_found_has_the_least_sum_of_squares() -> None:
    rng = np.random.default_rng(2)
    b = rng.uniform(-100, 100, (8, 3))
    a = b + rng.normal(0, 1.0, b.shape)
    w = rng.uniform(0.1, 3.0, 8)
    T = align(b, a, w)
    least = w @ ((T.apply(b) - a) ** 2).sum(axis=1)
    for delta in np.eye(6) * [1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4]:
        for sign in (1, -1):
            moved = (T @ Pose.exp(sign * delta)).apply(b)
            assert w @ ((moved - a) ** 2).sum(axis=1) > least


def test_a_weight_of_two_is_a_pair_given_twice_and_zero_is_a_pair_left_out() -> None:
    rng = np.random.default_rng(3)
    b = rng.uniform(-100, 100, (6, 3))
    a = b + rng.normal(0, 1.0, b.shape)
    rows = [0, 0, 1, 2, 3, 4]
    T = align(b, a, np.array([2.0, 1, 1, 1, 1, 0]))
    twice = align(b[rows], a[rows])
    np.testing.assert_allclose(T.R, twice.R, atol=1e-12)
    np.testing.assert_allclose(T.t_mm, twice.t_mm, atol=1e-10)


@LAW
@given(T=poses(), n=st.integers(3, 12), seed=st.integers(0, 99))
def test_weighted_alignment_of_exact_pairs_is_exact(T: Pose, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    p = rng.uniform(-100, 100, (n, 3))
    found, cov = align_weighted(p, T.apply(p), covariances(rng, n, 0.1), covariances(rng, n, 0.1))
    np.testing.assert_allclose(found.R, T.R, atol=1e-9)
    np.testing.assert_allclose(found.t_mm, T.t_mm, atol=1e-7)
    assert np.linalg.eigvalsh(cov).min() > 0


def test_equal_isotropic_covariances_give_the_closed_form() -> None:
    rng = np.random.default_rng(4)
    b = rng.uniform(-100, 100, (8, 3))
    a = b + rng.normal(0, 0.5, b.shape)
    same = np.tile(np.eye(3) * 0.25, (8, 1, 1))
    T, _ = align_weighted(b, a, same, same)
    expected = align(b, a)
    np.testing.assert_allclose(T.R, expected.R, atol=1e-9)
    np.testing.assert_allclose(T.t_mm, expected.t_mm, atol=1e-7)


def test_weighted_alignment_beats_the_closed_form_when_errors_are_long_in_depth() -> None:
    rng = np.random.default_rng(5)
    plain, weighted = [], []
    for _ in range(200):
        b = points_before(rng, 6)
        cov = np.tile(np.diag([0.05, 0.05, 1.0]) ** 2, (6, 1, 1))
        measured = b + rng.normal(0, 1, b.shape) * [0.05, 0.05, 1.0]
        zero = np.zeros_like(cov)
        plain.append(align(measured, b).log())
        weighted.append(align_weighted(measured, b, cov, zero)[0].log())
    assert np.std(weighted, axis=0)[:2].max() < 0.7 * np.std(plain, axis=0)[:2].max()


@pytest.mark.parametrize("n", [3, 4, 10])
def test_covariance_is_that_of_noisy_points(n: int) -> None:
    rng = np.random.default_rng(6 + n)
    T = Pose.exp(np.array([100.0, -50.0, 30.0, 0.4, -0.9, 0.2]))
    nees = []
    for _ in range(600):
        b = points_before(rng, n)
        C_b, C_a = covariances(rng, n, 0.1), covariances(rng, n, 0.05)
        noise_b = np.einsum("nij,nj->ni", np.linalg.cholesky(C_b), rng.normal(size=(n, 3)))
        noise_a = np.einsum("nij,nj->ni", np.linalg.cholesky(C_a), rng.normal(size=(n, 3)))
        found, cov = align_weighted(b + noise_b, T.apply(b) + noise_a, C_b, C_a)
        delta = (found.inverse() @ T).log()  # T_true = T_found · exp(δ)
        nees.append(delta @ np.linalg.solve(cov, delta))
    assert chdtri(6 * 600, 1 - 5e-4) < np.sum(nees) < chdtri(6 * 600, 5e-4)
    assert abs((np.array(nees) > chdtri(6, 0.5)).mean() - 0.5) < 4 * 0.5 / np.sqrt(600)


def test_undetermined_poses_raise() -> None:
    line = np.outer(np.array([0.0, 10.0, 25.0, 70.0]), [0.6, 0.0, 0.8]) + np.array([1.0, 2.0, 500.0])
    cov = np.tile(np.eye(3), (4, 1, 1))
    with pytest.raises(np.linalg.LinAlgError, match="not on one line"):
        align_weighted(line, line, cov, cov)
    two = points_before(np.random.default_rng(7), 2)
    with pytest.raises(np.linalg.LinAlgError, match="fewer than three"):
        align_weighted(two, two, cov[:2], cov[:2])


@LAW
@given(T=poses(), seed=st.integers(0, 99))
def test_spread_off_a_line_is_the_rms_distance_from_it_wherever_it_lies(T: Pose, seed: int) -> None:
    rng = np.random.default_rng(seed)
    along, angle = rng.uniform(-100, 100, 40), rng.uniform(0, 2 * np.pi, 20)
    across = 2.0 * np.c_[np.cos(angle), np.sin(angle)]
    p = np.c_[np.r_[along[:20], along[:20]], np.r_[across, -across]]  # pairs on a tube of radius 2 about the x axis
    assert spread_off_line_mm(T.apply(p)) <= 2.0 + 1e-9
    assert spread_off_line_mm(T.apply(p)) > 1.9
    assert spread_off_line_mm(T.apply(p * [1, 0, 0])) < 1e-9


def test_fewer_than_three_points_have_no_spread_off_a_line() -> None:
    assert spread_off_line_mm(np.zeros((0, 3))) == 0.0
    assert spread_off_line_mm(np.array([[0.0, 0, 0], [5, 5, 5]])) == 0.0
