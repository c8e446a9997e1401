"""Where the centre of a circle is whose image is an ellipse: not at the ellipse's centre (Ahn, Warnecke, Kotowski 1999).

The nearer half of a tilted circle shows larger than the farther one, and a lens bends both (Heikkilä & Silvén 1997). One
image leaves two answers, about mirror images of one another; two images of the circle say which. Knows no diameter.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from trifix.geometry.camera import Camera, distort_jacobian


@dataclass(frozen=True, slots=True, eq=False)
class CircleViews:
    """What one camera's ellipses say of the circles that they are images of: two answers each."""

    shift_px: Float[np.ndarray, "n 2 2"]
    """For either answer, what leads from the ellipse's centre to the image of the circle's centre (px)."""
    sigma_px: Float[np.ndarray, "n"]
    """Standard deviation of that shift along each axis, for the error of the ellipse (px)."""
    normal: Float[np.ndarray, "n 2 3"]
    """For either answer, the circle's unit normal towards the camera, camera coordinates; NaN where it is unknown."""
    sigma_rad: Float[np.ndarray, "n"]
    """Standard deviation of the normal's direction about each axis across it (rad)."""

    def settled(self, share: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
        """Mean shift (px) and its covariance (px²), by the probability of either answer: what is open, widens it."""
        mean = np.einsum("nk,nki->ni", share, self.shift_px)
        apart = self.shift_px[:, 0] - self.shift_px[:, 1]
        open_px2 = (share[:, 0] * share[:, 1])[:, None, None] * apart[:, :, None] * apart[:, None, :]
        return mean, open_px2 + self.sigma_px[:, None, None] ** 2 * np.eye(2)


def views_of_circles(
    camera: Camera,
    xy: Float[np.ndarray, "n 2"],
    ellipse: Float[np.ndarray, "n 3"],
    sigma_px: Float[np.ndarray, "n"],
) -> CircleViews:
    """Circles from ellipses: centres as undistorted slopes, semi-axes and angle in pixels, errors of the centres.

    The ellipse's dual conic is that of the circle, r² (I − N Nᵀ) − X Xᵀ, but for a factor (Hartley & Zisserman 2004,
    section 8.6): one decomposition gives its centre X and its normal N in units of its radius r. Where a = b, only the
    size is taken to be known: the shift is then zero, and as uncertain as circles tilted by any angle make it.
    """
    J = _projection_jacobian(camera, xy)
    along = np.linalg.inv(J) @ _half_axes_px(ellipse)  # two conjugate radii, as slopes
    bend_px = _bend_px(camera, xy, J, along)
    is_known = np.isfinite(along).all(axis=(1, 2)) & np.isfinite(xy).all(axis=1)
    has_shape = is_known & (ellipse[:, 0] > ellipse[:, 1])

    shift_px = np.where(is_known[:, None], -bend_px, 0.0)[:, None].repeat(2, axis=1)
    a_px = np.where(is_known, ellipse[:, 0], 0.0)
    largest_px = a_px**2 / np.sqrt(np.linalg.det(J))  # a²/f; a tilt θ shifts by a²/f sin θ cos θ
    normal = np.full((len(xy), 2, 3), np.nan)
    sigma_rad = np.full(len(xy), np.inf)
    shift_sigma_px = 0.25 * np.where(is_known, largest_px, 0.0)  # sin²θ cos²θ is 1/8 on average, over two axes

    k = np.flatnonzero(has_shape)
    if len(k):
        centre = xy[k] - np.linalg.solve(J[k], bend_px[k, :, None])[:, :, 0]
        X, normal[k] = _circles(centre, along[k])
        shift_px[k] += np.einsum("nij,nkj->nki", J[k], X[:, :, :2] / X[:, :, 2:] - centre[:, None])
        cosine = -(normal[k, 0] * X[:, 0]).sum(axis=1) / np.linalg.norm(X[:, 0], axis=1)
        sigma_rad[k] = _tilt_sigma_rad(cosine, ellipse[k], sigma_px[k])
        shift_sigma_px[k] = largest_px[k] * cosine * sigma_rad[k]
    return CircleViews(shift_px, shift_sigma_px, normal, sigma_rad)


def share_of_answers(
    left: CircleViews,
    right: CircleViews,
    rows_left: Int[np.ndarray, "m"],
    rows_right: Int[np.ndarray, "m"],
    R_right_left: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "k 2"]]:
    """Probabilities of the two answers for the circles of both cameras, from pairs that may be one circle, some falsely.

    Normals of one circle agree within their errors, those of false answers are anywhere before the camera: a normal law
    against a uniform one on the half-sphere, summed over all pairs of a circle. Circles without a pair stay open.
    """
    n_left, n_right = left.normal[rows_left], right.normal[rows_right] @ R_right_left
    variance = (left.sigma_rad[rows_left] ** 2 + right.sigma_rad[rows_right] ** 2)[:, None, None]
    d2 = ((n_left[:, :, None] - n_right[:, None, :]) ** 2).sum(axis=3)
    ratio = np.nan_to_num(np.exp(-0.5 * d2 / variance) / variance, nan=0.0)
    return (
        _share(rows_left, ratio.sum(axis=2), len(left.normal)),
        _share(rows_right, ratio.sum(axis=1), len(right.normal)),
    )


def _share(rows: Int[np.ndarray, "m"], ratio: Float[np.ndarray, "m 2"], n: int) -> Float[np.ndarray, "n 2"]:
    """Ratios of likelihood to chance, added up for each circle, as probabilities."""
    weight = 1.0 + np.stack([np.bincount(rows, ratio[:, k], minlength=n) for k in (0, 1)], axis=1)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _projection_jacobian(camera: Camera, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 2"]:
    """d(u, v) / d(undistorted slopes) (px)."""
    J = distort_jacobian(camera.model, camera.coefficients, xy)
    return np.asarray(J * np.array([[camera.fu_px], [camera.fv_px]]))


def _half_axes_px(ellipse: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 2"]:
    """The semi-axes as columns (px)."""
    a, b, c, s = ellipse[:, 0], ellipse[:, 1], np.cos(ellipse[:, 2]), np.sin(ellipse[:, 2])
    return np.stack([np.stack([a * c, -b * s], axis=1), np.stack([a * s, b * c], axis=1)], axis=1)


def _bend_px(
    camera: Camera,
    xy: Float[np.ndarray, "n 2"],
    J: Float[np.ndarray, "n 2 2"],
    along: Float[np.ndarray, "n 2 2"],
) -> Float[np.ndarray, "n 2"]:
    """How far a lens moves the centre of area of an ellipse from the image of its centre, to second order (px).

    With conjugate radii h, the second moments of an ellipse are Σ h hᵀ / 4, and D the derivative along one,
    Σ (D J h / 8 + J h tr(J⁻¹ D J) / 4): the curvature of the mapping, and where it makes area large.
    """
    if camera.model == "none":
        return np.zeros_like(xy)
    total = np.zeros_like(xy)
    inverse = np.linalg.inv(J)
    for k in (0, 1):
        h = along[:, :, k]
        DJ = 0.5 * (_projection_jacobian(camera, xy + h) - _projection_jacobian(camera, xy - h))
        gain = np.einsum("nij,nji->n", inverse, DJ)
        total += np.einsum("nij,nj->ni", DJ / 8 + J * (gain / 4)[:, None, None], h)
    return total


def _circles(
    centre: Float[np.ndarray, "n 2"], along: Float[np.ndarray, "n 2 2"]
) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 3"]]:
    """Centre, in radii, and normal of the two circles whose image an undistorted ellipse is.

    The dual conic r² (I − N Nᵀ) − X Xᵀ has the largest eigenvalue r², across N and X. Divided by it, the others are
    μ > 0 > ν, and in the plane of their vectors N = (±√(1−μ) cos α, −√(1−ν) sin α), X = (±√(1−μ) sin α, √(1−ν) cos α),
    sin² α = μ/(μ−ν).
    """
    n = len(centre)
    dual = np.empty((n, 3, 3))
    dual[:, :2, :2] = along @ np.swapaxes(along, 1, 2) - centre[:, :, None] * centre[:, None, :]
    dual[:, :2, 2] = dual[:, 2, :2] = -centre
    dual[:, 2, 2] = -1.0
    value, vector = np.linalg.eigh(dual)
    nu, mu = value[:, 0] / value[:, 2], value[:, 1] / value[:, 2]
    across, ahead = vector[:, :, 1], vector[:, :, 0] * np.sign(vector[:, 2:, 0])
    sine, cosine = np.sqrt(mu / (mu - nu)), np.sqrt(-nu / (mu - nu))
    p, q = np.sqrt(np.maximum(1 - mu, 0.0)), np.sqrt(1 - nu)
    side = np.array([1.0, -1.0])[:, None] * across[:, None]
    X = (p * sine)[:, None, None] * side + ((q * cosine)[:, None] * ahead)[:, None]
    N = (p * cosine)[:, None, None] * side - ((q * sine)[:, None] * ahead)[:, None]
    return X, N


def _tilt_sigma_rad(
    cosine: Float[np.ndarray, "n"], ellipse: Float[np.ndarray, "n 3"], sigma_px: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Error of the normal about each axis, for cos θ = b/a with an error σ: σ / sin θ.

    An edge that errs independently all round moves a circle's centre by σ_px along each axis, its mean radius by
    σ_px/√2, and makes it oval by σ_px. Errors alone make sin² θ about 2 σ: that much is not believed.
    """
    a, ratio = ellipse[:, 0], ellipse[:, 1] / ellipse[:, 0]
    sigma = sigma_px / a * np.sqrt(1.5 + ratio + 1.5 * ratio**2)
    return np.asarray(sigma / np.sqrt(np.maximum(1 - cosine**2 - 2 * sigma, sigma)))
