"""Absolute orientation: the rigid motion that takes one set of points to another.

``align`` is closed-form, with one weight a point (Horn 1987; Kabsch 1976; Umeyama 1991, who fixes the sign).
``align_weighted`` starts there and minimises Mahalanobis distances with a full covariance a pair: prefer it when the
errors are not alike in all directions, as a stereo sensor's never are.
"""

import numpy as np
from jaxtyping import Float

from trifix.geometry.pose import Pose


def align(
    xyz_b_mm: Float[np.ndarray, "n 3"],
    xyz_a_mm: Float[np.ndarray, "n 3"],
    weight: Float[np.ndarray, "n"] | None = None,
) -> Pose:
    """``T_a_b`` minimising Σ w |T p_b − p_a|² over n ≥ 3 pairs.

    Collinear points leave the turn about their line open: some minimiser is returned.
    """
    w = np.ones(len(xyz_b_mm)) if weight is None else weight
    w = w / w.sum()
    centre_b, centre_a = w @ xyz_b_mm, w @ xyz_a_mm
    H = (xyz_a_mm - centre_a).T @ ((xyz_b_mm - centre_b) * w[:, None])
    U, _, Vt = np.linalg.svd(H)
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = (U * [1.0, 1.0, sign]) @ Vt
    return Pose(R, centre_a - R @ centre_b)


def align_weighted(
    xyz_b_mm: Float[np.ndarray, "n 3"],
    xyz_a_mm: Float[np.ndarray, "n 3"],
    cov_b_mm2: Float[np.ndarray, "n 3 3"],
    cov_a_mm2: Float[np.ndarray, "n 3 3"],
    initial: Pose | None = None,
    iterations: int = 5,
) -> tuple[Pose, Float[np.ndarray, "6 6"]]:
    """``T_a_b`` minimising Σ rᵀ (R C_b Rᵀ + C_a)⁻¹ r with r = p_a − T p_b, and its covariance.

    Gauss-Newton on T · exp(δ). The covariance is of δ = (translation mm, rotation rad), the inverse of the normal
    matrix: it holds when the given covariances do and the pairs are independent.

    Raises:
        numpy.linalg.LinAlgError: the pairs do not determine a pose (fewer than three, or on one line).
    """
    spread = np.linalg.svd(xyz_b_mm - xyz_b_mm.mean(axis=0), compute_uv=False)
    if len(xyz_b_mm) < 3 or spread[1] <= 1e-9 * spread[0]:
        raise np.linalg.LinAlgError("fewer than three points that are not on one line do not determine a pose")
    T = align(xyz_b_mm, xyz_a_mm) if initial is None else initial
    cov = np.zeros((6, 6))
    for _ in range(iterations):
        S = T.R @ cov_b_mm2 @ T.R.T + cov_a_mm2
        # r(δ) = p_a − T exp(δ) p_b  ≈  r − R [I, −[p_b]×] δ;  column k of −R [p]× is R (e_k × p)
        J = np.empty((len(xyz_b_mm), 3, 6))
        J[:, :, :3] = T.R
        J[:, :, 3:] = T.R @ np.swapaxes(np.cross(np.eye(3), xyz_b_mm[:, None, :]), 1, 2)
        r = xyz_a_mm - T.apply(xyz_b_mm)
        W_J = np.linalg.solve(S, J)
        cov = np.linalg.inv(np.einsum("nij,nik->jk", J, W_J))
        delta = cov @ np.einsum("nij,ni->j", W_J, r)
        T = T @ Pose.exp(delta)
        if np.abs(delta).max() < 1e-10:
            break
    return T, cov


def spread_off_line_mm(xyz_mm: Float[np.ndarray, "n 3"]) -> float:
    """Root mean square distance of the points from the straight line that fits them best."""
    if len(xyz_mm) < 3:
        return 0.0
    s = np.linalg.svd(xyz_mm - xyz_mm.mean(axis=0), compute_uv=False)
    return float(np.sqrt((s[1:] ** 2).sum() / len(xyz_mm)))


def point_jacobian(xyz_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 6"]:
    """[I, −[p]×]: how points in sensor coordinates move with δ = (translation mm, rotation rad) of the sensor."""
    J = np.zeros((len(xyz_mm), 3, 6))
    J[:, :, :3] = np.eye(3)
    x, y, z = xyz_mm.T
    J[:, 0, 4], J[:, 0, 5] = z, -y
    J[:, 1, 3], J[:, 1, 5] = -z, x
    J[:, 2, 3], J[:, 2, 4] = y, -x
    return J
