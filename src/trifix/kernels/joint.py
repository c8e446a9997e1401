"""Compiled loops of the map's joint covariance: frames that condition it, targets that enter it, leave it, come back.

The state is a row of blocks of three: the error of a target (mm), or of a place, which takes two, as a shift (mm) and a
turn (rad) in world coordinates. Everything is in plain arrays; (R, t) is T_world_sensor, and pose covariances are of
δ = (translation, rotation), T · exp(δ), as everywhere. The matrix P has room for more blocks than are in use.
"""

import numpy as np
from jaxtyping import Float, Int
from numba import njit

_TINY = 1e-10  # share of its largest entry that a pivot is not allowed to fall below
_ROUNDS = 30  # of a power iteration
_MARGIN = 1.1  # on its result, which comes from below


@njit(cache=True, nogil=True)
def pose_fields(
    places: Float[np.ndarray, "c 3"], R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "c3 6"]:
    """R [I, −[p]×] of some places, p = Rᵀ (x − t): how what is seen there moves in the world with δ of the sensor."""
    H = np.empty((3 * len(places), 6))
    for i in range(len(places)):
        d0, d1, d2 = places[i, 0] - t[0], places[i, 1] - t[1], places[i, 2] - t[2]
        for k in range(3):
            H[3 * i, k], H[3 * i + 1, k], H[3 * i + 2, k] = R[0, k], R[1, k], R[2, k]
            # a turn about the sensor's k-th axis: R e_k × (x − t)
            H[3 * i, 3 + k] = R[1, k] * d2 - R[2, k] * d1
            H[3 * i + 1, 3 + k] = R[2, k] * d0 - R[0, k] * d2
            H[3 * i + 2, 3 + k] = R[0, k] * d1 - R[1, k] * d0
    return H


@njit(cache=True, nogil=True)
def residuals(
    places: Float[np.ndarray, "c 3"],
    points: Float[np.ndarray, "c 3"],
    points_cov: Float[np.ndarray, "c 3 3"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "c3"], Float[np.ndarray, "c 3 3"]]:
    """x − T p of pairs of a place and a point, and the points' covariances in the world."""
    r, cov, turned = np.empty(3 * len(places)), np.empty((len(places), 3, 3)), np.empty((3, 3))
    for i in range(len(places)):
        for a in range(3):
            r[3 * i + a] = places[i, a] - t[a]
            for b in range(3):
                r[3 * i + a] -= R[a, b] * points[i, b]
                turned[a, b] = R[a, 0] * points_cov[i, 0, b]
                turned[a, b] += R[a, 1] * points_cov[i, 1, b] + R[a, 2] * points_cov[i, 2, b]
        for a in range(3):
            for b in range(3):
                cov[i, a, b] = turned[a, 0] * R[b, 0] + turned[a, 1] * R[b, 1] + turned[a, 2] * R[b, 2]
    return r, cov


@njit(cache=True, nogil=True)
def condition(
    P: Float[np.ndarray, "cap cap"],
    used: int,
    seen: Int[np.ndarray, "c"],
    noise: Float[np.ndarray, "c 3 3"],
    H: Float[np.ndarray, "c3 6"],
    r: Float[np.ndarray, "c3"],
    gain: float,
) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"], Float[np.ndarray, "6 used"], Float[np.ndarray, "used"]]:
    """What r = −e + H δ − noise tells of the errors e of the seen blocks and of δ, of which nothing was known before.

    With S = P_seen + noise: δ's estimate and covariance M⁻¹ = (Hᵀ S⁻¹ H)⁻¹, its covariance with all errors, and their
    estimate. P changes by ``gain`` times Pᵀ (S⁻¹ − S⁻¹ H M⁻¹ Hᵀ S⁻¹) P: −1 is the update of a Kalman filter from which
    δ has been eliminated. The first ``used`` rows and columns of P are looked at; with none, P stays as it is.
    """
    m = 3 * len(seen)
    L = np.empty((m, m))
    for i in range(len(seen)):
        for j in range(i + 1):
            for a in range(3):
                for b in range(3):
                    L[3 * i + a, 3 * j + b] = P[3 * seen[i] + a, 3 * seen[j] + b]
                    if i == j:
                        L[3 * i + a, 3 * j + b] += noise[i, a, b]
    _factor(L)
    G, q = np.empty((m, 6)), np.empty((m, 1))
    G[:], q[:, 0] = H, r
    _substitute(L, G, 6)
    _substitute(L, q, 1)
    M, g, cov = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    for i in range(m):
        for a in range(6):
            g[a] += G[i, a] * q[i, 0]
            for b in range(6):
                M[a, b] += G[i, a] * G[i, b]
    _invert(M, cov)
    delta = np.zeros(6)
    for a in range(6):
        for b in range(6):
            delta[a] += cov[a, b] * g[b]
    cross, shift = np.zeros((6, used)), np.zeros(used)
    if used == 0:
        return delta, cov, cross, shift
    W = np.empty((m + m % 2, used))
    W[m:] = 0.0
    for i in range(m):
        W[i] = P[3 * seen[i // 3] + i % 3, :used]
    _substitute(L, W, used)
    GW = np.zeros((6, used))
    for i in range(m):
        for a in range(6):
            h = G[i, a]
            for j in range(used):
                GW[a, j] += h * W[i, j]
    for a in range(6):
        for b in range(6):
            for j in range(used):
                cross[a, j] += cov[a, b] * GW[b, j]
    for i in range(m):
        rest = q[i, 0]
        for a in range(6):
            h = G[i, a]
            rest -= h * delta[a]
            for j in range(used):
                W[i, j] -= h * cross[a, j]
        for j in range(used):
            shift[j] -= W[i, j] * rest
    _add_square(P, W, used, gain)
    return delta, cov, cross, shift


@njit(cache=True, nogil=True)
def enter_block(
    P: Float[np.ndarray, "cap cap"],
    used: int,
    block: int,
    H: Float[np.ndarray, "3 6"],
    pose_cov: Float[np.ndarray, "6 6"],
    cross: Float[np.ndarray, "6 cap"],
    noise: Float[np.ndarray, "3 3"],
) -> None:
    """A target's error e = H δ + noise takes a block; ``cross``, of δ with all blocks, takes note of it."""
    b = 3 * block
    for a in range(3):
        for j in range(used):
            s = 0.0
            for k in range(6):
                s += H[a, k] * cross[k, j]
            P[b + a, j] = P[j, b + a] = s
    for k in range(6):
        for a in range(3):
            s = 0.0
            for c in range(6):
                s += pose_cov[k, c] * H[a, c]
            cross[k, b + a] = s
    for a in range(3):
        for c in range(3):
            s = noise[a, c]
            for k in range(6):
                s += H[a, k] * cross[k, b + c]
            P[b + a, b + c] = s


@njit(cache=True, nogil=True)
def clear_block(P: Float[np.ndarray, "cap cap"], block: int) -> None:
    """A block that is nobody's."""
    for a in range(3 * block, 3 * block + 3):
        for j in range(len(P)):
            P[a, j] = P[j, a] = 0.0


@njit(cache=True, nogil=True)
def carry(
    xyz: Float[np.ndarray, "k 3"],
    block: Int[np.ndarray, "k"],
    place: Int[np.ndarray, "k"],
    first: Int[np.ndarray, "p"],
    second: Int[np.ndarray, "p"],
    centre: Float[np.ndarray, "p 3"],
    shift: Float[np.ndarray, "used"],
) -> None:
    """Targets move by the estimate of their errors: those with a block by its own, others with their place."""
    for k in range(len(xyz)):
        if block[k] >= 0:
            for a in range(3):
                xyz[k, a] += shift[3 * block[k] + a]
        elif place[k] >= 0:
            f, g = 3 * first[place[k]], 3 * second[place[k]]
            x, y, z = xyz[k] - centre[place[k]]
            xyz[k, 0] += shift[f] + shift[g + 1] * z - shift[g + 2] * y
            xyz[k, 1] += shift[f + 1] + shift[g + 2] * x - shift[g] * z
            xyz[k, 2] += shift[f + 2] + shift[g] * y - shift[g + 1] * x


@njit(cache=True, nogil=True)
def own_errors(
    P: Float[np.ndarray, "cap cap"],
    group: Int[np.ndarray, "c"],
    noise: Float[np.ndarray, "c 3 3"],
    H: Float[np.ndarray, "c3 6"],
    cov: Float[np.ndarray, "6 6"],
) -> Float[np.ndarray, "c 3 3"]:
    """Covariances of some targets apart that, taken for independent, are no less than E = P_group − H cov Hᵀ.

    They are λ times its diagonal blocks D, with λ the largest eigenvalue of D⁻¹ E: λ D − E is then nowhere negative.
    Where E loses its digits to far larger errors, they are c times the blocks of P_group, which no c targets exceed.
    """
    c = len(group)
    m = 3 * c
    E, D, inverse, whole = np.empty((m, m)), np.empty((c, 3, 3)), np.empty((c, 3, 3)), noise.copy()
    for i in range(m):
        for j in range(m):
            s = P[3 * group[i // 3] + i % 3, 3 * group[j // 3] + j % 3]
            if i // 3 == j // 3:
                s += noise[i // 3, i % 3, j % 3]
                whole[i // 3, i % 3, j % 3] = s
            for a in range(6):
                for b in range(6):
                    s -= H[i, a] * cov[a, b] * H[j, b]
            E[i, j] = s
            if i // 3 == j // 3:
                D[i // 3, i % 3, j % 3] = s + noise[i // 3, i % 3, j % 3]
    for i in range(c):
        if not min(D[i, 0, 0], D[i, 1, 1], D[i, 2, 2]) > 0.0:
            return float(c) * whole
        _invert(D[i].copy(), inverse[i])
    v, w = np.empty(m), np.empty(m)
    for i in range(m):
        v[i] = 1.0 + 0.37 * (i % 7) - 0.61 * (i % 4)
    largest = 1.0
    for _ in range(_ROUNDS):
        top, bottom = 0.0, 0.0
        for i in range(m):
            s = 0.0
            for j in range(m):
                s += E[i, j] * v[j]
            w[i] = s
            top += s * v[i]
        for i in range(m):
            k, a = i // 3, i % 3
            bottom += v[i] * (D[k, a, 0] * v[3 * k] + D[k, a, 1] * v[3 * k + 1] + D[k, a, 2] * v[3 * k + 2])
        if not bottom > 0.0:
            return float(c) * whole
        largest = max(largest, top / bottom)
        length = 0.0
        for i in range(m):
            k, a = i // 3, i % 3
            s = inverse[k, a, 0] * w[3 * k] + inverse[k, a, 1] * w[3 * k + 1] + inverse[k, a, 2] * w[3 * k + 2]
            v[i] = s
            length = max(length, abs(s))
        if length <= 0.0:  # nothing of E is left in v: the fields explain all of the errors
            break
        for i in range(m):
            v[i] /= length
    return D * (_MARGIN * largest)


@njit(cache=True, nogil=True)
def _factor(A: Float[np.ndarray, "m m"]) -> None:
    """The lower triangle of a symmetric matrix becomes that of its Cholesky factor."""
    m, largest = len(A), 0.0
    for i in range(m):
        largest = max(largest, A[i, i])
    for i in range(m):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            if i == j:
                A[i, i] = np.sqrt(max(s, _TINY * largest))
            else:
                A[i, j] = s / A[j, j]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _substitute(L: Float[np.ndarray, "m m"], W: Float[np.ndarray, "m n"], n: int) -> None:
    """W becomes L⁻¹ W; four rows of it at a time are taken off, as that spares memory."""
    for i in range(len(L)):
        row, k = W[i], 0
        while k + 4 <= i:
            a, b, c, d = L[i, k], L[i, k + 1], L[i, k + 2], L[i, k + 3]
            A, B, C, D = W[k], W[k + 1], W[k + 2], W[k + 3]
            for j in range(n):
                row[j] -= a * A[j] + b * B[j] + c * C[j] + d * D[j]
            k += 4
        while k < i:
            a, A = L[i, k], W[k]
            for j in range(n):
                row[j] -= a * A[j]
            k += 1
        a = 1.0 / L[i, i]
        for j in range(n):
            row[j] *= a


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_square(P: Float[np.ndarray, "cap cap"], W: Float[np.ndarray, "m n"], n: int, gain: float) -> None:
    """P += gain Wᵀ W in the first n rows and columns; n is a multiple of three, and W has an even number of rows."""
    for i in range(0, n, 3):
        p, q, r = P[i], P[i + 1], P[i + 2]
        for k in range(0, len(W), 2):
            A, B = W[k], W[k + 1]
            a0, a1, a2 = gain * A[i], gain * A[i + 1], gain * A[i + 2]
            b0, b1, b2 = gain * B[i], gain * B[i + 1], gain * B[i + 2]
            for j in range(i, n):
                x, y = A[j], B[j]
                p[j] += a0 * x + b0 * y
                q[j] += a1 * x + b1 * y
                r[j] += a2 * x + b2 * y
    for i in range(n):
        for j in range(i + 1, n):
            P[j, i] = P[i, j]


@njit(cache=True, nogil=True)
def _invert(A: Float[np.ndarray, "m m"], out: Float[np.ndarray, "m m"]) -> None:
    """Writes the inverse of a positive matrix, whose unknowns may be of any scale, and leaves nothing of the matrix."""
    m = len(A)
    scale = np.empty(m)
    for i in range(m):
        scale[i] = 1.0 / np.sqrt(A[i, i]) if A[i, i] > 0 else 1.0
    for i in range(m):
        for j in range(m):
            A[i, j] *= scale[i] * scale[j]
    _factor(A)
    U = np.zeros((m, m))
    for i in range(m):
        U[i, i] = 1.0
    _substitute(A, U, m)
    for i in range(m):
        for j in range(m):
            s = 0.0
            for k in range(m):
                s += U[k, i] * U[k, j]
            out[i, j] = s * scale[i] * scale[j]


def warm_up() -> None:
    """Compiles every loop of this module."""
    rng = np.random.default_rng(0)
    places, R, t = rng.normal(size=(4, 3)), np.eye(3), np.zeros(3)
    cov, rows = np.tile(np.eye(3), (4, 1, 1)), np.arange(4)
    P, H = np.eye(15), pose_fields(places, R, t)
    r, noise = residuals(places, places, cov, R, t)
    _, pose_cov, _, _ = condition(P, 12, rows, noise, H, r, -1.0)
    own_errors(P, rows, noise, H, pose_cov)
    enter_block(P, 12, 4, H[:3].copy(), pose_cov, np.zeros((6, 15)), cov[0])
    clear_block(P, 4)
    carry(places, rows, rows, rows, rows, places.copy(), np.zeros(12))
