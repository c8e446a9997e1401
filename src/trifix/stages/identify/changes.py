"""What lets a technique form anew only what a change touches: changed rows, neighbours, a set of triangles."""

import numpy as np
from jaxtyping import Bool, Int

from trifix.kernels import matching
from trifix.records import ReferenceMap


class Moved:
    """Tells which rows of the map have changed since it was last asked."""

    def __init__(self) -> None:
        self._xyz_mm = np.full((0, 3), np.nan)

    def since_last(self, map: ReferenceMap) -> Bool[np.ndarray, "k"]:
        """Rows whose target appeared, went or has another position."""
        old = np.pad(self._xyz_mm, ((0, len(map) - len(self._xyz_mm)), (0, 0)), constant_values=np.nan)
        new = np.where(map.alive[:, None], map.xyz_mm, np.nan)
        self._xyz_mm = new
        return np.asarray(~((old == new) | (np.isnan(old) & np.isnan(new))).all(axis=1))


class NearestThree:
    """The three nearest others of each living target, kept up to date as targets change."""

    def __init__(self) -> None:
        self.row = np.full((0, 3), -1)
        """(k, 3) their rows, nearest first; -1 where there are fewer."""
        self._distance2 = np.full((0, 3), np.inf)

    def renew(self, map: ReferenceMap, is_changed: Bool[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
        """Brings the neighbours up to date; returns the rows for which they were sought anew."""
        more = len(map) - len(self.row)
        self.row = np.pad(self.row, ((0, more), (0, 0)), constant_values=-1)
        self._distance2 = np.pad(self._distance2, ((0, more), (0, 0)), constant_values=np.inf)
        return np.asarray(matching.renew_nearest(map.xyz_mm, map.alive, is_changed, self.row, self._distance2))


class TriangleSet:
    """Distinct triangles, each contributed by one or more targets; what no target contributes any longer goes."""

    def __init__(self) -> None:
        self._slot: dict[tuple[int, ...], int] = {}
        self._uses: list[int] = []
        self._table = np.empty((64, 3), dtype=np.int64)

    def __len__(self) -> int:
        return len(self._uses)

    @property
    def table(self) -> Int[np.ndarray, "t 3"]:
        """Rows of the targets, ascending; the order of the triangles means nothing."""
        return self._table[: len(self._uses)]

    def replace(self, old: Int[np.ndarray, "m 3"], new: Int[np.ndarray, "n 3"]) -> list[int]:
        """Takes contributions back and adds others; negative rows stand for none. Returns the slots with new triangles.

        ``old`` must have been added before.
        """
        touched: set[int] = set()
        for triangle in np.sort(new, axis=1).tolist():
            if triangle[0] >= 0:
                self._add(tuple(triangle), touched)
        for triangle in np.sort(old, axis=1).tolist():
            if triangle[0] >= 0:
                self._take_back(tuple(triangle), touched)
        return sorted(slot for slot in touched if slot < len(self))

    def _add(self, triangle: tuple[int, ...], touched: set[int]) -> None:
        slot = self._slot.get(triangle)
        if slot is not None:
            self._uses[slot] += 1
            return
        slot = len(self._uses)
        if slot == len(self._table):
            self._table = np.concatenate([self._table, np.empty_like(self._table)])
        self._table[slot] = triangle
        self._slot[triangle] = slot
        self._uses.append(1)
        touched.add(slot)

    def _take_back(self, triangle: tuple[int, ...], touched: set[int]) -> None:
        slot = self._slot[triangle]
        self._uses[slot] -= 1
        if self._uses[slot]:
            return
        del self._slot[triangle]
        last = len(self._uses) - 1
        if slot < last:  # the last one fills the gap
            self._table[slot], self._uses[slot] = self._table[last], self._uses[last]
            self._slot[tuple(self._table[slot].tolist())] = slot
            touched.add(slot)
        self._uses.pop()
