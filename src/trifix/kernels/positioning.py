"""Compiled loops of identification and verification: triangle tables, look-up, growing a hypothesis.

Everything is in plain arrays and millimetres. Six-vectors and 6 x 6 covariances are of δ = (translation, rotation) in
sensor coordinates, T · exp(δ), as everywhere.
"""

import numpy as np
from numba import njit

CLUTTER_SHARES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Shares of a frame's points that are clutter; a hypothesis is weighed under each of them, see ``grow``."""

TARGETS_AROUND = 2.5
"""κ: a normal density of the spread of five neighbours stands for this many targets (five on a disc: 2π · 5/4π)."""


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


@njit(cache=True, nogil=True)
def build_grid(xyz, rows, cell_mm):
    """Hashed cells over some rows of ``xyz``: (start of each bucket, rows in bucket order)."""
    size = 16
    while size < 2 * len(rows):
        size *= 2
    start = np.zeros(size + 1, np.int64)
    key = np.empty(len(rows), np.int64)
    for n in range(len(rows)):
        r = rows[n]
        key[n] = _bucket(
            int(np.floor(xyz[r, 0] / cell_mm)),
            int(np.floor(xyz[r, 1] / cell_mm)),
            int(np.floor(xyz[r, 2] / cell_mm)),
            size - 1,
        )
        start[key[n] + 1] += 1
    for b in range(size):
        start[b + 1] += start[b]
    place = start[:-1].copy()
    item = np.empty(len(rows), np.int64)
    for n in range(len(rows)):
        item[place[key[n]]] = rows[n]
        place[key[n]] += 1
    return start, item


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
    """Weighted absolute orientation of h three-point hypotheses: (R (h,3,3), t (h,3), P (h,6,6), ok (h)).

    The pose that lays one triangle's axes on the other's is the start of two Gauss-Newton steps on the Mahalanobis
    distances of the three pairs; P is the inverse of their normal matrix.
    """
    h = len(points)
    R_out = np.empty((h, 3, 3))
    t_out = np.empty((h, 3))
    P_out = np.empty((h, 6, 6))
    ok = np.zeros(h, np.bool_)
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
    return R_out, t_out, P_out, ok


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


@njit(cache=True, nogil=True)
def grow(
    R,
    t,
    P,
    sequence,
    xyz,
    cov,
    left,
    right,
    used_left,
    used_right,
    target_xyz,
    target_cov,
    target_view,
    target_spread,
    used_target,
    start,
    item,
    cell_mm,
    gate,
    matched,
    log_ratio,
):
    """Takes the points of ``sequence`` in turn, predicts each from all before it, and weighs the agreement.

    R, t, P (the pose and its covariance) are sharpened in place by each point that finds its target: a Kalman filter.
    ``matched`` (n) receives the row of the target of each point, -1 for none, -2 for a point that was passed over
    because its prediction was still too vague, or because two targets competed for it.

    ``log_ratio`` (one entry a clutter share c) gains ln(c + (1 − c) · N(r; S) / q) for a point with a target at
    residual r, and ln c for one without: the likelihood of the point if the pose is right, against that of a point that
    falls by chance where targets are. q = κ N(0; S + Σ) is the density of targets around that one, with Σ the
    ``target_spread`` of its neighbours: where they lie in a plane, lying in it is no evidence. Each point is predicted
    from points before it only; its factor therefore has mean ≤ 1 if the pose is wrong, and so has the product.
    """
    S = np.empty((3, 3))
    G = np.empty((3, 3))
    Q = np.empty((3, 3))
    B = np.empty((3, 3))
    J = np.empty((3, 6))
    PJ = np.empty((6, 3))
    K = np.empty((6, 3))
    e = np.empty(3)
    delta = np.empty(6)
    x = np.empty(3)
    shares = CLUTTER_SHARES
    mask = len(start) - 2
    found = 0
    for n in sequence:
        if (left[n] >= 0 and used_left[left[n]]) or (right[n] >= 0 and used_right[right[n]]):
            matched[n] = -1  # one of its dots belongs to another point: no evidence either way
            continue
        p = xyz[n]
        for r in range(3):
            x[r] = R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2] + t[r]
        # covariance of the prediction, without the target's own
        J[:] = 0.0
        J[0, 0] = J[1, 1] = J[2, 2] = 1.0
        J[0, 4], J[0, 5] = p[2], -p[1]
        J[1, 3], J[1, 5] = -p[2], p[0]
        J[2, 3], J[2, 4] = p[1], -p[0]
        for a in range(6):
            for r in range(3):
                s = 0.0
                for b in range(6):
                    s += P[a, b] * J[r, b]
                PJ[a, r] = s
        for r in range(3):
            for c in range(3):
                s = cov[n, r, c]
                for a in range(6):
                    s += J[r, a] * PJ[a, c]
                B[r, c] = s
        reach = gate * np.sqrt(B[0, 0] + B[1, 1] + B[2, 2])
        if reach > 2.0 * cell_mm:
            matched[n] = -2
            continue
        reach = max(reach, 0.05 * cell_mm) + 0.25 * cell_mm  # and some for the targets' own covariance
        best = -1
        best_d2 = 1e300
        best_ratio = 0.0
        second_d2 = 1e300
        i0, i1 = int(np.floor((x[0] - reach) / cell_mm)), int(np.floor((x[0] + reach) / cell_mm))
        j0, j1 = int(np.floor((x[1] - reach) / cell_mm)), int(np.floor((x[1] + reach) / cell_mm))
        k0, k1 = int(np.floor((x[2] - reach) / cell_mm)), int(np.floor((x[2] + reach) / cell_mm))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    b = _bucket(i, j, k, mask)
                    for m in range(start[b], start[b + 1]):
                        q = item[m]
                        y0, y1, y2 = target_xyz[q, 0], target_xyz[q, 1], target_xyz[q, 2]
                        if (
                            int(np.floor(y0 / cell_mm)) != i
                            or int(np.floor(y1 / cell_mm)) != j
                            or int(np.floor(y2 / cell_mm)) != k
                        ):
                            continue
                        d0, d1, d2 = y0 - x[0], y1 - x[1], y2 - x[2]
                        if d0 * d0 + d1 * d1 + d2 * d2 > reach * reach:
                            continue
                        # a target is not seen from behind
                        s0, s1, s2 = t[0] - y0, t[1] - y1, t[2] - y2
                        if target_view[q, 0] * s0 + target_view[q, 1] * s1 + target_view[q, 2] * s2 < 0:
                            continue
                        _innovation_frame(R, B, target_cov[q], S)
                        if _inverse3(S, G) <= 0.0:
                            continue
                        for r in range(3):
                            e[r] = R[0, r] * d0 + R[1, r] * d1 + R[2, r] * d2
                        m2 = 0.0
                        for r in range(3):
                            for c in range(3):
                                m2 += e[r] * G[r, c] * e[c]
                        if m2 > gate * gate:
                            continue
                        if m2 < best_d2:
                            second_d2 = best_d2
                            best, best_d2 = q, m2
                            _innovation_frame(R, S, target_spread[q], Q)
                            best_ratio = np.sqrt(_determinant3(Q) / _determinant3(S)) / TARGETS_AROUND
                        elif m2 < second_d2:
                            second_d2 = m2
        if best >= 0 and second_d2 - best_d2 < 6.0:
            matched[n] = -2  # E holds points with exactly one counterpart (Khoury 2006, eq. 1-4)
            continue
        if best < 0 or used_target[best]:
            matched[n] = -1
            for c in range(len(shares)):
                log_ratio[c] += np.log(shares[c])
            continue
        peak = np.exp(-0.5 * best_d2) * best_ratio
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
        _innovation_frame(R, B, target_cov[best], S)
        _inverse3(S, G)
        d0, d1, d2 = target_xyz[best, 0] - x[0], target_xyz[best, 1] - x[1], target_xyz[best, 2] - x[2]
        for r in range(3):
            e[r] = R[0, r] * d0 + R[1, r] * d1 + R[2, r] * d2
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
def score_hypotheses(
    R,
    t,
    P,
    ok,
    points,
    targets,
    neighbours,
    xyz,
    cov,
    left,
    right,
    target_xyz,
    target_cov,
    target_view,
    target_spread,
    start,
    item,
    cell_mm,
    gate,
):
    """A first look at each of h hypotheses: the log ratio over the ``neighbours`` of its three points.

    Returns the mean over the clutter shares (h); -inf where the hypothesis is impossible.
    """
    h = len(points)
    score = np.full(h, -np.inf)
    matched = np.empty(len(xyz), np.int64)
    used_left = np.zeros(max(left.max() if len(left) else 0, 0) + 1, np.bool_)
    used_right = np.zeros(max(right.max() if len(right) else 0, 0) + 1, np.bool_)
    used_target = np.zeros(len(target_xyz), np.bool_)
    sequence = np.empty(3 * neighbours.shape[1], np.int64)
    stamp = np.full(len(xyz), -1, np.int64)
    Ri = np.empty((3, 3))
    ti = np.empty(3)
    Pi = np.empty((6, 6))
    log_ratio = np.zeros(len(CLUTTER_SHARES))
    for i in range(h):
        if not ok[i]:
            continue
        behind = False
        for v in range(3):
            q = targets[i, v]
            s = 0.0
            for c in range(3):
                s += target_view[q, c] * (t[i, c] - target_xyz[q, c])
            behind |= s < 0
        if behind:
            continue
        for v in range(3):
            p = points[i, v]
            stamp[p] = i
            used_target[targets[i, v]] = True
            if left[p] >= 0:
                used_left[left[p]] = True
            if right[p] >= 0:
                used_right[right[p]] = True
        length = 0
        for j in range(neighbours.shape[1]):
            for v in range(3):
                p = neighbours[points[i, v], j]
                if p >= 0 and stamp[p] != i:
                    stamp[p] = i
                    sequence[length] = p
                    length += 1
        Ri[:] = R[i]
        ti[:] = t[i]
        Pi[:] = P[i]
        log_ratio[:] = 0.0
        grow(
            Ri,
            ti,
            Pi,
            sequence[:length],
            xyz,
            cov,
            left,
            right,
            used_left,
            used_right,
            target_xyz,
            target_cov,
            target_view,
            target_spread,
            used_target,
            start,
            item,
            cell_mm,
            gate,
            matched,
            log_ratio,
        )
        score[i] = log_mean(log_ratio)
        for v in range(3):
            p = points[i, v]
            used_target[targets[i, v]] = False
            if left[p] >= 0:
                used_left[left[p]] = False
            if right[p] >= 0:
                used_right[right[p]] = False
        for j in range(length):
            p = sequence[j]
            if matched[p] >= 0:
                used_target[matched[p]] = False
                if left[p] >= 0:
                    used_left[left[p]] = False
                if right[p] >= 0:
                    used_right[right[p]] = False
    return score


@njit(cache=True, nogil=True)
def log_mean(log_values):
    """ln of the mean of exp: the ratio averaged over the clutter shares is itself a ratio with mean ≤ 1."""
    top = log_values.max()
    s = 0.0
    for v in log_values:
        s += np.exp(v - top)
    return top + np.log(s / len(log_values))


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
    rows = np.arange(len(xyz))
    none = np.full(len(xyz), -1)
    view = np.tile([0.0, 0.0, -1.0], (len(xyz), 1))
    spread = cov.copy()
    neighbours = nearest(xyz, 4)
    triangles = describe_triangles(xyz, cov, -xyz, local_triangles(neighbours), 0.3)[0]
    oriented = orient_triangles(xyz, cov, triangles, xyz, cov, triangles)
    grid = build_grid(xyz, rows, 10.0)
    scene = (xyz, cov, none, none, xyz, cov, view, spread)
    score_hypotheses(*oriented, triangles, triangles, neighbours, *scene, *grid, 10.0, 4.0)
    R, t, P, _ = (column[0].copy() for column in oriented)
    used = np.zeros(len(xyz) + 1, dtype=np.bool_)
    log_ratio = np.zeros(len(CLUTTER_SHARES))
    targets_with_free = (xyz, cov, view, spread, used.copy())
    grow(R, t, P, rows, xyz, cov, none, none, used, used, *targets_with_free, *grid, 10.0, 4.0, none.copy(), log_ratio)
    log_mean(log_ratio)
