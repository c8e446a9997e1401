"""Compiled loops of stereo vision: dots of two images to pairs to centres to points; what both cameras should see.

A rig is one array of numbers, as ``StereoRig.parameters`` lays them out. Everything happens in undistorted slopes
(x/z, y/z), and in millimetres. Knows no map and no hypothesis.
"""

from math import erf

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

Rig = Float[np.ndarray, "36"]
CameraParameters = Float[np.ndarray, "12"]

_TRUSTED = 1  # state of a target, as in ``TargetState``: above it, none is alive

# columns of a prepared dot: slopes, their covariance, and the one that an error of one pixel in u and v would make
_X, _Y, _CXX, _CXY, _CYY, _PXX, _PXY, _PYY = range(8)

# columns of the view of a circle, which has two answers: for either, the shift (px) from the ellipse's centre to the
# image of the circle's, and the unit normal towards the camera; the errors of shift (px) and normal (rad) about an axis
_SHIFT, _NORMAL, _SHIFT_SIGMA, _NORMAL_SIGMA = (0, 2), (4, 7), 10, 11
_OUT_OF_ROUND = 0.01  # error of b/a that no noise explains: targets as they are printed, pixels as they are calibrated


# --- one camera ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _distort(camera: CameraParameters, x: float, y: float) -> tuple[float, float]:
    """Distorted slopes of undistorted ones."""
    k1, k2, k3, k4, k5 = camera[7], camera[8], camera[9], camera[10], camera[11]
    r2 = x * x + y * y
    if camera[6] == 1.0:  # radtan: k1, k2, p1, p2, k3
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k5))
        return (
            x * radial + 2 * k3 * x * y + k4 * (r2 + 2 * x * x),
            y * radial + k3 * (r2 + 2 * y * y) + 2 * k4 * x * y,
        )
    if camera[6] == 2.0:  # equidistant
        r = np.sqrt(r2)
        if r <= 1e-9:
            return x, y
        theta = np.arctan(r)
        t2 = theta * theta
        scale = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        return x * scale, y * scale
    return x, y


@njit(cache=True, nogil=True, error_model="numpy")
def _distort_jacobian(camera: CameraParameters, x: float, y: float) -> tuple[float, float, float]:
    """The three entries of the symmetric d(distorted) / d(undistorted) slopes."""
    k1, k2, k3, k4, k5 = camera[7], camera[8], camera[9], camera[10], camera[11]
    r2 = x * x + y * y
    if camera[6] == 1.0:
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k5))
        d_radial = k1 + r2 * (2 * k2 + 3 * r2 * k5)  # d radial / d r²
        return (
            radial + 2 * x * x * d_radial + 2 * k3 * y + 6 * k4 * x,
            2 * x * y * d_radial + 2 * k3 * x + 2 * k4 * y,
            radial + 2 * y * y * d_radial + 6 * k3 * y + 2 * k4 * x,
        )
    if camera[6] == 2.0:
        r = max(np.sqrt(r2), 1e-9)
        theta = np.arctan(r)
        t2 = theta * theta
        scale = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        d_theta_d = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        slope = (d_theta_d / (1 + r2) - scale) / max(r2, 1e-18)  # (d scale / d r) / r
        return scale + slope * x * x, slope * x * y, scale + slope * y * y
    return 1.0, 0.0, 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _undistort(camera: CameraParameters, x_d: float, y_d: float) -> tuple[float, float]:
    """Undistorted slopes of distorted ones, by Newton's method; NaN where the model cannot be inverted."""
    if camera[6] == 0.0:
        return x_d, y_d
    if camera[6] == 2.0:
        return _undistort_equidistant(camera, x_d, y_d)
    x, y, error = x_d, y_d, np.inf
    for _ in range(20):
        x_now, y_now = _distort(camera, x, y)
        rx, ry = x_now - x_d, y_now - y_d
        error = max(abs(rx), abs(ry))
        if not error >= 1e-13:
            break
        a, b, d = _distort_jacobian(camera, x, y)
        det = a * d - b * b
        if abs(det) < 1e-12:
            return np.nan, np.nan
        x -= (d * rx - b * ry) / det
        y -= (a * ry - b * rx) / det
    # before the fold the model keeps orientation (det > 0) and does not turn slopes round (trace > 0)
    a, b, d = _distort_jacobian(camera, x, y)
    if error < 1e-9 and a * d - b * b > 0 and a + d > 0:
        return x, y
    return np.nan, np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _undistort_equidistant(camera: CameraParameters, x_d: float, y_d: float) -> tuple[float, float]:
    """The same for ``equidistant``: Newton's method on the angle θ, whose polynomial is nearly a straight line."""
    k1, k2, k3, k4 = camera[7], camera[8], camera[9], camera[10]
    theta_d = np.sqrt(x_d * x_d + y_d * y_d)
    theta, error, slope = min(theta_d, 1.5), np.inf, 1.0
    for _ in range(20):
        t2 = theta * theta
        residual = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        error = abs(residual)
        if not error >= 1e-13:
            break
        if slope <= 1e-6:
            return np.nan, np.nan
        theta -= residual / slope
    if not (error < 1e-9 and slope > 0 and theta < np.pi / 2):
        return np.nan, np.nan
    ratio = np.tan(theta) / theta_d if theta_d > 1e-9 else 1.0
    return x_d * ratio, y_d * ratio


@njit(cache=True, nogil=True, error_model="numpy")
def prepare_dots(
    uv: Float[np.ndarray, "n 2"], cov: Float[np.ndarray, "n 2 2"], camera: CameraParameters
) -> Float[np.ndarray, "n 8"]:
    """Undistorted slopes of dots, the entries xx, xy, yy of their covariance, and those for an error of one pixel."""
    out = np.empty((len(uv), 8))
    fu, fv = camera[0], camera[1]
    for i in range(len(uv)):
        x, y = _undistort(camera, (uv[i, 0] - camera[2]) / fu, (uv[i, 1] - camera[3]) / fv)
        a, b, d = _distort_jacobian(camera, x, y)
        det = a * d - b * b
        # d(x/z, y/z) / d(u, v)
        j00, j01, j10, j11 = d / (det * fu), -b / (det * fv), -b / (det * fu), a / (det * fv)
        c00, c01, c11 = cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1]
        out[i, _X], out[i, _Y] = x, y
        out[i, _CXX] = j00 * j00 * c00 + 2 * j00 * j01 * c01 + j01 * j01 * c11
        out[i, _CXY] = j00 * j10 * c00 + (j00 * j11 + j01 * j10) * c01 + j01 * j11 * c11
        out[i, _CYY] = j10 * j10 * c00 + 2 * j10 * j11 * c01 + j11 * j11 * c11
        out[i, _PXX] = j00 * j00 + j01 * j01
        out[i, _PXY] = j00 * j10 + j01 * j11
        out[i, _PYY] = j10 * j10 + j11 * j11
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _is_in_image(camera: CameraParameters, x: float, y: float, z: float, margin_px: float) -> bool:
    """Whether a place in camera coordinates shows in the image, and not only because the model folds it back."""
    if not z > 0:
        return False
    x, y = x / z, y / z
    x_d, y_d = _distort(camera, x, y)
    u, v, low = x_d * camera[0] + camera[2], y_d * camera[1] + camera[3], margin_px - 0.5
    if not (low <= u <= camera[4] - 0.5 - margin_px and low <= v <= camera[5] - 0.5 - margin_px):
        return False
    x_back, y_back = _undistort(camera, x_d, y_d)
    return abs(x_back - x) < 1e-6 * (1 + abs(x)) and abs(y_back - y) < 1e-6 * (1 + abs(y))


# --- circles, whose centres are not where their images have theirs ---------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def views_of_circles(
    dots: Float[np.ndarray, "n 8"],
    ellipse: Float[np.ndarray, "n 3"],
    sigma_px: Float[np.ndarray, "n"],
    camera: CameraParameters,
) -> Float[np.ndarray, "n 12"]:
    """What the ellipses of prepared dots say of the circles that they show; ``sigma_px`` are the errors of the centres.

    A circle of centre X, radius r and normal N has the dual conic r² (I − N Nᵀ) − X Xᵀ, and that of the ellipse is a
    multiple of it: one decomposition gives the two circles that it may be (Hartley & Zisserman 2004, 8.6). Where a = b,
    only the size is taken to be known, and the shift as uncertain as circles tilted by any angle make it.
    """
    out = np.zeros((len(dots), 12))
    C, V = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(dots)):
        out[i, 4:10], out[i, _NORMAL_SIGMA] = np.nan, np.inf
        x, y, a_px, b_px = dots[i, _X], dots[i, _Y], ellipse[i, 0], ellipse[i, 1]
        if not (a_px > 0 and b_px > 0 and np.isfinite(x + y + a_px + ellipse[i, 2])):
            continue
        a, b, d = _distort_jacobian(camera, x, y)
        det = a * d - b * b
        # the half axes as slopes, and how far a lens moves the centre of area: the second moments are Σ h hᵀ / 4, and
        # over them count the mapping's curvature and where it makes area large, Σ (D J h / 8 + J h tr(J⁻¹ D J) / 4)
        c, s = np.cos(ellipse[i, 2]), np.sin(ellipse[i, 2])
        sxx = sxy = syy = bend_x = bend_y = 0.0
        for k in range(2):
            hu, hv = (a_px * c, a_px * s) if k == 0 else (-b_px * s, b_px * c)
            hu, hv = hu / camera[0], hv / camera[1]
            hx, hy = (d * hu - b * hv) / det, (a * hv - b * hu) / det
            sxx, sxy, syy = sxx + hx * hx, sxy + hx * hy, syy + hy * hy
            a1, b1, d1 = _distort_jacobian(camera, x + hx, y + hy)
            a0, b0, d0 = _distort_jacobian(camera, x - hx, y - hy)
            da, db, dd = 0.5 * (a1 - a0), 0.5 * (b1 - b0), 0.5 * (d1 - d0)
            gain = (d * da - 2 * b * db + a * dd) / det
            bend_x += (da * hx + db * hy) / 8 + hu * gain / 4
            bend_y += (db * hx + dd * hy) / 8 + hv * gain / 4
        largest_px = a_px * a_px / np.sqrt(camera[0] * camera[1] * det)  # a²/f: a tilt θ shifts by a²/f sin θ cos θ
        if not a_px > b_px:
            for k in range(2):
                out[i, _SHIFT[k]], out[i, _SHIFT[k] + 1] = -camera[0] * bend_x, -camera[1] * bend_y
            out[i, _SHIFT_SIGMA] = 0.25 * largest_px  # sin² θ cos² θ is 1/8 on average, and there are two axes
            continue
        mx, my = x - (d * bend_x - b * bend_y) / det, y - (a * bend_y - b * bend_x) / det
        C[0, 0], C[0, 1], C[0, 2] = sxx - mx * mx, sxy - mx * my, -mx
        C[1, 1], C[1, 2], C[2, 2] = syy - my * my, -my, -1.0
        _diagonalise(C, V)
        # by the largest eigenvalue, r² across N and X, the others are μ > 0 > ν, and in the plane of their vectors
        # N = (±√(1−μ) cos α, −√(1−ν) sin α), X = (±√(1−μ) sin α, √(1−ν) cos α) in radii, sin² α = μ/(μ−ν)
        last = 0 if C[0, 0] < 0 else 1 if C[1, 1] < 0 else 2
        middle, first = (last + 1) % 3, (last + 2) % 3
        if C[middle, middle] > C[first, first]:
            middle, first = first, middle
        mu, nu = C[middle, middle] / C[first, first], C[last, last] / C[first, first]
        sine, cosine = np.sqrt(mu / (mu - nu)), np.sqrt(-nu / (mu - nu))
        p, q = np.sqrt(max(1 - mu, 0.0)), np.sqrt(1 - nu)
        ahead = q if V[2, last] > 0 else -q
        facing = 1.0
        for k in range(2):
            side = p if k == 0 else -p
            X0 = side * sine * V[0, middle] + ahead * cosine * V[0, last]
            X1 = side * sine * V[1, middle] + ahead * cosine * V[1, last]
            X2 = side * sine * V[2, middle] + ahead * cosine * V[2, last]
            N0 = side * cosine * V[0, middle] - ahead * sine * V[0, last]
            N1 = side * cosine * V[1, middle] - ahead * sine * V[1, last]
            N2 = side * cosine * V[2, middle] - ahead * sine * V[2, last]
            dx, dy = X0 / X2 - mx, X1 / X2 - my
            out[i, _SHIFT[k]] = camera[0] * (a * dx + b * dy - bend_x)
            out[i, _SHIFT[k] + 1] = camera[1] * (b * dx + d * dy - bend_y)
            out[i, _NORMAL[k]], out[i, _NORMAL[k] + 1], out[i, _NORMAL[k] + 2] = N0, N1, N2
            facing = -(N0 * X0 + N1 * X1 + N2 * X2) / np.sqrt(X0 * X0 + X1 * X1 + X2 * X2)
        # An edge that errs independently all round moves the centre by σ along each axis, the mean radius by σ/√2, and
        # makes a circle oval by σ. So errs b/a, the cosine of the tilt; errors alone make sin² about twice that error,
        # and so much of it is not believed.
        ratio = b_px / a_px
        error = np.hypot(sigma_px[i] / a_px * np.sqrt(1.5 + ratio + 1.5 * ratio * ratio), _OUT_OF_ROUND)
        sigma_rad = error / np.sqrt(max(1 - facing * facing - 2 * error, error))
        out[i, _NORMAL_SIGMA] = sigma_rad
        doubled = (
            2 * facing * facing - 1
        )  # the shift, a²/f sin θ cos θ, goes with cos 2θ along the tilt, cos θ across it
        out[i, _SHIFT_SIGMA] = largest_px * sigma_rad * np.sqrt(0.5 * (doubled * doubled + facing * facing))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _diagonalise(C: Float[np.ndarray, "3 3"], V: Float[np.ndarray, "3 3"]) -> None:
    """Eigenvalues of a symmetric matrix (its upper half) in place of its diagonal, eigenvectors as columns of V.

    Jacobi's rotations: Golub & Van Loan 2013, algorithm 8.5.1; exact for the small eigenvalues beside a large one.
    """
    V[:] = 0.0
    V[0, 0] = V[1, 1] = V[2, 2] = 1.0
    for _ in range(12):
        if C[0, 1] == 0.0 and C[0, 2] == 0.0 and C[1, 2] == 0.0:
            return
        for p, q, r in ((0, 2, 1), (1, 2, 0), (0, 1, 2)):
            off = C[p, q]
            if off == 0.0:
                continue
            tau = (C[q, q] - C[p, p]) / (2 * off)
            t = (1.0 if tau >= 0 else -1.0) / (abs(tau) + np.sqrt(1 + tau * tau))
            c = 1 / np.sqrt(1 + t * t)
            s = t * c
            C[p, p], C[q, q], C[p, q] = C[p, p] - t * off, C[q, q] + t * off, 0.0
            pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
            C[pr], C[qr] = c * C[pr] - s * C[qr], s * C[pr] + c * C[qr]
            for k in range(3):
                V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]


@njit(cache=True, nogil=True, error_model="numpy")
def weigh_answers(
    left: Float[np.ndarray, "n 12"],
    right: Float[np.ndarray, "m 12"],
    rows_left: Int[np.ndarray, "p"],
    rows_right: Int[np.ndarray, "p"],
    rig: Rig,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]]:
    """Likelihoods of the two answers for the circles of either camera, from pairs that may show one circle.

    Normals of one circle agree within their errors; those of others, or of false answers, are anywhere before the
    camera, alike likely: a normal law over the uniform one on the half-sphere, summed over all pairs of a circle.
    """
    R = rig[24:33]
    of_left, of_right = np.ones((len(left), 2)), np.ones((len(right), 2))
    for k in range(len(rows_left)):
        i, j = rows_left[k], rows_right[k]
        variance = left[i, _NORMAL_SIGMA] ** 2 + right[j, _NORMAL_SIGMA] ** 2
        if not variance < np.inf:
            continue
        for one in range(2):
            n0, n1, n2 = left[i, _NORMAL[one]], left[i, _NORMAL[one] + 1], left[i, _NORMAL[one] + 2]
            d0, d1 = R[0] * n0 + R[1] * n1 + R[2] * n2, R[3] * n0 + R[4] * n1 + R[5] * n2
            d2 = R[6] * n0 + R[7] * n1 + R[8] * n2
            for other in range(2):
                e0 = d0 - right[j, _NORMAL[other]]
                e1 = d1 - right[j, _NORMAL[other] + 1]
                e2 = d2 - right[j, _NORMAL[other] + 2]
                ratio = np.exp(-0.5 * (e0 * e0 + e1 * e1 + e2 * e2) / variance) / variance
                of_left[i, one] += ratio
                of_right[j, other] += ratio
    return of_left, of_right


@njit(cache=True, nogil=True, error_model="numpy")
def centres_of_circles(
    uv: Float[np.ndarray, "n 2"],
    cov: Float[np.ndarray, "n 2 2"],
    views: Float[np.ndarray, "n 12"],
    likelihood: Float[np.ndarray, "n 2"],
    noise_scale: float,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Images of the circles' centres and their covariances, before the noise scale: mean and spread of the answers."""
    uv, cov = uv.copy(), cov.copy()
    for i in range(len(uv)):
        share = likelihood[i, 0] / (likelihood[i, 0] + likelihood[i, 1])
        u0, v0, u1, v1 = views[i, 0], views[i, 1], views[i, 2], views[i, 3]
        uv[i, 0] += share * u0 + (1 - share) * u1
        uv[i, 1] += share * v0 + (1 - share) * v1
        apart, own = share * (1 - share) / noise_scale**2, (views[i, _SHIFT_SIGMA] / noise_scale) ** 2
        cov[i, 0, 0] += apart * (u0 - u1) ** 2 + own
        cov[i, 0, 1] += apart * (u0 - u1) * (v0 - v1)
        cov[i, 1, 0] = cov[i, 0, 1]
        cov[i, 1, 1] += apart * (v0 - v1) ** 2 + own
    return uv, cov


# --- two cameras -----------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _essential(rig: Rig) -> Float[np.ndarray, "3 3"]:
    """E = [t]× R, with the baseline scaled to one."""
    R, t = rig[24:33].reshape(3, 3), rig[33:]
    length = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    E = np.empty((3, 3))
    for c in range(3):
        E[0, c] = (t[1] * R[2, c] - t[2] * R[1, c]) / length
        E[1, c] = (t[2] * R[0, c] - t[0] * R[2, c]) / length
        E[2, c] = (t[0] * R[1, c] - t[1] * R[0, c]) / length
    return E


@njit(cache=True, nogil=True, error_model="numpy")
def _midpoint(rig: Rig, xl: float, yl: float, xr: float, yr: float) -> tuple[float, float, float, float]:
    """The place midway between two rays, sensor coordinates, and its depth before the right camera; NaN if parallel.

    Hartley & Sturm 1997, section 5.3.
    """
    R, t = rig[24:33], rig[33:]
    d0, d1, d2 = R[0] * xr + R[3] * yr + R[6], R[1] * xr + R[4] * yr + R[7], R[2] * xr + R[5] * yr + R[8]
    b0 = -(R[0] * t[0] + R[3] * t[1] + R[6] * t[2])  # centre of the right camera
    b1 = -(R[1] * t[0] + R[4] * t[1] + R[7] * t[2])
    b2 = -(R[2] * t[0] + R[5] * t[1] + R[8] * t[2])
    ll, rr = xl * xl + yl * yl + 1.0, d0 * d0 + d1 * d1 + d2 * d2
    lr = xl * d0 + yl * d1 + d2
    bl, br = xl * b0 + yl * b1 + b2, d0 * b0 + d1 * b1 + d2 * b2
    det = ll * rr - lr * lr
    if not det > 1e-12 * ll * rr:
        return np.nan, np.nan, np.nan, np.nan
    p, q = (rr * bl - lr * br) / det, (lr * bl - ll * br) / det
    x, y, z = 0.5 * (p * xl + b0 + q * d0), 0.5 * (p * yl + b1 + q * d1), 0.5 * (p + b2 + q * d2)
    return x, y, z, R[6] * x + R[7] * y + R[8] * z + t[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _differs(size: float, other: float, log_ratio: float) -> bool:
    """Whether two sizes are further apart than the ratio allows; unknown ones are not."""
    return abs(np.log(size / other)) > log_ratio


@njit(cache=True, nogil=True, error_model="numpy")
def pair_dots(
    left: Float[np.ndarray, "n 8"],
    right: Float[np.ndarray, "m 8"],
    left_ellipse: Float[np.ndarray, "n 3"],
    right_ellipse: Float[np.ndarray, "m 3"],
    left_label: Int[np.ndarray, "n"],
    right_label: Int[np.ndarray, "m"],
    rig: Rig,
    max_sigmas: float,
    noise_scale: float,
    nearest_mm: float,
    farthest_mm: float,
    max_size_ratio: float,
    target_diameter_mm: float,
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"], Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """All pairs of prepared dots that may be one target: rows, misfit and its sigma as in ``StereoMatches``.

    The misfit is e = x_rightᵀ E x_left, whose gradients are the two epipolar lines: its variance is
    l_leftᵀ C_left l_left + l_rightᵀ C_right l_right, to first order (Hartley & Zisserman 2004, eq. 11.9).
    """
    E = _essential(rig)
    lines = np.empty((len(right), 2))  # in the left image, of right dots: Eᵀ x_right
    for j in range(len(right)):
        x, y = right[j, _X], right[j, _Y]
        lines[j, 0] = E[0, 0] * x + E[1, 0] * y + E[2, 0]
        lines[j, 1] = E[0, 1] * x + E[1, 1] * y + E[2, 1]
    room, count = 4 * len(left) + 16, 0
    rows_left, rows_right = np.empty(room, np.int64), np.empty(room, np.int64)
    misfit, sigma = np.empty(room), np.empty(room)
    log_ratio = np.log(max_size_ratio)
    gate2 = (max_sigmas * noise_scale) ** 2
    for i in range(len(left)):
        x, y = left[i, _X], left[i, _Y]
        l0 = E[0, 0] * x + E[0, 1] * y + E[0, 2]  # E x_left, in the right image
        l1 = E[1, 0] * x + E[1, 1] * y + E[1, 2]
        l2 = E[2, 0] * x + E[2, 1] * y + E[2, 2]
        for j in range(len(right)):
            value = l0 * right[j, _X] + l1 * right[j, _Y] + l2
            m0, m1 = lines[j, 0], lines[j, 1]
            variance = (
                m0 * m0 * left[i, _CXX] + 2 * m0 * m1 * left[i, _CXY] + m1 * m1 * left[i, _CYY]
                + l0 * l0 * right[j, _CXX] + 2 * l0 * l1 * right[j, _CXY] + l1 * l1 * right[j, _CYY]
            )  # fmt: skip
            if not value * value <= gate2 * variance:
                continue
            if left_label[i] >= 0 and right_label[j] >= 0 and left_label[i] != right_label[j]:
                continue
            _, _, z_left, z_right = _midpoint(rig, x, y, right[j, _X], right[j, _Y])
            if not (min(z_left, z_right) >= nearest_mm and max(z_left, z_right) <= farthest_mm):
                continue
            size_left = 2 * np.sqrt(left_ellipse[i, 0] * left_ellipse[i, 1]) * z_left / rig[0]
            size_right = 2 * np.sqrt(right_ellipse[j, 0] * right_ellipse[j, 1]) * z_right / rig[12]
            if _differs(size_left, size_right, log_ratio):
                continue
            if target_diameter_mm > 0 and (
                _differs(size_left, target_diameter_mm, log_ratio)
                or _differs(size_right, target_diameter_mm, log_ratio)
            ):
                continue
            if count == room:
                room *= 2
                rows_left, rows_right = _longer(rows_left, room), _longer(rows_right, room)
                misfit, sigma = _longer(misfit, room), _longer(sigma, room)
            # in pixels: divided by what an error of one pixel in every coordinate would make
            per_px = np.sqrt(
                m0 * m0 * left[i, _PXX] + 2 * m0 * m1 * left[i, _PXY] + m1 * m1 * left[i, _PYY]
                + l0 * l0 * right[j, _PXX] + 2 * l0 * l1 * right[j, _PXY] + l1 * l1 * right[j, _PYY]
            )  # fmt: skip
            rows_left[count], rows_right[count] = i, j
            misfit[count], sigma[count] = value / per_px, np.sqrt(variance) / per_px
            count += 1
    return rows_left[:count], rows_right[:count], misfit[:count], sigma[:count]


@njit(cache=True, nogil=True)
def _longer(array: np.ndarray, length: int) -> np.ndarray:
    out = np.empty(length, array.dtype)
    out[: len(array)] = array
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_pairs(
    left: Float[np.ndarray, "n 8"],
    right: Float[np.ndarray, "m 8"],
    rows_left: Int[np.ndarray, "p"],
    rows_right: Int[np.ndarray, "p"],
    rig: Rig,
    noise_scale: float,
) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, "q 3 3"], Int[np.ndarray, "q"]]:
    """Places and covariances (mm, mm²) of pairs of prepared dots that meet before both cameras, and their rows.

    Two Gauss-Newton steps from the midpoint to the least reprojection error, each dot weighted by its covariance: the
    maximum-likelihood point for Gaussian dots (Hartley & Sturm 1997, section 2).
    """
    R, t = rig[24:33], rig[33:]
    xyz, cov = np.empty((len(rows_left), 3)), np.empty((len(rows_left), 3, 3))
    rows, count = np.empty(len(rows_left), np.int64), 0
    J, C = np.zeros((4, 3)), np.empty((3, 3))
    for k in range(len(rows_left)):
        a, b = left[rows_left[k]], right[rows_right[k]]
        x, y, z, _ = _midpoint(rig, a[_X], a[_Y], b[_X], b[_Y])
        is_good = True
        for _ in range(2):
            x_r = R[0] * x + R[1] * y + R[2] * z + t[0]
            y_r = R[3] * x + R[4] * y + R[5] * z + t[1]
            z_r = R[6] * x + R[7] * y + R[8] * z + t[2]
            if not (z > 0 and z_r > 0):
                is_good = False
                break
            # d(slopes left, slopes right) / d(x, y, z)
            J[0, 0], J[0, 2], J[1, 1], J[1, 2] = 1 / z, -x / (z * z), 1 / z, -y / (z * z)
            for c in range(3):
                J[2, c] = (R[c] - x_r / z_r * R[6 + c]) / z_r
                J[3, c] = (R[3 + c] - y_r / z_r * R[6 + c]) / z_r
            gradient = (0.0, 0.0, 0.0)
            A = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            for side in range(2):
                dot = a if side == 0 else b
                r0 = dot[_X] - (x / z if side == 0 else x_r / z_r)
                r1 = dot[_Y] - (y / z if side == 0 else y_r / z_r)
                det = dot[_CXX] * dot[_CYY] - dot[_CXY] * dot[_CXY]
                w00, w01, w11 = dot[_CYY] / det, -dot[_CXY] / det, dot[_CXX] / det
                u0, u1, u2 = J[2 * side, 0], J[2 * side, 1], J[2 * side, 2]
                v0, v1, v2 = J[2 * side + 1, 0], J[2 * side + 1, 1], J[2 * side + 1, 2]
                s, q = w00 * r0 + w01 * r1, w01 * r0 + w11 * r1
                gradient = (gradient[0] + u0 * s + v0 * q, gradient[1] + u1 * s + v1 * q, gradient[2] + u2 * s + v2 * q)
                A = (
                    A[0] + w00 * u0 * u0 + 2 * w01 * u0 * v0 + w11 * v0 * v0,
                    A[1] + w00 * u0 * u1 + w01 * (u0 * v1 + v0 * u1) + w11 * v0 * v1,
                    A[2] + w00 * u0 * u2 + w01 * (u0 * v2 + v0 * u2) + w11 * v0 * v2,
                    A[3] + w00 * u1 * u1 + 2 * w01 * u1 * v1 + w11 * v1 * v1,
                    A[4] + w00 * u1 * u2 + w01 * (u1 * v2 + v1 * u2) + w11 * v1 * v2,
                    A[5] + w00 * u2 * u2 + 2 * w01 * u2 * v2 + w11 * v2 * v2,
                )
            _invert(A, C)
            x += C[0, 0] * gradient[0] + C[0, 1] * gradient[1] + C[0, 2] * gradient[2]
            y += C[1, 0] * gradient[0] + C[1, 1] * gradient[1] + C[1, 2] * gradient[2]
            z += C[2, 0] * gradient[0] + C[2, 1] * gradient[1] + C[2, 2] * gradient[2]
        if not (is_good and np.isfinite(x + y + z) and np.isfinite(C.sum())):
            continue
        xyz[count, 0], xyz[count, 1], xyz[count, 2] = x, y, z
        for r in range(3):
            for c in range(3):
                cov[count, r, c] = noise_scale * noise_scale * C[r, c]
        rows[count] = k
        count += 1
    return xyz[:count], cov[:count], rows[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _invert(A: tuple[float, float, float, float, float, float], out: Float[np.ndarray, "3 3"]) -> None:
    """Inverse of the symmetric matrix with upper triangle A (row by row), by its cofactors."""
    c00, c01, c02 = A[3] * A[5] - A[4] * A[4], A[2] * A[4] - A[1] * A[5], A[1] * A[4] - A[2] * A[3]
    det = A[0] * c00 + A[1] * c01 + A[2] * c02
    out[0, 0], out[1, 1], out[2, 2] = c00 / det, (A[0] * A[5] - A[2] * A[2]) / det, (A[0] * A[3] - A[1] * A[1]) / det
    out[0, 1] = out[1, 0] = c01 / det
    out[0, 2] = out[2, 0] = c02 / det
    out[1, 2] = out[2, 1] = (A[1] * A[2] - A[0] * A[4]) / det


@njit(cache=True, nogil=True, error_model="numpy")
def expected_targets(
    xyz: Float[np.ndarray, "k 3"],
    view: Float[np.ndarray, "k 3"],
    state: Int[np.ndarray, "k"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    points: Float[np.ndarray, "n 3"],
    rig: Float[np.ndarray, "_"],
    margin_px: float,
) -> Bool[np.ndarray, "k"]:
    """Which living targets a sensor at T_world_sensor = (R, t) should see: facing it, and in both images.

    They lie in the range of depths of the frame's points. Without a rig (an empty array), the box of slopes that
    these fill stands for the images.
    """
    out = np.zeros(len(xyz), np.bool_)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)  # of slopes and depth
    for i in range(len(points)):
        z = points[i, 2]
        for c, value in enumerate((points[i, 0] / z, points[i, 1] / z, z)):
            low[c], high[c] = min(low[c], value), max(high[c], value)
    for k in range(len(xyz)):
        if state[k] > _TRUSTED:
            continue
        d0, d1, d2 = xyz[k, 0] - t[0], xyz[k, 1] - t[1], xyz[k, 2] - t[2]
        z = R[0, 2] * d0 + R[1, 2] * d1 + R[2, 2] * d2
        if not (low[2] <= z <= high[2]):
            continue
        distance = max(np.sqrt(d0 * d0 + d1 * d1 + d2 * d2), 1e-12)
        if -(view[k, 0] * d0 + view[k, 1] * d1 + view[k, 2] * d2) < 0.5 * distance:  # False where it is unknown
            continue
        x, y = R[0, 0] * d0 + R[1, 0] * d1 + R[2, 0] * d2, R[0, 1] * d0 + R[1, 1] * d1 + R[2, 1] * d2
        if len(rig) == 0:
            out[k] = low[0] <= x / z <= high[0] and low[1] <= y / z <= high[1]
            continue
        if not _is_in_image(rig[:12], x, y, z, margin_px):
            continue
        S, s = rig[24:33], rig[33:]
        x_r = S[0] * x + S[1] * y + S[2] * z + s[0]
        y_r = S[3] * x + S[4] * y + S[5] * z + s[1]
        z_r = S[6] * x + S[7] * y + S[8] * z + s[2]
        out[k] = _is_in_image(rig[12:24], x_r, y_r, z_r, margin_px)
    return out


# --- how noisy the dots are ------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def likeliest_scale(
    z: Float[np.ndarray, "s"], gate: Float[np.ndarray, "s"], scales: Float[np.ndarray, "c"]
) -> tuple[float, float]:
    """Scale of the normal part of |z| < gate, the rest being uniform, and by how much its logarithm is likelier than 1.

    Of the candidates, ascending, every fourth is tried, and then those about each of them that is better than its
    neighbours. Without evidence, a scale near 1 is likelier.
    """
    ratio = np.empty(len(z))
    value = np.full(len(scales), -np.inf)
    for i in range(0, len(scales), 4):
        value[i] = _log_likelihood(z, gate, scales[i], ratio)
    best, best_value = 1.0, -np.inf
    for i in range(0, len(scales), 4):
        if (i >= 4 and value[i - 4] > value[i]) or (i + 4 < len(scales) and value[i + 4] > value[i]):
            continue
        at = i
        for step in (2, 1):
            middle = at
            for near in (middle - step, middle + step):
                if 0 <= near < len(scales):
                    value[near] = _log_likelihood(z, gate, scales[near], ratio)
                    at = near if value[near] > value[at] else at
        if value[at] > best_value:
            best, best_value = scales[at], value[at]
    return best, best_value - _log_likelihood(z, gate, 1.0, ratio)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp"})
def _log_likelihood(
    z: Float[np.ndarray, "s"], gate: Float[np.ndarray, "s"], scale: float, ratio: Float[np.ndarray, "s"]
) -> float:
    """That of a scale with its likeliest share (eight steps of expectation-maximisation), over that of false pairs
    alone; ``ratio`` is working space."""
    cut = last_gate = 0.0
    for i in range(len(z)):
        if gate[i] != last_gate:  # residuals of one frame have one gate
            last_gate = gate[i]
            cut = np.sqrt(2 / np.pi) / scale * gate[i] / erf(gate[i] / scale / np.sqrt(2.0))
        ratio[i] = cut * np.exp(-0.5 * (z[i] / scale) ** 2)  # of the densities: normal, cut at the gate, to uniform
    share = 0.5
    for _ in range(8):
        total = 0.0
        for i in range(len(z)):
            total += share * ratio[i] / (share * ratio[i] + (1 - share))
        share = total / len(z)
    value = -(np.log(scale) ** 2)
    for i in range(len(z)):
        value += np.log(share * ratio[i] + (1 - share))
    return value


def warm_up() -> None:
    """Compiles every loop of this module."""
    rig = np.zeros(36)
    rig[[0, 1, 12, 13, 24, 28, 32]] = 1.0
    rig[33] = -100.0
    uv, cov = np.array([[0.1, 0.1], [0.2, 0.3]]), np.tile(1e-4 * np.eye(2), (2, 1, 1))
    left, right = prepare_dots(uv, cov, rig[:12]), prepare_dots(uv - [0.2, 0.0], cov, rig[12:24])
    size, label = np.ones((2, 3)), np.full(2, -1)
    pairs = pair_dots(left, right, size, size, label, label, rig, 3.0, 1.0, 100.0, 1000.0, 2.0, 0.0)
    views = [views_of_circles(each, size, np.ones(2), rig[:12]) for each in (left, right)]
    likelihood, _ = weigh_answers(views[0], views[1], pairs[0], pairs[1], rig)
    centres_of_circles(uv, cov, views[0], likelihood, 1.0)
    xyz, _, _ = triangulate_pairs(left, right, pairs[0], pairs[1], rig, 1.0)
    for each in (rig, np.zeros(0)):
        expected_targets(xyz, -xyz, np.zeros(len(xyz), np.int64), np.eye(3), np.zeros(3), xyz, each, 10.0)
    likeliest_scale(np.ones(2), np.full(2, 3.0), np.geomspace(0.5, 2.0, 8))
