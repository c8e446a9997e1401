"""Compiled loops of the growing map: what a fix teaches about known targets, ghosts and new ones.

Everything is in plain arrays and millimetres; (R, t) is T_world_sensor, and 6 x 6 covariances are of
δ = (translation, rotation), T · exp(δ), as everywhere. Arrays of targets have room for more rows than are in use.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

PROVISIONAL, TRUSTED, REMOVED = 0, 1, 3
"""States of a target, as in ``TargetState``."""

_VAGUE = 0.1  # sigma of a point that is no target any more, in distances from the sensor
_NEAREST = 4  # known targets, nearest first, that a new point is compared with


@njit(cache=True, nogil=True)
def teach(
    xyz: Float[np.ndarray, "k 3"],
    cov: Float[np.ndarray, "k 3 3"],
    view: Float[np.ndarray, "k 3"],
    sightings: Int[np.ndarray, "k"],
    last_seen: Int[np.ndarray, "k"],
    misses: Int[np.ndarray, "k"],
    state: Int[np.ndarray, "k"],
    is_expected: Bool[np.ndarray, "e"],
    points: Float[np.ndarray, "n 3"],
    points_cov: Float[np.ndarray, "n 3 3"],
    point: Int[np.ndarray, "c"],
    target: Int[np.ndarray, "c"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    pose_cov: Float[np.ndarray, "6 6"],
    frame_index: int,
    stays: bool,
    is_mean: bool,
    trusted_after: int,
    max_misses: int,
) -> None:
    """Identified targets learn from their sightings; the others, as many as ``is_expected`` has, may have missed one.

    Kalman: K = C (C + C_seen)⁻¹; mean: (n x + x_seen) / (n + 1) with covariance (n² C + C_seen) / (n + 1)². A target
    that ``stays`` has been moved already: its covariance alone learns.
    """
    place, C, S, K, left = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    is_seen = np.zeros(len(is_expected), np.bool_)
    for i in range(len(point)):
        p, q = point[i], target[i]
        is_seen[q] = True
        _to_world(points[p], points_cov[p], R, t, pose_cov, place, C)
        n = max(sightings[q], 1)  # a position that was given counts as one sighting
        left[:] = xyz[q]
        if is_mean:
            for r in range(3):
                xyz[q, r] += (place[r] - xyz[q, r]) / (n + 1.0)
                for c in range(3):
                    cov[q, r, c] = (n * n * cov[q, r, c] + C[r, c]) / (n + 1.0) ** 2
        else:
            for r in range(3):
                for c in range(3):
                    S[r, c] = cov[q, r, c] + C[r, c]
                place[r] -= xyz[q, r]
            _invert(S)
            for r in range(3):
                for c in range(3):
                    K[r, c] = cov[q, r, 0] * S[0, c] + cov[q, r, 1] * S[1, c] + cov[q, r, 2] * S[2, c]
            for r in range(3):
                xyz[q, r] += K[r, 0] * place[0] + K[r, 1] * place[1] + K[r, 2] * place[2]
                for c in range(3):
                    C[r, c] = cov[q, r, c] - (K[r, 0] * cov[q, 0, c] + K[r, 1] * cov[q, 1, c] + K[r, 2] * cov[q, 2, c])
            for r in range(3):
                for c in range(3):
                    cov[q, r, c] = 0.5 * (C[r, c] + C[c, r])
        if stays:
            xyz[q] = left
        _towards(t, xyz[q], place)
        for c in range(3):
            place[c] += view[q, c] * n if np.isfinite(view[q, c]) else 0.0
        _normalise(place)
        view[q] = place
        sightings[q] += 1
        last_seen[q] = frame_index
        if state[q] == PROVISIONAL and sightings[q] >= trusted_after:
            state[q] = TRUSTED
    for q in range(len(is_expected)):
        if is_expected[q] and not is_seen[q]:
            misses[q] += 1
        if max_misses > 0 and state[q] == PROVISIONAL and misses[q] > max_misses * sightings[q]:
            state[q] = REMOVED


@njit(cache=True, nogil=True)
def new_points(
    xyz: Float[np.ndarray, "k 3"],
    cov: Float[np.ndarray, "k 3 3"],
    state: Int[np.ndarray, "k"],
    targets: int,
    points: Float[np.ndarray, "n 3"],
    points_cov: Float[np.ndarray, "n 3 3"],
    point: Int[np.ndarray, "c"],
    match: Int[np.ndarray, "n"],
    left: Int[np.ndarray, "m"],
    right: Int[np.ndarray, "m"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    pose_cov: Float[np.ndarray, "6 6"],
    max_sigmas: float,
) -> Int[np.ndarray, "a"]:
    """Rows of points that are none of the first so many targets and share no dot with one that is.

    ``left`` and ``right`` are the dots of each pair, ``match`` the pair of each point; they are empty where there are
    no pairs.
    """
    is_free = np.ones(len(points), np.bool_)
    is_free[point] = False
    if len(left):
        is_left_used, is_right_used = np.zeros(left.max() + 1, np.bool_), np.zeros(right.max() + 1, np.bool_)
        for p in point:
            is_left_used[left[match[p]]] = is_right_used[right[match[p]]] = True
        for p in range(len(points)):
            is_free[p] &= not (is_left_used[left[match[p]]] or is_right_used[right[match[p]]])
    rows = distinct_points(points, points_cov, np.flatnonzero(is_free))
    count = 0
    place, C, S = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    nearest, distance = np.empty(_NEAREST, np.int64), np.empty(_NEAREST)
    for p in rows:
        _to_world(points[p], points_cov[p], R, t, pose_cov, place, C)
        nearest[:], distance[:] = -1, np.inf
        for q in range(targets):
            dx = xyz[q, 0] - place[0]
            dx2 = dx * dx
            if dx2 >= distance[-1] or state[q] > TRUSTED:
                continue
            d2 = dx2 + (xyz[q, 1] - place[1]) ** 2 + (xyz[q, 2] - place[2]) ** 2
            i = _NEAREST - 1
            if d2 >= distance[i]:
                continue
            while i > 0 and distance[i - 1] > d2:
                nearest[i], distance[i] = nearest[i - 1], distance[i - 1]
                i -= 1
            nearest[i], distance[i] = q, d2
        is_new = True
        for i in range(_NEAREST):
            q = nearest[i]
            if q < 0:
                break
            for r in range(3):
                for c in range(3):
                    S[r, c] = C[r, c] + cov[q, r, c]
            _invert(S)
            is_new &= _squared(S, xyz[q, 0] - place[0], xyz[q, 1] - place[1], xyz[q, 2] - place[2]) > max_sigmas**2
        if is_new:
            rows[count] = p
            count += 1
    return rows[:count]


@njit(cache=True, nogil=True)
def enter_points(
    id: Int[np.ndarray, "k"],
    xyz: Float[np.ndarray, "k 3"],
    cov: Float[np.ndarray, "k 3 3"],
    view: Float[np.ndarray, "k 3"],
    sightings: Int[np.ndarray, "k"],
    last_seen: Int[np.ndarray, "k"],
    misses: Int[np.ndarray, "k"],
    state: Int[np.ndarray, "k"],
    targets: int,
    points: Float[np.ndarray, "n 3"],
    points_cov: Float[np.ndarray, "n 3 3"],
    new: Int[np.ndarray, "a"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    pose_cov: Float[np.ndarray, "6 6"],
    frame_index: int,
    next_id: int,
) -> Int[np.ndarray, "a"]:
    """Some points become provisional targets, in the rows of removed ones first; returns their rows."""
    rows = np.empty(len(new), np.int64)
    vacant, end = 0, targets
    place, C = np.empty(3), np.empty((3, 3))
    for i in range(len(new)):
        while vacant < targets and state[vacant] != REMOVED:
            vacant += 1
        row = vacant
        if vacant == targets:
            row = end
            end += 1
        _to_world(points[new[i]], points_cov[new[i]], R, t, pose_cov, place, C)
        id[row], xyz[row], cov[row] = next_id + i, place, C
        _towards(t, xyz[row], place)
        view[row] = place
        sightings[row], last_seen[row], misses[row], state[row] = 1, frame_index, 0, PROVISIONAL
        rows[i] = row
    return rows


@njit(cache=True, nogil=True)
def distinct_points(
    points: Float[np.ndarray, "n 3"], cov: Float[np.ndarray, "n 3 3"], rows: Int[np.ndarray, "r"]
) -> Int[np.ndarray, "d"]:
    """Those of some points that could be targets of their own.

    They are not the same measurement, to a millionth of a millimetre, as an earlier one; and their distance from the
    sensor is known to a tenth, beyond which a covariance says nothing of where they are.
    """
    out, count = np.empty(len(rows), np.int64), 0
    grid = np.empty((len(rows), 3))
    for p in rows:
        far2 = points[p, 0] ** 2 + points[p, 1] ** 2 + points[p, 2] ** 2
        if cov[p, 0, 0] + cov[p, 1, 1] + cov[p, 2, 2] > _VAGUE**2 * far2:
            continue
        for c in range(3):
            grid[count, c] = np.rint(1e6 * points[p, c])
        is_new = True
        for i in range(count):
            if grid[i, 0] == grid[count, 0] and grid[i, 1] == grid[count, 1] and grid[i, 2] == grid[count, 2]:
                is_new = False
                break
        if is_new:
            out[count] = p
            count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def squared_distances(
    xyz: Float[np.ndarray, "k 3"],
    cov: Float[np.ndarray, "k 3 3"],
    points: Float[np.ndarray, "n 3"],
    points_cov: Float[np.ndarray, "n 3 3"],
    point: Int[np.ndarray, "c"],
    target: Int[np.ndarray, "c"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "c"]:
    """Squared Mahalanobis distances of points, seen from an exact pose, to the targets that they are."""
    out = np.empty(len(point))
    place, S, exact = np.empty(3), np.empty((3, 3)), np.zeros((6, 6))
    for i in range(len(point)):
        p, q = point[i], target[i]
        _to_world(points[p], points_cov[p], R, t, exact, place, S)
        for r in range(3):
            for c in range(3):
                S[r, c] += cov[q, r, c]
        _invert(S)
        out[i] = _squared(S, xyz[q, 0] - place[0], xyz[q, 1] - place[1], xyz[q, 2] - place[2])
    return out


@njit(cache=True, nogil=True)
def _to_world(
    p: Float[np.ndarray, "3"],
    p_cov: Float[np.ndarray, "3 3"],
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    pose_cov: Float[np.ndarray, "6 6"],
    place: Float[np.ndarray, "3"],
    cov: Float[np.ndarray, "3 3"],
) -> None:
    """Writes the place and covariance of a point seen from an uncertain pose: R (C + J P Jᵀ) Rᵀ with J = [I, −[p]×]."""
    J = np.zeros((3, 6))
    J[0, 0] = J[1, 1] = J[2, 2] = 1.0
    J[0, 4], J[0, 5], J[1, 3], J[1, 5], J[2, 3], J[2, 4] = p[2], -p[1], -p[2], p[0], p[1], -p[0]
    JP = np.zeros((3, 6))
    for r in range(3):
        for c in range(6):
            for k in range(6):
                JP[r, c] += J[r, k] * pose_cov[k, c]
    total, turned = np.empty((3, 3)), np.empty((3, 3))
    for r in range(3):
        place[r] = R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2] + t[r]
        for c in range(3):
            total[r, c] = p_cov[r, c]
            for k in range(6):
                total[r, c] += JP[r, k] * J[c, k]
    for r in range(3):
        for c in range(3):
            turned[r, c] = R[r, 0] * total[0, c] + R[r, 1] * total[1, c] + R[r, 2] * total[2, c]
    for r in range(3):
        for c in range(3):
            cov[r, c] = turned[r, 0] * R[c, 0] + turned[r, 1] * R[c, 1] + turned[r, 2] * R[c, 2]


@njit(cache=True, nogil=True)
def _towards(t: Float[np.ndarray, "3"], xyz: Float[np.ndarray, "3"], out: Float[np.ndarray, "3"]) -> None:
    """Writes the unit direction to the sensor."""
    out[0], out[1], out[2] = t[0] - xyz[0], t[1] - xyz[1], t[2] - xyz[2]
    _normalise(out)


@njit(cache=True, nogil=True)
def _normalise(v: Float[np.ndarray, "3"]) -> None:
    length = max(np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 1e-12)
    v[0], v[1], v[2] = v[0] / length, v[1] / length, v[2] / length


@njit(cache=True, nogil=True)
def _invert(S: Float[np.ndarray, "3 3"]) -> None:
    """A symmetric matrix becomes its inverse, by its cofactors."""
    a, b, c, d, e, f = S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    S[0, 0], S[1, 1], S[2, 2] = c00 / det, (a * f - c * c) / det, (a * d - b * b) / det
    S[0, 1] = S[1, 0] = c01 / det
    S[0, 2] = S[2, 0] = c02 / det
    S[1, 2] = S[2, 1] = (b * c - a * e) / det


@njit(cache=True, nogil=True)
def _squared(W: Float[np.ndarray, "3 3"], x: float, y: float, z: float) -> float:
    """vᵀ W v of v = (x, y, z)."""
    return (
        x * (W[0, 0] * x + W[0, 1] * y + W[0, 2] * z)
        + y * (W[1, 0] * x + W[1, 1] * y + W[1, 2] * z)
        + z * (W[2, 0] * x + W[2, 1] * y + W[2, 2] * z)
    )


def warm_up() -> None:
    """Compiles every loop of this module."""
    k = 5
    xyz, cov, view = np.zeros((k, 3)), np.tile(np.eye(3), (k, 1, 1)), np.zeros((k, 3))
    numbers = [np.zeros(k, np.int64) for _ in range(4)]
    points, rows, none = np.array([[0.0, 0, 1], [0, 0, 900]]), np.arange(1), np.zeros(0, np.int64)
    seen, pose = (points, cov[:2].copy()), (np.eye(3), np.zeros(3), np.eye(6))
    teach(xyz, cov, view, *numbers, np.ones(3, np.bool_), *seen, rows, rows, *pose, 0, False, False, 3, 8)
    new = new_points(xyz, cov, numbers[3], 3, *seen, rows, np.zeros(2, np.int64), none, none, *pose, 6.0)
    enter_points(numbers[0].copy(), xyz, cov, view, *numbers, 3, *seen, new, *pose, 0, 3)
    distinct_points(points, cov, rows)
    squared_distances(xyz, cov, *seen, rows, rows, *pose[:2])
