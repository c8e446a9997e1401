"""Compiled loops of the map's index: a grid over the targets, their nearest neighbours, their local triangles.

Everything is kept under the targets' anchors: the places where they were when they were indexed last. Knows rows and
millimetres; when to index anew and what to do with what is found is decided by ``trifix.index``.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from numba import njit

Pairs = tuple[Int[np.ndarray, "h 3"], Int[np.ndarray, "h 3"], Int[np.ndarray, "h"]]

NEIGHBOURS = 8
PAIRS = 28
"""Pairs of eight neighbours: the triangles that one target may own."""

_REACH_CELLS = 4  # neighbours are sought within so many cells
_SIDE_CELLS = 3.2  # cells of sides to one of space, times the cube root of the targets: a few triangles in each
_FEWEST_SIDE_CELLS, _MOST_SIDE_CELLS = 16.0, 128.0
_SLENDER = 0.15  # triangles whose altitude is a smaller part of their longest side are left out
_EDGE_ON_SINE = 0.34202014332566873  # sin 20°: nearer to edge-on the handedness of a triangle is not trusted
_ORDERS = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]])  # even ones first
_FIRST = np.array([i for i in range(NEIGHBOURS) for _ in range(i + 1, NEIGHBOURS)])
_SECOND = np.array([j for i in range(NEIGHBOURS) for j in range(i + 1, NEIGHBOURS)])
_DUE = -2  # in place of the nearest neighbour: this row's triangles are out of the table, its neighbours to be sought


class Store(NamedTuple):
    """The index's arrays and scales; ``cap`` is the number of rows there is room for."""

    id: Int[np.ndarray, "cap"]
    """Identity of the target that is indexed in this row; -1 for none."""
    anchor: Float32[np.ndarray, "cap 3"]
    """Where it was when it was indexed, world coordinates (mm)."""
    neighbour: Int32[np.ndarray, "cap 8"]
    """Rows of the nearest others within four cells, nearest first, the lower row first in a tie; -1 where fewer."""
    cell_next: Int32[np.ndarray, "cap"]
    """The next row in the same bucket of cells; -1 ends the chain."""
    side_next: Int32[np.ndarray, "cap*28"]
    """The next triangle in the same bucket of sides; -1 ends the chain."""
    cell_head: Int32[np.ndarray, "c"]
    """First row of each bucket of cells, a power of two of them."""
    side_head: Int32[np.ndarray, "s"]
    """First triangle of each bucket of sides, a power of two of them; triangle e is pair e mod 28 of row e // 28."""
    cell_mm: float
    """Width of the cells in space."""
    side_mm: float
    """Width of the cells in the space of three sorted sides."""
    slack_mm: float
    """A target farther than this from its anchor is indexed anew."""


def new_store(cap: int, targets: int, cell_mm: float, slack_mm: float) -> Store:
    """An empty index with room for ``cap`` rows and tables for about so many targets."""
    return with_empty_tables(
        Store(
            id=np.full(cap, -1, dtype=np.int64),
            anchor=np.zeros((cap, 3), dtype=np.float32),
            neighbour=np.full((cap, NEIGHBOURS), -1, dtype=np.int32),
            cell_next=np.full(cap, -1, dtype=np.int32),
            side_next=np.full(cap * PAIRS, -1, dtype=np.int32),
            cell_head=np.zeros(0, dtype=np.int32),
            side_head=np.zeros(0, dtype=np.int32),
            cell_mm=cell_mm,
            side_mm=cell_mm / _FEWEST_SIDE_CELLS,
            slack_mm=slack_mm,
        ),
        targets,
    )


def with_empty_tables(store: Store, targets: int) -> Store:
    """The same rows with tables of a size for about so many targets, and nothing in them."""
    size = 1 << max(targets, 8).bit_length()
    cells = min(max(_SIDE_CELLS * targets ** (1 / 3), _FEWEST_SIDE_CELLS), _MOST_SIDE_CELLS)
    return store._replace(
        cell_head=np.full(size, -1, dtype=np.int32),
        side_head=np.full(4 * size, -1, dtype=np.int32),
        side_mm=store.cell_mm / cells,
    )


# --- small parts -----------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _bucket(i, j, k, mask):
    return ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & mask


@njit(cache=True, nogil=True)
def _cell(store, p, axis):
    return int(np.floor(np.float64(store.anchor[p, axis]) / store.cell_mm))


@njit(cache=True, nogil=True)
def _cell_bucket(store, p):
    return _bucket(_cell(store, p, 0), _cell(store, p, 1), _cell(store, p, 2), len(store.cell_head) - 1)


@njit(cache=True, nogil=True)
def _distance2(anchor, p, q):
    x = np.float64(anchor[p, 0]) - np.float64(anchor[q, 0])
    y = np.float64(anchor[p, 1]) - np.float64(anchor[q, 1])
    z = np.float64(anchor[p, 2]) - np.float64(anchor[q, 2])
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def _is_owner(p, a, b, pa2, pb2, ab2):
    """Whether the triangle is p's: opposite the longest side, of several the lowest row; and no needle."""
    if not ((ab2 > pa2 or (ab2 == pa2 and p < b)) and (ab2 > pb2 or (ab2 == pb2 and p < a))):
        return False
    along = (pa2 + pb2 - ab2) / 2
    return pa2 * pb2 - along * along > (_SLENDER * ab2) ** 2  # |pa x pb|² = (altitude · |ab|)²


@njit(cache=True, nogil=True)
def _side_bucket(store, p, i, j):
    """Bucket of the triangle of row p with its i-th and j-th neighbours; -1 where p owns none."""
    a, b = store.neighbour[p, i], store.neighbour[p, j]
    pa2, pb2 = _distance2(store.anchor, p, a), _distance2(store.anchor, p, b)
    ab2 = _distance2(store.anchor, a, b)
    if not _is_owner(p, a, b, pa2, pb2, ab2):
        return -1
    return _bucket(
        int(np.floor(np.sqrt(min(pa2, pb2)) / store.side_mm)),
        int(np.floor(np.sqrt(max(pa2, pb2)) / store.side_mm)),
        int(np.floor(np.sqrt(ab2) / store.side_mm)),
        len(store.side_head) - 1,
    )


@njit(cache=True, nogil=True)
def _link_triangles(store, p):
    """Puts the triangles of row p into the table; returns how many."""
    count = 0
    code = -1
    for i in range(NEIGHBOURS):
        for j in range(i + 1, NEIGHBOURS):
            code += 1
            if store.neighbour[p, j] < 0:
                continue
            bucket = _side_bucket(store, p, i, j)
            if bucket >= 0:
                store.side_next[p * PAIRS + code] = store.side_head[bucket]
                store.side_head[bucket] = p * PAIRS + code
                count += 1
    return count


@njit(cache=True, nogil=True)
def _unlink_triangles(store, p):
    """Takes the triangles of row p out of the table and marks it as due; returns how many."""
    count = 0
    code = -1
    for i in range(NEIGHBOURS):
        for j in range(i + 1, NEIGHBOURS):
            code += 1
            if store.neighbour[p, j] < 0:
                continue
            bucket = _side_bucket(store, p, i, j)
            if bucket >= 0:
                _unlink(store.side_head, store.side_next, bucket, p * PAIRS + code)
                count += 1
    store.neighbour[p, 0] = _DUE
    return count


@njit(cache=True, nogil=True)
def _unlink(head, following, bucket, item):
    e = head[bucket]
    if e == item:
        head[bucket] = following[e]
        return
    while following[e] != item:
        e = following[e]
    following[e] = following[item]


@njit(cache=True, nogil=True)
def _link_cell(store, p):
    bucket = _cell_bucket(store, p)
    store.cell_next[p] = store.cell_head[bucket]
    store.cell_head[bucket] = p


# --- neighbours ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _around(store, x):
    """Rows of the other targets that may have row x for a neighbour: those within four cells."""
    found = np.empty(256, np.int64)
    count = 0
    mask = len(store.cell_head) - 1
    limit = (_REACH_CELLS * store.cell_mm) ** 2
    x0, x1, x2 = _cell(store, x, 0), _cell(store, x, 1), _cell(store, x, 2)
    for i in range(x0 - _REACH_CELLS, x0 + _REACH_CELLS + 1):
        for j in range(x1 - _REACH_CELLS, x1 + _REACH_CELLS + 1):
            for k in range(x2 - _REACH_CELLS, x2 + _REACH_CELLS + 1):
                q = store.cell_head[_bucket(i, j, k, mask)]
                while q >= 0:
                    if (
                        q != x
                        and _distance2(store.anchor, q, x) <= limit
                        and _cell(store, q, 0) == i
                        and _cell(store, q, 1) == j
                        and _cell(store, q, 2) == k
                    ):
                        if count == len(found):
                            more = np.empty(2 * count, np.int64)
                            more[:count] = found
                            found = more
                        found[count] = q
                        count += 1
                    q = store.cell_next[q]
    return found[:count]


@njit(cache=True, nogil=True)
def _seek_neighbours(store, p, distance2):
    """Fills the neighbours of row p, going outwards shell by shell of cells; ``distance2`` (8) is scratch."""
    mask = len(store.cell_head) - 1
    limit = (_REACH_CELLS * store.cell_mm) ** 2
    p0, p1, p2 = _cell(store, p, 0), _cell(store, p, 1), _cell(store, p, 2)
    margin = store.cell_mm  # from p to the nearest wall of its cell
    for axis in range(3):
        within = np.float64(store.anchor[p, axis]) - _cell(store, p, axis) * store.cell_mm
        margin = min(margin, within, store.cell_mm - within)
    held = 0
    store.neighbour[p] = -1
    for shell in range(_REACH_CELLS + 1):
        for i in range(p0 - shell, p0 + shell + 1):
            for j in range(p1 - shell, p1 + shell + 1):
                is_side = abs(i - p0) == shell or abs(j - p1) == shell
                for k in range(p2 - shell, p2 + shell + 1, 1 if is_side or shell == 0 else 2 * shell):
                    q = store.cell_head[_bucket(i, j, k, mask)]
                    while q >= 0:
                        d = _distance2(store.anchor, p, q)
                        if (
                            d <= limit
                            and q != p
                            and (
                                held < NEIGHBOURS
                                or d < distance2[NEIGHBOURS - 1]
                                or (d == distance2[NEIGHBOURS - 1] and q < store.neighbour[p, NEIGHBOURS - 1])
                            )
                            and _cell(store, q, 0) == i
                            and _cell(store, q, 1) == j
                            and _cell(store, q, 2) == k
                        ):
                            rank = held if held < NEIGHBOURS else NEIGHBOURS - 1
                            while rank > 0 and (
                                distance2[rank - 1] > d
                                or (distance2[rank - 1] == d and store.neighbour[p, rank - 1] > q)
                            ):
                                distance2[rank] = distance2[rank - 1]
                                store.neighbour[p, rank] = store.neighbour[p, rank - 1]
                                rank -= 1
                            distance2[rank] = d
                            store.neighbour[p, rank] = q
                            held = min(held + 1, NEIGHBOURS)
                        q = store.cell_next[q]
        # whatever is nearer than this has been met
        if held == NEIGHBOURS and distance2[NEIGHBOURS - 1] < (shell * store.cell_mm + margin) ** 2:
            break


# --- following the map -----------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def changed_rows(
    store: Store,
    among: Int[np.ndarray, "r"],
    id: Int[np.ndarray, "k"],
    state: Int[np.ndarray, "k"],
    xyz: Float[np.ndarray, "k 3"],
    cov: Float[np.ndarray, "k 3 3"],
    last_alive: int,
) -> tuple[Int[np.ndarray, "c"], float]:
    """Rows of ``among`` that are not indexed as they are, and the largest trace of a covariance in it (mm²)."""
    changed = np.empty(len(among), np.int64)
    count = 0
    widest = 0.0
    limit = store.slack_mm**2
    for r in among:
        if r < len(id) and state[r] <= last_alive:
            widest = max(widest, cov[r, 0, 0] + cov[r, 1, 1] + cov[r, 2, 2])
            x, y, z = xyz[r, 0] - store.anchor[r, 0], xyz[r, 1] - store.anchor[r, 1], xyz[r, 2] - store.anchor[r, 2]
            is_changed = store.id[r] != id[r] or x * x + y * y + z * z > limit
        else:
            is_changed = store.id[r] >= 0
        if is_changed:
            changed[count] = r
            count += 1
    return changed[:count], widest


@njit(cache=True, nogil=True)
def index_rows(
    store: Store,
    rows: Int[np.ndarray, "r"],
    id: Int[np.ndarray, "k"],
    state: Int[np.ndarray, "k"],
    xyz: Float[np.ndarray, "k 3"],
    last_alive: int,
    targets: int,
    triangles: int,
) -> tuple[int, int]:
    """Indexes rows anew, or takes them out; returns the numbers of targets and triangles, which are given as they were.

    Neighbours and triangles of a row depend on its own anchor and on those that it lists. So the rows touched are the
    given ones, those that list one of them, and those that will: their triangles leave the table while their anchors
    are still the old ones, and are formed again in the end.
    """
    due = [np.int64(r) for r in range(0)]
    for x in rows:
        if store.id[x] < 0:
            continue
        for p in _around(store, x):
            if store.neighbour[p, 0] == _DUE:
                continue
            for rank in range(NEIGHBOURS):
                if store.neighbour[p, rank] == x:
                    triangles -= _unlink_triangles(store, p)
                    due.append(p)
                    break
        if store.neighbour[x, 0] != _DUE:
            triangles -= _unlink_triangles(store, x)
        _unlink(store.cell_head, store.cell_next, _cell_bucket(store, x), x)
        store.id[x] = -1
        targets -= 1
    coming = 0
    for x in rows:
        if store.id[x] >= 0:
            continue
        store.neighbour[x] = -1
        if x >= len(id) or state[x] > last_alive:
            continue
        store.id[x] = id[x]
        for axis in range(3):
            store.anchor[x, axis] = xyz[x, axis]
        _link_cell(store, x)
        store.neighbour[x, 0] = _DUE
        due.append(x)
        coming += 1
    targets += coming
    if coming < targets:  # otherwise all are due already
        for x in rows:
            if store.id[x] < 0:
                continue
            for p in _around(store, x):
                if store.neighbour[p, 0] == _DUE:
                    continue
                last = store.neighbour[p, NEIGHBOURS - 1]
                enters = last < 0
                if not enters:
                    d, d_last = _distance2(store.anchor, p, x), _distance2(store.anchor, p, last)
                    enters = d < d_last or (d == d_last and x < last)
                if enters:
                    triangles -= _unlink_triangles(store, p)
                    due.append(p)
    distance2 = np.empty(NEIGHBOURS)
    for p in due:
        if store.id[p] >= 0 and store.neighbour[p, 0] == _DUE:
            _seek_neighbours(store, p, distance2)
            triangles += _link_triangles(store, p)
    return targets, triangles


@njit(cache=True, nogil=True)
def link_all(store: Store) -> None:
    """Fills empty tables of cells and sides with all that is indexed."""
    for p in range(len(store.id)):
        if store.id[p] >= 0:
            _link_cell(store, p)
            _link_triangles(store, p)


@njit(cache=True, nogil=True)
def distances_to_third(xyz: Float[np.ndarray, "k 3"], rows: Int[np.ndarray, "a"], every: int) -> Float[np.ndarray, "s"]:
    """Distance from one of ``every`` so many rows to the third nearest other; infinite where there are fewer."""
    sample = rows[::every]
    out = np.empty(len(sample))
    for n in range(len(sample)):
        p = sample[n]
        first = second = third = np.inf
        for q in rows:
            if q == p:
                continue
            d = (xyz[p, 0] - xyz[q, 0]) ** 2 + (xyz[p, 1] - xyz[q, 1]) ** 2 + (xyz[p, 2] - xyz[q, 2]) ** 2
            if d < third:
                third = d
                if third < second:
                    second, third = third, second
                    if second < first:
                        first, second = second, first
        out[n] = np.sqrt(third)
    return out


# --- congruence ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _measure(xyz, cov, a, b, c, length, var):
    """Fills the sides opposite to a, b and c and their variances uᵀ (C + C') u."""
    for v in range(3):
        p, q = (b, c) if v == 0 else ((c, a) if v == 1 else (a, b))
        x, y, z = xyz[q, 0] - xyz[p, 0], xyz[q, 1] - xyz[p, 1], xyz[q, 2] - xyz[p, 2]
        d2 = x * x + y * y + z * z
        length[v] = np.sqrt(d2)
        var[v] = 0.0
        if d2 > 0:
            P, Q = cov[p], cov[q]
            var[v] = (
                x * x * (P[0, 0] + Q[0, 0])
                + y * y * (P[1, 1] + Q[1, 1])
                + z * z * (P[2, 2] + Q[2, 2])
                + 2 * (x * y * (P[0, 1] + Q[0, 1]) + x * z * (P[0, 2] + Q[0, 2]) + y * z * (P[1, 2] + Q[1, 2]))
            ) / d2


@njit(cache=True, nogil=True)
def _handedness(xyz, towards, sign, a, b, c):
    """Sign of the normal of (a, b, c) against the mean direction to the sensor; 0 where unknown or nearly edge-on."""
    e0, e1, e2 = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
    f0, f1, f2 = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
    n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    t0 = sign * (towards[a, 0] + towards[b, 0] + towards[c, 0])
    t1 = sign * (towards[a, 1] + towards[b, 1] + towards[c, 1])
    t2 = sign * (towards[a, 2] + towards[b, 2] + towards[c, 2])
    value = n0 * t0 + n1 * t1 + n2 * t2
    size2 = (n0 * n0 + n1 * n1 + n2 * n2) * (t0 * t0 + t1 * t1 + t2 * t2)
    if value * value > _EDGE_ON_SINE**2 * size2:  # False where a direction is NaN, too
        return 1 if value > 0 else -1
    return 0


@njit(cache=True, nogil=True)
def _agree(length, var, map_length, map_var, order, sigmas, floor_mm):
    """Whether all three sides agree when vertex v of the one triangle is vertex ``order[v]`` of the other."""
    for v in range(3):
        w = order[v]
        if abs(length[v] - map_length[w]) > floor_mm + sigmas * np.sqrt(var[v] + map_var[w]):
            return False
    return True


@njit(cache=True, nogil=True)
def _append(found, count, p, q, order, row):
    """Adds a pair of triangles to the table of (three points, three targets, row), growing it where it is full."""
    if count == len(found):
        more = np.empty((2 * count, 7), np.int64)
        more[:count] = found
        found = more
    for v in range(3):
        found[count, v] = p[v]
        found[count, 3 + v] = q[order[v]]
    found[count, 6] = row
    return found


@njit(cache=True, nogil=True)
def _columns(found):
    return found[:, :3].copy(), found[:, 3:6].copy(), found[:, 6].copy()


@njit(cache=True, nogil=True)
def _typical_variance(store, cov):
    """The variance of a side between two typical targets of the map, from a sample of them."""
    total, count = 0.0, 0
    for r in range(0, len(store.id), len(store.id) // 64 + 1):
        if store.id[r] >= 0:
            total += cov[r, 0, 0] + cov[r, 1, 1] + cov[r, 2, 2]
            count += 1
    return 2 / 3 * total / max(count, 1)


@njit(cache=True, nogil=True)
def largest_usual_trace(store, cov):
    """Sixteen times the median trace of the targets' covariances (mm²), from a sample of them."""
    trace = np.empty(65)
    count = 0
    for r in range(0, len(store.id), len(store.id) // 64 + 1):
        if store.id[r] >= 0:
            trace[count] = cov[r, 0, 0] + cov[r, 1, 1] + cov[r, 2, 2]
            count += 1
    return 16 * np.median(trace[:count]) if count else 0.0


# --- local triangles -------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def match_local(
    store: Store,
    triangles: Int[np.ndarray, "t 3"],
    xyz: Float[np.ndarray, "n 3"],
    cov: Float[np.ndarray, "n 3 3"],
    map_xyz: Float[np.ndarray, "k 3"],
    map_cov: Float[np.ndarray, "k 3 3"],
    map_view: Float[np.ndarray, "k 3"],
    widest: float,
    sigmas: float,
    floor_mm: float,
    limit: int,
) -> tuple[Pairs, int, float]:
    """Pairs of a frame's triangles with congruent ones of the table: points, targets, row of the frame's triangle.

    Ends after the triangle at which ``limit`` pairs are reached. Returns also how many were looked up, and how many
    pairs chance would have brought: as many as the tolerances' share of the side space that was visited, and of the
    triangles met there.
    """
    found = np.empty((64, 7), np.int64)
    count = tried = 0
    by_chance = 0.0
    typical = _typical_variance(store, map_cov)
    length, var, side, map_length, map_var = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    q = np.empty(3, np.int64)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    buckets = len(store.side_head)
    for f in range(len(triangles)):
        if count >= limit:
            break
        tried += 1
        p = triangles[f]
        _measure(xyz, cov, p[0], p[1], p[2], length, var)
        hand = _handedness(xyz, xyz, -1, p[0], p[1], p[2])
        side[0], side[2] = min(length[0], length[1], length[2]), max(length[0], length[1], length[2])
        side[1] = length[0] + length[1] + length[2] - side[0] - side[2]
        # in ascending order sides pair best, whichever vertices they pair
        reach = floor_mm + sigmas * np.sqrt(max(var[0], var[1], var[2]) + 2 * widest) + 2 * store.slack_mm
        box = 1.0
        visits = 1
        for s in range(3):
            low[s] = int(np.floor((side[s] - reach) / store.side_mm))
            high[s] = int(np.floor((side[s] + reach) / store.side_mm))
            visits *= high[s] - low[s] + 1
            box *= 2 * (floor_mm + sigmas * np.sqrt(var[s] + typical)) / store.side_mm
        is_sweep = visits > buckets  # so vague a triangle is compared with all
        cells = visits if is_sweep else 0
        met = 0
        for n in range(buckets if is_sweep else visits):
            bucket = n
            i = j = k = 0
            if not is_sweep:
                across, deep = high[1] - low[1] + 1, high[2] - low[2] + 1
                i, j, k = low[0] + n // (across * deep), low[1] + n // deep % across, low[2] + n % deep
                if i > j or j > k or k > i + j + 1:  # no triangle has such sides
                    continue
                cells += 1
                bucket = _bucket(i, j, k, buckets - 1)
            e = store.side_head[bucket]
            while e >= 0:
                c = e // PAIRS
                code = e - c * PAIRS
                e = store.side_next[e]
                a, b = store.neighbour[c, _FIRST[code]], store.neighbour[c, _SECOND[code]]
                s0, s1 = np.sqrt(_distance2(store.anchor, c, a)), np.sqrt(_distance2(store.anchor, c, b))
                s0, s1 = min(s0, s1), max(s0, s1)
                s2 = np.sqrt(_distance2(store.anchor, a, b))
                u, v, w = (
                    int(np.floor(s0 / store.side_mm)),
                    int(np.floor(s1 / store.side_mm)),
                    int(np.floor(s2 / store.side_mm)),
                )
                if is_sweep:
                    if not (low[0] <= u <= high[0] and low[1] <= v <= high[1] and low[2] <= w <= high[2]):
                        continue
                elif u != i or v != j or w != k:
                    continue
                met += 1
                if abs(s0 - side[0]) > reach or abs(s1 - side[1]) > reach or abs(s2 - side[2]) > reach:
                    continue
                q[0], q[1], q[2] = a, b, c
                _measure(map_xyz, map_cov, a, b, c, map_length, map_var)
                map_hand = 2  # not known yet
                for o in range(6):
                    if not _agree(length, var, map_length, map_var, _ORDERS[o], sigmas, floor_mm):
                        continue
                    if map_hand == 2:
                        map_hand = _handedness(map_xyz, map_view, 1, a, b, c)
                    if hand * map_hand * (1 if o < 3 else -1) >= 0:  # an exchange turns the normal over
                        found = _append(found, count, p, q, _ORDERS[o], f)
                        count += 1
        if cells > 0:
            by_chance += met * min(box / cells, 1.0)
    return _columns(found[:count]), tried, by_chance


# --- any three targets -----------------------------------------------------------------------------------------------


class PairTable(NamedTuple):
    """Pairs of targets by the distance of their anchors, in steps of ``step_mm``, and each target's partners."""

    start: Int[np.ndarray, "b"]
    """Where the pairs of each step begin."""
    pair: Int32[np.ndarray, "m 2"]
    """Rows of the pairs."""
    first_partner: Int[np.ndarray, "cap+1"]
    """Where the partners of each row begin."""
    partner: Int32[np.ndarray, "2m"]
    """Rows of the partners, nearest step first."""
    step: Int32[np.ndarray, "2m"]
    """The step of each."""
    step_mm: float
    """Width of a step."""


@njit(cache=True, nogil=True)
def count_pairs(
    anchor: Float32[np.ndarray, "cap 3"], rows: Int[np.ndarray, "r"], axis: int, steps: int, step_mm: float, limit: int
) -> tuple[Int[np.ndarray, "b"], int]:
    """Where the pairs of each step begin, for rows sorted along an axis; and comparisons, given up at ``limit``."""
    start = np.zeros(steps + 1, np.int64)
    reach = steps * step_mm
    compared = 0
    for m in range(len(rows)):
        for n in range(m + 1, len(rows)):
            if anchor[rows[n], axis] - anchor[rows[m], axis] > reach:
                break
            compared += 1
            step = int(np.sqrt(_distance2(anchor, rows[m], rows[n])) / step_mm)
            if step < steps:
                start[step + 1] += 1
        if compared > limit:
            break
    for b in range(steps):
        start[b + 1] += start[b]
    return start, compared


@njit(cache=True, nogil=True)
def list_pairs(
    anchor: Float32[np.ndarray, "cap 3"],
    rows: Int[np.ndarray, "r"],
    axis: int,
    start: Int[np.ndarray, "b"],
    step_mm: float,
) -> PairTable:
    """The table of the pairs that ``count_pairs`` counted."""
    steps = len(start) - 1
    reach = steps * step_mm
    pair = np.empty((start[steps], 2), np.int32)
    place = start[:-1].copy()
    first = np.zeros(len(anchor) + 1, np.int64)
    for m in range(len(rows)):
        for n in range(m + 1, len(rows)):
            if anchor[rows[n], axis] - anchor[rows[m], axis] > reach:
                break
            step = int(np.sqrt(_distance2(anchor, rows[m], rows[n])) / step_mm)
            if step < steps:
                pair[place[step], 0], pair[place[step], 1] = rows[m], rows[n]
                place[step] += 1
                first[rows[m] + 1] += 1
                first[rows[n] + 1] += 1
    for r in range(len(anchor)):
        first[r + 1] += first[r]
    partner, step_of = np.empty(2 * len(pair), np.int32), np.empty(2 * len(pair), np.int32)
    free = first[:-1].copy()
    for step in range(steps):
        for m in range(start[step], start[step + 1]):
            for end in range(2):
                r = pair[m, end]
                partner[free[r]], step_of[free[r]] = pair[m, 1 - end], step
                free[r] += 1
    return PairTable(start, pair, first, partner, step_of, step_mm)


@njit(cache=True, nogil=True)
def match_any(
    store: Store,
    table: PairTable,
    triangles: Int[np.ndarray, "t 3"],
    xyz: Float[np.ndarray, "n 3"],
    cov: Float[np.ndarray, "n 3 3"],
    map_xyz: Float[np.ndarray, "k 3"],
    map_cov: Float[np.ndarray, "k 3 3"],
    map_view: Float[np.ndarray, "k 3"],
    widest: float,
    sigmas: float,
    floor_mm: float,
    limit: int,
    max_comparisons: int,
) -> tuple[Pairs, int, float, bool]:
    """The pairs of ``match_local`` with any three targets; and whether ``max_comparisons`` ended the search.

    The frame's longest side is laid on every pair of targets that is as long, both ways round; third targets are
    among the partners of its one end.
    """
    found = np.empty((64, 7), np.int64)
    count = tried = compared = 0
    by_chance = 0.0
    is_cut = False
    typical = _typical_variance(store, map_cov)
    length, var, map_length, map_var = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    p, q = np.empty(3, np.int64), np.empty(3, np.int64)
    steps = len(table.start) - 1
    for f in range(len(triangles)):
        if count >= limit or is_cut:
            break
        tried += 1
        p[:] = triangles[f]
        _measure(xyz, cov, p[0], p[1], p[2], length, var)
        last = np.argmax(length)  # p[2] is to lie opposite the longest side
        p[last], p[2] = p[2], p[last]
        _measure(xyz, cov, p[0], p[1], p[2], length, var)
        hand = _handedness(xyz, xyz, -1, p[0], p[1], p[2])
        reach = floor_mm + sigmas * np.sqrt(max(var[0], var[1], var[2]) + 2 * widest) + 2 * store.slack_mm
        wide = 4 * reach  # chance is judged from third sides that miss by up to so much
        low, high = max(int((length[2] - reach) / table.step_mm), 0), int((length[2] + reach) / table.step_mm)
        low1, high1 = max(int((length[1] - reach) / table.step_mm), 0), int((length[1] + reach) / table.step_mm)
        if low >= steps:  # no two targets are so far apart
            continue
        high, high1 = min(high, steps - 1), min(high1, steps - 1)
        met = 0
        for m in range(table.start[low], table.start[high + 1]):
            for end in range(2):
                a, b = table.pair[m, end], table.pair[m, 1 - end]
                begin, stop = table.first_partner[a], table.first_partner[a + 1]
                n = begin + np.searchsorted(table.step[begin:stop], low1)
                compared += 1
                while n < stop and table.step[n] <= high1:
                    c = table.partner[n]
                    n += 1
                    compared += 1
                    miss = abs(np.sqrt(_distance2(store.anchor, b, c)) - length[0])
                    if miss > wide or c == b:
                        continue
                    met += 1
                    if miss > reach:
                        continue
                    q[0], q[1], q[2] = a, b, c
                    _measure(map_xyz, map_cov, a, b, c, map_length, map_var)
                    if (
                        _agree(length, var, map_length, map_var, _ORDERS[0], sigmas, floor_mm)
                        and hand * _handedness(map_xyz, map_view, 1, a, b, c) >= 0
                    ):
                        found = _append(found, count, p, q, _ORDERS[0], f)
                        count += 1
            if compared > max_comparisons:
                is_cut = True
                break
        volume = (high - low + 1) * (high1 - low1 + 1) * table.step_mm**2 * (wide + min(wide, length[0]))
        box = 1.0
        for s in range(3):
            box *= 2 * (floor_mm + sigmas * np.sqrt(var[s] + typical))
        by_chance += met * min(box / volume, 1.0)
    return _columns(found[:count]), tried, by_chance, is_cut


# --- triangles of a frame --------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def frame_triangles(
    xyz: Float[np.ndarray, "n 3"], cov: Float[np.ndarray, "n 3 3"], neighbours: int
) -> tuple[Int[np.ndarray, "t 3"], Float[np.ndarray, "t"]]:
    """Triangles as the table holds them, of points and their nearest others; and their place in a fair order of trial.

    That is the rank of the farther neighbour, as few points can have come between, or be missing in the map, where
    neighbours are near; and after the decimal point the standard deviations of the sides against their length.
    """
    n = len(xyz)
    k = max(min(neighbours, n - 1), 0)
    triangles = np.empty((n * k * (k - 1) // 2, 3), np.int64)
    place = np.empty(len(triangles))
    count = 0
    near, distance2 = np.empty(k, np.int64), np.empty(k)
    length, var = np.empty(3), np.empty(3)
    for p in range(n):
        held = 0
        for q in range(n):
            d = (xyz[p, 0] - xyz[q, 0]) ** 2 + (xyz[p, 1] - xyz[q, 1]) ** 2 + (xyz[p, 2] - xyz[q, 2]) ** 2
            if q == p or (held == k and d >= distance2[k - 1]):
                continue
            rank = held if held < k else k - 1
            while rank > 0 and distance2[rank - 1] > d:
                distance2[rank], near[rank] = distance2[rank - 1], near[rank - 1]
                rank -= 1
            distance2[rank], near[rank] = d, q
            held = min(held + 1, k)
        for i in range(k):
            for j in range(i + 1, k):
                a, b = near[i], near[j]
                ab2 = (xyz[a, 0] - xyz[b, 0]) ** 2 + (xyz[a, 1] - xyz[b, 1]) ** 2 + (xyz[a, 2] - xyz[b, 2]) ** 2
                if not _is_owner(p, a, b, distance2[i], distance2[j], ab2):
                    continue
                _measure(xyz, cov, p, a, b, length, var)
                triangles[count, 0], triangles[count, 1], triangles[count, 2] = p, a, b
                vague = np.sqrt(var[0] * var[1] * var[2]) / length[0] ** 3
                place[count] = j + vague / (1 + vague)
                count += 1
    return triangles[:count], place[:count]


@njit(cache=True, nogil=True)
def turns(triangles: Int[np.ndarray, "t 3"], points: int) -> Int[np.ndarray, "t"]:
    """The round in which each triangle has its turn when no point takes part twice in a round."""
    out = np.empty(len(triangles), np.int64)
    rounds = np.zeros(points, np.int64)
    for f in range(len(triangles)):
        p, a, b = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        out[f] = max(rounds[p], rounds[a], rounds[b])
        rounds[p] = rounds[a] = rounds[b] = out[f] + 1
    return out


@njit(cache=True, nogil=True)
def all_triangles(store):
    """Rows of the targets of every triangle in the index."""
    out = np.empty((len(store.id) * PAIRS, 3), np.int64)
    count = 0
    for p in range(len(store.id)):
        if store.id[p] < 0:
            continue
        for i in range(NEIGHBOURS):
            for j in range(i + 1, NEIGHBOURS):
                if store.neighbour[p, j] >= 0 and _side_bucket(store, p, i, j) >= 0:
                    out[count, 0], out[count, 1], out[count, 2] = p, store.neighbour[p, i], store.neighbour[p, j]
                    count += 1
    return out[:count]


# --- evidence --------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def smallest_variance(cov):
    """No point's variance along any axis is smaller (mm²): λ₁λ₂ ≤ (trace / 2)², so λ₃ ≥ det / (trace / 2)²."""
    least = np.inf
    for n in range(len(cov)):
        a, b, c, d, e, f = cov[n, 0, 0], cov[n, 0, 1], cov[n, 0, 2], cov[n, 1, 1], cov[n, 1, 2], cov[n, 2, 2]
        det = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
        half = 0.5 * (a + d + f)
        if half > 0:
            least = min(least, det / (half * half))
    return least


@njit(cache=True, nogil=True)
def largest_evidence(store, xyz, variance):
    """ln of the largest √det(I + Σ / σ²) / (m / 2) of any target, Σ the mean square offsets of its m ≤ 5 nearest."""
    most = np.log(2.0)
    for p in range(len(store.id)):
        if store.id[p] < 0:
            continue
        a = b = c = d = e = f = 0.0
        m = 0
        while m < 5 and store.neighbour[p, m] >= 0:
            q = store.neighbour[p, m]
            x, y, z = xyz[q, 0] - xyz[p, 0], xyz[q, 1] - xyz[p, 1], xyz[q, 2] - xyz[p, 2]
            a, b, c, d, e, f = a + x * x, b + x * y, c + x * z, d + y * y, e + y * z, f + z * z
            m += 1
        if m == 0:
            m = 1
            a = d = f = 16 * store.cell_mm**2
        g = 1.0 / (m * variance)
        a, b, c, d, e, f = 1 + a * g, b * g, c * g, 1 + d * g, e * g, 1 + f * g
        det = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
        most = max(most, 0.5 * np.log(det) - np.log(0.5 * m))
    return most


def warm_up() -> None:
    """Compiles every loop of this module for the types that it meets in use."""
    xyz = np.array([[0.0, 0.0, 400.0], [40.0, 0.0, 410.0], [0.0, 60.0, 420.0], [50.0, 70.0, 400.0]])
    cov = np.tile(np.eye(3) * 0.01, (len(xyz), 1, 1))
    rows = np.arange(len(xyz))
    store = new_store(len(xyz), len(xyz), 50.0, 0.1)
    distances_to_third(xyz, rows, 2)
    known = rows, rows, np.ones(len(xyz), dtype=np.int64), xyz
    changed_rows(store, *known, cov, 1)
    index_rows(store, *known, 1, 0, 0)
    link_all(with_empty_tables(store, len(xyz)))
    view = np.tile([0.0, 0.0, -1.0], (len(xyz), 1))
    frame, _ = frame_triangles(xyz, cov, 3)
    turns(frame, len(xyz))
    scene = (frame, xyz, cov, xyz, cov, view, 0.01, 3.0, 0.0, 9)
    match_local(store, *scene)
    largest_usual_trace(store, cov)
    all_triangles(store)
    largest_evidence(store, xyz, smallest_variance(cov))
    start, _ = count_pairs(store.anchor, rows, 0, 100, 1.0, 9)
    match_any(store, list_pairs(store.anchor, rows, 0, start, 1.0), *scene, 99)
