"""The map's index: what lies where, and which targets form a triangle with given sides.

Kept beside the map and updated in step with it, never made anew: a target that comes, goes or moves costs the same
whether the map holds a hundred others or a million. Finds congruent triangles; does not know what they prove.
"""

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from trifix.kernels import index as kernels
from trifix.records import ReferenceMap, TargetState

_ALIVE = int(TargetState.trusted)  # states up to this one are indexed
_SAMPLE = 64  # targets from which the spacing is judged
_SPACING_RATIO = 1.5  # a spacing that is off by more is corrected
_SLACK_CELLS = 1 / 400  # of a cell's width: an eighth of a cell of sides, microns to tenths of a millimetre
_FLOAT32_STEP = 2.0**-22  # anchors must not leave their slack by rounding


class MapIndex:
    """The index of one reference map, empty until it follows one."""

    def __init__(self) -> None:
        self._store = kernels.new_store(0, 0, 1.0, 0.0)
        self._targets = 0
        self._triangles = 0
        self._scaled_for = 0  # targets when the scales and the tables' sizes were chosen
        self._widest_mm2 = 0.0  # no target's covariance has a larger trace
        self._version = 0

    def follow(self, map: ReferenceMap, rows: Int[np.ndarray, "r"] | None = None) -> None:
        """Brings the index up to date with the map; ``rows`` are the only ones that may have changed, if given."""
        self._make_room(len(map))
        store = self._store
        among = np.arange(len(store.id)) if rows is None else rows
        changed, widest = kernels.changed_rows(store, among, map.id, map.state, map.xyz_mm, map.cov_mm2, _ALIVE)
        self._widest_mm2 = widest if rows is None else max(self._widest_mm2, widest)
        if len(changed) == 0:
            return
        self._version += 1
        if 4 * len(changed) > self._targets:
            self._build(map)
            return
        self._targets, self._triangles = kernels.index_rows(
            store, changed, map.id, map.state, map.xyz_mm, _ALIVE, self._targets, self._triangles
        )
        if not self._scaled_for / 4 <= self._targets <= 2 * self._scaled_for:
            self._rescale(map)

    @property
    def grid(
        self,
    ) -> tuple[Int32[np.ndarray, "c"], Int32[np.ndarray, "cap"], Float32[np.ndarray, "cap 3"], float, float]:
        """Cells over the targets: first row of each bucket, next row in it, anchors (mm), cell width, slack (mm)."""
        store = self._store
        return store.cell_head, store.cell_next, store.anchor, store.cell_mm, store.slack_mm

    @property
    def neighbour(self) -> Int32[np.ndarray, "cap 8"]:
        """Rows of the eight nearest others of each target within four cells, nearest first; -1 where fewer."""
        return self._store.neighbour

    @property
    def targets(self) -> int:
        """Targets in the index."""
        return self._targets

    @property
    def triangles(self) -> int:
        """Triangles in the index."""
        return self._triangles

    @property
    def bytes(self) -> int:
        """Memory that the index takes."""
        return sum(part.nbytes for part in self._store if isinstance(part, np.ndarray))

    @property
    def version(self) -> int:
        """Grows whenever something is indexed anew."""
        return self._version

    def _make_room(self, rows: int) -> None:
        cap = len(self._store.id)
        if rows <= cap:
            return
        store = self._store
        grown = kernels.new_store(max(rows, cap + cap // 2), 0, store.cell_mm, store.slack_mm)
        for old, new in zip(store[:5], grown[:5], strict=True):  # what has an entry or several a row
            new[: len(old)] = old
        self._store = grown._replace(cell_head=store.cell_head, side_head=store.side_head)

    def _build(self, map: ReferenceMap) -> None:
        """Indexes everything anew, on scales that suit the map."""
        alive = np.flatnonzero(map.alive)
        cell_mm = _spacing_mm(map.xyz_mm, alive)
        rounding_mm = _FLOAT32_STEP * float(np.abs(map.xyz_mm[alive]).max(initial=0.0))
        slack_mm = max(cell_mm * _SLACK_CELLS, rounding_mm)
        self._store = kernels.new_store(len(self._store.id), len(alive), cell_mm, slack_mm)
        self._scaled_for = len(alive)
        self._targets, self._triangles = kernels.index_rows(
            self._store, alive, map.id, map.state, map.xyz_mm, _ALIVE, 0, 0
        )

    def _rescale(self, map: ReferenceMap) -> None:
        """Resizes the tables to the number of targets, and the cells where these have come to lie otherwise."""
        spacing_mm = _spacing_mm(map.xyz_mm, np.flatnonzero(map.alive))
        if not 1 / _SPACING_RATIO < spacing_mm / self._store.cell_mm < _SPACING_RATIO:
            self._build(map)
            return
        self._scaled_for = self._targets
        self._store = kernels.with_empty_tables(self._store, self._targets)
        kernels.link_all(self._store)


def _spacing_mm(xyz_mm: Float[np.ndarray, "k 3"], rows: Int[np.ndarray, "a"]) -> float:
    """The typical distance from a target to the third nearest; that of all where there are fewer."""
    if len(rows) < 4:
        apart = np.ptp(xyz_mm[rows], axis=0) if len(rows) else np.zeros(3)
        return float(np.linalg.norm(apart)) or 1.0
    sample = rows[:: -(-len(rows) // _SAMPLE)]
    return max(float(np.median(kernels.distances_to_third(xyz_mm, rows, sample))), 1e-3)
