"""Stereo matches -> points in sensor coordinates, with their covariance (the paper's part P5). Knows no map.

Before that, dots become images of the targets' centres: that is no longer where their ellipses have theirs.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import ConfigError
from trifix.geometry import triangulation
from trifix.geometry.camera import StereoRig
from trifix.kernels import floats, integers
from trifix.kernels.stereo import centres_of_circles, prepare_dots, triangulate_pairs, views_of_circles, weigh_answers
from trifix.labels import contradict
from trifix.records import Dots, SensorPoints, StereoDots, StereoMatches

_SIZE_REACH = 0.25  # of a class, as the logarithm of a ratio


@dataclass(frozen=True, slots=True)
class TriangulateOptions:
    """Where two rays that do not quite meet have their point."""

    method: Literal["optimal", "linear", "midpoint"] = "optimal"
    """optimal: the least reprojection error, each dot weighted by its covariance; linear: the least algebraic error;
    midpoint: halfway between the rays. The covariance is that of the method."""
    correct_eccentricity: bool = True
    """Whether dots are moved where their ellipses say that the targets' centres are, and their covariances widened by
    what the ellipses leave open; false takes the centres of the ellipses."""
    diameters_mm: str = ""
    """Diameters of targets of several sizes (mm), such as "3 6 12": the number of the nearest, from 0, is the label of
    a point that has none; of ellipses only."""

    @property
    def classes_mm(self) -> Float[np.ndarray, "d"]:
        """The diameters as numbers (mm)."""
        return np.array(self.diameters_mm.replace(",", " ").split(), dtype=float)

    def __post_init__(self) -> None:
        try:
            is_length = bool((np.isfinite(self.classes_mm) & (self.classes_mm > 0)).all())
        except ValueError:
            is_length = False
        if not is_length or len(np.unique(self.classes_mm)) < len(self.classes_mm):
            raise ConfigError(
                f"triangulate.diameters_mm is {self.diameters_mm!r}, expected different lengths, as in '3 6 12'."
            )


Circles = Float[np.ndarray, "_ 12"]
"""What ellipses say of the circles that they show: a row each, as `kernels.stereo.views_of_circles` has it."""
NORMALS = slice(4, 10)
"""Columns of both answers for the normal, camera coordinates; NaN where only a size is known."""
NORMAL_SIGMA = 11
"""Column of the standard deviation of either (rad)."""
_SOME_OTHER = 1e-6  # likelihood of a circle that faces neither way


def correct_eccentricity(
    dots: StereoDots, matches: StereoMatches, rig: StereoRig, noise_scale: float = 1.0
) -> StereoDots:
    """The same dots at the images of their targets' centres, with the covariance that they have there.

    An ellipse has two answers; those that agree in both images are right. Dots of a single camera, and those whose
    pairs agree in neither, get the mean of both, and a covariance with their spread. ``noise_scale`` multiplies the
    dots' standard deviations, as it will afterwards: what does not grow with the noise is stated accordingly.
    """
    left, right = circles_of(dots, rig, noise_scale)
    likelihoods = weigh_answers(left, right, integers(matches.left), integers(matches.right), rig.parameters)
    return StereoDots(
        _shifted(dots.left, left, likelihoods[0], noise_scale), _shifted(dots.right, right, likelihoods[1], noise_scale)
    )


def circles_of(dots: StereoDots, rig: StereoRig, noise_scale: float) -> tuple[Circles, Circles]:
    """What the ellipses of either camera say of the circles that they show."""
    parameters = rig.parameters
    return _views(dots.left, parameters[:12], noise_scale), _views(dots.right, parameters[12:24], noise_scale)


def centres_by_normals(
    dots: Dots, centres: Dots, circles: Circles, normal: Float[np.ndarray, "n 3"], noise_scale: float
) -> Dots:
    """The dots at the images of their targets' centres, of targets whose normals are known; ``centres`` elsewhere.

    Normals are in camera coordinates, away from the object, NaN where unknown.
    """
    known = np.isfinite(normal).all(axis=1) & np.isfinite(circles[:, NORMAL_SIGMA])
    if not known.any():
        return centres
    apart2 = ((circles[:, NORMALS].reshape(-1, 2, 3) - normal[:, None]) ** 2).sum(axis=2)
    with np.errstate(invalid="ignore"):
        likelihood = np.exp(-0.5 * apart2 / circles[:, NORMAL_SIGMA, None] ** 2) + _SOME_OTHER
    by_normal = _shifted(dots, circles, floats(np.where(known[:, None], likelihood, 1.0)), noise_scale)
    return replace(
        centres,
        uv_px=np.where(known[:, None], by_normal.uv_px, centres.uv_px),
        cov_px2=np.where(known[:, None, None], by_normal.cov_px2, centres.cov_px2),
    )


def _views(dots: Dots, camera: Float[np.ndarray, "12"], noise_scale: float) -> Float[np.ndarray, "n 12"]:
    """What the ellipses of one camera say of the targets."""
    prepared = prepare_dots(floats(dots.uv_px), floats(dots.cov_px2), camera)
    sigma_px = noise_scale * np.sqrt(0.5 * np.trace(dots.cov_px2, axis1=1, axis2=2))
    return np.asarray(views_of_circles(prepared, floats(dots.ellipse), sigma_px, camera))


def _shifted(
    dots: Dots, views: Float[np.ndarray, "n 12"], likelihood: Float[np.ndarray, "n 2"], noise_scale: float
) -> Dots:
    uv, cov = centres_of_circles(floats(dots.uv_px), floats(dots.cov_px2), views, likelihood, float(noise_scale))
    return replace(dots, uv_px=uv, cov_px2=cov)


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
    labels = dots.left.label[rows_left[good]], dots.right.label[rows_right[good]]
    label = np.where(contradict(*labels), -1, np.maximum(*labels))
    if len(options.classes_mm):
        in_right = rig.T_right_left.apply(xyz)
        size_mm = np.sqrt(  # a circle keeps its long axis, however it is tilted
            2 * dots.left.ellipse[rows_left[good], 0] * xyz[:, 2] / rig.left.fu_px
            * 2 * dots.right.ellipse[rows_right[good], 0] * in_right[:, 2] / rig.right.fu_px
        )  # fmt: skip
        label = np.where(label < 0, _size_class(size_mm, options.classes_mm), label)
    return SensorPoints(
        xyz_mm=xyz,
        cov_mm2=cov,
        match=good,
        label=integers(label),
        row=np.arange(len(good)),
    )


def _size_class(size_mm: Float[np.ndarray, "n"], classes_mm: Float[np.ndarray, "d"]) -> Int[np.ndarray, "n"]:
    """Number of the nearest class in ratio; -1 for unknown sizes and for those between or beyond classes."""
    off = np.abs(np.log(size_mm[:, None] / classes_mm))
    apart = np.abs(np.log(classes_mm[:, None] / classes_mm)) + np.where(np.eye(len(classes_mm)), np.inf, 0.0)
    reach = min(_SIZE_REACH, 0.4 * apart.min())
    nearest = np.nan_to_num(off, nan=np.inf).argmin(axis=1)
    return np.where(off[np.arange(len(off)), nearest] <= reach, nearest, -1)


def _in_front(
    method: triangulation.Method, left: Float[np.ndarray, "p 8"], right: Float[np.ndarray, "p 8"], rig: StereoRig
) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, "q 3 3"], Int[np.ndarray, "q"]]:
    """Points, covariances and rows of the pairs of prepared dots that a method places before both cameras."""
    slopes = left[:, :2], right[:, :2]
    covariances = (each[:, [2, 3, 3, 4]].reshape(-1, 2, 2) for each in (left, right))  # of prepared dots: xx, xy, yy
    xyz, cov = triangulation.with_covariance(method, rig, *slopes, *covariances)
    is_good = (xyz[:, 2] > 0) & (rig.T_right_left.apply(xyz)[:, 2] > 0) & np.isfinite(cov).all(axis=(1, 2))
    return xyz[is_good], cov[is_good], np.flatnonzero(is_good)
