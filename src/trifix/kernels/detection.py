"""Compiled loops of the detector: connected blobs with their moments, and an ellipse fitted to grey values.

Knows grey values and numbers; which blob is worth being called a dot is decided by the stage.
"""

from math import atan2, exp, log, pi, sqrt

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numba import njit

Grey = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]

# Columns of a fit: centre and its covariance (px, px²), semi-axes (px) and the long one's angle (rad), blur of the edge
# (px), grey values of the surround and of the step from it to the dot, rms residual. All NaN where there is no fit.
U, V, COV_UU, COV_UV, COV_VV, A, B, THETA, BLUR, AROUND, STEP, RESIDUAL = range(12)

# Parameters of the fit: centre (2), the triangular factor of the ellipse's form (3), blur, level and gradient of the
# surround (3), level and gradient of the step (3).
_N = 12
# The prior knowledge, each as a standard deviation.
_LIGHT_PER_PX = 0.002  # relative change of the light per pixel
_OFFSET_PER_PX = 0.001  # departure from light that multiplies both sides of the edge alike, in contrasts per pixel
_LOG_BLUR = 0.8  # spread of the edge's blur about _BLUR_PX
_BLUR_PX = 0.8
_MIN_BLUR_PX = 0.29  # the pixel's own aperture: 1/sqrt(12)
_QUANTISATION_VARIANCE = 1.0 / 12.0
_ALIASING_PX2 = 0.013**2
_SOLID_RADIUS_PX = 12.0  # of larger dots only a band along the edge is looked at
_ENOUGH = 400  # pixels for the first, rough fit


@njit(cache=True, nogil=True)
def _root(parent: np.ndarray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _is_beyond(
    value: float, darkest: float, brightest: float, sign: float, min_contrast: float, min_range: float
) -> bool:
    lowest, highest = float(darkest), float(brightest)
    return bool(
        highest - lowest > max(min_contrast * highest, min_range) and sign * (2 * float(value) - lowest - highest) > 0
    )


@njit(cache=True, nogil=True)
def blobs(
    image: Grey,
    darkest: Grey,
    brightest: Grey,
    sign: float,
    min_contrast: float,
    min_range: float,
    min_diameter_px: float,
    max_diameter_px: float,
    min_axis_ratio: float,
    min_fill: float,
) -> Float[np.ndarray, "m 5"]:
    """Centre u, v (px) and second moments uu, uv, vv (px²) of roughly elliptic blobs away from the border.

    A blob is 4-connected pixels beyond the local threshold, which lies midway between the darkest and the brightest
    pixel about (Bernsen 1986), where these differ by ``min_contrast`` of the brighter and by ``min_range`` grey values,
    which noise alone must not reach. ``sign`` is +1 for bright blobs, -1 for dark ones.

    Labels runs of pixels rather than pixels (He, Chao & Suzuki 2008), so that moments come in closed form.
    """
    h, w = image.shape
    size = h * (w // 2 + 1)
    row = np.empty(size, np.int32)
    first = np.empty(size, np.int32)
    last = np.empty(size, np.int32)
    parent = np.empty(size, np.int32)
    n = 0
    above = 0  # first run of the row above
    for v in range(h):
        start = n
        u = 0
        while u < w:
            if not _is_beyond(image[v, u], darkest[v, u], brightest[v, u], sign, min_contrast, min_range):
                u += 1
                continue
            u0 = u
            while u < w and _is_beyond(image[v, u], darkest[v, u], brightest[v, u], sign, min_contrast, min_range):
                u += 1
            row[n], first[n], last[n], parent[n] = v, u0, u - 1, n
            n += 1
        k = above
        for i in range(start, n):
            while k < start and last[k] < first[i]:
                k += 1
            j = k
            while j < start and first[j] <= last[i]:
                a, b = _root(parent, i), _root(parent, j)
                if a < b:
                    parent[b] = a
                else:
                    parent[a] = b
                j += 1
        above = start

    # Sums of 1, u, v, uu, uv, vv over each blob, and its box.
    sums = np.zeros((n, 6))
    box = np.empty((n, 4), np.int32)
    for i in range(n):
        k = _root(parent, i)
        parent[i] = k
        if k == i:
            box[i, 0], box[i, 1], box[i, 2], box[i, 3] = first[i], last[i], row[i], row[i]
        else:
            box[k, 0] = min(box[k, 0], first[i])
            box[k, 1] = max(box[k, 1], last[i])
            box[k, 3] = row[i]
        m = float(last[i] - first[i] + 1)
        middle = 0.5 * (first[i] + last[i])
        su = m * middle
        sums[k, 0] += m
        sums[k, 1] += su
        sums[k, 2] += m * row[i]
        sums[k, 3] += m * middle * middle + m * (m * m - 1) / 12
        sums[k, 4] += su * row[i]
        sums[k, 5] += m * row[i] * row[i]

    min_area_px2 = max(pi / 4 * min_diameter_px**2, 4.0)
    max_area_px2 = pi / 4 * max_diameter_px**2
    out = np.empty((n, 5))
    found = 0
    for k in range(n):
        area = sums[k, 0]
        if parent[k] != k or area < min_area_px2 or area > max_area_px2:
            continue
        if box[k, 0] == 0 or box[k, 2] == 0 or box[k, 1] == w - 1 or box[k, 3] == h - 1:
            continue
        u_mean, v_mean = sums[k, 1] / area, sums[k, 2] / area
        uu = sums[k, 3] / area - u_mean * u_mean + 1 / 12
        uv = sums[k, 4] / area - u_mean * v_mean
        vv = sums[k, 5] / area - v_mean * v_mean + 1 / 12
        det = uu * vv - uv * uv
        spread = sqrt(0.25 * (uu - vv) ** 2 + uv * uv)
        minor, major = 0.5 * (uu + vv) - spread, 0.5 * (uu + vv) + spread
        fill = area / (4 * pi * sqrt(det))
        if minor < min_axis_ratio * min_axis_ratio * major or fill < min_fill:
            continue
        out[found, 0], out[found, 1] = u_mean, v_mean
        out[found, 2], out[found, 3], out[found, 4] = uu, uv, vv
        found += 1
    return out[:found].copy()


@njit(cache=True, nogil=True)
def _factor(H: np.ndarray, damping: float, L: np.ndarray) -> bool:
    """Cholesky factor L of H + damping·diag H, of which the lower triangle is read; False if not positive."""
    for i in range(_N):
        for j in range(i + 1):
            s = H[i, j]
            if i == j:
                s += damping * H[i, i]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 1e-14 * H[i, i]:
                    return False
                L[i, i] = sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@njit(cache=True, nogil=True)
def _solve(H: np.ndarray, g: np.ndarray, damping: float, L: np.ndarray, x: np.ndarray) -> bool:
    """Solves (H + damping·diag H) x = g, with L as storage; False where there is no solution."""
    if not _factor(H, damping, L):
        return False
    for i in range(_N):
        s = g[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(_N - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, _N):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True


@njit(cache=True, nogil=True)
def _leading_inverse(L: np.ndarray, unit: float) -> tuple[float, float, float]:
    """Entries 00, 01, 11 of unit·(LLᵀ)⁻¹: products of the first columns of L⁻¹."""
    a, b = np.zeros(_N), np.zeros(_N)
    for i in range(_N):
        s, t = 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0
        for k in range(i):
            s -= L[i, k] * a[k]
            t -= L[i, k] * b[k]
        a[i], b[i] = s / L[i, i], t / L[i, i]
    return unit * np.sum(a * a), unit * np.sum(a * b), unit * np.sum(b * b)


@njit(cache=True, nogil=True)
def _gather(
    image: np.ndarray,
    u0: float,
    v0: float,
    radius: float,
    x: np.ndarray,
    outer: float,
    inner: float,
    pixels: np.ndarray,
) -> int:
    """Fills ``pixels`` (u, v in radii about (u0, v0), grey value) with those between the edge's two offsets."""
    h, w = image.shape
    p, r, t = x[2], x[3], x[4]
    # Half the box of the ellipse: sqrt of the diagonal of (AᵀA)⁻¹.
    half_u = sqrt(1 + (r / t) ** 2) / p * radius + outer * radius + 1
    half_v = radius / t + outer * radius + 1
    cu, cv = u0 + x[0] * radius, v0 + x[1] * radius
    n = 0
    for v in range(max(0, int(cv - half_v)), min(h, int(cv + half_v) + 2)):
        for u in range(max(0, int(cu - half_u)), min(w, int(cu + half_u) + 2)):
            eu, ev = (u - u0) / radius, (v - v0) / radius
            du, dv = eu - x[0], ev - x[1]
            y0, y1 = p * du + r * dv, t * dv
            q = sqrt(y0 * y0 + y1 * y1)
            g0, g1 = p * y0, r * y0 + t * y1
            d = (q - 1) * q / (sqrt(g0 * g0 + g1 * g1) + 1e-12)
            if d <= outer and d >= -inner and n < pixels.shape[1]:
                pixels[0, n], pixels[1, n], pixels[2, n] = eu, ev, image[v, u]
                n += 1
    return n


@njit(cache=True, nogil=True)
def _thin(pixels: np.ndarray, n: int) -> int:
    """Keeps about _ENOUGH of the first n pixels, evenly."""
    stride = n // _ENOUGH
    if stride < 2:
        return n
    # An odd stride does not fall into step with rows of even length.
    stride |= 1
    kept = 0
    for i in range(0, n, stride):
        pixels[:, kept] = pixels[:, i]
        kept += 1
    return kept


@njit(cache=True, nogil=True)
def _differentiate(pixels: np.ndarray, n: int, x: np.ndarray, J: np.ndarray) -> None:
    """Fills the rows of J with the derivatives of each pixel's grey value, the last one with its residual.

    Model of a grey value at ξ: B(ξ) + C(ξ) Φ(−d/s), B and C linear in ξ, d the distance from the ellipse to first
    order, s the blur. The model is symmetric about the centre wherever B and C are level: what it gets wrong of a
    symmetric dot does not move the centre.
    """
    p, r, t, s = x[2], x[3], x[4], x[5]
    for k in range(n):
        eu, ev = pixels[0, k], pixels[1, k]
        du, dv = eu - x[0], ev - x[1]
        y0, y1 = p * du + r * dv, t * dv
        q = sqrt(y0 * y0 + y1 * y1)
        g0, g1 = p * y0, r * y0 + t * y1
        norm = sqrt(g0 * g0 + g1 * g1) + 1e-12
        z = (q - 1) * q / norm / s
        step = x[9] + x[10] * eu + x[11] * ev
        inside, slope = 0.0 if z > 0 else 1.0, 0.0
        if -4.5 < z < 4.5:
            # Normal density and, from it, the normal integral to 1e-7 (Abramowitz & Stegun 1964, 26.2.17).
            density = exp(-0.5 * z * z) * 0.3989422804014327
            y = 1 / (1 + 0.2316419 * abs(z))
            tail = y * (0.319381530 + y * (-0.356563782 + y * (1.781477937 + y * (-1.821255978 + y * 1.330274429))))
            inside = density * tail if z > 0 else 1 - density * tail
            slope = step * density / s  # −dI/dd
        along = slope / norm
        J[0, k], J[1, k] = along * g0, along * g1
        J[2, k], J[3, k], J[4, k] = -along * y0 * du, -along * y0 * dv, -along * y1 * dv
        J[5, k] = slope * z
        J[6, k], J[7, k], J[8, k] = 1.0, eu, ev
        J[9, k], J[10, k], J[11, k] = inside, inside * eu, inside * ev
        J[12, k] = pixels[2, k] - (x[6] + x[7] * eu + x[8] * ev + inside * step)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _product(a: np.ndarray, b: np.ndarray) -> float:
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@njit(cache=True, nogil=True)
def _normal_equations(
    pixels: np.ndarray,
    n: int,
    x: np.ndarray,
    radius: float,
    variance: float,
    J: np.ndarray,
    H: np.ndarray,
    g: np.ndarray,
) -> float:
    """Fills H = JᵀJ (lower triangle) and g = Jᵀr, the prior included; returns the sum of squares (grey values²)."""
    _differentiate(pixels, n, x, J)
    residual = J[_N, :n]
    for i in range(_N):
        g[i] = _product(J[i, :n], residual)
        for j in range(i + 1):
            H[i, j] = _product(J[i, :n], J[j, :n])
    total = _product(residual, residual)

    # Blur: log-normal.
    w = variance / _LOG_BLUR**2
    s = x[5]
    e = log(s * radius / _BLUR_PX)
    total += w * e * e
    H[5, 5] += w / (s * s)
    g[5] -= w * e / s
    # Light: L(ξ) = 1 + λ·ξ multiplies the levels B₀ and B₀ + C₀, up to an offset; λ is small. With the brighter
    # level m: (gradient of the brighter side) / m = λ, and B'·C₀ − C'·B₀ = 0.
    b, c = x[6], x[9]
    m = max(abs(b), abs(b + c), 1.0)
    w_light = variance / (_LIGHT_PER_PX * radius * m) ** 2
    w_offset = variance / (_OFFSET_PER_PX * radius * c) ** 2
    bright = 1.0 if c > 0 else 0.0
    for i in range(2):
        B, C = 7 + i, 10 + i
        e = x[B] + bright * x[C]
        total += w_light * e * e
        H[B, B] += w_light
        H[C, B] += w_light * bright
        H[C, C] += w_light * bright
        g[B] -= w_light * e
        g[C] -= w_light * e * bright
        jb, jc = c / m, -b / m
        e = jb * x[B] + jc * x[C]
        total += w_offset * e * e
        H[B, B] += w_offset * jb * jb
        H[C, B] += w_offset * jb * jc
        H[C, C] += w_offset * jc * jc
        g[B] -= w_offset * jb * e
        g[C] -= w_offset * jc * e
    return total


@njit(cache=True, nogil=True)
def _set_levels(pixels: np.ndarray, n: int, x: np.ndarray) -> bool:
    """Starts the levels of surround and step from the pixels clear of the edge; False where there are none."""
    around, inside, n_around, n_inside = 0.0, 0.0, 0, 0
    for i in range(n):
        y0 = x[2] * pixels[0, i] + x[3] * pixels[1, i]
        y1 = x[4] * pixels[1, i]
        q2 = y0 * y0 + y1 * y1
        if q2 < 0.8:
            inside += pixels[2, i]
            n_inside += 1
        elif q2 > 1.2:
            around += pixels[2, i]
            n_around += 1
    if n_inside == 0 or n_around == 0:
        return False
    x[6] = around / n_around
    x[9] = inside / n_inside - x[6]
    return True


@njit(cache=True, nogil=True)
def _descend(
    pixels: np.ndarray,
    n: int,
    x: np.ndarray,
    radius: float,
    variance: float,
    sign: float,
    max_misfit: float,
    noise: float,
    enough_px: float,
    J: np.ndarray,
    H: np.ndarray,
) -> float:
    """Levenberg-Marquardt from x, in place, until the centre moves less than ``enough_px``.

    Returns the variance of the residuals (grey values²) and leaves JᵀJ in H (J is storage); NaN where it leads nowhere.
    """
    H_new, L, g, g_new = np.empty((_N, _N)), np.zeros((_N, _N)), np.empty(_N), np.empty(_N)
    dx, x_new = np.empty(_N), np.empty(_N)
    damping, accepted = 1e-3, 0
    cost = _normal_equations(pixels, n, x, radius, variance, J, H, g)
    for _ in range(25):
        if not _solve(H, g, damping, L, dx):
            return np.nan
        for i in range(_N):
            x_new[i] = x[i] + dx[i]
        x_new[5] = min(max(x_new[5], _MIN_BLUR_PX / radius, 0.5 * x[5]), 2 * x[5])
        is_sane = x_new[2] > 0.1 and x_new[4] > 0.1 and x_new[0] ** 2 + x_new[1] ** 2 < 1 and sign * x_new[9] > 0
        cost_new = cost
        if is_sane:
            cost_new = _normal_equations(pixels, n, x_new, radius, variance, J, H_new, g_new)
        # The Jacobian holds to first order in the distance, so its fixed point lies a little beside the least sum: a
        # small rise is no reason to turn back.
        if not is_sane or cost_new > 1.02 * cost:
            damping = 10 * damping + 1e-2
            if damping > 1e4:
                return np.nan
            continue
        move_px = max(abs(x_new[0] - x[0]), abs(x_new[1] - x[1])) * radius
        x[:], H[:], g[:] = x_new, H_new, g_new
        cost = cost_new
        damping *= 0.1
        accepted += 1
        if move_px < enough_px:
            return cost / (n - _N)
        if accepted == 3 and cost > 4 * n * (noise**2 + (max_misfit * x[9]) ** 2):
            return np.nan
    return np.nan


@njit(cache=True, nogil=True)
def fit_ellipses(
    image: Grey,
    start: Float[np.ndarray, "m 5"],
    coarseness_px: Float[np.ndarray, "m"],
    sign: float,
    min_contrast: float,
    max_misfit: float,
    noise: float,
) -> Float[np.ndarray, "m 12"]:
    """Least squares of a blurred ellipse to the grey values about each blob.

    ``start`` holds u, v, uu, uv, vv of the blobs; ``coarseness_px`` is how far off that may be. The covariance is
    that of least squares with the noise taken from the residuals: the Cramér-Rao bound where the model holds.
    A fit is given up as soon as it is clear that its step (as a fraction of the brighter side) will stay well below
    ``min_contrast`` or its residual well above what ``noise`` (grey values) and ``max_misfit`` (a fraction of the
    step) make together.
    """
    out = np.full((len(start), 12), np.nan)
    H, L, x, narrow = np.empty((_N, _N)), np.zeros((_N, _N)), np.empty(_N), np.empty(_N)
    pixels, J = np.empty((3, 1024)), np.empty((_N + 1, 1024))
    for k in range(len(start)):
        u0, v0 = start[k, 0], start[k, 1]
        # A uniform ellipse with form E has second moments E/4; A is the factor of E⁻¹ = AᵀA, in radii.
        uu, uv, vv = 4 * start[k, 2], 4 * start[k, 3], 4 * start[k, 4]
        radius = (uu * vv - uv * uv) ** 0.25
        x[:] = 0.0
        x[2] = sqrt(vv) / radius
        x[3] = -uv / (radius * radius) / x[2]
        x[4] = sqrt(uu / (radius * radius) - x[3] * x[3])
        x[5] = _BLUR_PX / radius
        reach = 3.0 + 0.1 * radius  # enough surround to tell light that changes from an edge that moves
        variance, needed = np.nan, reach + coarseness_px[k]
        # A rough pass tells the noise, against which the prior is weighed, and where the edge lies; a second is final
        # unless the edge reaches beyond its window.
        for attempt in range(3):
            margin = needed
            room = int((2 * (sqrt(max(uu, vv)) + margin) + 6) ** 2)
            if room > pixels.shape[1]:
                pixels, J = np.empty((3, room)), np.empty((_N + 1, room))
            inner = (margin + 2) / radius if radius > _SOLID_RADIUS_PX else np.inf
            n = _gather(image, u0, v0, radius, x, margin / radius, inner, pixels)
            if attempt == 0:
                n = _thin(pixels, n)
                if n < 2 * _N or not _set_levels(pixels, n, x):
                    break
                if sign * x[9] < 0.5 * min_contrast * max(x[6], x[6] + x[9]):
                    break
                variance = max(1.0, 0.01 * x[9] * x[9])
            enough_px = 0.1 if attempt == 0 else 2e-3
            variance = _descend(pixels, n, x, radius, variance, sign, max_misfit, noise, enough_px, J, H)
            if not variance >= 0:
                break
            variance = max(variance, _QUANTISATION_VARIANCE)
            needed = reach + 3.0 * max(0.0, x[5] * radius - 0.8)
            if attempt > 0 and needed < margin + 1:
                break
        if not variance >= 0 or not _factor(H, 0.0, L):
            continue
        c_uu, c_uv, c_vv = _leading_inverse(L, variance * radius * radius)
        # More than noise remains: the surround may end near the edge (a sticker, a neighbour). Of the wide window and a
        # narrow one, that with the smaller covariance is right.
        if variance > 2 * max(noise * noise, _QUANTISATION_VARIANCE):
            narrow[:] = x
            margin = max(1.5, 0.25 * radius)
            n = _gather(image, u0, v0, radius, narrow, margin / radius, inner, pixels)
            if n > 2 * _N:
                found = _descend(pixels, n, narrow, radius, variance, sign, max_misfit, noise, enough_px, J, H)
                found = max(found, _QUANTISATION_VARIANCE) if found >= 0 else np.inf
                if found < variance and _factor(H, 0.0, L):
                    n_uu, n_uv, n_vv = _leading_inverse(L, found * radius * radius)
                    if n_uu + n_vv < c_uu + c_vv:
                        x[:], variance = narrow, found
                        c_uu, c_uv, c_vv = n_uu, n_uv, n_vv
        # What sampling a sharp edge adds (px², each way): found to fall with the number of pixels along the edge, and
        # as the spectrum of the blur at the sampling frequency, exp(−2π²s²).
        blur_px = x[5] * radius
        aliasing = _ALIASING_PX2 / radius * exp(-4 * pi**2 * (blur_px**2 - _MIN_BLUR_PX**2))
        p, r, t = x[2], x[3], x[4]
        # Form of the ellipse E = (AᵀA)⁻¹ and its eigenvalues a², b².
        e_uu, e_uv, e_vv = (1 + (r / t) ** 2) / (p * p), -r / (p * t * t), 1 / (t * t)
        spread = sqrt(0.25 * (e_uu - e_vv) ** 2 + e_uv * e_uv)
        mean = 0.5 * (e_uu + e_vv)
        out[k, U], out[k, V] = u0 + x[0] * radius, v0 + x[1] * radius
        out[k, COV_UU], out[k, COV_UV], out[k, COV_VV] = c_uu + aliasing, c_uv, c_vv + aliasing
        out[k, A] = radius * sqrt(mean + spread)
        out[k, B] = radius * sqrt(max(mean - spread, 0.0))
        out[k, THETA] = 0.5 * atan2(2 * e_uv, e_uu - e_vv)
        out[k, BLUR] = blur_px
        out[k, AROUND], out[k, STEP], out[k, RESIDUAL] = x[6], x[9], sqrt(variance)
    return out


def warm_up() -> None:
    """Compiles every kernel of this module for the types with which the stage calls it."""
    v, u = np.mgrid[0:24, 0:24]
    for dtype in (np.uint8, np.uint16):
        image = np.where((u - 12) ** 2 + (v - 12) ** 2 < 20, 50, 200).astype(dtype)
        found = blobs(image, np.full_like(image, 50), np.full_like(image, 200), -1.0, 0.2, 0.0, 3.0, 20.0, 0.3, 0.7)
        fit_ellipses(image, found, np.zeros(len(found)), -1.0, 0.2, 0.12, 0.0)
