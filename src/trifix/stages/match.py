"""Dots of the left image x dots of the right one -> pairs that may be the same target (the paper's part P4).

Identical dots can only be paired by geometry. *All* plausible pairs are kept, several to a dot where several lie on its
epipolar line: the map decides later. Knows no map and no pose.
"""

from dataclasses import dataclass

import numpy as np

from trifix.errors import ConfigError
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.epipolar import epipolar_residuals, essential_matrix, pairs_near_epipolar_lines
from trifix.geometry.triangulation import midpoint
from trifix.records import Dots, StereoDots, StereoMatches


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How far from the epipolar line, and between which depths, a pair is plausible."""

    max_epipolar_sigmas: float = 3.5
    """Largest distance from the epipolar line, in standard deviations of the two dots."""
    min_depth_mm: float = 0.0
    """Nearest depth of a target before either camera (mm); 0: one baseline."""
    max_depth_mm: float = 0.0
    """Farthest depth of a target before either camera (mm); 0: fifteen baselines."""
    max_size_ratio: float = 2.0
    """Largest ratio of the two dots' diameters, each scaled by its camera's focal length and depth."""
    target_diameter_mm: float = 0.0
    """Diameter of the targets (mm): a pair whose dots are not that large, within the ratio, is none; 0 if unknown."""

    def __post_init__(self) -> None:
        if self.max_epipolar_sigmas <= 0:
            raise ConfigError(f"match.max_epipolar_sigmas is {self.max_epipolar_sigmas}, expected a positive number.")
        if self.min_depth_mm < 0 or self.max_depth_mm < 0:
            raise ConfigError("match.min_depth_mm and match.max_depth_mm must not be negative.")
        if self.max_depth_mm and self.max_depth_mm <= self.min_depth_mm:
            raise ConfigError(
                f"match.max_depth_mm is {self.max_depth_mm}, expected more than min_depth_mm = {self.min_depth_mm}."
            )
        if self.target_diameter_mm < 0:
            raise ConfigError(
                f"match.target_diameter_mm is {self.target_diameter_mm}, expected a length, or 0 where it is unknown."
            )
        if self.max_size_ratio < 1:
            raise ConfigError(f"match.max_size_ratio is {self.max_size_ratio}, expected at least 1.")


def match(
    dots: StereoDots, rig: StereoRig, options: MatchOptions = MatchOptions(), noise_scale: float = 1.0
) -> StereoMatches:
    """All pairs near each other's epipolar line, within the depth limits and of similar size.

    ``noise_scale`` multiplies the dots' standard deviations.
    """
    xy_left, cov_left = undistort_dots(dots.left, rig.left)
    xy_right, cov_right = undistort_dots(dots.right, rig.right)
    E = essential_matrix(rig)

    # a wide gate first, on one matrix; then each pair by its own covariance
    widest = max(_largest_sigma(cov_left), _largest_sigma(cov_right))
    gate = 3.0 * noise_scale * options.max_epipolar_sigmas * widest
    left, right = pairs_near_epipolar_lines(E, xy_left, xy_right, gate)
    value, sigma = epipolar_residuals(E, xy_left[left], xy_right[right], cov_left[left], cov_right[right])
    keep = np.abs(value) <= options.max_epipolar_sigmas * noise_scale * sigma
    left, right, value, sigma = left[keep], right[keep], value[keep], sigma[keep]

    xyz = midpoint(rig, xy_left[left], xy_right[right])
    z_left, z_right = xyz[:, 2], rig.T_right_left.apply(xyz)[:, 2]
    nearest_mm = options.min_depth_mm or rig.baseline_mm
    farthest_mm = options.max_depth_mm or 15 * rig.baseline_mm
    with np.errstate(invalid="ignore"):
        keep = (np.minimum(z_left, z_right) >= nearest_mm) & (np.maximum(z_left, z_right) <= farthest_mm)
        size_left = dots.left.diameter_px[left] * z_left / rig.left.fu_px
        size_right = dots.right.diameter_px[right] * z_right / rig.right.fu_px
        widest = np.log(options.max_size_ratio)  # unknown sizes pass
        keep &= ~(np.abs(np.log(size_left / size_right)) > widest)
        if options.target_diameter_mm:
            for size in (size_left, size_right):
                keep &= ~(np.abs(np.log(size / options.target_diameter_mm)) > widest)
    keep &= ~((dots.left.label[left] >= 0) & (dots.right.label[right] >= 0)) | (
        dots.left.label[left] == dots.right.label[right]
    )
    left, right, value, sigma = left[keep], right[keep], value[keep], sigma[keep]

    # the same residual in pixels: divided by what an error of one pixel in every coordinate would make
    J_left = rig.left.unproject_jacobian(xy_left[left])
    J_right = rig.right.unproject_jacobian(xy_right[right])
    _, per_px = epipolar_residuals(
        E, xy_left[left], xy_right[right], J_left @ J_left.transpose(0, 2, 1), J_right @ J_right.transpose(0, 2, 1)
    )
    return StereoMatches(left=left, right=right, epipolar_px=value / per_px, epipolar_sigma_px=sigma / per_px)


def undistort_dots(dots: Dots, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted slopes (n, 2) of dots and their covariances (n, 2, 2)."""
    xy = camera.unproject(dots.uv_px)
    J = camera.unproject_jacobian(xy)
    return xy, np.asarray(J @ dots.cov_px2 @ J.transpose(0, 2, 1))


def _largest_sigma(cov: np.ndarray) -> float:
    """Largest standard deviation along any axis; 0 without dots."""
    return float(np.sqrt(np.nanmax(np.trace(cov, axis1=1, axis2=2), initial=0.0)))
