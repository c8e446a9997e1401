"""Compiled loops of the map's index: a grid over the targets, their nearest neighbours, their local triangles.

Everything is kept under the targets' anchors: the places where they were when they were indexed last. Knows rows and
millimetres; when to index anew and what to do with what is found is decided by ``trifix.index``.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from numba import njit

NEIGHBOURS = 8
PAIRS = 28
"""Pairs of eight neighbours: the triangles that one target may own."""

_REACH_CELLS = 4  # neighbours are sought within so many cells
_SIDE_CELLS = 48.0  # cells of sides to one of space: few triangles in each, few cells to a look-up
_SLENDER = 0.15  # triangles whose altitude is a smaller part of their longest side are left out
_EDGE_ON_SINE = 0.34202014332566873  # sin 20°: nearer to edge-on the handedness of a triangle is not trusted
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
            side_mm=cell_mm / _SIDE_CELLS,
            slack_mm=slack_mm,
        ),
        targets,
    )


def with_empty_tables(store: Store, targets: int) -> Store:
    """The same rows with tables of a size for about so many targets, and nothing in them."""
    size = 1 << max(targets, 8).bit_length()
    return store._replace(cell_head=np.full(size, -1, dtype=np.int32), side_head=np.full(4 * size, -1, dtype=np.int32))


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
    return pa2 * pb2 - along * along >= (_SLENDER * ab2) ** 2  # |pa x pb|² = (altitude · |ab|)²


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
def distances_to_third(
    xyz: Float[np.ndarray, "k 3"], rows: Int[np.ndarray, "a"], sample: Int[np.ndarray, "s"]
) -> Float[np.ndarray, "s"]:
    """Distance from each row of ``sample`` to the third nearest other of ``rows``; infinite where there are fewer."""
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


def warm_up() -> None:
    """Compiles every loop of this module for the types that it meets in use."""
    xyz = np.array([[0.0, 0.0, 400.0], [40.0, 0.0, 410.0], [0.0, 60.0, 420.0], [50.0, 70.0, 400.0]])
    cov = np.tile(np.eye(3) * 0.01, (len(xyz), 1, 1))
    rows = np.arange(len(xyz))
    store = new_store(len(xyz), len(xyz), 50.0, 0.1)
    distances_to_third(xyz, rows, rows[::2])
    known = rows, rows, np.ones(len(xyz), dtype=np.int64), xyz
    changed_rows(store, *known, cov, 1)
    index_rows(store, *known, 1, 0, 0)
    link_all(with_empty_tables(store, len(xyz)))
