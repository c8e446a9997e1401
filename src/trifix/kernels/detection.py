"""Compiled loops of the detector: connected blobs with their moments, and an ellipse fitted to grey values.

Knows grey values and numbers; which blob is worth being called a dot is decided by the stage.
"""

from math import atan2, exp, log, pi, sqrt

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from numba import njit

Grey = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]

# Columns of a blob: centre (px) and second moments (px²), sign: +1 of bright ones, -1 of dark ones,
# blur of the edge (px) to start with.
# Columns of a fit: those, with the moments of the ellipse; covariance of the centre (px²), semi-axes (px) and the long
# one's angle (rad), grey values of the surround and of the step from it to the dot, rms residual, what aliasing adds
# to the covariance (px²), how much opposite sides of the edge differ (steps). NaN where there is no fit.
U, V, UU, UV, VV, SIGN, BLUR, COV_UU, COV_UV, COV_VV, A, B, THETA, AROUND, STEP, RESIDUAL, ALIASING, LOPSIDED = range(
    18
)
COLUMNS = 18

BLOCK_PX = 4  # side of the blocks of pixels whose extremes are taken

# Parameters of the fit. First the odd ones: centre, gradients of the light and of the offset; then the even ones: the
# triangular factor of the ellipse's form, blur, levels of the surround and of the step. A dot is symmetric about its
# centre, so derivatives by the former are orthogonal to those by the latter, but for how the pixels happen to fall:
# each half is solved for by itself.
_HALF = 6
_N = 2 * _HALF
_P, _R, _T, _S, _AROUND, _STEP = range(_HALF, _N)
# Prior knowledge of the edge's blur, which is log-normal about _BLUR_PX.
_LOG_BLUR = 0.8
_BLUR_PX = 0.8
_MIN_BLUR_PX = 0.29  # the pixel's own aperture: 1/sqrt(12)
_QUANTISATION_VARIANCE = 1.0 / 12.0
_ALIASING_PX2 = 0.013**2
_MIN_FILL = 0.75  # area of a blob in areas of the ellipse of its moments; small dots lose a quarter to their pixels
_MAX_START = 0.4  # rms residual of a fit worth beginning, in steps
_SMALL_PX = 2.5  # mean semi-axis of a dot whose surround may end within a wide window's reach all round
_SHARP_PX = 1.0  # largest blur of such a dot
_CHANCE = 4.0  # standard deviations by which noise may let opposite sides of a dot differ
_ENOUGH = 160  # pixels for the first, rough fit


@njit(cache=True, nogil=True)
def block_extremes(image: Grey) -> tuple[Grey, Grey]:
    """Least and largest grey value in each block of pixels; pixels beyond the last whole block are left out."""
    h, w = image.shape
    rows, columns = h // BLOCK_PX, w // BLOCK_PX
    darkest, brightest = np.empty((rows, columns), image.dtype), np.empty((rows, columns), image.dtype)
    low, high = np.empty(4 * columns, image.dtype), np.empty(4 * columns, image.dtype)
    for i in range(rows):
        a, b, c, d = image[4 * i], image[4 * i + 1], image[4 * i + 2], image[4 * i + 3]
        for u in range(4 * columns):
            low[u] = min(min(a[u], b[u]), min(c[u], d[u]))
        for u in range(4 * columns):
            high[u] = max(max(a[u], b[u]), max(c[u], d[u]))
        for j in range(columns):
            darkest[i, j] = min(min(low[4 * j], low[4 * j + 1]), min(low[4 * j + 2], low[4 * j + 3]))
        for j in range(columns):
            brightest[i, j] = max(max(high[4 * j], high[4 * j + 1]), max(high[4 * j + 2], high[4 * j + 3]))
    return darkest, brightest


@njit(cache=True, nogil=True)
def _root(parent: np.ndarray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def blobs(
    image: Grey,
    low: Grey,
    high: Grey,
    darkest: Grey,
    brightest: Grey,
    min_contrast: float,
    min_range: float,
    min_diameter_px: float,
    max_diameter_px: float,
    min_length_px: float,
    min_axis_ratio: float,
) -> Float[np.ndarray, "m 7"]:
    """Roughly elliptic blobs, bright ones and dark ones, away from the border.

    A blob is 4-connected pixels on one side of the local threshold, which lies midway between the darkest and the
    brightest pixel about (Bernsen 1986; given for each block), where these differ by ``min_contrast`` of the brighter
    and by ``min_range`` grey values, which noise alone must not reach. ``low`` and ``high`` are the extremes of the
    blocks themselves: most lie on one side as a whole.

    Labels runs of pixels rather than pixels (He, Chao & Suzuki 2008), so that moments come in closed form.
    """
    h, w = image.shape
    rows, columns = low.shape
    size = h * w
    row = np.empty(size, np.int32)
    first = np.empty(size, np.int32)
    last = np.empty(size, np.int32)
    parent = np.empty(size, np.int32)
    sign = np.empty(size, np.int8)
    # Pieces of a row of blocks: first pixel, one beyond the last; sign, or twice the threshold where that is mixed.
    begin, end = np.empty(columns, np.int32), np.empty(columns, np.int32)
    side, threshold = np.empty(columns, np.int8), np.empty(columns, np.int32)
    pieces = 0
    n = 0
    above = 0  # first run of the row above
    for v in range(h):
        i = v // BLOCK_PX
        if i * BLOCK_PX == v and i < rows:
            pieces, latest = 0, 0
            for j in range(columns):
                faintest, most = float(darkest[i, j]), float(brightest[i, j])
                s, t = 0, int(darkest[i, j]) + int(brightest[i, j])
                if most - faintest > max(min_contrast * most, min_range):
                    s = 2
                    if i < rows - 1 and j < columns - 1:
                        if 2 * int(low[i, j]) > t:
                            s = 1
                        elif 2 * int(high[i, j]) <= t:
                            s = -1
                if s == 0 or (s == latest and s != 2):
                    if s != 0:
                        end[pieces - 1] += BLOCK_PX
                    latest = s
                    continue
                begin[pieces], end[pieces] = j * BLOCK_PX, (j + 1) * BLOCK_PX if j < columns - 1 else w
                side[pieces], threshold[pieces] = s, t
                pieces += 1
                latest = s
        start = n
        latest, reached = 0, -1  # sign of the open run, and where it has come to
        for piece in range(pieces):
            if begin[piece] != reached:
                latest = 0
            reached = end[piece]
            if side[piece] != 2:
                if side[piece] != latest:
                    row[n], first[n], parent[n], sign[n] = v, begin[piece], n, side[piece]
                    n += 1
                    latest = side[piece]
                last[n - 1] = reached - 1
                continue
            t = threshold[piece]
            for u in range(begin[piece], end[piece]):
                s = 1 if 2 * int(image[v, u]) > t else -1
                if s != latest:
                    row[n], first[n], parent[n], sign[n] = v, u, n, s
                    n += 1
                    latest = s
                last[n - 1] = u
        k = above
        for i in range(start, n):
            while k < start and last[k] < first[i]:
                k += 1
            j = k
            while j < start and first[j] <= last[i]:
                if sign[j] == sign[i]:
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
    out = np.empty((n, BLUR + 1))
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
        if minor < min_axis_ratio * min_axis_ratio * major or fill < _MIN_FILL:
            continue
        if 4 * sqrt(major) < min_length_px - 0.7:
            continue
        out[found, U], out[found, V], out[found, SIGN] = u_mean, v_mean, sign[k]
        out[found, BLUR] = _BLUR_PX
        out[found, UU], out[found, UV], out[found, VV] = uu, uv, vv
        found += 1
    return out[:found].copy()


@njit(cache=True, nogil=True)
def _factor(H: np.ndarray, damping: float, L: np.ndarray) -> bool:
    """Cholesky factor L of H + damping·diag H, of which the lower triangle is read; False if not positive."""
    for i in range(_HALF):
        for j in range(i + 1):
            s = H[i, j]
            if i == j:
                s += damping * H[i, i]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 1e-12 * H[i, i]:
                    return False
                L[i, i] = sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@njit(cache=True, nogil=True)
def _back(L: np.ndarray, g: np.ndarray, x: np.ndarray) -> None:
    """Solves L Lᵀ x = g."""
    for i in range(_HALF):
        s = g[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(_HALF - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, _HALF):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@njit(cache=True, nogil=True)
def _gather(
    image: np.ndarray,
    u0: float,
    v0: float,
    radius: float,
    x: np.ndarray,
    outer_px: float,
    inner_px: float,
    pixels: np.ndarray,
) -> int:
    """Fills ``pixels`` (u, v in radii about (u0, v0), grey value) with those between the edge's two offsets."""
    h, w = image.shape
    p, r, t = x[_P], x[_R], x[_T]
    # Form of the ellipse E = (AᵀA)⁻¹ (px²); with its axes a, b longer by m it is that of α I + β E.
    scale = radius * radius
    e_uu, e_uv, e_vv = scale * (1 + (r / t) ** 2) / (p * p), -scale * r / (p * t * t), scale / (t * t)
    mean, spread = 0.5 * (e_uu + e_vv), sqrt(0.25 * (e_uu - e_vv) ** 2 + e_uv * e_uv)
    a, b = sqrt(mean + spread), sqrt(max(mean - spread, 0.0))
    m = outer_px
    beta = 1 + 2 * m / (a + b)
    alpha = (a + m) ** 2 - beta * a * a
    o_uu, o_uv, o_vv = alpha + beta * e_uu, beta * e_uv, alpha + beta * e_vv
    m = -inner_px
    has_hole = b > inner_px + 0.5
    beta = 1 + 2 * m / (a + b)
    alpha = (a + m) ** 2 - beta * a * a
    i_uu, i_uv, i_vv = alpha + beta * e_uu, beta * e_uv, alpha + beta * e_vv
    cu, cv = u0 + x[0] * radius, v0 + x[1] * radius
    half_v = sqrt(o_vv)
    n, room = 0, pixels.shape[1]
    for v in range(max(0, int(np.ceil(cv - half_v))), min(h - 1, int(np.floor(cv + half_v))) + 1):
        dv = v - cv
        ev = np.float32((v - v0) / radius)
        middle = cu + o_uv / o_vv * dv
        half = sqrt(max(0.0, (o_uu - o_uv * o_uv / o_vv) * (1 - dv * dv / o_vv)))
        first, last = max(0, int(np.ceil(middle - half))), min(w - 1, int(np.floor(middle + half)))
        skip_from, skip_to = last + 1, last + 1
        if has_hole and dv * dv < i_vv:
            middle = cu + i_uv / i_vv * dv
            half = sqrt((i_uu - i_uv * i_uv / i_vv) * (1 - dv * dv / i_vv))
            skip_from, skip_to = int(np.ceil(middle - half)), int(np.floor(middle + half)) + 1
            if skip_to <= skip_from:
                skip_from, skip_to = last + 1, last + 1
        if n + last - first + 1 > room:
            return 0
        for u in range(first, min(skip_from, last + 1)):
            pixels[0, n], pixels[1, n], pixels[2, n] = (u - u0) / radius, ev, image[v, u]
            n += 1
        for u in range(max(first, skip_to), last + 1):
            pixels[0, n], pixels[1, n], pixels[2, n] = (u - u0) / radius, ev, image[v, u]
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
        pixels[0, kept], pixels[1, kept], pixels[2, kept] = pixels[0, i], pixels[1, i], pixels[2, i]
        kept += 1
    return kept


@njit(cache=True, nogil=True, fastmath=True)
def _differentiate(pixels: np.ndarray, n: int, x: np.ndarray, J: np.ndarray) -> None:
    """Fills the rows of J with the derivatives of each pixel's grey value, the last one with its residual.

    Model of a grey value at ξ, relative to the start: (1 + λ·ξ) (B + C Φ) + (o·ξ) C (h − Φ) with the light's gradient λ
    and an offset o of the darker side (h is 1 if the dot is the brighter), Φ = Φ(−d/s), d the distance from the ellipse
    to first order, s the blur. Φ integrates the density (1 − z²/k²)⁸ with k² = 19, of unit variance: nearly normal, but
    a polynomial. The model is symmetric about the centre wherever the light is level: what it gets wrong of a symmetric
    dot does not move the centre.

    Many short loops: only such with few arrays are vectorised, since the arrays might overlap.
    """
    f = np.float32
    cu, cv, lu, lv, ou, ov = f(x[0]), f(x[1]), f(x[2]), f(x[3]), f(x[4]), f(x[5])
    p, r, t, s, b, c = f(x[_P]), f(x[_R]), f(x[_T]), f(x[_S]), f(x[_AROUND]), f(x[_STEP])
    is_bright = f(1.0) if c > 0 else f(0.0)
    one, zero, half, by_s, tiny = f(1.0), f(0.0), f(0.5), f(1.0) / s, f(1e-6)
    k, by_k2, norm = f(4.358899), f(1.0 / 19.0), f(0.38294882517654555)
    # The density, integrated: binomial coefficients over odd numbers.
    c1, c2, c3, c4 = f(-8.0 / 3.0), f(28.0 / 5.0), f(-56.0 / 7.0), f(70.0 / 9.0)
    c5, c6, c7, c8 = f(-56.0 / 11.0), f(28.0 / 13.0), f(-8.0 / 15.0), f(1.0 / 17.0)
    eu, ev, grey = pixels[0], pixels[1], pixels[2]
    by_u, by_v, by_lu, by_lv, by_ou, by_ov = J[0], J[1], J[2], J[3], J[4], J[5]
    by_p, by_r, by_t, by_blur, inside, residual = J[6], J[7], J[8], J[9], J[11], J[12]
    along, z = J[13], J[14]
    for i in range(n):
        du, dv = eu[i] - cu, ev[i] - cv
        y0, y1 = p * du + r * dv, t * dv
        q = np.sqrt(y0 * y0 + y1 * y1)
        g0, g1 = p * y0, r * y0 + t * y1
        by_g = one / (np.sqrt(g0 * g0 + g1 * g1) + tiny)
        along[i] = by_g
        z[i] = min(max((q - one) * q * by_g * by_s, -k), k)
    for i in range(n):
        w = z[i] * z[i] * by_k2
        total = c4 + w * (c5 + w * (c6 + w * (c7 + w * c8)))
        total = one + w * (c1 + w * (c2 + w * (c3 + w * total)))
        inside[i] = half - z[i] * norm * total
    for i in range(n):
        w = max(one - z[i] * z[i] * by_k2, zero)
        w = w * w
        w = w * w
        by_blur[i] = c * norm * by_s * w * w * (one + (lu - ou) * eu[i] + (lv - ov) * ev[i])  # −dI/dd
    for i in range(n):
        along[i] *= by_blur[i]
        by_blur[i] *= z[i]
    for i in range(n):
        du, dv = eu[i] - cu, ev[i] - cv
        y0, y1 = p * du + r * dv, t * dv
        by_u[i] = along[i] * p * y0
        by_v[i] = along[i] * (r * y0 + t * y1)
    for i in range(n):
        du, dv = eu[i] - cu, ev[i] - cv
        y0 = p * du + r * dv
        by_p[i] = -along[i] * y0 * du
        by_r[i] = -along[i] * y0 * dv
    for i in range(n):
        dv = ev[i] - cv
        by_t[i] = -along[i] * t * dv * dv
    for i in range(n):
        by_lu[i] = eu[i] * (b + c * inside[i])
        by_ou[i] = eu[i] * c * (is_bright - inside[i])
    for i in range(n):
        by_lv[i] = ev[i] * (b + c * inside[i])
        by_ov[i] = ev[i] * c * (is_bright - inside[i])
    for i in range(n):
        light, offset = one + lu * eu[i] + lv * ev[i], ou * eu[i] + ov * ev[i]
        residual[i] = grey[i] - light * (b + c * inside[i]) - offset * c * (is_bright - inside[i])


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _product(a: np.ndarray, b: np.ndarray) -> float:
    total = np.float32(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return float(total)


@njit(cache=True, nogil=True)
def _normal_equations(
    pixels: np.ndarray,
    n: int,
    x: np.ndarray,
    radius: float,
    variance: float,
    prior: np.ndarray,
    J: np.ndarray,
    H: np.ndarray,
    g: np.ndarray,
) -> float:
    """Fills both halves of H = JᵀJ (lower triangles) and g = Jᵀr, the prior included; returns the sum of squares."""
    _differentiate(pixels, n, x, J)
    residual = J[_N, :n]
    for half in range(2):
        for i in range(_HALF):
            a = J[half * _HALF + i, :n]
            g[half, i] = _product(a, residual)
            for j in range(i + 1):
                H[half, i, j] = _product(a, J[half * _HALF + j, :n])
    total = _product(residual, residual)
    for i in range(2, _HALF):
        w = variance / (prior[i - 2] * radius) ** 2
        total += w * x[i] * x[i]
        H[0, i, i] += w
        g[0, i] -= w * x[i]
    w = variance / _LOG_BLUR**2
    s = x[_S]
    e = log(s * radius / _BLUR_PX)
    total += w * e * e
    k = _S - _HALF
    H[1, k, k] += w / (s * s)
    g[1, k] -= w * e / s
    return total


@njit(cache=True, nogil=True)
def _start(blob: np.ndarray, radius: float, x: np.ndarray) -> None:
    """Starts the form and the blur from those of a blob, without gradients."""
    # A uniform ellipse with form E has second moments E/4; A is the factor of E⁻¹ = AᵀA, in radii.
    uu, uv, vv = 4 * blob[UU], 4 * blob[UV], 4 * blob[VV]
    x[:] = 0.0
    x[_P] = sqrt(vv) / radius
    x[_R] = -uv / (radius * radius) / x[_P]
    x[_T] = sqrt(uu / (radius * radius) - x[_R] * x[_R])
    x[_S] = blob[BLUR] / radius


@njit(cache=True, nogil=True)
def _set_levels(pixels: np.ndarray, n: int, x: np.ndarray) -> bool:
    """Starts the levels of surround and step from the pixels clear of the edge; False where there are none."""
    around, inside, n_around, n_inside = 0.0, 0.0, 0, 0
    for i in range(n):
        y0 = x[_P] * pixels[0, i] + x[_R] * pixels[1, i]
        y1 = x[_T] * pixels[1, i]
        q2 = y0 * y0 + y1 * y1
        if q2 < 0.8:
            inside += pixels[2, i]
            n_inside += 1
        elif q2 > 1.2:
            around += pixels[2, i]
            n_around += 1
    if n_inside == 0 or n_around == 0:
        return False
    x[_AROUND] = around / n_around
    x[_STEP] = inside / n_inside - x[_AROUND]
    return True


@njit(cache=True, nogil=True)
def _descend(
    pixels: np.ndarray,
    n: int,
    x: np.ndarray,
    radius: float,
    variance: float,
    prior: np.ndarray,
    sign: float,
    max_start: float,
    max_misfit: float,
    noise: float,
    enough_px: float,
    white: float,
    J: np.ndarray,
    H: np.ndarray,
) -> float:
    """Levenberg-Marquardt from x, in place, until the centre moves less than ``enough_px``.

    Returns the variance of the residuals (grey values²) and leaves JᵀJ in H (J is storage); NaN where it leads nowhere.
    """
    H_new, L = np.empty((2, _HALF, _HALF)), np.zeros((_HALF, _HALF))
    g, g_new, dx, x_new = np.empty((2, _HALF)), np.empty((2, _HALF)), np.empty(_HALF), np.empty(_N)
    free = -float(_N)  # pixels that are not saturated, less the parameters
    for i in range(n):
        free += pixels[2, i] < white
    if free < _N:
        return np.nan
    damping, accepted = 1e-3, 0
    cost = _normal_equations(pixels, n, x, radius, variance, prior, J, H, g)
    if cost > n * (4 * noise**2 + (max_start * x[_STEP]) ** 2):
        return np.nan
    for _ in range(25):
        for half in range(2):
            if not _factor(H[half], damping, L):
                return np.nan
            _back(L, g[half], dx)
            for i in range(_HALF):
                x_new[half * _HALF + i] = x[half * _HALF + i] + dx[i]
        x_new[_S] = min(max(x_new[_S], _MIN_BLUR_PX / radius, 0.5 * x[_S]), 2 * x[_S])
        is_sane = x_new[_P] > 0.1 and x_new[_T] > 0.1 and x_new[0] ** 2 + x_new[1] ** 2 < 1 and sign * x_new[_STEP] > 0
        cost_new = cost
        if is_sane:
            cost_new = _normal_equations(pixels, n, x_new, radius, variance, prior, J, H_new, g_new)
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
            return cost / free
        if accepted == 2 and cost > 4 * n * (noise**2 + (max_misfit * x[_STEP]) ** 2):
            return np.nan
    return np.nan


@njit(cache=True, nogil=True)
def _leading_inverse(H: np.ndarray, L: np.ndarray) -> tuple[float, float, float]:
    """Entries 00, 01, 11 of the inverse of the matrix H; NaN where it has none."""
    if not _factor(H, 0.0, L):
        return np.nan, np.nan, np.nan
    unit, a, b = np.zeros(_HALF), np.empty(_HALF), np.empty(_HALF)
    unit[0] = 1.0
    _back(L, unit, a)
    unit[0], unit[1] = 0.0, 1.0
    _back(L, unit, b)
    return a[0], a[1], b[1]


@njit(cache=True, nogil=True)
def _lopsided(pixels: np.ndarray, n: int, x: np.ndarray, noise: float, J: np.ndarray) -> float:
    """How much the residuals of opposite eighths of the edge differ, inside or outside of it, beyond noise (steps).

    What the model gets wrong of a whole dot is the same on opposite sides, and what a thing before it does is not.
    """
    _differentiate(pixels, n, x, J)
    total, count = np.zeros((2, 8)), np.zeros((2, 8))
    for i in range(n):
        du, dv = pixels[0, i] - x[0], pixels[1, i] - x[1]
        y0, y1 = x[_P] * du + x[_R] * dv, x[_T] * dv
        eighth = 4 * (y0 > 0) + 2 * (y1 > 0) + (abs(y0) > abs(y1))
        side = 1 if y0 * y0 + y1 * y1 < 1 else 0
        total[side, eighth] += J[_N, i]
        count[side, eighth] += 1
    worst = 0.0
    for side in range(2):
        for k in range(4):
            one, other = count[side, k], count[side, k ^ 6]
            if one > 0 and other > 0:
                differ = abs(total[side, k] / one - total[side, k ^ 6] / other)
                worst = max(worst, differ - _CHANCE * noise * sqrt(1 / one + 1 / other))
    return worst / abs(x[_STEP])


@njit(cache=True, nogil=True)
def fit_ellipses(
    image: Grey,
    start: Float[np.ndarray, "m 7"],
    prior: Float[np.ndarray, "4"],
    min_contrast: float,
    max_misfit: float,
    noise: float,
    is_rough: bool,
) -> tuple[Float[np.ndarray, "m 18"], Float[np.ndarray, "m 4"], Float[np.ndarray, "m 6 6"]]:
    """Least squares of a blurred ellipse to the grey values about each start.

    ``start`` holds u, v, uu, uv, vv, sign and blur of the blobs. The covariance is
    that of least squares with the noise taken from the residuals: the Cramér-Rao bound where the model holds.
    A fit is given up as soon as it is clear that its step (as a fraction of the brighter side) will stay well below
    ``min_contrast`` or its residual well above what ``noise`` (grey values) and ``max_misfit`` (a fraction of the
    step) make together.
    """
    out = np.full((len(start), COLUMNS), np.nan)
    gradient, information = np.zeros((len(start), 4)), np.zeros((len(start), _HALF, _HALF))
    H, L, x, narrow = np.empty((2, _HALF, _HALF)), np.zeros((_HALF, _HALF)), np.empty(_N), np.empty(_N)
    H_narrow = np.empty((2, _HALF, _HALF))
    pixels, J = np.empty((3, 2048), np.float32), np.ones((_N + 3, 2048), np.float32)
    white = float(np.iinfo(image.dtype).max)
    for k in range(len(start)):
        u0, v0, sign = start[k, U], start[k, V], start[k, SIGN]
        radius = (16 * (start[k, UU] * start[k, VV] - start[k, UV] ** 2)) ** 0.25
        _start(start[k], radius, x)
        # Enough surround to tell light that changes from an edge that moves.
        reach = 2.0 if is_rough else 3.0 + 0.1 * radius
        variance, enough_px = np.nan, 2e-3
        needed = reach + 3.0 * max(0.0, start[k, BLUR] - 0.8)
        # A rough pass tells the noise, against which the prior is weighed, and where the edge lies; a second is final
        # unless the edge reaches beyond its window.
        for attempt in range(3):
            margin = needed
            n = _gather(image, u0, v0, radius, x, margin, margin + 2, pixels)
            if n == 0:
                room = int((2 * (2 * sqrt(max(start[k, UU], start[k, VV])) + margin) + 6) ** 2)
                pixels, J = np.empty((3, room), np.float32), np.ones((_N + 3, room), np.float32)
                n = _gather(image, u0, v0, radius, x, margin, margin + 2, pixels)
            if attempt == 0:
                n = _thin(pixels, n)
                if n < 2 * _N or not _set_levels(pixels, n, x):
                    break
                if sign * x[_STEP] < 0.5 * min_contrast * max(x[_AROUND], x[_AROUND] + x[_STEP]):
                    break
                variance = max(1.0, 0.01 * x[_STEP] ** 2)
            # Newton's steps shrink so fast that what is left to go is far less than the last one.
            enough_px = 0.1 if attempt == 0 else max(2e-3, 0.5 * sqrt(variance) / abs(x[_STEP]))
            variance = _descend(
                pixels, n, x, radius, variance, prior, sign, _MAX_START, max_misfit, noise, enough_px, white, J, H
            )
            if not variance >= 0:
                break
            variance = max(variance, _QUANTISATION_VARIANCE)
            needed = reach + 3.0 * max(0.0, x[_S] * radius - 0.8)
            if is_rough or (attempt > 0 and needed < margin + 1):
                break
        c_uu, c_uv, c_vv = np.nan, np.nan, np.nan
        if variance >= 0:
            c_uu, c_uv, c_vv = _leading_inverse(H[0], L)
        # More than noise remains, or too much for any fit: the surround may end near the edge (a sticker, a neighbour).
        # Of the wide window and a narrow one, that with the smaller covariance is right.
        is_first = not c_uu > 0
        is_worse = not variance <= 2 * max(noise * noise, _QUANTISATION_VARIANCE)
        if not is_rough and is_worse and (not is_first or radius < _SMALL_PX):
            if is_first:
                _start(start[k], radius, x)
                enough_px = 2e-3
            narrow[:] = x
            margin = max(1.5, 0.25 * radius)
            n = _gather(image, u0, v0, radius, narrow, margin, margin + 2, pixels)
            is_clear = n > 2 * _N and (not is_first or _set_levels(pixels, n, narrow))
            if is_first and is_clear:
                is_clear = sign * narrow[_STEP] >= min_contrast * max(narrow[_AROUND], narrow[_AROUND] + narrow[_STEP])
            if is_clear:
                found = _descend(
                    pixels,
                    n,
                    narrow,
                    radius,
                    max(1.0, 0.01 * narrow[_STEP] ** 2) if is_first else variance,
                    prior,
                    sign,
                    _MAX_START,
                    max_misfit,
                    noise,
                    enough_px,
                    white,
                    J,
                    H_narrow,
                )
                # By itself a narrow window tells clutter from dots only where the edge is sharp.
                if found >= 0 and (not is_first or narrow[_S] * radius < _SHARP_PX):
                    found = max(found, _QUANTISATION_VARIANCE)
                    n_uu, n_uv, n_vv = _leading_inverse(H_narrow[0], L)
                    if is_first or (found < variance and found * (n_uu + n_vv) < variance * (c_uu + c_vv)):
                        x[:], variance, H[:] = narrow, found, H_narrow
                        c_uu, c_uv, c_vv = n_uu, n_uv, n_vv
        if not c_uu > 0:
            continue
        out[k, LOPSIDED] = 0.0
        if not is_rough:
            margin = max(1.5, 2 * x[_S] * radius)
            n = _gather(image, u0, v0, radius, x, margin, margin + 2, pixels)
            if n > 0:
                out[k, LOPSIDED] = _lopsided(pixels, n, x, max(noise, sqrt(_QUANTISATION_VARIANCE)), J)
        # What sampling a sharp edge adds (px², each way): found to fall with the number of pixels along the edge, and
        # as the spectrum of the blur at the sampling frequency, exp(−2π²s²).
        blur_px = x[_S] * radius
        aliasing = _ALIASING_PX2 / radius * exp(-4 * pi**2 * (blur_px**2 - _MIN_BLUR_PX**2))
        p, r, t = x[_P], x[_R], x[_T]
        scale = radius * radius
        e_uu, e_uv, e_vv = scale * (1 + (r / t) ** 2) / (p * p), -scale * r / (p * t * t), scale / (t * t)
        spread = sqrt(0.25 * (e_uu - e_vv) ** 2 + e_uv * e_uv)
        mean = 0.5 * (e_uu + e_vv)
        out[k, U], out[k, V], out[k, SIGN] = u0 + x[0] * radius, v0 + x[1] * radius, sign
        out[k, UU], out[k, UV], out[k, VV] = 0.25 * e_uu, 0.25 * e_uv, 0.25 * e_vv
        for i in range(_HALF):
            H[0, i, i] -= variance / (prior[i - 2] * radius) ** 2 if i >= 2 else 0.0
            for j in range(i + 1):
                unit_i, unit_j = radius if i < 2 else 1 / radius, radius if j < 2 else 1 / radius
                information[k, i, j] = H[0, i, j] / (variance * unit_i * unit_j)
        gradient[k] = x[2:_HALF] / radius
        unit = variance * scale
        out[k, COV_UU], out[k, COV_UV], out[k, COV_VV] = unit * c_uu + aliasing, unit * c_uv, unit * c_vv + aliasing
        # Blur draws the edge inwards by s²κ/2 where its curvature κ is less than 1/s, and by no more than s/2.
        a, b = sqrt(mean + spread), sqrt(max(mean - spread, 1e-12))
        at_ends, at_flanks = blur_px * a / (b * b), blur_px * b / (a * a)
        out[k, A] = a + 0.5 * blur_px * at_ends / (1 + at_ends)
        out[k, B] = b + 0.5 * blur_px * at_flanks / (1 + at_flanks)
        out[k, THETA] = 0.5 * atan2(2 * e_uv, e_uu - e_vv)
        out[k, BLUR], out[k, ALIASING] = blur_px, aliasing
        out[k, AROUND], out[k, STEP], out[k, RESIDUAL] = x[_AROUND], x[_STEP], sqrt(variance)
    return out, gradient, information


@njit(cache=True, nogil=True)
def share_gradients(
    fits: Float[np.ndarray, "m 18"],
    gradient: Float[np.ndarray, "m 4"],
    information: Float[np.ndarray, "m 6 6"],
    prior: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "m 5"]:
    """Centres u, v and their covariances uu, uv, vv (px, px²) with what all dots of the image tell of its light.

    A dot by itself hardly tells a gradient of the light from a shift of its edge, which costs a third of the accuracy.
    The mean and the spread of the gradients over the dots, by the method of moments beyond what the fits' own
    errors make, take the place of the prior with which each was fitted (empirical Bayes; Efron & Morris 1973). The
    spread has the benefit of the doubt: one standard error of itself, or that prior as one dot more, if that is less.
    """
    m = len(fits)
    own, error = np.empty((m, 4)), np.empty((m, 4))  # estimates without the prior, and their variances
    L, H = np.zeros((_HALF, _HALF)), np.empty((_HALF, _HALF))
    unit, x, g = np.zeros(_HALF), np.empty(_HALF), np.zeros(_HALF)
    for k in range(m):
        own[k], error[k] = 0.0, np.inf
        if not _factor(information[k], 1e-9, L):
            continue
        # At the optimum the pull of the data equals that of the prior.
        g[2:] = gradient[k] / prior**2
        _back(L, g, x)
        own[k] = gradient[k] + x[2:]
        for i in range(4):
            unit[:] = 0.0
            unit[2 + i] = 1.0
            _back(L, unit, x)
            error[k, i] = x[2 + i]
    mean, spread2 = np.zeros(4), np.empty(4)
    for pair in range(2):
        i, j = 2 * pair, 2 * pair + 2
        tau2 = prior[i] ** 2
        for _ in range(8):
            top, bottom = 0.0, 0.0
            for c in range(i, j):
                weight = 1 / (error[:, c] + tau2)
                if pair == 0:
                    mean[c] = np.sum(weight * own[:, c]) / (np.sum(weight) + 1 / (prior[c] ** 2 + tau2))
                top += np.sum(weight**2 * ((own[:, c] - mean[c]) ** 2 - np.minimum(error[:, c], 1e30)))
                bottom += np.sum(weight**2)
            found = max(0.0, top / max(bottom, 1e-300))
            tau2 = min((m * found + prior[i] ** 2) / (m + 1), found + 1 / max(np.mean(weight) * sqrt(m), 1e-300))
        spread2[i:j] = tau2
    out = np.empty((m, 5))
    for k in range(m):
        g[:] = 0.0
        for i in range(4):
            g[2 + i] = gradient[k, i] / prior[i] ** 2 - (gradient[k, i] - mean[i]) / spread2[i]
        H[:] = information[k]
        for i in range(4):
            H[2 + i, 2 + i] += 1 / spread2[i]
        out[k, 0], out[k, 1] = fits[k, U], fits[k, V]
        out[k, 2], out[k, 3], out[k, 4] = fits[k, COV_UU], fits[k, COV_UV], fits[k, COV_VV]
        c_uu, c_uv, c_vv = _leading_inverse(H, L)
        if c_uu > 0:
            _back(L, g, x)
            out[k, 0] += x[0]
            out[k, 1] += x[1]
            out[k, 2], out[k, 3], out[k, 4] = c_uu + fits[k, ALIASING], c_uv, c_vv + fits[k, ALIASING]
    return out


@njit(cache=True, nogil=True)
def distinct(
    uv: Float[np.ndarray, "m 2"], reach: Float[np.ndarray, "m"], order: Int[np.ndarray, "m"]
) -> Bool[np.ndarray, "m"]:
    """Which points to keep, taken in the given order, so that no two lie within the reach of either."""
    m = len(uv)
    kept = np.zeros(m, np.bool_)
    rank = np.empty(m, np.int64)
    rank[order] = np.arange(m)
    by_v = np.argsort(uv[:, 1])
    most = 0.0
    for i in range(m):
        most = max(most, reach[i])
    place = np.empty(m, np.int64)
    place[by_v] = np.arange(m)
    for i in order:
        clear = True
        for step in (-1, 1):
            p = place[i] + step
            while clear and 0 <= p < m and abs(uv[by_v[p], 1] - uv[i, 1]) < most:
                j = by_v[p]
                if kept[j]:
                    d = max(reach[i], reach[j])
                    clear = (uv[i, 0] - uv[j, 0]) ** 2 + (uv[i, 1] - uv[j, 1]) ** 2 >= d * d
                p += step
        kept[i] = clear
    return kept


@njit(cache=True, nogil=True)
def noise_samples(image: Grey, lag_px: int) -> Float[np.ndarray, "p"]:
    """Magnitudes, at places all over the image, of a mask of nine pixels ``lag_px`` apart that is blind to slopes.

    Where there is only noise and that is not correlated over the lag, they are of six times its standard deviation. The
    mask is the difference of two Laplacians (Immerkær 1996).
    """
    h, w = image.shape
    step = max(1, int(sqrt(h * w / 4096)))
    one, two = lag_px, 2 * lag_px
    out = np.empty(((h - two - 1) // step + 1, (w - two - 1) // step + 1))
    for i in range(out.shape[0]):
        a, b, c = image[i * step], image[i * step + one], image[i * step + two]
        for j in range(out.shape[1]):
            u = j * step
            corners = int(a[u]) + int(a[u + two]) + int(c[u]) + int(c[u + two])
            sides = int(a[u + one]) + int(b[u]) + int(b[u + two]) + int(c[u + one])
            out[i, j] = abs(corners - 2 * sides + 4 * int(b[u + one]))
    return out.ravel()


def warm_up() -> None:
    """Compiles every kernel of this module for the types with which the stage calls it."""
    v, u = np.mgrid[0:24, 0:24]
    prior = np.full(4, 1e-3)
    for dtype in (np.uint8, np.uint16):
        image = np.where((u - 12) ** 2 + (v - 12) ** 2 < 20, 50, 200).astype(dtype)
        noise_samples(image, 1)
        low, high = block_extremes(image)
        found = blobs(image, low, high, np.full_like(low, 50), np.full_like(low, 200), 0.2, 0.0, 3.0, 20.0, 3.0, 0.3)
        fits, gradient, information = fit_ellipses(image, found, prior, 0.2, 0.12, 0.0, False)
    share_gradients(fits, gradient, information, prior)
    distinct(fits[:, :2].copy(), fits[:, B].copy(), np.arange(len(fits)))
