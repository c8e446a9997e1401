"""Compiled loops of tending the map: who was seen from where, whose residuals are biased, who stands near whom.

What is remembered of a target stands in one row of each of four tables: ``count`` (integers, columns below),
``cells`` (two sets of directions: seen from, and missed from since it was last seen), ``first`` (unit direction of the
first sighting, NaN where unknown) and ``bias`` (information of the residuals, upper triangle row by row, their weighted
sum, and the mean of the newest). Millimetres, world coordinates.
"""

import numpy as np
from numba import njit

ID, FIRST, LAST, HITS, TRIES, MISSED, TURNED, WEIGHED = range(8)
"""Columns of ``count``: identity; lesson of the first and of the last sighting; sightings; how often it should have
been seen by then; how often since; whether it was seen from two directions; how many residuals ``bias`` holds."""
COLUMNS = 8
CELLS = 6
"""Words of 64 directions each: the sides of a cube, eight by eight, about 11° wide."""
WITNESSES = 3
"""Targets that stood there when another was last seen and still do: so many say where that one should be."""

_TRUSTED = 1  # TargetState.trusted
_NEWEST = 0.3  # share of the newest residual in their mean: that of the last three or so


@njit(cache=True, nogil=True)
def witness(lesson, t, seen, missed, added, min_turn_cos, id, xyz, state, count, cells, first, bias):
    """Counts sightings and misses; returns how many witnesses each miss has (n), -1 for one that tells nothing.

    A miss tells nothing unless the target was seen from about the same direction before. It counts only if three of
    those seen now, the witnesses, were known when it was last seen, or else the map may have drifted meanwhile; and if
    two of its three nearest are seen, or else a hand may hide them all.
    """
    witnesses = np.full(len(missed), -1)
    for k in range(len(missed)):
        row = missed[k]
        if count[row, ID] != id[row]:
            _begin(row, id[row], lesson, count, cells, first, bias)
            continue
        word, bit = _cell(t[0] - xyz[row, 0], t[1] - xyz[row, 1], t[2] - xyz[row, 2])
        if cells[row, 0, word] & bit == 0:
            continue
        witnesses[k] = 0
        for other in seen:
            if count[other, ID] == id[other] and count[other, FIRST] <= count[row, LAST]:
                witnesses[k] += 1
        if witnesses[k] >= WITNESSES and _stands_free(k, seen, missed, xyz, state):
            count[row, MISSED] += 1
            cells[row, 1, word] |= bit
    for row in seen:
        if count[row, ID] != id[row]:
            _begin(row, id[row], lesson, count, cells, first, bias)
        _see(row, lesson, t, xyz, min_turn_cos, count, cells, first)
    for row in added:
        _begin(row, id[row], lesson, count, cells, first, bias)
        _see(row, lesson, t, xyz, min_turn_cos, count, cells, first)
    return witnesses


@njit(cache=True, nogil=True)
def _stands_free(k, seen, missed, xyz, state):
    """Whether two of the three nearest to a missed target are seen; others that were missed may never have been."""
    d2 = np.full(3, np.inf)
    is_seen = np.zeros(3, np.bool_)
    for i in range(len(seen) + len(missed)):
        row = seen[i] if i < len(seen) else missed[i - len(seen)]
        if i == len(seen) + k or (i >= len(seen) and state[row] != _TRUSTED):
            continue
        d = _distance2(xyz[row], xyz[missed[k]])
        for place in range(3):
            if d < d2[place]:
                for after in range(2, place, -1):
                    d2[after], is_seen[after] = d2[after - 1], is_seen[after - 1]
                d2[place], is_seen[place] = d, i < len(seen)
                break
    return is_seen.sum() >= 2


@njit(cache=True, nogil=True)
def directions(cells):
    """How many directions (n) are in the second sets of some rows of ``cells``: from so many were they missed."""
    out = np.zeros(len(cells), np.int64)
    for k in range(len(cells)):
        for word in cells[k, 1]:
            while word:
                word &= word - np.uint64(1)
                out[k] += 1
    return out


@njit(cache=True, nogil=True)
def _begin(row, id, lesson, count, cells, first, bias):
    count[row] = 0
    count[row, ID] = id
    count[row, FIRST] = lesson
    count[row, LAST] = lesson
    cells[row] = 0
    first[row] = np.nan
    bias[row] = 0.0


@njit(cache=True, nogil=True)
def _see(row, lesson, t, xyz, min_turn_cos, count, cells, first):
    x, y, z = t[0] - xyz[row, 0], t[1] - xyz[row, 1], t[2] - xyz[row, 2]
    word, bit = _cell(x, y, z)
    cells[row, 0, word] |= bit
    cells[row, 1] = 0
    count[row, LAST] = lesson
    count[row, HITS] += 1
    count[row, TRIES] += 1 + count[row, MISSED]
    count[row, MISSED] = 0
    r = np.sqrt(x * x + y * y + z * z)
    if np.isnan(first[row, 0]):
        first[row, 0], first[row, 1], first[row, 2] = x / r, y / r, z / r
    elif first[row, 0] * x + first[row, 1] * y + first[row, 2] * z < min_turn_cos * r:
        count[row, TURNED] = 1


@njit(cache=True, nogil=True)
def _cell(x, y, z):
    """Word and bit of the direction (x, y, z): the side of a cube that it meets, and where on that side."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        side, a, b, c = (0 if x > 0 else 1), y, z, ax
    elif ay >= az:
        side, a, b, c = (2 if y > 0 else 3), x, z, ay
    else:
        side, a, b, c = (4 if z > 0 else 5), x, y, az
    i = min(7, int(4.0 * (a / c + 1.0)))
    j = min(7, int(4.0 * (b / c + 1.0)))
    return side, np.uint64(1) << np.uint64(8 * i + j)


@njit(cache=True, nogil=True)
def weigh(
    R, t, P, point_xyz, point_cov, point, target, at, at_cov, missed, xyz, cov, max_sigmas, forgetting, count, bias
):
    """Adds residuals, point less target, to the targets' bias; returns its χ² and the shift, in mm and in sigmas.

    First come the ``target`` of a fix, which stood ``at`` before it, then the ``missed``, for each of which the nearest
    point speaks that the fix left over. Residuals beyond ``max_sigmas`` are passed over, and leave zeros.

    With b = Σ λⁱ S⁻¹ r and A = Σ λⁱ S⁻¹, were there no bias, (1 + λ) bᵀ A⁻¹ b would be χ² of three degrees once many
    have been weighed. The shift is the mean of the newest residuals, its sigmas those of the last.
    """
    n, m = len(point_xyz), len(target)
    found = np.zeros((m + len(missed), 3))
    world = np.empty((n, 3))
    is_free = np.ones(n, np.bool_)
    for p in range(n):
        for a in range(3):
            world[p, a] = R[a, 0] * point_xyz[p, 0] + R[a, 1] * point_xyz[p, 1] + R[a, 2] * point_xyz[p, 2] + t[a]
    for p in point:
        is_free[p] = False
    S, weight, inverse, r = np.empty((3, 3)), np.empty(6), np.empty(6), np.empty(3)
    for k in range(len(found)):
        if k < m:
            q, p, x, C = target[k], point[k], at[k], at_cov[k]
        else:
            q = missed[k - m]
            x, C = xyz[q], cov[q]
            p, least = -1, np.inf
            for other in range(n):
                if is_free[other]:
                    d2 = (world[other, 0] - x[0]) ** 2 + (world[other, 1] - x[1]) ** 2 + (world[other, 2] - x[2]) ** 2
                    if d2 < least:
                        p, least = other, d2
            if p < 0 or least > max_sigmas**2 * (
                point_cov[p, 0, 0] + point_cov[p, 1, 1] + point_cov[p, 2, 2] + C[0, 0] + C[1, 1] + C[2, 2]
            ):
                continue
        _world_covariance(R, P, point_xyz[p], point_cov[p], S)
        for a in range(3):
            r[a] = world[p, a] - x[a]
            for b in range(3):
                S[a, b] += C[a, b]
        if not _inverse(S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2], weight):
            continue
        if _form(weight, r) > max_sigmas**2:
            continue
        v = bias[q]
        for a in range(9):
            v[a] *= forgetting
        for a in range(6):
            v[a] += weight[a]
        v[6] += weight[0] * r[0] + weight[1] * r[1] + weight[2] * r[2]
        v[7] += weight[1] * r[0] + weight[3] * r[1] + weight[4] * r[2]
        v[8] += weight[2] * r[0] + weight[4] * r[1] + weight[5] * r[2]
        for a in range(3):
            v[9 + a] += _NEWEST * (r[a] - v[9 + a])
        count[q, WEIGHED] += 1
        if _inverse(v[0], v[1], v[2], v[3], v[4], v[5], inverse):
            found[k, 0] = (1.0 + forgetting) * _form(inverse, v[6:])
            found[k, 1] = np.sqrt(v[9] ** 2 + v[10] ** 2 + v[11] ** 2)
            found[k, 2] = np.sqrt(_form(weight, v[9:]))
    return found


@njit(cache=True, nogil=True)
def _world_covariance(R, P, p, C, out):
    """R (C + J P Jᵀ) Rᵀ with J = [I, −[p]×]: of a point seen from an uncertain pose."""
    A = np.empty((3, 3))
    for a in range(3):
        a1, a2 = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            b1, b2 = (b + 1) % 3, (b + 2) % 3
            # row a of −[p]× is p[a2] at a1 and −p[a1] at a2
            A[a, b] = C[a, b] + P[a, b]
            A[a, b] += p[b2] * P[a, 3 + b1] - p[b1] * P[a, 3 + b2]
            A[a, b] += p[a2] * P[3 + a1, b] - p[a1] * P[3 + a2, b]
            A[a, b] += p[a2] * (p[b2] * P[3 + a1, 3 + b1] - p[b1] * P[3 + a1, 3 + b2])
            A[a, b] -= p[a1] * (p[b2] * P[3 + a2, 3 + b1] - p[b1] * P[3 + a2, 3 + b2])
    for a in range(3):
        for b in range(3):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += R[a, i] * A[i, j] * R[b, j]
            out[a, b] = total


@njit(cache=True, nogil=True)
def _inverse(xx, xy, xz, yy, yz, zz, out):
    """Upper triangle of the inverse of a symmetric matrix; false where there is none."""
    out[0], out[1], out[2] = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * out[0] + xy * out[1] + xz * out[2]
    if not det > 0.0:
        return False
    out[3], out[4], out[5] = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    for a in range(6):
        out[a] /= det
    return True


@njit(cache=True, nogil=True)
def _form(S, r):
    return (
        S[0] * r[0] * r[0]
        + S[3] * r[1] * r[1]
        + S[5] * r[2] * r[2]
        + 2.0 * (S[1] * r[0] * r[1] + S[2] * r[0] * r[2] + S[4] * r[1] * r[2])
    )


@njit(cache=True, nogil=True)
def seen_together(rows, apart_mm, share, sigmas, xyz, cov, state):
    """The smallest distance between two trusted targets of some rows (mm), and the pairs (m, 2) of near ones.

    The distance is that given where it is smaller. Near is what lies within the share of it, or what covariance,
    bounded from above, does not tell apart.
    """
    n = len(rows)
    least = apart_mm**2
    for i in range(n):
        for j in range(i):
            if state[rows[i]] == _TRUSTED and state[rows[j]] == _TRUSTED:
                least = min(least, _distance2(xyz[rows[i]], xyz[rows[j]]))
    pairs = [(0, 0) for _ in range(0)]
    reach2 = share**2 * least if np.isfinite(least) else 0.0
    for i in range(n):
        for j in range(i):
            a, b = rows[i], rows[j]
            d2 = _distance2(xyz[a], xyz[b])
            if d2 < reach2 or d2 < sigmas**2 * (_trace(cov[a]) + _trace(cov[b])):
                pairs.append((a, b))
    return np.sqrt(least), pairs


@njit(cache=True, nogil=True)
def near_pairs(missed, reach_mm, seen, sigmas, xyz, cov):
    """Pairs (m, 2) of a missed target and a seen one nearer than the reach, or than covariance, bounded, explains."""
    pairs = [(0, 0) for _ in range(0)]
    for i in range(len(missed)):
        a = missed[i]
        for b in seen:
            d2 = _distance2(xyz[a], xyz[b])
            if d2 < reach_mm**2 or d2 < sigmas**2 * (_trace(cov[a]) + _trace(cov[b])):
                pairs.append((a, b))
    return pairs


@njit(cache=True, nogil=True)
def _distance2(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@njit(cache=True, nogil=True)
def _trace(C):
    return C[0, 0] + C[1, 1] + C[2, 2]


def warm_up() -> None:
    """Compiles every kernel here with the types it will meet."""
    k = 2
    rows, xyz, cov = np.zeros(1, np.int64), np.ones((k, 3)), np.tile(np.eye(3), (k, 1, 1))
    id, state = np.zeros(k, np.int64), np.ones(k, np.int64)
    count, cells = np.zeros((k, COLUMNS), np.int64), np.zeros((k, 2, CELLS), np.uint64)
    first, bias, t, R = np.zeros((k, 3)), np.zeros((k, 12)), np.zeros(3), np.eye(3)
    witness(1, t, rows, rows, rows, 1.0, id, xyz, state, count, cells, first, bias)
    directions(cells)
    weigh(R, t, np.eye(6), xyz, cov, rows, rows, xyz[:1], cov[:1], rows, xyz, cov, 4.0, 0.9, count, bias)
    seen_together(rows, 1.0, 0.4, 4.0, xyz, cov, state)
    near_pairs(rows, 1.0, rows, 4.0, xyz, cov)
