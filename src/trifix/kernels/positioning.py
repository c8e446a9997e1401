"""Compiled loops of identification and verification: triangle tables, look-up, growing a hypothesis.

Everything is in plain arrays and millimetres. Six-vectors and 6 x 6 covariances are of δ = (translation, rotation) in
sensor coordinates, T · exp(δ), as everywhere.
"""

import numpy as np
from numba import njit

CLUTTER_SHARES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Shares of a frame's points that are clutter; a hypothesis is weighed under each of them, see ``grow``."""

MISS_RATES = np.array([0.02, 0.1, 0.3, 0.6, 0.9])
"""Shares of the targets in view that a frame may fail to see."""

MISS_WEIGHTS = np.array([0.4, 0.3, 0.2, 0.07, 0.03])
"""How common frames of each miss rate are taken to be: mostly nothing is hidden, seldom nearly everything."""

_MANY, _LOOKS_PER_CELL = 200, 4
"""Of so many hypotheses, only so many that lead to about the same pose get a look."""

_FIRST_ASKED = 8
"""Neighbours that a hypothesis is asked for first: if none of them has a target where it should, no more are asked."""

_HOLDING = 6
"""Trusted targets that hold a pose without the others."""

_TRUSTED = 1
"""State of a target that has been seen again from other poses, or was given."""

SURROUNDING = 5
"""Neighbours of a target that tell how targets lie around it."""


# --- triangles -------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def local_triangles(neighbours):
    """All triangles (p, a, b), a and b among the neighbours of p, each once, vertices ascending."""
    n, k = neighbours.shape
    out = np.empty((n * k * (k - 1) // 2, 3), np.int64)
    count = 0
    for p in range(n):
        for i in range(k):
            a = neighbours[p, i]
            for j in range(i + 1, k):
                b = neighbours[p, j]
                if a < 0 or b < 0:
                    continue
                # the triangle belongs to its lowest vertex that lists the other two
                lo, hi = min(a, b), max(a, b)
                if (lo < p and _lists(neighbours, lo, p, hi)) or (hi < p and _lists(neighbours, hi, p, lo)):
                    continue
                x, y, z = p, lo, hi
                if x > y:
                    x, y = y, x
                if y > z:
                    y, z = z, y
                if x > y:
                    x, y = y, x
                out[count, 0], out[count, 1], out[count, 2] = x, y, z
                count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def _lists(neighbours, p, a, b):
    found_a = found_b = False
    for i in range(neighbours.shape[1]):
        found_a |= neighbours[p, i] == a
        found_b |= neighbours[p, i] == b
    return found_a and found_b


@njit(cache=True, nogil=True)
def describe_triangles(xyz, cov, towards_sensor, triangles, min_sine):
    """Canonical vertex order, sorted sides, their variances and the handedness of triangles.

    Vertices are ordered by the side opposite to them, shortest first, so that congruent scalene triangles pair vertex
    by vertex. Handedness is the sign of the normal (in that order) against the direction to the sensor: 0 where that
    is unknown or within ``min_sine`` of edge-on.
    """
    n = len(triangles)
    order = np.empty((n, 3), np.int64)
    side = np.empty((n, 3))
    var = np.empty((n, 3))
    hand = np.zeros(n, np.int64)
    for i in range(n):
        length = np.empty(3)
        variance = np.empty(3)
        for v in range(3):
            a, b = triangles[i, (v + 1) % 3], triangles[i, (v + 2) % 3]
            dx, dy, dz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
            d = np.sqrt(dx * dx + dy * dy + dz * dz)
            length[v] = d
            s = 0.0
            if d > 0:
                u = (dx / d, dy / d, dz / d)
                for r in range(3):
                    for c in range(3):
                        s += u[r] * (cov[a, r, c] + cov[b, r, c]) * u[c]
            variance[v] = s
        o0, o1, o2 = 0, 1, 2
        if length[o0] > length[o1]:
            o0, o1 = o1, o0
        if length[o1] > length[o2]:
            o1, o2 = o2, o1
        if length[o0] > length[o1]:
            o0, o1 = o1, o0
        order[i, 0], order[i, 1], order[i, 2] = triangles[i, o0], triangles[i, o1], triangles[i, o2]
        side[i, 0], side[i, 1], side[i, 2] = length[o0], length[o1], length[o2]
        var[i, 0], var[i, 1], var[i, 2] = variance[o0], variance[o1], variance[o2]

        a, b, c = order[i, 0], order[i, 1], order[i, 2]
        e0, e1, e2 = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        f0, f1, f2 = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
        t0 = towards_sensor[a, 0] + towards_sensor[b, 0] + towards_sensor[c, 0]
        t1 = towards_sensor[a, 1] + towards_sensor[b, 1] + towards_sensor[c, 1]
        t2 = towards_sensor[a, 2] + towards_sensor[b, 2] + towards_sensor[c, 2]
        size = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) * np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        value = n0 * t0 + n1 * t1 + n2 * t2
        if size > 0 and abs(value) > min_sine * size:  # False where a direction is NaN, too
            hand[i] = 1 if value > 0 else -1
    return order, side, var, hand


# --- a grid over the targets -----------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _bucket(i, j, k, mask):
    return ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & mask


# --- small closed forms ----------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _inverse3(S, out):
    """Inverse of a symmetric 3 x 3 matrix into ``out``; returns the determinant."""
    a, b, c, d, e, f = S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    if det == 0.0:
        return det
    g = 1.0 / det
    out[0, 0] = A * g
    out[0, 1] = out[1, 0] = B * g
    out[0, 2] = out[2, 0] = C * g
    out[1, 1] = (a * f - c * c) * g
    out[1, 2] = out[2, 1] = (b * c - a * e) * g
    out[2, 2] = (a * d - b * b) * g
    return det


@njit(cache=True, nogil=True)
def _determinant3(S):
    """Determinant of a symmetric 3 x 3 matrix."""
    a, b, c, d, e, f = S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2]
    return a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)


@njit(cache=True, nogil=True)
def _inverse6(A, out):
    """Inverse of a symmetric positive 6 x 6 matrix by Cholesky; False where it is not positive."""
    L = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if s <= 1e-14 * (A[i, i] + 1e-300):
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    Li = np.zeros((6, 6))
    for i in range(6):
        Li[i, i] = 1.0 / L[i, i]
        for j in range(i):
            s = 0.0
            for k in range(j, i):
                s -= L[i, k] * Li[k, j]
            Li[i, j] = s / L[i, i]
    for i in range(6):
        for j in range(6):
            s = 0.0
            for k in range(max(i, j), 6):
                s += Li[k, i] * Li[k, j]
            out[i, j] = s
    return True


@njit(cache=True, nogil=True)
def _move(R, t, delta):
    """T ← T · exp(δ), to second order in the translation; the rotation exactly."""
    for i in range(3):
        s = 0.0
        for j in range(3):
            s += R[i, j] * delta[j]
        t[i] += s
    x, y, z = delta[3], delta[4], delta[5]
    theta = np.sqrt(x * x + y * y + z * z)
    if theta < 1e-12:
        return
    a = np.sin(theta) / theta
    b = (1.0 - np.cos(theta)) / (theta * theta)
    E = np.empty((3, 3))
    E[0, 0] = 1 - b * (y * y + z * z)
    E[0, 1] = -a * z + b * x * y
    E[0, 2] = a * y + b * x * z
    E[1, 0] = a * z + b * x * y
    E[1, 1] = 1 - b * (x * x + z * z)
    E[1, 2] = -a * x + b * y * z
    E[2, 0] = -a * y + b * x * z
    E[2, 1] = a * x + b * y * z
    E[2, 2] = 1 - b * (x * x + y * y)
    M = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            M[i, j] = R[i, 0] * E[0, j] + R[i, 1] * E[1, j] + R[i, 2] * E[2, j]
    R[:] = M


@njit(cache=True, nogil=True)
def _triad(xyz, rows, out):
    """Orthonormal axes of a triangle, as columns: along (0, 1), in the plane, normal. False if on one line."""
    a, b, c = rows[0], rows[1], rows[2]
    e0, e1, e2 = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
    f0, f1, f2 = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
    n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    e = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
    n = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if e < 1e-9 or n < 1e-9 * e:
        return False
    e0, e1, e2 = e0 / e, e1 / e, e2 / e
    n0, n1, n2 = n0 / n, n1 / n, n2 / n
    out[0, 0], out[1, 0], out[2, 0] = e0, e1, e2
    out[0, 1], out[1, 1], out[2, 1] = n1 * e2 - n2 * e1, n2 * e0 - n0 * e2, n0 * e1 - n1 * e0
    out[0, 2], out[1, 2], out[2, 2] = n0, n1, n2
    return True


@njit(cache=True, nogil=True)
def _innovation_frame(R, cov_point, cov_target, S):
    """C_point + Rᵀ C_target R: the covariance of a residual in sensor coordinates."""
    for i in range(3):
        for j in range(3):
            s = cov_point[i, j]
            for k in range(3):
                w = 0.0
                for m in range(3):
                    w += cov_target[k, m] * R[m, j]
                s += R[k, i] * w
            S[i, j] = s


@njit(cache=True, nogil=True)
def orient_triangles(xyz, cov, points, target_xyz, target_cov, targets):
    """Weighted absolute orientation of h three-point hypotheses: (R (h,3,3), t (h,3), P (h,6,6), ok (h), d² (h)).

    The pose that lays one triangle's axes on the other's is the start of two Gauss-Newton steps on the Mahalanobis
    distances of the three pairs; P is the inverse of their normal matrix.
    """
    h = len(points)
    R_out = np.empty((h, 3, 3))
    t_out = np.empty((h, 3))
    P_out = np.empty((h, 6, 6))
    ok = np.zeros(h, np.bool_)
    d2 = np.full(h, np.nan)
    F = np.empty((3, 3))
    W = np.empty((3, 3))
    S = np.empty((3, 3))
    G = np.empty((3, 3))
    A = np.empty((6, 6))
    P = np.empty((6, 6))
    J = np.zeros((3, 6))
    g = np.empty(6)
    delta = np.empty(6)
    for i in range(h):
        if not (_triad(xyz, points[i], F) and _triad(target_xyz, targets[i], W)):
            continue
        R = np.empty((3, 3))
        t = np.empty(3)
        for r in range(3):
            for c in range(3):
                R[r, c] = W[r, 0] * F[c, 0] + W[r, 1] * F[c, 1] + W[r, 2] * F[c, 2]
        for r in range(3):
            s = 0.0
            for v in range(3):
                p, q = points[i, v], targets[i, v]
                s += target_xyz[q, r] - (R[r, 0] * xyz[p, 0] + R[r, 1] * xyz[p, 1] + R[r, 2] * xyz[p, 2])
            t[r] = s / 3
        good = True
        for _ in range(2):
            A[:] = 0.0
            g[:] = 0.0
            for v in range(3):
                p, q = points[i, v], targets[i, v]
                _innovation_frame(R, cov[p], target_cov[q], S)
                if _inverse3(S, G) <= 0.0:
                    good = False
                    break
                _residual_jacobian(R, t, xyz[p], target_xyz[q], J, delta)
                for a in range(6):
                    for b in range(6):
                        s = 0.0
                        for r in range(3):
                            for c in range(3):
                                s += J[r, a] * G[r, c] * J[c, b]
                        A[a, b] += s
                    s = 0.0
                    for r in range(3):
                        for c in range(3):
                            s += J[r, a] * G[r, c] * delta[c]
                    g[a] += s
            good = good and _inverse6(A, P)
            if not good:
                break
            for a in range(6):
                s = 0.0
                for b in range(6):
                    s += P[a, b] * g[b]
                delta[a] = s
            _move(R, t, delta)
        if not good:
            continue
        R_out[i], t_out[i], P_out[i], ok[i] = R, t, P, True
        d2[i] = 0.0
        for v in range(3):
            p, q = points[i, v], targets[i, v]
            _innovation_frame(R, cov[p], target_cov[q], S)
            _inverse3(S, G)
            _residual_jacobian(R, t, xyz[p], target_xyz[q], J, delta)
            for r in range(3):
                d2[i] += delta[r] * (G[r, 0] * delta[0] + G[r, 1] * delta[1] + G[r, 2] * delta[2])
    return R_out, t_out, P_out, ok, d2


@njit(cache=True, nogil=True)
def _residual_jacobian(R, t, point, target, J, residual):
    """Residual Rᵀ(target − t) − point in sensor coordinates and its model [I, −[p]×] δ."""
    d0, d1, d2 = target[0] - t[0], target[1] - t[1], target[2] - t[2]
    for r in range(3):
        residual[r] = R[0, r] * d0 + R[1, r] * d1 + R[2, r] * d2 - point[r]
    J[:] = 0.0
    J[0, 0] = J[1, 1] = J[2, 2] = 1.0
    J[0, 4], J[0, 5] = point[2], -point[1]
    J[1, 3], J[1, 5] = -point[2], point[0]
    J[2, 3], J[2, 4] = point[1], -point[0]


# --- growing a hypothesis --------------------------------------------------------------------------------------------
#
# The arguments come in groups: ``frame`` is (xyz, cov, left, right) of the points and the dots that they are made of,
# -1 for none; ``scene`` is (xyz, cov, view, state, sightings, misses, neighbour) of the targets; ``grid`` holds the
# hashed cells of the map's index: (head of each bucket, next in it, position under which a target is filed, width of a
# cell, how far a target may be from that position).


@njit(cache=True, nogil=True)
def _lever(P, p, PJ):
    """P Jᵀ (6, 3) with J = [I, −[p]×]: how the pose's error moves a point."""
    for a in range(6):
        PJ[a, 0] = P[a, 0] + P[a, 4] * p[2] - P[a, 5] * p[1]
        PJ[a, 1] = P[a, 1] - P[a, 3] * p[2] + P[a, 5] * p[0]
        PJ[a, 2] = P[a, 2] + P[a, 3] * p[1] - P[a, 4] * p[0]


@njit(cache=True, nogil=True)
def _predicted_covariance(PJ, p, C, B):
    """B = C + J P Jᵀ."""
    for c in range(3):
        B[0, c] = C[0, c] + PJ[0, c] + p[2] * PJ[4, c] - p[1] * PJ[5, c]
        B[1, c] = C[1, c] + PJ[1, c] - p[2] * PJ[3, c] + p[0] * PJ[5, c]
        B[2, c] = C[2, c] + PJ[2, c] + p[1] * PJ[3, c] - p[0] * PJ[4, c]


@njit(cache=True, nogil=True)
def _surroundings(q, xyz, neighbour, cell_mm, out):
    """Mean square offsets of the nearest neighbours of a target into ``out``; returns (their number, spacing mm).

    A target without neighbours within the reach of the index, four cells, has one there for all we know.
    """
    out[:] = 0.0
    count = 0
    farthest2 = 0.0
    for i in range(SURROUNDING):
        w = neighbour[q, i]
        if w < 0:
            break
        count += 1
        d0, d1, d2 = xyz[w, 0] - xyz[q, 0], xyz[w, 1] - xyz[q, 1], xyz[w, 2] - xyz[q, 2]
        out[0, 0] += d0 * d0
        out[0, 1] += d0 * d1
        out[0, 2] += d0 * d2
        out[1, 1] += d1 * d1
        out[1, 2] += d1 * d2
        out[2, 2] += d2 * d2
        farthest2 = max(farthest2, d0 * d0 + d1 * d1 + d2 * d2)
    if count == 0:
        for r in range(3):
            out[r, r] = 16 * cell_mm * cell_mm
        return 1, 4 * cell_mm
    for r in range(3):
        for c in range(r, 3):
            out[r, c] /= count
            out[c, r] = out[r, c]
    return count, np.sqrt(farthest2 * np.pi / count)


@njit(cache=True, nogil=True)
def _find_target(x, R, t, B, reach, gate, scene, grid, S, G):
    """The target nearest to a predicted point: (its row or -1, squared Mahalanobis distance, that of the second)."""
    xyz, cov, view = scene[0], scene[1], scene[2]
    head, following, anchor, cell_mm = grid[0], grid[1], grid[2], grid[3]
    mask = len(head) - 1
    best = -1
    best_d2 = second_d2 = 1e300
    e0 = e1 = e2 = 0.0
    i0, i1 = int(np.floor((x[0] - reach) / cell_mm)), int(np.floor((x[0] + reach) / cell_mm))
    j0, j1 = int(np.floor((x[1] - reach) / cell_mm)), int(np.floor((x[1] + reach) / cell_mm))
    k0, k1 = int(np.floor((x[2] - reach) / cell_mm)), int(np.floor((x[2] + reach) / cell_mm))
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                q = head[_bucket(i, j, k, mask)]
                while q >= 0:
                    here = q
                    q = following[q]
                    d0, d1, d2 = xyz[here, 0] - x[0], xyz[here, 1] - x[1], xyz[here, 2] - x[2]
                    if d0 * d0 + d1 * d1 + d2 * d2 > reach * reach:
                        continue
                    if (
                        int(np.floor(np.float64(anchor[here, 0]) / cell_mm)) != i
                        or int(np.floor(np.float64(anchor[here, 1]) / cell_mm)) != j
                        or int(np.floor(np.float64(anchor[here, 2]) / cell_mm)) != k
                    ):
                        continue
                    # a target is not seen from behind
                    s0, s1, s2 = t[0] - xyz[here, 0], t[1] - xyz[here, 1], t[2] - xyz[here, 2]
                    if view[here, 0] * s0 + view[here, 1] * s1 + view[here, 2] * s2 < 0:
                        continue
                    _innovation_frame(R, B, cov[here], S)
                    if _inverse3(S, G) <= 0.0:
                        continue
                    e0 = R[0, 0] * d0 + R[1, 0] * d1 + R[2, 0] * d2
                    e1 = R[0, 1] * d0 + R[1, 1] * d1 + R[2, 1] * d2
                    e2 = R[0, 2] * d0 + R[1, 2] * d1 + R[2, 2] * d2
                    m2 = (
                        G[0, 0] * e0 * e0
                        + G[1, 1] * e1 * e1
                        + G[2, 2] * e2 * e2
                        + 2 * (G[0, 1] * e0 * e1 + G[0, 2] * e0 * e2 + G[1, 2] * e1 * e2)
                    )
                    if m2 > gate * gate:
                        continue
                    if m2 < best_d2:
                        second_d2 = best_d2
                        best, best_d2 = here, m2
                    elif m2 < second_d2:
                        second_d2 = m2
    return best, best_d2, second_d2


@njit(cache=True, nogil=True)
def _rarity(R, S, q, scene, cell_mm, Q, D):
    """N(0; S) / q: how much denser an expected target is at its own place than targets around it are; D is scratch."""
    count, _ = _surroundings(q, scene[0], scene[6], cell_mm, D)
    _innovation_frame(R, S, D, Q)
    return np.sqrt(_determinant3(Q) / _determinant3(S)) / (0.5 * count)


@njit(cache=True, nogil=True)
def grow(R, t, P, sequence, frame, used, scene, used_target, grid, gate, matched, log_ratio):
    """Takes the points of ``sequence`` in turn, predicts each from all before it, and weighs the agreement.

    R, t, P (the pose and its covariance) are sharpened in place by each point that finds its target: a Kalman filter.
    ``matched`` (n) receives the row of the target of each point, -1 for none, -2 for a point that was passed over
    because its prediction was still too vague, or because two targets competed for it. ``used`` marks dots, left and
    right, that belong to a point already, and ``used_target`` targets.

    ``log_ratio`` (one entry a clutter share c) gains ln(c + (1 − c) · N(r; S) / q) for a point with a target at
    residual r, and ln c for one without: the likelihood of the point if the pose is right, against that of a point that
    falls by chance where targets are. q = κ N(0; S + Σ) is the density of targets around that one, with Σ the mean
    square offsets of its m neighbours and κ = m/2, which is right for a disc evenly filled: where targets lie in a
    plane, lying in it is no evidence. Each point is predicted from points before it only; its factor therefore has
    mean ≤ 1 if the pose is wrong, and so has the product. Returns the number of points that found a target.
    """
    xyz, cov, left, right = frame
    used_left, used_right = used
    cell_mm, slack_mm = grid[3], grid[4]
    S, G, Q, B, D = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    PJ, K = np.empty((6, 3)), np.empty((6, 3))
    e, x, delta = np.empty(3), np.empty(3), np.empty(6)
    shares = CLUTTER_SHARES
    found = 0
    for n in sequence:
        if (left[n] >= 0 and used_left[left[n]]) or (right[n] >= 0 and used_right[right[n]]):
            matched[n] = -1  # one of its dots belongs to another point: no evidence either way
            continue
        p = xyz[n]
        for r in range(3):
            x[r] = R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2] + t[r]
        _lever(P, p, PJ)
        _predicted_covariance(PJ, p, cov[n], B)
        reach = gate * np.sqrt(B[0, 0] + B[1, 1] + B[2, 2])
        if not reach <= 2.0 * cell_mm:
            matched[n] = -2
            continue
        reach += 0.25 * cell_mm + slack_mm  # for the targets' own covariance, and for how they are filed
        best, best_d2, second_d2 = _find_target(x, R, t, B, reach, gate, scene, grid, S, G)
        if best >= 0 and second_d2 - best_d2 < 6.0:
            matched[n] = -2  # E holds points with exactly one counterpart (Khoury 2006, eq. 1-4)
            continue
        if best < 0 or used_target[best]:
            matched[n] = -1
            for c in range(len(shares)):
                log_ratio[c] += np.log(shares[c])
            continue
        _innovation_frame(R, B, scene[1][best], S)
        peak = np.exp(-0.5 * best_d2) * _rarity(R, S, best, scene, cell_mm, Q, D)
        for c in range(len(shares)):
            log_ratio[c] += np.log(shares[c] + (1.0 - shares[c]) * peak)
        matched[n] = best
        used_target[best] = True
        if left[n] >= 0:
            used_left[left[n]] = True
        if right[n] >= 0:
            used_right[right[n]] = True
        found += 1

        # Kalman update of the pose by this pair
        _inverse3(S, G)
        y = scene[0][best]
        for r in range(3):
            e[r] = R[0, r] * (y[0] - x[0]) + R[1, r] * (y[1] - x[1]) + R[2, r] * (y[2] - x[2])
        for a in range(6):
            for r in range(3):
                K[a, r] = PJ[a, 0] * G[0, r] + PJ[a, 1] * G[1, r] + PJ[a, 2] * G[2, r]
            delta[a] = K[a, 0] * e[0] + K[a, 1] * e[1] + K[a, 2] * e[2]
        for a in range(6):
            for b in range(6):
                P[a, b] -= K[a, 0] * PJ[b, 0] + K[a, 1] * PJ[b, 1] + K[a, 2] * PJ[b, 2]
        _move(R, t, delta)
    return found


@njit(cache=True, nogil=True)
def _in_camera(R, t, y, cam_R, cam_t, p, h, A):
    """Slopes ``h`` of a target in a camera, and A = dh/dp with p the target in sensor coordinates; False behind it."""
    for r in range(3):
        p[r] = R[0, r] * (y[0] - t[0]) + R[1, r] * (y[1] - t[1]) + R[2, r] * (y[2] - t[2])
    X = cam_R[0, 0] * p[0] + cam_R[0, 1] * p[1] + cam_R[0, 2] * p[2] + cam_t[0]
    Y = cam_R[1, 0] * p[0] + cam_R[1, 1] * p[1] + cam_R[1, 2] * p[2] + cam_t[1]
    Z = cam_R[2, 0] * p[0] + cam_R[2, 1] * p[1] + cam_R[2, 2] * p[2] + cam_t[2]
    if Z <= 1.0:
        return False
    h[0], h[1] = X / Z, Y / Z
    for c in range(3):
        A[0, c] = (cam_R[0, c] - h[0] * cam_R[2, c]) / Z
        A[1, c] = (cam_R[1, c] - h[1] * cam_R[2, c]) / Z
    return True


@njit(cache=True, nogil=True)
def _add_seen_covariance(A, C, out):
    """out (2, 2) += A C Aᵀ."""
    for r in range(2):
        for c in range(2):
            s = 0.0
            for i in range(3):
                for j in range(3):
                    s += A[r, i] * C[i, j] * A[c, j]
            out[r, c] += s


@njit(cache=True, nogil=True)
def grow_by_dots(R, t, P, dots, used, cams, scene, used_target, alive, cell_mm, gate, dot_target, log_ratio):
    """The same as ``grow`` with dots that no point has claimed: two equations each against a known target.

    ``dots`` is (camera, row in that camera, slopes, covariance of the slopes), ``cams`` the rotations and translations
    of both cameras, ``alive`` the rows of the targets that may be seen. Evidence counts as in ``grow``, in the image.
    Those that are too vague wait until others have sharpened the pose. Returns the number that found a target.
    """
    camera, row, xy, cov = dots
    cam_R, cam_t = cams
    d = len(camera)
    PJ, AP, K = np.empty((6, 3)), np.empty((6, 2)), np.empty((6, 2))
    S, U, V = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    B, D, W = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    zero = np.zeros((3, 3))
    p, h, A = np.empty(3), np.empty(2), np.empty((2, 3))
    delta = np.empty(6)
    shares = CLUTTER_SHARES
    found = 0
    for turn in range(3):
        for n in range(d):
            if dot_target[n] >= 0 or (turn > 0 and dot_target[n] == -1):
                continue
            if used[camera[n]][row[n]]:
                dot_target[n] = -1
                continue
            m = camera[n]
            best, best_d2, second_d2 = -1, 1e300, 1e300
            for q in alive:
                if used_target[q]:
                    continue
                s0, s1, s2 = t[0] - scene[0][q, 0], t[1] - scene[0][q, 1], t[2] - scene[0][q, 2]
                if scene[2][q, 0] * s0 + scene[2][q, 1] * s1 + scene[2][q, 2] * s2 < 0:
                    continue
                if not _in_camera(R, t, scene[0][q], cam_R[m], cam_t[m], p, h, A):
                    continue
                e0, e1 = h[0] - xy[n, 0], h[1] - xy[n, 1]
                if e0 * e0 + e1 * e1 > 0.01:  # a tenth of the depth to the side
                    continue
                _lever(P, p, PJ)
                _innovation_frame(R, zero, scene[1][q], D)
                _predicted_covariance(PJ, p, D, B)
                S[:] = cov[n]
                _add_seen_covariance(A, B, S)
                det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
                m2 = (S[1, 1] * e0 * e0 - 2 * S[0, 1] * e0 * e1 + S[0, 0] * e1 * e1) / det
                if m2 > gate * gate:
                    continue
                if m2 < best_d2:
                    second_d2 = best_d2
                    best, best_d2 = q, m2
                elif m2 < second_d2:
                    second_d2 = m2
            if best >= 0 and second_d2 - best_d2 < 6.0:
                dot_target[n] = -2
                continue
            if best < 0:
                dot_target[n] = -1
                for c in range(len(shares)):
                    log_ratio[c] += np.log(shares[c])
                continue
            _in_camera(R, t, scene[0][best], cam_R[m], cam_t[m], p, h, A)
            e0, e1 = h[0] - xy[n, 0], h[1] - xy[n, 1]
            _lever(P, p, PJ)
            _innovation_frame(R, zero, scene[1][best], D)
            _predicted_covariance(PJ, p, D, B)
            S[:] = cov[n]
            _add_seen_covariance(A, B, S)
            det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
            count, _ = _surroundings(best, scene[0], scene[6], cell_mm, D)
            _innovation_frame(R, zero, D, W)
            U[:] = S
            _add_seen_covariance(A, W, U)
            around = U[0, 0] * U[1, 1] - U[0, 1] * U[1, 0]
            peak = np.exp(-0.5 * best_d2) * np.sqrt(around / det) / (0.5 * count)
            for c in range(len(shares)):
                log_ratio[c] += np.log(shares[c] + (1.0 - shares[c]) * peak)
            dot_target[n] = best
            used_target[best] = True
            used[m][row[n]] = True
            found += 1

            V[0, 0], V[1, 1], V[0, 1], V[1, 0] = S[1, 1] / det, S[0, 0] / det, -S[0, 1] / det, -S[0, 1] / det
            for a in range(6):
                for r in range(2):
                    AP[a, r] = PJ[a, 0] * A[r, 0] + PJ[a, 1] * A[r, 1] + PJ[a, 2] * A[r, 2]
            for a in range(6):
                for r in range(2):
                    K[a, r] = AP[a, 0] * V[0, r] + AP[a, 1] * V[1, r]
                delta[a] = K[a, 0] * e0 + K[a, 1] * e1
            for a in range(6):
                for b in range(6):
                    P[a, b] -= K[a, 0] * AP[b, 0] + K[a, 1] * AP[b, 1]
            _move(R, t, delta)
    return found


@njit(cache=True, nogil=True)
def _refine(R, t, P, frame, scene, matched, dots, cams, dot_target, prior, gate, d2, residual_mm):
    """The pose from all pairs at once, by Gauss-Newton on their Mahalanobis distances; False where they determine none.

    Pairs beyond the gate are let go. Once enough trusted targets hold the pose, those that are not trusted yet have no
    say in it: some are false pairs, which move together. ``prior`` is a pose with its information, zero for none. P
    receives the covariance, ``d2`` (n) and ``residual_mm`` (n) what is left of each pair of points.
    """
    xyz, cov = frame[0], frame[1]
    camera, xy, dot_cov = dots[0], dots[2], dots[3]
    prior_R, prior_t, prior_info = prior
    S, G, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    A, g, delta = np.empty((6, 6)), np.empty(6), np.empty(6)
    J, GJ, e = np.zeros((3, 6)), np.empty((3, 6)), np.empty(3)
    p, h, H, U = np.empty(3), np.empty(2), np.empty((2, 3)), np.empty((2, 2))
    HJ, zero = np.empty((2, 6)), np.zeros((3, 3))
    trusted = 0
    for n in range(len(xyz)):
        trusted += matched[n] >= 0 and scene[3][matched[n]] == _TRUSTED
    for _ in range(3):
        for _ in range(6):
            A[:] = prior_info
            for r in range(3):
                e[r] = (
                    prior_R[0, r] * (prior_t[0] - t[0])
                    + prior_R[1, r] * (prior_t[1] - t[1])
                    + prior_R[2, r] * (prior_t[2] - t[2])
                )
            # log(T⁻¹ T_prior), for small angles
            w0 = w1 = w2 = 0.0
            for k in range(3):
                w0 += 0.5 * (R[k, 2] * prior_R[k, 1] - R[k, 1] * prior_R[k, 2])
                w1 += 0.5 * (R[k, 0] * prior_R[k, 2] - R[k, 2] * prior_R[k, 0])
                w2 += 0.5 * (R[k, 1] * prior_R[k, 0] - R[k, 0] * prior_R[k, 1])
            for a in range(6):
                g[a] = (
                    prior_info[a, 0] * e[0]
                    + prior_info[a, 1] * e[1]
                    + prior_info[a, 2] * e[2]
                    + prior_info[a, 3] * w0
                    + prior_info[a, 4] * w1
                    + prior_info[a, 5] * w2
                )
            for n in range(len(xyz)):
                q = matched[n]
                if q < 0 or (trusted >= _HOLDING and scene[3][q] != _TRUSTED):
                    continue
                _innovation_frame(R, cov[n], scene[1][q], S)
                if _inverse3(S, G) <= 0.0:
                    return False
                _residual_jacobian(R, t, xyz[n], scene[0][q], J, e)
                for r in range(3):
                    for a in range(6):
                        GJ[r, a] = G[r, 0] * J[0, a] + G[r, 1] * J[1, a] + G[r, 2] * J[2, a]
                for a in range(6):
                    for b in range(a, 6):
                        A[a, b] += J[0, a] * GJ[0, b] + J[1, a] * GJ[1, b] + J[2, a] * GJ[2, b]
                    g[a] += GJ[0, a] * e[0] + GJ[1, a] * e[1] + GJ[2, a] * e[2]
            for n in range(len(camera)):
                q = dot_target[n]
                if q < 0:
                    continue
                if not _in_camera(R, t, scene[0][q], cams[0][camera[n]], cams[1][camera[n]], p, h, H):
                    return False
                _innovation_frame(R, zero, scene[1][q], B)
                U[:] = dot_cov[n]
                _add_seen_covariance(H, B, U)
                det = U[0, 0] * U[1, 1] - U[0, 1] * U[1, 0]
                u, v, w = U[1, 1] / det, -U[0, 1] / det, U[0, 0] / det
                _residual_jacobian(R, t, p, scene[0][q], J, e)
                for r in range(2):
                    for a in range(6):
                        HJ[r, a] = H[r, 0] * J[0, a] + H[r, 1] * J[1, a] + H[r, 2] * J[2, a]
                e0, e1 = h[0] - xy[n, 0], h[1] - xy[n, 1]
                for a in range(6):
                    f0, f1 = u * HJ[0, a] + v * HJ[1, a], v * HJ[0, a] + w * HJ[1, a]
                    for b in range(a, 6):
                        A[a, b] += f0 * HJ[0, b] + f1 * HJ[1, b]
                    g[a] += f0 * e0 + f1 * e1
            for a in range(6):
                for b in range(a):
                    A[a, b] = A[b, a]
            if not _inverse6(A, P):
                return False
            largest = 0.0
            for a in range(6):
                s = 0.0
                for b in range(6):
                    s += P[a, b] * g[b]
                delta[a] = s
                largest = max(largest, abs(s))
            _move(R, t, delta)
            if largest < 1e-8:
                break
        dropped = False
        for n in range(len(xyz)):
            q = matched[n]
            d2[n] = residual_mm[n] = np.nan
            if q < 0:
                continue
            _innovation_frame(R, cov[n], scene[1][q], S)
            _inverse3(S, G)
            _residual_jacobian(R, t, xyz[n], scene[0][q], J, e)
            s = 0.0
            for r in range(3):
                s += e[r] * (G[r, 0] * e[0] + G[r, 1] * e[1] + G[r, 2] * e[2])
            d2[n], residual_mm[n] = s, np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
            if s > gate * gate:
                matched[n], dropped = -1, True
        for n in range(len(camera)):
            q = dot_target[n]
            if q < 0:
                continue
            _in_camera(R, t, scene[0][q], cams[0][camera[n]], cams[1][camera[n]], p, h, H)
            _innovation_frame(R, zero, scene[1][q], B)
            U[:] = dot_cov[n]
            _add_seen_covariance(H, B, U)
            e0, e1 = h[0] - xy[n, 0], h[1] - xy[n, 1]
            det = U[0, 0] * U[1, 1] - U[0, 1] * U[1, 0]
            if (U[1, 1] * e0 * e0 - 2 * U[0, 1] * e0 * e1 + U[0, 0] * e1 * e1) / det > gate * gate:
                dot_target[n], dropped = -1, True
        if not dropped:
            return True
    return True


@njit(cache=True, nogil=True)
def add_dots(R, t, P, frame, matched, dots, cams, scene, alive, cell_mm, gate):
    """The pose with the dots that no pair of it claims and that it takes to a target: (target of each dot, d², mm).

    ``R``, ``t``, ``P`` and ``matched`` change in place; where the pose cannot be solved anew, the first is empty.
    """
    _, _, left, right = frame
    n, most = len(matched), 1
    for p in range(n):
        most = max(most, left[p] + 1, right[p] + 1)
    for p in range(len(dots[1])):
        most = max(most, dots[1][p] + 1)
    used = (np.zeros(most, np.bool_), np.zeros(most, np.bool_))
    used_target = np.zeros(len(scene[0]), np.bool_)
    for p in range(n):
        if matched[p] >= 0:
            used[0][left[p]] = used[1][right[p]] = used_target[matched[p]] = True
    dot_target = np.full(len(dots[0]), -2, np.int64)
    log_ratio = np.zeros(len(CLUTTER_SHARES))
    d2, residual_mm = np.full(n, np.nan), np.full(n, np.nan)
    grow_by_dots(R, t, P, dots, used, cams, scene, used_target, alive, cell_mm, gate, dot_target, log_ratio)
    nowhere = (np.eye(3), np.zeros(3), np.zeros((6, 6)))
    if not _refine(R, t, P, frame, scene, matched, dots, cams, dot_target, nowhere, gate, d2, residual_mm):
        return dot_target[:0], d2, residual_mm
    return dot_target, d2, residual_mm


@njit(cache=True, nogil=True)
def _likelihood(R, frame, scene, matched, d2, cell_mm, log_ratio):
    """ln of the likelihood of all points at one pose, against chance, a clutter share each: to compare poses by."""
    S, Q, D = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    shares = CLUTTER_SHARES
    log_ratio[:] = 0.0
    for n in range(len(matched)):
        peak = 0.0
        if matched[n] >= 0:
            _innovation_frame(R, frame[1][n], scene[1][matched[n]], S)
            peak = np.exp(-0.5 * d2[n]) * _rarity(R, S, matched[n], scene, cell_mm, Q, D)
        for c in range(len(shares)):
            log_ratio[c] += np.log(shares[c] + (1.0 - shares[c]) * peak)


@njit(cache=True, nogil=True)
def _log_missed(R, t, frame, scene, matched, dot_target, windows, near_mm, is_marked):
    """ln of the probability that so many of the targets in view are seen as are: a factor ≤ 1 of the likelihood.

    Asked are the matched targets and their neighbours, as far as they are trusted, face the sensor and lie in every
    window (R, t, limits of slopes and depth) in which a target must be seen. A target that is often missed tells
    little; one with some point near its place may have been seen.
    """
    window_R, window_t, limits = windows
    rates = MISS_RATES
    log_p = np.log(MISS_WEIGHTS)
    if len(limits) == 0:
        return 0.0
    xyz, view, state, sightings, misses, neighbour = scene[0], scene[2], scene[3], scene[4], scene[5], scene[6]
    points = frame[0]
    asked = np.empty((len(matched) + len(dot_target)) * (1 + neighbour.shape[1]), np.int64)
    count = seen = 0
    for n in range(len(matched) + len(dot_target)):
        q = matched[n] if n < len(matched) else dot_target[n - len(matched)]
        if q >= 0:
            is_marked[q] = True
            asked[count] = q
            count += 1
    seen = count
    for i in range(seen):
        for w in neighbour[asked[i]]:
            if w >= 0 and not is_marked[w]:
                is_marked[w] = True
                asked[count] = w
                count += 1
    x = np.empty(3)
    for i in range(count):
        q = asked[i]
        is_marked[q] = False
        own = (misses[q] + 0.2) / (misses[q] + sightings[q] + 2.0)
        if i < seen:
            for m in range(len(rates)):
                log_p[m] += np.log(1 - max(rates[m], own))
            continue
        if state[q] != _TRUSTED:
            continue
        s0, s1, s2 = t[0] - xyz[q, 0], t[1] - xyz[q, 1], t[2] - xyz[q, 2]
        facing = view[q, 0] * s0 + view[q, 1] * s1 + view[q, 2] * s2
        if not facing > 0.5 * np.sqrt(s0 * s0 + s1 * s1 + s2 * s2):  # False where the direction is unknown
            continue
        for r in range(3):
            x[r] = -(R[0, r] * s0 + R[1, r] * s1 + R[2, r] * s2)
        is_in_view = True
        for b in range(len(limits)):
            W, v = window_R[b], window_t[b]
            X = W[0, 0] * x[0] + W[0, 1] * x[1] + W[0, 2] * x[2] + v[0]
            Y = W[1, 0] * x[0] + W[1, 1] * x[1] + W[1, 2] * x[2] + v[1]
            Z = W[2, 0] * x[0] + W[2, 1] * x[1] + W[2, 2] * x[2] + v[2]
            is_in_view &= (
                limits[b, 4] < Z
                and limits[b, 5] > Z
                and limits[b, 0] * Z < X
                and limits[b, 1] * Z > X
                and limits[b, 2] * Z < Y
                and limits[b, 3] * Z > Y
            )
        if not is_in_view:
            continue
        for n in range(len(points)):
            if (points[n, 0] - x[0]) ** 2 + (points[n, 1] - x[1]) ** 2 + (points[n, 2] - x[2]) ** 2 < near_mm**2:
                is_in_view = False
                break
        if is_in_view:
            for m in range(len(rates)):
                log_p[m] += np.log(max(rates[m], own))
    top = log_p.max()
    return top + np.log(np.exp(log_p - top).sum())


@njit(cache=True, nogil=True)
def _look(h, R, t, P, point, target, near, frame, used, scene, used_target, grid, gate, matched, stamp, log_ratio):
    """A first look at a hypothesis, over the neighbours of its points: (how many were asked, found, passed over).

    Leaves ``used`` and ``used_target`` as they were.
    """
    left, right = frame[2], frame[3]
    c = point.shape[1]
    sequence = np.empty(c * near.shape[1], np.int64)
    length = 0
    for v in range(c):
        p = point[h, v]
        stamp[p] = h
        used_target[target[h, v]] = True
        if left[p] >= 0:
            used[0][left[p]] = True
        if right[p] >= 0:
            used[1][right[p]] = True
    for j in range(near.shape[1]):
        for v in range(c):
            p = near[point[h, v], j]
            if p >= 0 and stamp[p] != h:
                stamp[p] = h
                sequence[length] = p
                length += 1
    Rh, th, Ph = R[h].copy(), t[h].copy(), P[h].copy()
    log_ratio[:] = 0.0
    asked = min(length, _FIRST_ASKED)
    found = grow(Rh, th, Ph, sequence[:asked], frame, used, scene, used_target, grid, gate, matched, log_ratio)
    if found > 0 and asked < length:
        rest = sequence[asked:length]
        found += grow(Rh, th, Ph, rest, frame, used, scene, used_target, grid, gate, matched, log_ratio)
        asked = length
    passed = 0
    for j in range(asked):
        p = sequence[j]
        if matched[p] < 0:
            passed += matched[p] == -2
            continue
        used_target[matched[p]] = False
        if left[p] >= 0:
            used[0][left[p]] = False
        if right[p] >= 0:
            used[1][right[p]] = False
    for v in range(c):
        p = point[h, v]
        used_target[target[h, v]] = False
        if left[p] >= 0:
            used[0][left[p]] = False
        if right[p] >= 0:
            used[1][right[p]] = False
    return asked, found, passed


@njit(cache=True, nogil=True)
def _is_seen_often(R, t, centre, width_mm, cells, looks):
    """Whether enough poses near this one have been looked at; notes it otherwise in an open hash table of cells.

    A cell is as wide as points are vague, and a sixty-fourth in every entry of two columns of R: look-alikes may lie
    millimetres apart.
    """
    key = np.uint64(14695981039346656037)
    for r in range(3):
        x = R[r, 0] * centre[0] + R[r, 1] * centre[1] + R[r, 2] * centre[2] + t[r]
        key = (key ^ np.uint64(np.int64(np.floor(x / width_mm)))) * np.uint64(1099511628211)
        key = (key ^ np.uint64(np.int64(np.floor(64 * R[r, 0])))) * np.uint64(1099511628211)
        key = (key ^ np.uint64(np.int64(np.floor(64 * R[r, 1])))) * np.uint64(1099511628211)
    slot = np.int64(key >> np.uint64(20)) % len(cells)
    while looks[slot] > 0 and cells[slot] != key:
        slot = (slot + 1) % len(cells)
    cells[slot] = key
    looks[slot] += 1
    return looks[slot] > _LOOKS_PER_CELL


@njit(cache=True, nogil=True)
def solve(
    R,
    t,
    P,
    is_valid,
    own,
    point,
    target,
    near,
    frame,
    dots,
    cams,
    alive,
    scene,
    grid,
    windows,
    prior,
    gate,
    limits,
    known,
):
    """The different solutions that h hypotheses lead to, in the order in which they were worked out.

    A hypothesis names c pairs (``point``, ``target``: (h, c)), or none: then it is the pose itself that is supposed,
    with its covariance; ``own`` is the log ratio of what it names already. Each gets a first look over the ``near``
    points of its own; promising ones are worked out over all points, until one has a log ratio of ``enough``; else the
    best looking ones are. Dots that no point has claimed are asked where the points alone are not enough. ``limits`` is
    (``enough``, points that a solution must be able to explain, solutions to work out at most); ``known`` (k, n) holds
    matches of solutions whose hypotheses are skipped.

    Returns (number of solutions s, R, t, covariance, target of each point, residual of each pair in mm, target of each
    dot, spacing of the targets around each, log ratio, log likelihood).
    """
    xyz, cov, left, right = frame
    enough, needed, most = limits
    cell_mm = grid[3]
    h, c = point.shape
    n, d, k = len(xyz), len(dots[0]), len(scene[0])
    most_dots = 1
    for p in range(n):
        most_dots = max(most_dots, left[p] + 1, right[p] + 1)
    for p in range(d):
        most_dots = max(most_dots, dots[1][p] + 1)
    used = (np.zeros(most_dots, np.bool_), np.zeros(most_dots, np.bool_))
    used_target, is_marked = np.zeros(k, np.bool_), np.zeros(k, np.bool_)
    stamp = np.full(n, -1, np.int64)
    look = np.empty(n, np.int64)
    shares = len(CLUTTER_SHARES)
    log_ratio = np.zeros(shares)
    s = 0
    out_R, out_t, out_P = np.empty((most, 3, 3)), np.empty((most, 3)), np.empty((most, 6, 6))
    out_matched, out_d2 = np.full((most, n), -1, np.int64), np.full((most, n), np.nan)
    out_mm, out_spacing = np.full((most, n), np.nan), np.full((most, n), np.nan)
    out_dot = np.full((most, d), -2, np.int64)
    out_ratio, out_likelihood = np.empty(most), np.empty(most)
    no_dots = (dots[0][:0], dots[1][:0], dots[2][:0], dots[3][:0])
    score = np.full(h, -np.inf)
    order = np.empty(h, np.int64)
    cells, looks = np.zeros(2 * h if h > _MANY else 0, np.uint64), np.zeros(2 * h if h > _MANY else 0, np.int64)
    middle = np.zeros(3)
    near_mm = 1e-6  # within which a point may be a target, after all
    for p in range(n):
        middle += xyz[p] / n
        near_mm = max(near_mm, gate * np.sqrt(cov[p, 0, 0] + cov[p, 1, 1] + cov[p, 2, 2]))
    waiting = 0
    B, D = np.empty((3, 3)), np.empty((3, 3))
    PJ = np.empty((6, 3))
    for i in range(2 * h):  # first all of them as they come, then those that wait, best first
        if i < h:
            a = i
            if not is_valid[a]:
                continue
            is_behind = is_known = False
            for v in range(c):
                y, w = scene[0][target[a, v]], scene[2][target[a, v]]
                is_behind |= w[0] * (t[a, 0] - y[0]) + w[1] * (t[a, 1] - y[1]) + w[2] * (t[a, 2] - y[2]) < 0
            if is_behind:
                continue
            for j in range(len(known)):
                is_same = c > 0
                for v in range(c):
                    is_same &= known[j, point[a, v]] == target[a, v]
                is_known |= is_same
            if is_known:
                continue
            if c:
                if h > _MANY and _is_seen_often(R[a], t[a], middle, near_mm, cells, looks):
                    continue
                asked, found, passed = _look(
                    a, R, t, P, point, target, near, frame, used, scene, used_target, grid, gate, look, stamp, log_ratio
                )
                if c + found + passed + (n - c - asked) < needed:
                    continue
                score[a] = log_mean(log_ratio) + own[a]
                if not score[a] >= 0.5 * enough:
                    order[waiting] = a
                    waiting += 1
                    continue
        else:
            if i - h >= waiting:
                break
            if i == h:
                order[:waiting] = order[:waiting][np.argsort(-score[order[:waiting]], kind="mergesort")]
            a = order[i - h]
        is_part = False
        for j in range(s):
            is_same = True
            for v in range(c):
                is_same &= out_matched[j, point[a, v]] == target[a, v]
            is_part |= is_same
        if is_part:
            continue
        if s == most:
            break

        # all points, those nearest to the hypothesis first
        Rs, ts, Ps = R[a].copy(), t[a].copy(), P[a].copy()
        matched, dot_target = out_matched[s], out_dot[s]
        matched[:] = -1
        dot_target[:] = -2
        used[0][:] = False
        used[1][:] = False
        used_target[:] = False
        log_ratio[:] = 0.0
        distance = np.empty(n)
        centre = np.zeros(3)
        for v in range(c):
            p = point[a, v]
            centre += xyz[p] / c
            matched[p] = target[a, v]
            used_target[target[a, v]] = True
            if left[p] >= 0:
                used[0][left[p]] = True
            if right[p] >= 0:
                used[1][right[p]] = True
        for p in range(n):
            if c:
                distance[p] = ((xyz[p] - centre) ** 2).sum()
            else:  # the surest first
                _lever(Ps, xyz[p], PJ)
                _predicted_covariance(PJ, xyz[p], cov[p], B)
                distance[p] = B[0, 0] + B[1, 1] + B[2, 2]
        by_distance = np.argsort(distance, kind="mergesort")
        sequence = np.empty(n, np.int64)
        length = 0
        for p in by_distance:
            if matched[p] < 0:
                sequence[length] = p
                length += 1
        for _ in range(2 if c else 3):  # again, those that were too vague or had two counterparts
            grow(Rs, ts, Ps, sequence[:length], frame, used, scene, used_target, grid, gate, matched, log_ratio)
            kept = 0
            for j in range(length):
                if matched[sequence[j]] == -2:
                    sequence[kept] = sequence[j]
                    kept += 1
            length = kept
        asks_dots = d > 0 and log_mean(log_ratio) + own[a] < enough
        if asks_dots:
            grow_by_dots(Rs, ts, Ps, dots, used, cams, scene, used_target, alive, cell_mm, gate, dot_target, log_ratio)
        pairs = 0
        for p in range(n):
            pairs += matched[p] >= 0
        if pairs < needed or (pairs < 3 and c >= 3):
            continue
        asked_dots = dots if asks_dots else no_dots
        info = prior[2] if pairs < 3 else np.zeros((6, 6))
        if not _refine(
            Rs,
            ts,
            Ps,
            frame,
            scene,
            matched,
            asked_dots,
            cams,
            dot_target,
            (prior[0], prior[1], info),
            gate,
            out_d2[s],
            out_mm[s],
        ):
            continue
        pairs = 0
        for p in range(n):
            pairs += matched[p] >= 0
        if (pairs < 3 and c >= 3) or pairs < needed:
            continue
        asked_targets = dot_target if asks_dots else dot_target[:0]
        missed = _log_missed(Rs, ts, frame, scene, matched, asked_targets, windows, near_mm, is_marked)
        out_ratio[s] = log_mean(log_ratio) + missed + own[a]
        _likelihood(Rs, frame, scene, matched, out_d2[s], cell_mm, log_ratio)
        out_likelihood[s] = log_mean(log_ratio) + missed
        for p in range(n):
            if matched[p] >= 0:
                out_spacing[s, p] = _surroundings(matched[p], scene[0], scene[6], cell_mm, D)[1]
        out_R[s], out_t[s], out_P[s] = Rs, ts, Ps
        s += 1
        if out_ratio[s - 1] >= enough and needed == 0:
            break
    return (
        s,
        out_R[:s],
        out_t[:s],
        out_P[:s],
        out_matched[:s],
        out_mm[:s],
        out_dot[:s],
        out_spacing[:s],
        out_ratio[:s],
        out_likelihood[:s],
    )


@njit(cache=True, nogil=True)
def log_mean(log_values):
    """ln of the mean of exp: the ratio averaged over the clutter shares is itself a ratio with mean ≤ 1."""
    top = log_values.max()
    s = 0.0
    for v in log_values:
        s += np.exp(v - top)
    return top + np.log(s / len(log_values))


@njit(cache=True, nogil=True)
def covering_triples(xyz, needed):
    """Triples of points of which every set of ``needed`` points contains one.

    The points are parted into g = (needed − 1) // 2 groups of near ones: of 2 g + 1 points, three fall into one group,
    and every three of a group are a triple.
    """
    n = len(xyz)
    groups = max(1, (needed - 1) // 2)
    size = (n + groups - 1) // groups
    group = np.full(n, -1, np.int64)
    centre = np.zeros(3)
    for p in range(n):
        centre += xyz[p] / n
    out = np.empty((groups * size * (size - 1) * (size - 2) // 6 + 1, 3), np.int64)
    members = np.empty(size, np.int64)
    count = 0
    free = n
    for g in range(groups):
        if free == 0:
            break
        first, farthest = -1, -1.0
        for p in range(n):
            d = ((xyz[p] - centre) ** 2).sum()
            if group[p] < 0 and d > farthest:
                first, farthest = p, d
        here = (free + groups - g - 1) // (groups - g)
        group[first] = g
        members[0] = first
        for m in range(1, here):
            best, nearest_d = -1, np.inf
            for p in range(n):
                d = ((xyz[p] - xyz[first]) ** 2).sum()
                if group[p] < 0 and d < nearest_d:
                    best, nearest_d = p, d
            group[best] = g
            members[m] = best
        free -= here
        for i in range(here):
            for j in range(i + 1, here):
                for k in range(j + 1, here):
                    out[count, 0], out[count, 1], out[count, 2] = members[i], members[j], members[k]
                    count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def nearest(xyz, k):
    """Rows of the k nearest other points of each point, nearest first; -1 where there are fewer."""
    n = len(xyz)
    out = np.full((n, k), -1, np.int64)
    distance = np.empty(k)
    for p in range(n):
        held = 0
        for q in range(n):
            if q == p:
                continue
            d = (xyz[p, 0] - xyz[q, 0]) ** 2 + (xyz[p, 1] - xyz[q, 1]) ** 2 + (xyz[p, 2] - xyz[q, 2]) ** 2
            if held == k and d >= distance[k - 1]:
                continue
            i = held if held < k else k - 1
            while i > 0 and distance[i - 1] > d:
                distance[i] = distance[i - 1]
                out[p, i] = out[p, i - 1]
                i -= 1
            distance[i] = d
            out[p, i] = q
            held = min(held + 1, k)
    return out


def warm_up() -> None:
    """Compiles every kernel for the types that it meets in use."""
    xyz = np.array(
        [[0.0, 0.0, 400.0], [40.0, 0.0, 410.0], [0.0, 60.0, 420.0], [50.0, 70.0, 400.0], [90.0, 20.0, 430.0]]
    )
    cov = np.tile(np.eye(3) * 0.01, (len(xyz), 1, 1))
    neighbours = nearest(xyz, 4)
    triangles = describe_triangles(xyz, cov, -xyz, local_triangles(neighbours), 0.3)[0]
    oriented = orient_triangles(xyz, cov, triangles, xyz, cov, triangles)
    none = np.full(len(xyz), -1)
    zero = np.zeros(len(xyz), np.int64)
    view = np.tile([0.0, 0.0, -1.0], (len(xyz), 1))
    scene = (xyz, cov, view, zero, zero, zero, np.full((len(xyz), 8), -1, np.int32))
    grid = (np.array([0], np.int32), np.array([1, 2, 3, 4, -1], np.int32), xyz.astype(np.float32), 100.0, 0.1)
    dots = (zero[:1], zero[:1], np.zeros((1, 2)), np.eye(2)[None])
    cams = (np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    windows = (*cams, np.ones((2, 6)))
    prior = (np.eye(3), np.zeros(3), np.eye(6))
    own = np.zeros(len(triangles))
    at = np.eye(3), np.zeros(3), np.eye(6)
    add_dots(*at, (xyz, cov, none, none), none.copy(), dots, cams, scene, zero, 0.1, 4.0)
    solve(
        *oriented[:4],
        own,
        triangles,
        triangles,
        neighbours,
        (xyz, cov, none, none),
        dots,
        cams,
        zero,
        scene,
        grid,
        windows,
        prior,
        4.0,
        (20.0, 0, 2),
        none[None],
    )
    log_mean(np.zeros(len(CLUTTER_SHARES)))
    covering_triples(xyz, 3)
