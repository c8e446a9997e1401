"""Compiled loops of the adjustment: normal equations frame by frame, with every pose eliminated on the way.

Everything is in plain arrays, millimetres and standard deviations. A *sighting* is one target seen in one frame, by
one camera or both; sightings stand sorted by frame, then target. What was measured of it has been condensed to its
information A (3 x 3) about the place p in sensor coordinates and the pull b = A · (measured − p): these loops know
neither cameras nor points. With T · exp(δ), dp/dδ = G = [−I, [p]×] and dp/dX = Rᵀ.

The unknowns that stay are called columns: three for every target that is not held, then those of the rig.
"""

import numpy as np
from numba import njit

_TINY = 1e-300


@njit(cache=True, nogil=True)
def in_sensor(start, target, R, t, xyz, out):
    """Rᵀ (X − t): the place of each sighting's target in sensor coordinates."""
    for k in range(len(start) - 1):
        for s in range(start[k], start[k + 1]):
            j = target[s]
            x, y, z = xyz[j, 0] - t[k, 0], xyz[j, 1] - t[k, 1], xyz[j, 2] - t[k, 2]
            for i in range(3):
                out[s, i] = R[k, 0, i] * x + R[k, 1, i] * y + R[k, 2, i] * z


@njit(cache=True, nogil=True)
def condense(start, J, r, weight, A, b):
    """A = Σ w Jᵀ J and b = Σ w Jᵀ r over the whitened measurements of each sighting."""
    for s in range(len(A)):
        A[s] = 0.0
        b[s] = 0.0
        for m in range(start[s], start[s + 1]):
            w = weight[m]
            if w == 0.0:
                continue
            for d in range(J.shape[1]):
                for i in range(3):
                    x = w * J[m, d, i]
                    b[s, i] += x * r[m, d]
                    for j in range(3):
                        A[s, i, j] += x * J[m, d, j]


@njit(cache=True, nogil=True)
def condense_rig(start, J, J_rig, r, weight, C, H, g):
    """C = Σ w Jᵀ J_rig of each sighting; H += Σ w J_rigᵀ J_rig and g += Σ w J_rigᵀ r of all."""
    q = J_rig.shape[2]
    for s in range(len(C)):
        C[s] = 0.0
        for m in range(start[s], start[s + 1]):
            w = weight[m]
            if w == 0.0:
                continue
            for d in range(J.shape[1]):
                for i in range(3):
                    for j in range(q):
                        C[s, i, j] += w * J[m, d, i] * J_rig[m, d, j]
                for i in range(q):
                    x = w * J_rig[m, d, i]
                    g[i] += x * r[m, d]
                    for j in range(q):
                        H[i, j] += x * J_rig[m, d, j]


@njit(cache=True, nogil=True)
def own_information(start, target, p, A, R, of_pose, of_target):
    """Information about each pose if the map were known, and about each target if the poses were; added to."""
    M = np.empty((6, 3))
    for k in range(len(start) - 1):
        for s in range(start[k], start[k + 1]):
            _across(p[s], A[s], M)
            _add_pose(p[s], M, of_pose[k])
            _add_rotated(A[s], R[k], of_target[target[s]])


@njit(cache=True, nogil=True)
def _across(p, A, M):
    """M = Gᵀ A for G = [−I, [p]×]."""
    for j in range(3):
        M[0, j], M[1, j], M[2, j] = -A[0, j], -A[1, j], -A[2, j]
        M[3, j] = p[2] * A[1, j] - p[1] * A[2, j]
        M[4, j] = p[0] * A[2, j] - p[2] * A[0, j]
        M[5, j] = p[1] * A[0, j] - p[0] * A[1, j]


@njit(cache=True, nogil=True)
def _add_pose(p, M, B):
    """B += M G."""
    for i in range(6):
        B[i, 0] -= M[i, 0]
        B[i, 1] -= M[i, 1]
        B[i, 2] -= M[i, 2]
        B[i, 3] += M[i, 1] * p[2] - M[i, 2] * p[1]
        B[i, 4] += M[i, 2] * p[0] - M[i, 0] * p[2]
        B[i, 5] += M[i, 0] * p[1] - M[i, 1] * p[0]


@njit(cache=True, nogil=True)
def _add_rotated(A, R, V):
    """V += R A Rᵀ."""
    for i in range(3):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += R[i, k] * (A[k, 0] * R[j, 0] + A[k, 1] * R[j, 1] + A[k, 2] * R[j, 2])
            V[i, j] += s


@njit(cache=True, nogil=True)
def eliminate(start, target, column, is_free, p, A, b, C, R, damping, S, g, own, L, F, y, columns):
    """Adds the sightings to the normal equations of the columns, with the poses eliminated (Schur complement).

    ``S`` (its upper half) and ``g`` come with whatever else is known about the columns. Of each free pose stay
    L, the Cholesky factor of its own matrix B, y = L⁻¹ u with u its right-hand side, and one row of F = (L⁻¹ E)ᵀ for
    every entry of ``columns``, where E couples it to the columns: 3 a sighting and q a frame. ``damping`` enlarges
    the diagonal (Marquardt); ``own`` is what that of S was before the poses took their part.
    """
    n = len(g)
    q = C.shape[2]
    V = np.empty((3, 3))
    for k in range(len(start) - 1):
        for s in range(start[k], start[k + 1]):
            c = column[target[s]]
            if c >= 0:
                V[:] = 0.0
                _add_rotated(A[s], R[k], V)
                for i in range(3):
                    g[c + i] += R[k, i, 0] * b[s, 0] + R[k, i, 1] * b[s, 1] + R[k, i, 2] * b[s, 2]
                    for j in range(i, 3):
                        S[c + i, c + j] += V[i, j]
                    for j in range(q):
                        S[c + i, n - q + j] += (
                            R[k, i, 0] * C[s, 0, j] + R[k, i, 1] * C[s, 1, j] + R[k, i, 2] * C[s, 2, j]
                        )
    for i in range(n):
        S[i, i] *= 1.0 + damping
        own[i] = S[i, i]

    B = np.empty((6, 6))
    u = np.empty(6)
    M = np.empty((6, 3))
    for k in range(len(start) - 1):
        if not is_free[k]:
            continue
        first = 3 * start[k] + q * k
        last = 3 * start[k + 1] + q * (k + 1)
        B[:] = 0.0
        u[:] = 0.0
        F[last - q : last] = 0.0
        for s in range(start[k], start[k + 1]):
            x0, x1, x2 = p[s, 0], p[s, 1], p[s, 2]
            _across(p[s], A[s], M)
            _add_pose(p[s], M, B)
            u[0] -= b[s, 0]
            u[1] -= b[s, 1]
            u[2] -= b[s, 2]
            u[3] += x2 * b[s, 1] - x1 * b[s, 2]
            u[4] += x0 * b[s, 2] - x2 * b[s, 0]
            u[5] += x1 * b[s, 0] - x0 * b[s, 1]
            row = first + 3 * (s - start[k])
            for i in range(3):
                for a in range(6):
                    F[row + i, a] = M[a, 0] * R[k, i, 0] + M[a, 1] * R[k, i, 1] + M[a, 2] * R[k, i, 2]
            for j in range(q):
                row = last - q + j
                F[row, 0] -= C[s, 0, j]
                F[row, 1] -= C[s, 1, j]
                F[row, 2] -= C[s, 2, j]
                F[row, 3] += x2 * C[s, 1, j] - x1 * C[s, 2, j]
                F[row, 4] += x0 * C[s, 2, j] - x2 * C[s, 0, j]
                F[row, 5] += x1 * C[s, 0, j] - x0 * C[s, 1, j]
        for a in range(6):
            B[a, a] *= 1.0 + damping
        _cholesky6(B, L[k])
        _solve_lower6(L[k], u)
        y[k] = u
        for row in range(first, last):
            _solve_lower6(L[k], F[row])
        for row in range(first, last):
            c = columns[row]
            if c < 0:
                continue
            f0, f1, f2, f3, f4, f5 = F[row, 0], F[row, 1], F[row, 2], F[row, 3], F[row, 4], F[row, 5]
            g[c] -= f0 * u[0] + f1 * u[1] + f2 * u[2] + f3 * u[3] + f4 * u[4] + f5 * u[5]
            for other in range(row, last):
                d = columns[other]
                if d >= 0:
                    S[c, d] -= (
                        f0 * F[other, 0]
                        + f1 * F[other, 1]
                        + f2 * F[other, 2]
                        + f3 * F[other, 3]
                        + f4 * F[other, 4]
                        + f5 * F[other, 5]
                    )


@njit(cache=True, nogil=True)
def _cholesky6(B, L):
    """Lower triangle L with L Lᵀ = B."""
    for i in range(6):
        for j in range(i + 1):
            s = B[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(s, _TINY)) if i == j else s / L[j, j]


@njit(cache=True, nogil=True)
def _solve_lower6(L, x):
    """x ← L⁻¹ x."""
    for i in range(6):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]


@njit(cache=True, nogil=True)
def _solve_upper6(L, x):
    """x ← L⁻ᵀ x."""
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@njit(cache=True, nogil=True)
def substitute(start, is_free, step, L, F, y, columns, delta):
    """δ = L⁻ᵀ (y − Fᵀ · step) of every free pose, zero for the others."""
    q = (len(columns) - 3 * start[-1]) // (len(start) - 1)
    for k in range(len(start) - 1):
        delta[k] = 0.0
        if not is_free[k]:
            continue
        x = delta[k]
        x[:] = y[k]
        for row in range(3 * start[k] + q * k, 3 * start[k + 1] + q * (k + 1)):
            c = columns[row]
            if c >= 0:
                for a in range(6):
                    x[a] -= F[row, a] * step[c]
        _solve_upper6(L[k], x)


@njit(cache=True, nogil=True)
def pose_covariances(start, is_free, cov, L, F, columns, out):
    """L⁻ᵀ (I + Fᵀ C F) L⁻¹ of every free pose: its own covariance and the share of the columns', which is ``cov``."""
    q = (len(columns) - 3 * start[-1]) // (len(start) - 1)
    P = np.empty((6, 6))
    for k in range(len(start) - 1):
        if not is_free[k]:
            continue
        first, last = 3 * start[k] + q * k, 3 * start[k + 1] + q * (k + 1)
        P[:] = np.eye(6)
        for row in range(first, last):
            c = columns[row]
            if c < 0:
                continue
            g0 = g1 = g2 = g3 = g4 = g5 = 0.0
            for other in range(first, last):
                d = columns[other]
                if d >= 0:
                    v = cov[c, d]
                    g0 += v * F[other, 0]
                    g1 += v * F[other, 1]
                    g2 += v * F[other, 2]
                    g3 += v * F[other, 3]
                    g4 += v * F[other, 4]
                    g5 += v * F[other, 5]
            for a in range(6):
                f = F[row, a]
                P[a, 0] += f * g0
                P[a, 1] += f * g1
                P[a, 2] += f * g2
                P[a, 3] += f * g3
                P[a, 4] += f * g4
                P[a, 5] += f * g5
        for i in range(6):  # L⁻ᵀ on the left, then, P being symmetric, on the right
            _solve_upper6(L[k], P[:, i])
        for i in range(6):
            _solve_upper6(L[k], P[i])
        for i in range(6):
            for j in range(6):
                out[k, i, j] = 0.5 * (P[i, j] + P[j, i])


@njit(cache=True, nogil=True)
def move(R, t, delta):
    """T ← T · exp(δ) for every pose, exactly."""
    E = np.empty((3, 3))
    V = np.empty((3, 3))
    W = np.zeros((3, 3))
    one = np.eye(3)
    for k in range(len(R)):
        x, y, z = delta[k, 3], delta[k, 4], delta[k, 5]
        theta = np.sqrt(x * x + y * y + z * z)
        if theta < 1e-4:  # series: the closed form loses all digits
            a, b, c = 1.0 - theta**2 / 6.0, 0.5 - theta**2 / 24.0, 1.0 / 6.0 - theta**2 / 120.0
        else:
            a, b = np.sin(theta) / theta, 2.0 * (np.sin(theta / 2.0) / theta) ** 2
            c = (theta - np.sin(theta)) / theta**3
        W[0, 1], W[0, 2], W[1, 0], W[1, 2], W[2, 0], W[2, 1] = -z, y, z, -x, -y, x
        for i in range(3):
            for j in range(3):
                ww = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
                E[i, j] = one[i, j] + a * W[i, j] + b * ww  # Rodrigues
                V[i, j] = one[i, j] + b * W[i, j] + c * ww
        v0 = V[0, 0] * delta[k, 0] + V[0, 1] * delta[k, 1] + V[0, 2] * delta[k, 2]
        v1 = V[1, 0] * delta[k, 0] + V[1, 1] * delta[k, 1] + V[1, 2] * delta[k, 2]
        v2 = V[2, 0] * delta[k, 0] + V[2, 1] * delta[k, 1] + V[2, 2] * delta[k, 2]
        for i in range(3):
            t[k, i] += R[k, i, 0] * v0 + R[k, i, 1] * v1 + R[k, i, 2] * v2
            r0, r1, r2 = R[k, i, 0], R[k, i, 1], R[k, i, 2]
            for j in range(3):
                R[k, i, j] = r0 * E[0, j] + r1 * E[1, j] + r2 * E[2, j]


@njit(cache=True, nogil=True)
def mirror(S):
    """Copies the upper half of a square matrix onto the lower."""
    n = len(S)
    block = 64  # rows and columns at a time, so that both stay in the cache
    for i0 in range(0, n, block):
        for j0 in range(i0, n, block):
            for i in range(i0, min(i0 + block, n)):
                for j in range(max(j0, i + 1), min(j0 + block, n)):
                    S[j, i] = S[i, j]


def warm_up() -> None:
    """Compiles every kernel for the types that it meets in use."""
    p = np.array([[0.0, 0.0, 400.0], [40.0, 0.0, 410.0], [0.0, 60.0, 420.0]])
    start = np.array([0, 3])
    target = np.arange(3)
    column = 3 * target
    columns = np.arange(11)
    is_free = np.ones(1, dtype=np.bool_)
    A, b, C = np.zeros((3, 3, 3)), np.zeros((3, 3)), np.zeros((3, 3, 2))
    R, t, delta = np.eye(3)[None].copy(), np.zeros((1, 3)), np.zeros((1, 6))
    S, g = np.eye(11), np.zeros(11)
    J, J_rig, r, weight = np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3, 2)), np.zeros((3, 3)), np.ones(3)
    each = np.arange(4)
    in_sensor(start, target, R, t, p, p.copy())
    condense(each, J, r, weight, A, b)
    condense_rig(each, J, J_rig, r, weight, C, np.zeros((2, 2)), np.zeros(2))
    own_information(start, target, p, A, R, np.zeros((1, 6, 6)), np.zeros((3, 3, 3)))
    L, F, y = np.zeros((1, 6, 6)), np.zeros((11, 6)), np.zeros((1, 6))
    eliminate(start, target, column, is_free, p, A, b, C, R, 0.0, S, g, g.copy(), L, F, y, columns)
    mirror(S)
    substitute(start, is_free, g, L, F, y, columns, delta)
    pose_covariances(start, is_free, S, L, F, columns, np.zeros((1, 6, 6)))
    move(R, t, delta)
