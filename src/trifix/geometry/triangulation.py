"""Points from two rays, with their covariance (the paper's part P5).

``triangulate`` is what the loop uses: the maximum-likelihood point when each dot has a covariance of its own, and the
covariance of that point. The three methods that the paper names stand beside it, for comparison and as starts;
``with_covariance`` carries the dots' covariances through any of them:

- ``midpoint``: fast, no noise model; prefer it as a start. It moves when space is moved projectively, so it is poor
  where the two rays have very different lengths.
- ``linear``: one singular value decomposition; prefer it for rays that are nearly parallel, where the midpoint fails.
- ``optimal``: exact for equal, circular noise in both images, without a start and without local minima; prefer it as
  the reference to measure others against, as it is slow.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from trifix.geometry.camera import StereoRig
from trifix.geometry.epipolar import essential_matrix


def midpoint(
    rig: StereoRig, xy_left: Float[np.ndarray, "n 2"], xy_right: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Sensor coordinates (mm) midway between the two rays; NaN where they are parallel.

    Hartley & Sturm 1997, section 5.3.
    """
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


def linear(
    rig: StereoRig, xy_left: Float[np.ndarray, "n 2"], xy_right: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Sensor coordinates (mm) of the least singular vector of x × (P X) = 0 in both images; NaN for parallel rays.

    Hartley & Zisserman 2004, section 12.2, homogeneous method; lengths are scaled by the baseline.
    """
    P_left = np.eye(3, 4)
    P_right = np.c_[rig.T_right_left.R, rig.T_right_left.t_mm / rig.baseline_mm]
    A = np.stack(
        [xy[:, i, None] * P[2] - P[i] for xy, P in ((xy_left, P_left), (xy_right, P_right)) for i in (0, 1)], 1
    )
    X = np.full((len(A), 4), np.nan)
    ok = np.isfinite(A).all(axis=(1, 2))
    X[ok] = np.linalg.svd(A[ok])[2][:, 3]
    X[np.abs(X[:, 3]) < 1e-12] = np.nan  # parallel rays meet at infinity, but for rounding
    return np.asarray(X[:, :3] / X[:, 3:] * rig.baseline_mm)


def optimal(
    rig: StereoRig, xy_left: Float[np.ndarray, "n 2"], xy_right: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Sensor coordinates (mm) of the least sum of squared slope errors, by the polynomial method.

    Hartley & Sturm 1997; Hartley & Zisserman 2004, algorithm 12.1.
    """
    E = essential_matrix(rig)
    corrected = [_correct(E, left, right) for left, right in zip(xy_left, xy_right, strict=True)]
    both = np.array(corrected).reshape(-1, 4)
    return midpoint(rig, both[:, :2], both[:, 2:])


def _correct(
    E: Float[np.ndarray, "3 3"], left: Float[np.ndarray, "2"], right: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "4"]:
    """The pair nearest to (left, right) whose rays meet; NaN for slopes that are NaN."""
    if not np.isfinite([left, right]).all():
        return np.full(4, np.nan)
    to_left, to_right = np.eye(3), np.eye(3)  # steps 1 and 2: move both points to the origin
    to_left[:2, 2], to_right[:2, 2] = left, right
    F = to_right.T @ E @ to_left
    U, _, Vt = np.linalg.svd(F)
    e_left, e_right = (e / np.hypot(e[0], e[1]) for e in (Vt[2], U[:, 2]))  # step 3: the epipoles
    turn_left, turn_right = (  # step 4: turn them onto the axis of x
        np.array([[e[0], e[1], 0.0], [-e[1], e[0], 0.0], [0.0, 0.0, 1.0]]) for e in (e_left, e_right)
    )
    F = turn_right @ F @ turn_left.T
    f, g = e_left[2], e_right[2]  # f and f'
    a, b, c, d = F[1, 1], F[1, 2], F[2, 1], F[2, 2]
    ab, cd = np.array([a, b]), np.array([c, d])  # a t + b, c t + d
    square = np.polyadd(np.polymul(ab, ab), g**2 * np.polymul(cd, cd))
    one = np.array([f**2, 0.0, 1.0])
    polynomial = np.polysub(  # eq. 12.7
        np.polymul([1.0, 0.0], np.polymul(square, square)),
        (a * d - b * c) * np.polymul(np.polymul(one, one), np.polymul(ab, cd)),
    )
    t = np.append(np.roots(polynomial).real, 0.0)
    u, v = np.polyval(ab, t), np.polyval(cd, t)
    # each candidate as a pair of epipolar lines; the last is t = ∞
    lines_left = np.vstack([np.c_[t * f, np.ones(len(t)), -t], [f, 0.0, -1.0]])
    lines_right = np.vstack([np.c_[-g * v, u, v], [-g * c, a, c]])
    with np.errstate(divide="ignore", invalid="ignore"):  # eq. 12.5: squared distances of the origin
        cost = sum(line[:, 2] ** 2 / (line[:, :2] ** 2).sum(axis=1) for line in (lines_left, lines_right))
    best = int(np.nanargmin(cost))
    points = []
    for line, turn, move in ((lines_left[best], turn_left, to_left), (lines_right[best], turn_right, to_right)):
        foot = np.array([-line[0] * line[2], -line[1] * line[2], line[0] ** 2 + line[1] ** 2])
        x = move @ turn.T @ foot
        points.append(x[:2] / x[2])
    return np.concatenate(points)


Method = Callable[
    [StereoRig, Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]],
    Float[np.ndarray, "n 3"],
]

_STEP = 1e-6
"""Of a slope, for central differences: errors of the differences and of rounding are about equal, and tiny."""


def with_covariance(
    method: Method,
    rig: StereoRig,
    xy_left: Float[np.ndarray, "n 2"],
    xy_right: Float[np.ndarray, "n 2"],
    cov_left: Float[np.ndarray, "n 2 2"],
    cov_right: Float[np.ndarray, "n 2 2"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """What a method finds (mm), and the covariance (mm²) that the errors of the slopes make of it: Σ J C Jᵀ.

    J is the method's own derivative, by central differences, so each gets the covariance that it deserves: that of
    ``midpoint`` and ``linear`` is never smaller than that of the maximum-likelihood point.
    """
    cov = np.zeros((len(xy_left), 3, 3))
    for side, C in enumerate((cov_left, cov_right)):
        J = np.empty((len(xy_left), 3, 2))
        for axis in range(2):
            step = np.zeros((2, 2))
            step[side, axis] = _STEP
            ahead = method(rig, xy_left + step[0], xy_right + step[1])
            behind = method(rig, xy_left - step[0], xy_right - step[1])
            J[:, :, axis] = (ahead - behind) / (2 * _STEP)
        cov += J @ C @ np.swapaxes(J, 1, 2)
    return method(rig, xy_left, xy_right), cov


def triangulate(
    rig: StereoRig,
    xy_left: Float[np.ndarray, "n 2"],
    xy_right: Float[np.ndarray, "n 2"],
    cov_left: Float[np.ndarray, "n 2 2"],
    cov_right: Float[np.ndarray, "n 2 2"],
    iterations: int = 2,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Sensor coordinates (mm) and covariances (mm²) of n pairs of undistorted slopes with their covariances.

    Gauss-Newton steps from the midpoint to the least reprojection error, each dot weighted by its covariance: the
    maximum-likelihood point for Gaussian dots (Hartley & Sturm 1997, section 2). NaN where the rays are parallel or
    meet behind a camera.
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
