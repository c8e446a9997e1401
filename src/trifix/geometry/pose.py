"""Rigid motions of space, SE(3).

``T_a_b`` takes coordinates in ``b`` to coordinates in ``a``: ``p_a = T_a_b.apply(p_b)`` and
``T_a_c = T_a_b @ T_b_c``. Millimetres and radians throughout. Tangent vectors are δ = (translation, rotation), and a
pose is perturbed on its right, T · exp(δ), so that a covariance is expressed in the coordinates of ``b``
(Solà, Deray, Atchuthan 2018, "A micro Lie theory", with the translation first).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_SMALL_RAD = 1e-4  # below: series instead of the closed form, which loses all digits


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rotation followed by a translation: ``p_a = R p_b + t``."""

    R: Float[np.ndarray, "3 3"]
    """Rotation matrix, right-handed and orthonormal."""
    t_mm: Float[np.ndarray, "3"]
    """Translation (mm)."""

    @staticmethod
    def identity() -> "Pose":
        """The motion that leaves everything in place."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quaternion(q_xyzw: Float[np.ndarray, "4"], t_mm: Float[np.ndarray, "3"]) -> "Pose":
        """The pose of a quaternion (x, y, z, w), normalised here, and a translation (mm)."""
        x, y, z, w = np.asarray(q_xyzw, dtype=float) / np.linalg.norm(q_xyzw)
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        return Pose(R, np.asarray(t_mm, dtype=float))

    @staticmethod
    def exp(delta: Float[np.ndarray, "6"]) -> "Pose":
        """The motion reached from the identity along δ = (translation mm, rotation rad)."""
        rho, phi = np.asarray(delta[:3], dtype=float), np.asarray(delta[3:], dtype=float)
        return Pose(exp_rotation(phi), _left_jacobian(phi) @ rho)

    def log(self) -> Float[np.ndarray, "6"]:
        """δ = (translation mm, rotation rad) with ``Pose.exp(δ)`` equal to this pose; angles up to π."""
        phi = log_rotation(self.R)
        return np.concatenate([np.linalg.solve(_left_jacobian(phi), self.t_mm), phi])

    @property
    def quaternion_xyzw(self) -> Float[np.ndarray, "4"]:
        """The rotation as a unit quaternion with w ≥ 0 (Shepperd 1978: the largest component is found first)."""
        R = self.R
        # four times the outer product of the quaternion (x, y, z, w) with itself
        Q = np.array(
            [
                [1 + R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
                [R[0, 1] + R[1, 0], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
                [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1 - R[0, 0] - R[1, 1] + R[2, 2], R[1, 0] - R[0, 1]],
                [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + R[0, 0] + R[1, 1] + R[2, 2]],
            ]
        )
        q = Q[int(np.argmax(np.diag(Q)))]
        q = q / np.linalg.norm(q)
        return np.asarray(-q if q[3] < 0 else q)

    def apply(self, xyz_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The points (n, 3) in the coordinates on the left of the pose's name."""
        return np.asarray(xyz_mm @ self.R.T + self.t_mm)

    def inverse(self) -> "Pose":
        """``T_b_a`` of ``T_a_b``."""
        return Pose(self.R.T.copy(), -self.R.T @ self.t_mm)

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.R @ other.R, self.R @ other.t_mm + self.t_mm)

    def adjoint(self) -> Float[np.ndarray, "6 6"]:
        """Ad with T · exp(δ) = exp(Ad δ) · T: carries a tangent vector or covariance across the pose."""
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = self.R
        A[:3, 3:] = skew(self.t_mm) @ self.R
        return A

    def angle_rad(self) -> float:
        """The angle of the rotation, 0 to π."""
        return float(np.linalg.norm(log_rotation(self.R)))

    def distance_mm(self, other: "Pose") -> float:
        """Distance between the origins of the two poses."""
        return float(np.linalg.norm(self.t_mm - other.t_mm))


def skew(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The matrix [v]× with [v]× w = v × w."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exp_rotation(phi_rad: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation about φ by |φ| (Rodrigues)."""
    theta = float(np.linalg.norm(phi_rad))
    W = skew(phi_rad)
    if theta < _SMALL_RAD:
        a, b = 1 - theta**2 / 6, 0.5 - theta**2 / 24
    else:
        a, b = np.sin(theta) / theta, 2 * (np.sin(theta / 2) / theta) ** 2  # 1 − cos θ = 2 sin² θ/2
    return np.asarray(np.eye(3) + a * W + b * (W @ W))


def log_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """The rotation vector φ, |φ| ≤ π, taken from the quaternion: accurate near 0 and near π alike."""
    q = Pose(R, np.zeros(3)).quaternion_xyzw
    s = float(np.linalg.norm(q[:3]))
    if s < 1e-12:
        return np.asarray(2.0 * q[:3])
    return np.asarray(2.0 * np.arctan2(s, q[3]) / s * q[:3])


def _left_jacobian(phi: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """V of SE(3): the translation of exp(ρ, φ) is V ρ."""
    theta = float(np.linalg.norm(phi))
    W = skew(phi)
    if theta < _SMALL_RAD:
        a, b = 0.5 - theta**2 / 24, 1 / 6 - theta**2 / 120
    else:
        a, b = 2 * (np.sin(theta / 2) / theta) ** 2, (theta - np.sin(theta)) / theta**3
    return np.asarray(np.eye(3) + a * W + b * (W @ W))
