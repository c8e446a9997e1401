"""Stereo matches -> points in sensor coordinates, with their covariance (the paper's part P5). Knows no map."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.geometry import triangulation
from trifix.geometry.camera import StereoRig
from trifix.kernels import floats, integers
from trifix.kernels.stereo import prepare_dots, triangulate_pairs
from trifix.records import SensorPoints, StereoDots, StereoMatches


@dataclass(frozen=True, slots=True)
class TriangulateOptions:
    """Where two rays that do not quite meet have their point."""

    method: Literal["optimal", "linear", "midpoint"] = "optimal"
    """optimal: the least reprojection error, each dot weighted by its covariance; linear: the least algebraic error;
    midpoint: halfway between the rays. The covariance is that of the method."""


def triangulate(
    dots: StereoDots,
    matches: StereoMatches,
    rig: StereoRig,
    noise_scale: float = 1.0,
    options: TriangulateOptions = TriangulateOptions(),
) -> SensorPoints:
    """One point a match that meets in front of both cameras; ``noise_scale`` multiplies the standard deviations."""
    parameters = rig.parameters
    left = prepare_dots(floats(dots.left.uv_px), floats(dots.left.cov_px2), parameters[:12])
    right = prepare_dots(floats(dots.right.uv_px), floats(dots.right.cov_px2), parameters[12:24])
    rows_left, rows_right = integers(matches.left), integers(matches.right)
    if options.method == "optimal":
        xyz, cov, good = triangulate_pairs(left, right, rows_left, rows_right, parameters, float(noise_scale))
    else:
        method = {"linear": triangulation.linear, "midpoint": triangulation.midpoint}[options.method]
        xyz, cov, good = _in_front(method, left[rows_left], right[rows_right], rig)
        cov *= noise_scale**2
    return SensorPoints(
        xyz_mm=xyz,
        cov_mm2=cov,
        match=good,
        label=integers(np.maximum(dots.left.label[rows_left[good]], dots.right.label[rows_right[good]])),
        row=np.arange(len(good)),
    )


def _in_front(
    method: triangulation.Method, left: Float[np.ndarray, "p 8"], right: Float[np.ndarray, "p 8"], rig: StereoRig
) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, "q 3 3"], Int[np.ndarray, "q"]]:
    """Points, covariances and rows of the pairs of prepared dots that a method places before both cameras."""
    slopes = left[:, :2], right[:, :2]
    covariances = (each[:, [2, 3, 3, 4]].reshape(-1, 2, 2) for each in (left, right))  # of prepared dots: xx, xy, yy
    xyz, cov = triangulation.with_covariance(method, rig, *slopes, *covariances)
    is_good = (xyz[:, 2] > 0) & (rig.T_right_left.apply(xyz)[:, 2] > 0) & np.isfinite(cov).all(axis=(1, 2))
    return xyz[is_good], cov[is_good], np.flatnonzero(is_good)
