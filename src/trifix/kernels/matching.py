"""Compiled loops of the matching techniques: congruent triangles, pair counts, neighbours, votes, counterparts.

Knows rows, lengths in millimetres and tolerances; what a technique makes of them is decided by the stages.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

Sides = Float[np.ndarray, "t 3"]
Triangles = Int[np.ndarray, "t 3"]
Store = Int[np.ndarray, "e"]
Pairs = tuple[Int[np.ndarray, "h 3"], Int[np.ndarray, "h 3"], Int[np.ndarray, "h"]]

# --- congruence ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _orders_that_agree(
    side: np.ndarray,
    var: np.ndarray,
    hand: int,
    map_side: np.ndarray,
    map_var: np.ndarray,
    map_hand: int,
    sigmas: float,
    floor_mm: float,
) -> int:
    """Which vertex orders make two triangles congruent: 1 as they are, 2 and 4 with the two shortest or longest sides
    exchanged; 0 for none, and for an equilateral triangle of the frame."""
    can_swap01 = side[1] - side[0] <= floor_mm + sigmas * np.sqrt(var[0] + var[1])
    can_swap12 = side[2] - side[1] <= floor_mm + sigmas * np.sqrt(var[1] + var[2])
    if can_swap01 and can_swap12:
        return 0
    orders = 0
    for order in range(3):
        if (order == 1 and not can_swap01) or (order == 2 and not can_swap12):
            continue
        # an exchange of two vertices turns the normal over
        if map_hand * (hand if order == 0 else -hand) < 0:
            continue
        agree = True
        for s in range(3):
            q = s
            if order == 1 and s < 2:
                q = 1 - s
            elif order == 2 and s > 0:
                q = 3 - s
            if abs(side[q] - map_side[s]) > floor_mm + sigmas * np.sqrt(var[q] + map_var[s]):
                agree = False
        if agree:
            orders += 1 << order
    return orders


@njit(cache=True, nogil=True)
def _append(
    points: np.ndarray,
    targets: np.ndarray,
    rows: np.ndarray,
    found: int,
    order: np.ndarray,
    map_order: np.ndarray,
    row: int,
    orders: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Adds the vertex pairs of every order that agrees, growing the tables where they are full."""
    if found + 2 > len(rows):
        more = 2 * len(rows)
        points_, targets_, rows_ = (
            np.empty((more, 3), np.int64),
            np.empty((more, 3), np.int64),
            np.empty(more, np.int64),
        )
        points_[:found], targets_[:found], rows_[:found] = points[:found], targets[:found], rows[:found]
        points, targets, rows = points_, targets_, rows_
    for way in range(3):
        if not orders & (1 << way):
            continue
        points[found] = order
        if way > 0:
            points[found, way - 1], points[found, way] = order[way], order[way - 1]
        targets[found] = map_order
        rows[found] = row
        found += 1
    return points, targets, rows, found


@njit(cache=True, nogil=True)
def match_sorted(
    order: Triangles,
    side: Sides,
    var: Sides,
    hand: Int[np.ndarray, "t"],
    map_order: Triangles,
    map_side: Sides,
    map_var: Sides,
    map_hand: Int[np.ndarray, "t"],
    sigmas: float,
    floor_mm: float,
    limit: int,
) -> Pairs:
    """Congruent pairs: points (h, 3), targets (h, 3), row of the map's triangle (h); at most about ``limit``.

    The map's triangles come sorted by their longest side; the others are those of ``describe_triangles``.
    """
    points, targets, rows = np.empty((256, 3), np.int64), np.empty((256, 3), np.int64), np.empty(256, np.int64)
    found = 0
    longest = map_side[:, 2].copy()
    widest = 0.0
    for m in range(len(map_var)):
        widest = max(widest, map_var[m, 1], map_var[m, 2])
    for f in range(len(order)):
        # no side of the map exceeds its longest, so this holds when the two longest are exchanged, too
        reach = floor_mm + sigmas * np.sqrt(max(var[f, 1], var[f, 2]) + widest)
        first = np.searchsorted(longest, side[f, 2] - reach)
        for m in range(first, len(longest)):
            if longest[m] > side[f, 2] + reach:
                break
            orders = _orders_that_agree(
                side[f], var[f], hand[f], map_side[m], map_var[m], map_hand[m], sigmas, floor_mm
            )
            if orders:
                points, targets, rows, found = _append(points, targets, rows, found, order[f], map_order[m], m, orders)
        if found >= limit:
            break
    return points[:found], targets[:found], rows[:found]


@njit(cache=True, nogil=True)
def _bucket(i: int, j: int, k: int, mask: int) -> int:
    return ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & mask


@njit(cache=True, nogil=True)
def hash_sides(side: Sides, cell_mm: float) -> tuple[Int[np.ndarray, "b"], Int[np.ndarray, "t"]]:
    """A hash table over the three sorted sides: where each bucket begins, and the triangles in bucket order."""
    size = 16
    while size < 2 * len(side):
        size *= 2
    start = np.zeros(size + 1, np.int64)
    bucket = np.empty(len(side), np.int64)
    for m in range(len(side)):
        cell = np.floor(side[m] / cell_mm).astype(np.int64)
        bucket[m] = _bucket(cell[0], cell[1], cell[2], size - 1)
        start[bucket[m] + 1] += 1
    for b in range(size):
        start[b + 1] += start[b]
    place = start[:-1].copy()
    item = np.empty(len(side), np.int64)
    for m in range(len(side)):
        item[place[bucket[m]]] = m
        place[bucket[m]] += 1
    return start, item


@njit(cache=True, nogil=True)
def match_hashed(
    order: Triangles,
    side: Sides,
    var: Sides,
    hand: Int[np.ndarray, "t"],
    map_order: Triangles,
    map_side: Sides,
    map_var: Sides,
    map_hand: Int[np.ndarray, "t"],
    start: Int[np.ndarray, "b"],
    item: Int[np.ndarray, "m"],
    cell_mm: float,
    sigmas: float,
    floor_mm: float,
    limit: int,
) -> tuple[Int[np.ndarray, "h 3"], Int[np.ndarray, "h 3"], Int[np.ndarray, "h"], int]:
    """The congruent pairs of ``match_sorted``, by the table of ``hash_sides``, and how many were compared."""
    points, targets, rows = np.empty((256, 3), np.int64), np.empty((256, 3), np.int64), np.empty(256, np.int64)
    found = compared = 0
    mask = len(start) - 2
    widest = 0.0
    for m in range(len(map_var)):
        widest = max(widest, map_var[m].max())
    for f in range(len(order)):
        # sides in ascending order pair best, so no exchange brings them closer than this
        reach = floor_mm + sigmas * np.sqrt(var[f].max() + widest)
        low = np.floor((side[f] - reach) / cell_mm).astype(np.int64)
        high = np.floor((side[f] + reach) / cell_mm).astype(np.int64)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    b = _bucket(i, j, k, mask)
                    for n in range(start[b], start[b + 1]):
                        m = item[n]
                        if (
                            int(np.floor(map_side[m, 0] / cell_mm)) != i
                            or int(np.floor(map_side[m, 1] / cell_mm)) != j
                            or int(np.floor(map_side[m, 2] / cell_mm)) != k
                        ):
                            continue
                        compared += 1
                        orders = _orders_that_agree(
                            side[f], var[f], hand[f], map_side[m], map_var[m], map_hand[m], sigmas, floor_mm
                        )
                        if orders:
                            points, targets, rows, found = _append(
                                points, targets, rows, found, order[f], map_order[m], m, orders
                            )
        if found >= limit:
            break
    return points[:found], targets[:found], rows[:found], compared


# --- counts of pairs seen together -----------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def count_pairs(
    seen: Int[np.ndarray, "s"],
    xyz: Float[np.ndarray, "k 3"],
    id: Int[np.ndarray, "k"],
    head: Int[np.ndarray, "k"],
    other: Store,
    count: Store,
    distance: Float[np.ndarray, "e"],
    following: Store,
    free: int,
    best: Int[np.ndarray, "k 3"],
) -> tuple[int, int]:
    """Adds one to the count of every pair of ``seen`` targets; returns the head of the free list and what was taken.

    Each target has a chain of half-edges (other, count, distance, following). ``best`` receives the three targets seen
    most often with each one, -1 where there are fewer; ties go to the nearer at the first common sighting, then to the
    lower id. The caller provides enough free half-edges.
    """
    taken = 0
    is_wanted = np.zeros(len(head), np.bool_)
    for s in seen:
        is_wanted[s] = True
    for p in seen:
        is_wanted[p] = False
        edge = head[p]
        while edge >= 0:
            if is_wanted[other[edge]]:
                count[edge] += 1
                is_wanted[other[edge]] = False
            edge = following[edge]
        for q in seen:
            if q != p and is_wanted[q]:
                edge, free = free, following[free]
                taken += 1
                other[edge] = q
                count[edge] = 1
                distance[edge] = np.sqrt(
                    (xyz[p, 0] - xyz[q, 0]) ** 2 + (xyz[p, 1] - xyz[q, 1]) ** 2 + (xyz[p, 2] - xyz[q, 2]) ** 2
                )
                following[edge] = head[p]
                head[p] = edge
            is_wanted[q] = True
        is_wanted[p] = True
        _rank_partners(p, id, head, other, count, distance, following, best)
    return free, taken


@njit(cache=True, nogil=True)
def _rank_partners(
    p: int,
    id: Int[np.ndarray, "k"],
    head: Int[np.ndarray, "k"],
    other: Store,
    count: Store,
    distance: Float[np.ndarray, "e"],
    following: Store,
    best: Int[np.ndarray, "k 3"],
) -> None:
    top = np.full(3, -1, np.int64)
    edge = head[p]
    while edge >= 0:
        e = edge
        for rank in range(3):
            t = top[rank]
            if (
                t < 0
                or count[e] > count[t]
                or (
                    count[e] == count[t]
                    and (distance[e] < distance[t] or (distance[e] == distance[t] and id[other[e]] < id[other[t]]))
                )
            ):
                top[rank] = e
                e = t
            if e < 0:
                break
        edge = following[edge]
    for rank in range(3):
        best[p, rank] = other[top[rank]] if top[rank] >= 0 else -1


@njit(cache=True, nogil=True)
def forget_targets(
    is_gone: Bool[np.ndarray, "k"],
    id: Int[np.ndarray, "k"],
    head: Int[np.ndarray, "k"],
    other: Store,
    count: Store,
    distance: Float[np.ndarray, "e"],
    following: Store,
    free: int,
    best: Int[np.ndarray, "k 3"],
) -> tuple[int, int]:
    """Removes targets and every pair they stand in; returns the head of the free list and what was freed."""
    freed = 0
    for p in range(len(head)):
        before = -1
        edge = head[p]
        has_lost = False
        while edge >= 0:
            after = following[edge]
            if is_gone[p] or is_gone[other[edge]]:
                if before < 0:
                    head[p] = after
                else:
                    following[before] = after
                following[edge] = free
                free = edge
                freed += 1
                has_lost = True
            else:
                before = edge
            edge = after
        if has_lost:
            _rank_partners(p, id, head, other, count, distance, following, best)
    return free, freed


@njit(cache=True, nogil=True)
def rarest_pairs(
    triangles: Triangles, head: Int[np.ndarray, "k"], other: Store, count: Store, following: Store
) -> Int[np.ndarray, "t"]:
    """Of each triangle, the count of the pair seen together least often."""
    out = np.zeros(len(triangles), np.int64)
    for i in range(len(triangles)):
        least = 1 << 60
        for v in range(3):
            q = triangles[i, (v + 1) % 3]
            edge = head[triangles[i, v]]
            while edge >= 0 and other[edge] != q:
                edge = following[edge]
            least = min(least, count[edge] if edge >= 0 else 0)
        out[i] = least
    return out


# --- nearest targets -------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def renew_nearest(
    xyz: Float[np.ndarray, "k 3"],
    is_alive: Bool[np.ndarray, "k"],
    is_changed: Bool[np.ndarray, "k"],
    nearest: Int[np.ndarray, "k 3"],
    distance2: Float[np.ndarray, "k 3"],
) -> Bool[np.ndarray, "k"]:
    """Brings the three nearest others of each target up to date; returns the targets whose neighbours were sought anew.

    Only targets that changed, that list one that changed, or that one which changed has come near to, can have new
    neighbours. Ties go to the lower row. ``nearest`` holds -1 and ``distance2`` infinity where there are fewer.
    """
    changed = np.flatnonzero(is_changed & is_alive)
    is_renewed = np.zeros(len(xyz), np.bool_)
    for p in range(len(xyz)):
        is_due = is_changed[p]
        if is_alive[p] and not is_due:
            for rank in range(3):
                q = nearest[p, rank]
                is_due |= q >= 0 and is_changed[q]
            limit = distance2[p, 2]
            for q in changed:
                if is_due:
                    break
                d = (xyz[p, 0] - xyz[q, 0]) ** 2 + (xyz[p, 1] - xyz[q, 1]) ** 2 + (xyz[p, 2] - xyz[q, 2]) ** 2
                is_due = d <= limit
        if not is_due:
            continue
        is_renewed[p] = True
        nearest[p] = -1
        distance2[p] = np.inf
        if not is_alive[p]:
            continue
        for q in range(len(xyz)):
            if q == p or not is_alive[q]:
                continue
            d = (xyz[p, 0] - xyz[q, 0]) ** 2 + (xyz[p, 1] - xyz[q, 1]) ** 2 + (xyz[p, 2] - xyz[q, 2]) ** 2
            if d >= distance2[p, 2]:
                continue
            rank = 2
            while rank > 0 and distance2[p, rank - 1] > d:
                distance2[p, rank] = distance2[p, rank - 1]
                nearest[p, rank] = nearest[p, rank - 1]
                rank -= 1
            distance2[p, rank] = d
            nearest[p, rank] = q
    return is_renewed


# --- votes of distances ----------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def vote(
    pair: Int[np.ndarray, "d 2"],
    length: Float[np.ndarray, "d"],
    var: Float[np.ndarray, "d"],
    points: int,
    xyz: Float[np.ndarray, "a 3"],
    cov: Float[np.ndarray, "a 3 3"],
    axis: int,
    sigmas: float,
    floor_mm: float,
) -> Int[np.ndarray, "points a"]:
    """How often each point (row) may be each target (column): every similar distance votes for both ways of pairing.

    The frame's distances come sorted by length, the targets by their coordinate along ``axis``, so that the search
    ends where no distance of the frame reaches.
    """
    votes = np.zeros((points, len(xyz)), np.int64)
    if len(length) == 0:
        return votes
    widest = var.max()
    trace = 0.0
    for i in range(len(cov)):
        trace = max(trace, cov[i, 0, 0] + cov[i, 1, 1] + cov[i, 2, 2])
    reach = length[-1] + floor_mm + sigmas * np.sqrt(widest + 2 * trace)
    for i in range(len(xyz)):
        for j in range(i + 1, len(xyz)):
            if xyz[j, axis] - xyz[i, axis] > reach:
                break
            u0, u1, u2 = xyz[j, 0] - xyz[i, 0], xyz[j, 1] - xyz[i, 1], xyz[j, 2] - xyz[i, 2]
            d = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
            if d > reach or d == 0.0:
                continue
            u = (u0 / d, u1 / d, u2 / d)
            map_var = 0.0
            for r in range(3):
                for c in range(3):
                    map_var += u[r] * (cov[i, r, c] + cov[j, r, c]) * u[c]
            tolerance = floor_mm + sigmas * np.sqrt(widest + map_var)
            for n in range(np.searchsorted(length, d - tolerance), len(length)):
                if length[n] > d + tolerance:
                    break
                if abs(length[n] - d) <= floor_mm + sigmas * np.sqrt(var[n] + map_var):
                    for e in range(2):
                        votes[pair[n, e], i] += 1
                        votes[pair[n, e], j] += 1
    return votes


# --- counterparts ----------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def counterparts(
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    xyz: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "a 3"],
    axis: int,
    tolerance_mm: float,
    matched: Int[np.ndarray, "n"],
) -> tuple[int, float]:
    """E of Khoury 2006, eq. 1-4: for each point the only target within the tolerance, -1 where there is none or a
    second one, or where another point is nearer to it. Returns how many have one, and their rms distance.

    The targets come sorted by their coordinate along ``axis``.
    """
    count = 0
    total = 0.0
    along = targets[:, axis]
    distance2 = np.empty(len(xyz))
    for n in range(len(xyz)):
        x = R[0, 0] * xyz[n, 0] + R[0, 1] * xyz[n, 1] + R[0, 2] * xyz[n, 2] + t[0]
        y = R[1, 0] * xyz[n, 0] + R[1, 1] * xyz[n, 1] + R[1, 2] * xyz[n, 2] + t[1]
        z = R[2, 0] * xyz[n, 0] + R[2, 1] * xyz[n, 1] + R[2, 2] * xyz[n, 2] + t[2]
        w = x if axis == 0 else (y if axis == 1 else z)
        matched[n] = -1
        within = 0
        for m in range(np.searchsorted(along, w - tolerance_mm), len(along)):
            if along[m] > w + tolerance_mm:
                break
            d2 = (targets[m, 0] - x) ** 2 + (targets[m, 1] - y) ** 2 + (targets[m, 2] - z) ** 2
            if d2 <= tolerance_mm * tolerance_mm:
                within += 1
                matched[n], distance2[n] = m, d2
        if within != 1:
            matched[n] = -1
            continue
        for before in range(n):
            if matched[before] == matched[n]:
                worse = n if distance2[n] >= distance2[before] else before
                matched[worse] = -1
                count -= 1
                total -= distance2[worse]
                break
        count += 1
        total += distance2[n]
    return count, np.sqrt(max(total, 0.0) / count) if count > 0 else np.inf


@njit(cache=True, nogil=True)
def _align(
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
    xyz: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "a 3"],
    matched: Int[np.ndarray, "n"],
) -> bool:
    """Least-squares pose of the matched points, in place, from one that is near; False where they lie on one line.

    With both sets about their centres, the small rotation w that is still missing solves
    Σ (|p|² I − p pᵀ) w = Σ p × q.
    """
    count = 0
    centre, centre_target = np.zeros(3), np.zeros(3)
    for n in range(len(xyz)):
        if matched[n] >= 0:
            count += 1
            centre += xyz[n]
            centre_target += targets[matched[n]]
    centre /= count
    centre_target /= count
    p, q, w = np.empty(3), np.empty(3), np.empty(3)
    for _ in range(4):
        a = b = c = d = e = f = 0.0  # rows (a, b, c), (b, d, e), (c, e, f)
        g0 = g1 = g2 = 0.0
        for n in range(len(xyz)):
            if matched[n] < 0:
                continue
            for r in range(3):
                p[r] = 0.0
                for s in range(3):
                    p[r] += R[r, s] * (xyz[n, s] - centre[s])
                q[r] = targets[matched[n], r] - centre_target[r]
            a += p[1] * p[1] + p[2] * p[2]
            d += p[0] * p[0] + p[2] * p[2]
            f += p[0] * p[0] + p[1] * p[1]
            b -= p[0] * p[1]
            c -= p[0] * p[2]
            e -= p[1] * p[2]
            g0 += p[1] * q[2] - p[2] * q[1]
            g1 += p[2] * q[0] - p[0] * q[2]
            g2 += p[0] * q[1] - p[1] * q[0]
        A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
        det = a * A + b * B + c * C
        if det <= 1e-9 * ((a + d + f) / 3) ** 3:
            return False
        w[0] = (A * g0 + B * g1 + C * g2) / det
        w[1] = (B * g0 + (a * f - c * c) * g1 + (b * c - a * e) * g2) / det
        w[2] = (C * g0 + (b * c - a * e) * g1 + (a * d - b * b) * g2) / det
        # rotation by w as a quaternion (w/2, 1), normalised: exact to second order, and a rotation always
        k = 1.0 / np.sqrt(1.0 + (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) / 4)
        x, y, z, s = w[0] / 2 * k, w[1] / 2 * k, w[2] / 2 * k, k
        for column in range(3):
            r0, r1, r2 = R[0, column], R[1, column], R[2, column]
            R[0, column] = (1 - 2 * (y * y + z * z)) * r0 + 2 * (x * y - z * s) * r1 + 2 * (x * z + y * s) * r2
            R[1, column] = 2 * (x * y + z * s) * r0 + (1 - 2 * (x * x + z * z)) * r1 + 2 * (y * z - x * s) * r2
            R[2, column] = 2 * (x * z - y * s) * r0 + 2 * (y * z + x * s) * r1 + (1 - 2 * (x * x + y * y)) * r2
        if w[0] * w[0] + w[1] * w[1] + w[2] * w[2] < 1e-16:
            break
    for r in range(3):
        t[r] = centre_target[r] - (R[r, 0] * centre[0] + R[r, 1] * centre[1] + R[r, 2] * centre[2])
    return True


@njit(cache=True, nogil=True)
def settle(
    R: Float[np.ndarray, "h 3 3"],
    t: Float[np.ndarray, "h 3"],
    is_valid: Bool[np.ndarray, "h"],
    xyz: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "a 3"],
    axis: int,
    tolerance_mm: float,
) -> tuple[Float[np.ndarray, "h 3 3"], Float[np.ndarray, "h 3"], Int[np.ndarray, "h"], Float[np.ndarray, "h"]]:
    """Of each of h poses: the pose of all points that have a counterpart, how many these are, and their rms distance.

    Counterparts and pose are found in turn until the counterparts stay the same, five times at most. No count is left
    to poses whose counterparts are fewer than three or on one line. The targets come sorted along ``axis``.
    """
    h = len(R)
    R, t = R.copy(), t.copy()
    count = np.zeros(h, np.int64)
    rms = np.full(h, np.inf)
    matched, before = np.empty(len(xyz), np.int64), np.empty(len(xyz), np.int64)
    for i in range(h):
        if not is_valid[i]:
            continue
        found, error = counterparts(R[i], t[i], xyz, targets, axis, tolerance_mm, matched)
        for _ in range(5):
            if found < 3 or not _align(R[i], t[i], xyz, targets, matched):
                found = 0
                break
            before[:] = matched
            found, error = counterparts(R[i], t[i], xyz, targets, axis, tolerance_mm, matched)
            if (before == matched).all():
                break
        if found >= 3:
            count[i], rms[i] = found, error
    return R, t, count, rms


def warm_up() -> None:
    """Compiles every loop of this module."""
    triangle, side, hand = np.array([[0, 1, 2]]), np.array([[3.0, 4.0, 5.0]]), np.zeros(1, np.int64)
    described = triangle, side, side, hand
    match_sorted(*described, *described, 3.0, 0.0, 9)
    match_hashed(*described, *described, *hash_sides(side, 1.0), 1.0, 3.0, 0.0, 9)
    xyz, cov = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]), np.zeros((3, 3, 3))
    best, head, is_one = np.full((3, 3), -1), np.full(3, -1), np.ones(3, np.bool_)
    edges = head, np.zeros(6, np.int64), np.zeros(6, np.int64), np.zeros(6), np.array([1, 2, 3, 4, 5, -1])
    count_pairs(np.arange(3), xyz, np.arange(3), *edges, 0, best)
    rarest_pairs(triangle, head, edges[1], edges[2], edges[4])
    forget_targets(is_one, np.arange(3), *edges, -1, best)
    renew_nearest(xyz, is_one, is_one, best, np.zeros((3, 3)))
    vote(np.array([[0, 1]]), np.array([3.0]), np.array([1.0]), 2, xyz, cov, 0, 3.0, 0.0)
    settle(np.eye(3)[None], np.zeros((1, 3)), is_one[:1], xyz, xyz[[0, 2, 1]], 0, 1.0)
