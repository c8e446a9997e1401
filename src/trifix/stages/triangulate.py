"""Stereo matches -> points in sensor coordinates, with their covariance (the paper's part P5). Knows no map."""

import numpy as np

from trifix.geometry.camera import StereoRig
from trifix.geometry.triangulation import triangulate as triangulate_rays
from trifix.records import SensorPoints, StereoDots, StereoMatches


def triangulate(dots: StereoDots, matches: StereoMatches, rig: StereoRig, noise_scale: float = 1.0) -> SensorPoints:
    """One point a match that meets in front of both cameras; ``noise_scale`` multiplies the standard deviations."""
    uv_left, uv_right = dots.left.uv_px[matches.left], dots.right.uv_px[matches.right]
    xy_left, xy_right = rig.left.unproject(uv_left), rig.right.unproject(uv_right)
    J_left, J_right = rig.left.unproject_jacobian(xy_left), rig.right.unproject_jacobian(xy_right)
    xyz, cov = triangulate_rays(
        rig,
        xy_left,
        xy_right,
        noise_scale**2 * J_left @ dots.left.cov_px2[matches.left] @ J_left.transpose(0, 2, 1),
        noise_scale**2 * J_right @ dots.right.cov_px2[matches.right] @ J_right.transpose(0, 2, 1),
    )
    good = np.flatnonzero(np.isfinite(xyz).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    return SensorPoints(
        xyz_mm=xyz[good],
        cov_mm2=cov[good],
        match=good,
        label=np.maximum(dots.left.label[matches.left[good]], dots.right.label[matches.right[good]]),
        row=np.arange(len(good)),
    )
