"""Stereo matches -> points in sensor coordinates, with their covariance (the paper's part P5). Knows no map."""

import numpy as np

from trifix.geometry.camera import StereoRig
from trifix.kernels import floats, integers
from trifix.kernels.stereo import prepare_dots, triangulate_pairs
from trifix.records import SensorPoints, StereoDots, StereoMatches


def triangulate(dots: StereoDots, matches: StereoMatches, rig: StereoRig, noise_scale: float = 1.0) -> SensorPoints:
    """One point a match that meets in front of both cameras; ``noise_scale`` multiplies the standard deviations."""
    parameters = rig.parameters
    left = prepare_dots(floats(dots.left.uv_px), floats(dots.left.cov_px2), parameters[:12])
    right = prepare_dots(floats(dots.right.uv_px), floats(dots.right.cov_px2), parameters[12:24])
    rows_left, rows_right = integers(matches.left), integers(matches.right)
    xyz, cov, good = triangulate_pairs(left, right, rows_left, rows_right, parameters, float(noise_scale))
    return SensorPoints(
        xyz_mm=xyz,
        cov_mm2=cov,
        match=good,
        label=integers(np.maximum(dots.left.label[rows_left[good]], dots.right.label[rows_right[good]])),
        row=np.arange(len(good)),
    )
