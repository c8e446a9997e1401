"""Points from two rays, with their covariance (the paper's part P5).

``midpoint`` is the middle of the shortest segment between the rays (Hartley & Sturm 1997, section 5.3): fast, and only
a start. ``triangulate`` moves it to the minimum of the reprojection error with Gauss-Newton steps, each dot weighted
by its covariance, which is the maximum-likelihood point for Gaussian dots (Hartley & Sturm 1997, section 2).
"""

import numpy as np
from jaxtyping import Float

from trifix.geometry.camera import StereoRig


def midpoint(
    rig: StereoRig, xy_left: Float[np.ndarray, "n 2"], xy_right: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Sensor coordinates (mm) midway between the two rays; NaN where the rays are parallel."""
    d_left = np.c_[xy_left, np.ones(len(xy_left))]
    d_right = np.c_[xy_right, np.ones(len(xy_right))] @ rig.T_right_left.R  # R⁻¹ d, in sensor coordinates
    b = rig.right_centre_mm
    ll, rr = (d_left**2).sum(axis=1), (d_right**2).sum(axis=1)
    lr = (d_left * d_right).sum(axis=1)
    bl, br = d_left @ b, d_right @ b
    det = ll * rr - lr * lr
    det = np.where(det > 1e-12 * ll * rr, det, np.nan)
    s = (rr * bl - lr * br) / det
    t = (lr * bl - ll * br) / det
    return np.asarray(0.5 * (s[:, None] * d_left + b + t[:, None] * d_right))


def triangulate(
    rig: StereoRig,
    xy_left: Float[np.ndarray, "n 2"],
    xy_right: Float[np.ndarray, "n 2"],
    cov_left: Float[np.ndarray, "n 2 2"],
    cov_right: Float[np.ndarray, "n 2 2"],
    iterations: int = 2,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Sensor coordinates (mm) and covariances (mm²) of n pairs of undistorted slopes with their covariances.

    NaN where the rays are parallel or meet behind a camera.
    """
    xyz = midpoint(rig, xy_left, xy_right)
    W_left, W_right = np.linalg.inv(cov_left), np.linalg.inv(cov_right)
    cov = np.full((len(xyz), 3, 3), np.nan)
    for _ in range(max(iterations, 1)):
        in_right = rig.T_right_left.apply(xyz)
        xyz[(xyz[:, 2] <= 0) | (in_right[:, 2] <= 0)] = np.nan
        r_left, J_left = xy_left - xyz[:, :2] / xyz[:, 2:], _slope_jacobian(xyz)
        r_right = xy_right - in_right[:, :2] / in_right[:, 2:]
        J_right = _slope_jacobian(in_right) @ rig.T_right_left.R
        A = np.swapaxes(J_left, 1, 2) @ W_left
        B = np.swapaxes(J_right, 1, 2) @ W_right
        ok = np.isfinite(xyz).all(axis=1)
        cov[~ok] = np.nan
        cov[ok] = np.linalg.inv((A @ J_left + B @ J_right)[ok])
        step = A @ r_left[:, :, None] + B @ r_right[:, :, None]
        xyz = xyz + (cov @ step)[:, :, 0]
    return xyz, cov


def _slope_jacobian(xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 3"]:
    """d(x/z, y/z) / d(x, y, z)."""
    J = np.zeros((len(xyz), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1 / xyz[:, 2]
    J[:, :, 2] = -xyz[:, :2] / xyz[:, 2:] ** 2
    return J
