import numpy as np
import pytest
from hypothesis import given
from scipy.linalg import expm
from strategies import LAW, directions, poses, tangents

from trifix.geometry.pose import Pose, exp_rotation, log_rotation, skew


def matrix(T: Pose) -> np.ndarray:
    return np.block([[T.R, T.t_mm[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def assert_same(a: Pose, b: Pose, tol_mm: float = 1e-8, tol: float = 1e-11) -> None:
    np.testing.assert_allclose(a.R, b.R, atol=tol, rtol=0)
    np.testing.assert_allclose(a.t_mm, b.t_mm, atol=tol_mm, rtol=0)


@LAW
@given(poses(), poses(), poses())
def test_composition_is_associative(a: Pose, b: Pose, c: Pose) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@LAW
@given(poses())
def test_identity_and_inverse_are_neutral(a: Pose) -> None:
    assert_same(a @ Pose.identity(), a)
    assert_same(Pose.identity() @ a, a)
    assert_same(a @ a.inverse(), Pose.identity())
    assert_same(a.inverse() @ a, Pose.identity())


@LAW
@given(poses())
def test_rotations_are_proper(a: Pose) -> None:
    np.testing.assert_allclose(a.R @ a.R.T, np.eye(3), atol=1e-13)
    assert abs(np.linalg.det(a.R) - 1) < 1e-13


@LAW
@given(poses(), poses())
def test_neighbouring_letters_cancel(T_a_b: Pose, T_b_c: Pose) -> None:
    p_c = np.array([[1.0, -2.0, 3.0], [400.0, 0.0, -70.0]])
    np.testing.assert_allclose((T_a_b @ T_b_c).apply(p_c), T_a_b.apply(T_b_c.apply(p_c)), atol=1e-9)


@LAW
@given(tangents())
def test_exp_is_the_matrix_exponential(delta: np.ndarray) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(delta[3:]), delta[:3]
    np.testing.assert_allclose(matrix(Pose.exp(delta)), expm(generator), atol=2e-10, rtol=0)


@LAW
@given(tangents())
def test_log_undoes_exp_near_zero_and_near_pi(delta: np.ndarray) -> None:
    back = Pose.exp(delta).log()
    is_half_turn = np.linalg.norm(delta[3:]) > np.pi - 1e-7  # there φ and −φ are the same turn
    if is_half_turn:
        assert_same(Pose.exp(back), Pose.exp(delta), tol_mm=1e-5, tol=1e-7)
    else:
        np.testing.assert_allclose(back[3:], delta[3:], atol=1e-11)
        np.testing.assert_allclose(back[:3], delta[:3], atol=1e-8)


@LAW
@given(poses())
def test_exp_undoes_log(a: Pose) -> None:
    assert_same(Pose.exp(a.log()), a, tol_mm=1e-8)


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
def test_log_of_an_exact_half_turn_has_length_pi(axis: list[float]) -> None:
    a = np.array(axis)
    phi = log_rotation(2 * np.outer(a, a) - np.eye(3))
    assert abs(np.linalg.norm(phi) - np.pi) < 1e-12
    np.testing.assert_allclose(np.abs(phi / np.pi), np.abs(a), atol=1e-12)


@LAW
@given(poses(), tangents(length_mm=100.0))
def test_adjoint_carries_tangents_across_the_pose(T: Pose, delta: np.ndarray) -> None:
    assert_same(T @ Pose.exp(delta), Pose.exp(T.adjoint() @ delta) @ T, tol_mm=1e-7)


@LAW
@given(poses(), poses())
def test_adjoint_is_a_homomorphism(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose((a @ b).adjoint(), a.adjoint() @ b.adjoint(), atol=1e-8)


@LAW
@given(poses())
def test_quaternions_round_trip(a: Pose) -> None:
    q = a.quaternion_xyzw
    assert abs(np.linalg.norm(q) - 1) < 1e-14
    assert q[3] >= 0
    assert_same(Pose.from_quaternion(q, a.t_mm), a, tol=1e-14)
    assert_same(Pose.from_quaternion(-3 * q, a.t_mm), a, tol=1e-14)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    T = Pose.from_quaternion(np.array([0.0, 0.0, 1.0, 1.0]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(T.apply(np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]], atol=1e-15)


@LAW
@given(poses(), tangents())
def test_angle_and_distance_are_those_of_the_tangent(T: Pose, delta: np.ndarray) -> None:
    step = Pose.exp(delta)
    assert abs(step.angle_rad() - np.linalg.norm(delta[3:])) < 1e-7
    assert abs((T @ step).distance_mm(T) - np.linalg.norm(step.t_mm)) < 1e-8


@LAW
@given(directions())
def test_rotation_about_an_axis_leaves_it(axis: np.ndarray) -> None:
    np.testing.assert_allclose(exp_rotation(1.3 * axis) @ axis, axis, atol=1e-14)
