"""Cameras and the pair of them: from space to pixels and back.

Pixel (0, 0) is the centre of the top-left pixel, (u, v) = (column, row). Camera coordinates: x right, y down,
z forward. Distortion models are Kalibr's: ``radtan`` (Brown 1966; k1, k2, p1, p2 and optionally k3, OpenCV's order)
and ``equidistant`` (Kannala & Brandt 2006; k1..k4).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from trifix.geometry.pose import Pose

DistortionModel = Literal["none", "radtan", "equidistant"]

_MODELS: tuple[DistortionModel, ...] = ("none", "radtan", "equidistant")


@dataclass(frozen=True, slots=True)
class Camera:
    """One calibrated camera: a pinhole with distortion."""

    fu_px: float
    """Focal length along u (px)."""
    fv_px: float
    """Focal length along v (px)."""
    pu_px: float
    """Principal point, u (px)."""
    pv_px: float
    """Principal point, v (px)."""
    width_px: int
    """Columns of the image."""
    height_px: int
    """Rows of the image."""
    model: DistortionModel = "none"
    """Which distortion the coefficients belong to."""
    coefficients: tuple[float, ...] = ()
    """radtan: k1, k2, p1, p2[, k3]; equidistant: k1, k2, k3, k4; none: empty."""

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """The matrix of intrinsics."""
        return np.array([[self.fu_px, 0.0, self.pu_px], [0.0, self.fv_px, self.pv_px], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Float[np.ndarray, "12"]:
        """The camera in numbers, for compiled loops: its fields in their order, five coefficients.

        The model is 0 for none, 1 for radtan, 2 for equidistant; coefficients that it has not are zero.
        """
        numbers = (self.fu_px, self.fv_px, self.pu_px, self.pv_px, self.width_px, self.height_px)
        return np.array(
            (*numbers, _MODELS.index(self.model), *self.coefficients, *(0.0,) * (5 - len(self.coefficients)))
        )

    def project(self, xyz_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of points in this camera's coordinates; NaN for points not in front of it."""
        z = np.where(xyz_mm[:, 2] > 0, xyz_mm[:, 2], np.nan)
        xy = distort(self.model, self.coefficients, xyz_mm[:, :2] / z[:, None])
        return xy * [self.fu_px, self.fv_px] + [self.pu_px, self.pv_px]

    def project_jacobian(self, xyz_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 3"]:
        """d(u, v) / d(x, y, z) at points in front of the camera (px/mm)."""
        z = xyz_mm[:, 2]
        xy = xyz_mm[:, :2] / z[:, None]
        J_xy = distort_jacobian(self.model, self.coefficients, xy)
        J_pinhole = np.zeros((len(z), 2, 3))
        J_pinhole[:, 0, 0] = J_pinhole[:, 1, 1] = 1 / z
        J_pinhole[:, :, 2] = -xy / z[:, None]
        return np.asarray(np.array([[self.fu_px], [self.fv_px]]) * (J_xy @ J_pinhole))

    def unproject(self, uv_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Undistorted ray slopes (x/z, y/z) of pixels; NaN where the distortion model cannot be inverted."""
        xy = (uv_px - [self.pu_px, self.pv_px]) / [self.fu_px, self.fv_px]
        return undistort(self.model, self.coefficients, xy)

    def unproject_jacobian(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 2"]:
        """d(x/z, y/z) / d(u, v) at undistorted slopes, for carrying pixel covariances (1/px)."""
        J = distort_jacobian(self.model, self.coefficients, xy) * np.array([[self.fu_px], [self.fv_px]])
        return np.asarray(np.linalg.inv(J))

    def sees(self, xyz_mm: Float[np.ndarray, "n 3"], margin_px: float = 0.0) -> np.ndarray:
        """Which points (camera coordinates) fall on the image, at least ``margin_px`` inside its edge: (n,) bool.

        Points so far off the axis that the distortion model folds them back into the image are not seen.
        """
        uv = self.project(xyz_mm)
        low, high = margin_px - 0.5, np.array([self.width_px, self.height_px]) - 0.5 - margin_px
        seen = np.asarray(((uv >= low) & (uv <= high)).all(axis=1))
        slopes = xyz_mm[seen, :2] / xyz_mm[seen, 2:]
        seen[seen] = (np.abs(self.unproject(uv[seen]) - slopes) < 1e-6 * (1 + np.abs(slopes))).all(axis=1)
        return seen


@dataclass(frozen=True, slots=True)
class StereoRig:
    """Two cameras held rigidly; sensor coordinates are those of the left one."""

    left: Camera
    """Camera 0."""
    right: Camera
    """Camera 1."""
    T_right_left: Pose
    """Coordinates in the right camera of what has coordinates in the left (mm)."""

    @property
    def baseline_mm(self) -> float:
        """Distance between the centres of projection."""
        return float(np.linalg.norm(self.T_right_left.t_mm))

    @property
    def right_centre_mm(self) -> Float[np.ndarray, "3"]:
        """Centre of projection of the right camera, sensor coordinates."""
        return self.T_right_left.inverse().t_mm

    @property
    def parameters(self) -> Float[np.ndarray, "36"]:
        """The rig in numbers, for compiled loops: left camera, right camera, R and t of ``T_right_left``."""
        T = self.T_right_left
        return np.concatenate([self.left.parameters, self.right.parameters, T.R.ravel(), T.t_mm])


def distort(
    model: DistortionModel, coefficients: tuple[float, ...], xy: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Distorted slopes of undistorted ones."""
    if model == "none":
        return np.asarray(xy, dtype=float)
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    if model == "radtan":
        k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=1,
        )
    k1, k2, k3, k4 = coefficients
    r = np.sqrt(r2)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = np.where(r > 1e-9, theta_d / np.maximum(r, 1e-9), 1.0)
    return np.asarray(xy * scale[:, None])


def distort_jacobian(
    model: DistortionModel, coefficients: tuple[float, ...], xy: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2 2"]:
    """d(distorted) / d(undistorted) slopes."""
    J = np.zeros((len(xy), 2, 2))
    if model == "none":
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        return J
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    if model == "radtan":
        k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        d_radial = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # d radial / d r²
        J[:, 0, 0] = radial + 2 * x * x * d_radial + 2 * p1 * y + 6 * p2 * x
        J[:, 0, 1] = J[:, 1, 0] = 2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y
        J[:, 1, 1] = radial + 2 * y * y * d_radial + 6 * p1 * y + 2 * p2 * x
        return J
    k1, k2, k3, k4 = coefficients
    r = np.maximum(np.sqrt(r2), 1e-9)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    d_theta_d = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    scale = theta_d / r
    slope = (d_theta_d / (1 + r2) - scale) / r2.clip(1e-18)  # (d scale / d r) / r
    J[:, 0, 0] = scale + slope * x * x
    J[:, 0, 1] = J[:, 1, 0] = slope * x * y
    J[:, 1, 1] = scale + slope * y * y
    return J


def undistort(
    model: DistortionModel, coefficients: tuple[float, ...], xy: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Undistorted slopes of distorted ones, by Newton's method; NaN where the model cannot be inverted.

    That is where no slope distorts to the given one, or only one beyond the fold at which the model turns back.
    """
    if model == "none" or len(xy) == 0:
        return np.asarray(xy, dtype=float)
    if model == "equidistant":
        return _undistort_equidistant(coefficients, np.asarray(xy, dtype=float))
    guess = np.array(xy, dtype=float)
    error = np.full(len(xy), np.inf)
    for _ in range(20):
        residual = distort(model, coefficients, guess) - xy
        error = np.abs(residual).max(axis=1)
        if np.nanmax(error, initial=0.0) < 1e-13:
            break
        J = distort_jacobian(model, coefficients, guess)
        det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
        det = np.where(np.abs(det) < 1e-12, np.nan, det)
        guess = guess - np.stack(
            [
                (J[:, 1, 1] * residual[:, 0] - J[:, 0, 1] * residual[:, 1]) / det,
                (J[:, 0, 0] * residual[:, 1] - J[:, 1, 0] * residual[:, 0]) / det,
            ],
            axis=1,
        )
    # before the fold the model keeps orientation (det > 0) and does not turn slopes round (trace > 0)
    J = distort_jacobian(model, coefficients, guess)
    is_before_fold = (np.linalg.det(J) > 0) & (np.trace(J, axis1=1, axis2=2) > 0)
    guess[~((error < 1e-9) & is_before_fold)] = np.nan
    return guess


def _undistort_equidistant(coefficients: tuple[float, ...], xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The same for ``equidistant``: Newton's method on the angle θ, whose polynomial is nearly a straight line."""
    k1, k2, k3, k4 = coefficients
    theta_d = np.linalg.norm(xy, axis=1)
    theta = np.minimum(theta_d, 1.5)
    error = np.full(len(xy), np.inf)
    slope = np.ones(len(xy))
    for _ in range(20):
        t2 = theta * theta
        residual = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        error = np.abs(residual)
        if np.nanmax(error, initial=0.0) < 1e-13:
            break
        theta = theta - residual / np.where(slope > 1e-6, slope, np.nan)
    is_invertible = (error < 1e-9) & (slope > 0) & (theta < np.pi / 2)
    ratio = np.where(theta_d > 1e-9, np.tan(theta) / np.maximum(theta_d, 1e-9), 1.0)
    return np.asarray(np.where(is_invertible[:, None], xy * ratio[:, None], np.nan))
