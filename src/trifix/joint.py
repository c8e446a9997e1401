"""What the errors of a map's targets have in common: the covariance of all of them at once, and poses by it.

A filter in the sense of Smith, Self and Cheeseman (1990) on the targets alone: each frame's pose is unknown before it
and eliminated after it. The targets seen last are held exactly. Those that have not been seen for longest are put away
together, as a place of which only shift and turn stay correlated with the rest; what they lose of their correlations is
paid for, so that no covariance becomes too small by it: covariances of the place and of the rest grow as much as
whatever those correlations were could demand.

Lives beside the map and moves its targets; world coordinates are exact by definition of the first frame, or as the
given map has them. Knows no image and no matching.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from trifix.geometry.pose import Pose
from trifix.kernels import floats, integers
from trifix.kernels import joint as kernels
from trifix.records import Fix, ReferenceMap, SensorPoints, TargetState

_ALIVE = _TRUSTED = int(TargetState.trusted)  # states up to this one are known here
_HOLDING = 6  # trusted targets that hold a pose without the others
_GROUP = 16  # targets that are put away together
_DEAR = 4.0  # β: what is put away pays so many times as much for lost correlations as what stays
_RIDGE_MM2 = 1e-9  # so well is nothing known that is put away
_FEWEST = 3  # blocks that hold a shift and a turn
_NOBODY, _PLACE = -1, -2


class JointMap:
    """The joint covariance of one map's targets."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._P = np.zeros((0, 0))
        self._row = np.zeros(0, dtype=np.int64)
        """Row of the target of each block, or _PLACE, or _NOBODY."""
        self._id = np.zeros(0, dtype=np.int64)
        """Identity of each row's target as it is known here; -1 where it is not."""
        self._block = np.zeros(0, dtype=np.int64)
        """Block of each row's target; -1 where it is put away."""
        self._place = np.zeros(0, dtype=np.int64)
        """Place with which each row's target was put away; -1 where it is held, or is apart from all others."""
        self._own = np.zeros((0, 3, 3))
        """Covariance of each target that is put away, given its place's error (mm²)."""
        self._xyz = np.zeros((0, 3))
        """Where each target was left (mm)."""
        self._seen = np.zeros(0, dtype=np.int64)
        """When each target was last seen, in frames learnt from."""
        self._frames = 0
        self._shift = np.zeros(0, dtype=np.int64)
        """First block of each place; -1 where there is none any more."""
        self._turn = np.zeros(0, dtype=np.int64)
        """Its second block."""
        self._centre = np.zeros((0, 3))
        """What the place turns about (mm)."""

    def settle(self, map: ReferenceMap, points: SensorPoints, fix: Fix) -> tuple[Pose, Float[np.ndarray, "6 6"]]:
        """The pose of a fix by all that its targets' errors have in common, and its covariance in world coordinates.

        As in verification, targets that are not trusted yet have no say where enough others hold the pose. Where the
        motion carries it, the pose stays, and what its targets share is added to its covariance.
        """
        self.follow(map)
        seen = self._seen_of(points, fix)
        if len(fix.point) < _FEWEST or len(seen) < _FEWEST:
            return fix.T_world_sensor, fix.cov + self._shared(map, fix.T_world_sensor, np.unique(seen.target))
        trusted = np.flatnonzero(map.state[seen.target] == _TRUSTED)
        if len(trusted) >= _HOLDING:
            seen = seen.rows(trusted)
        P, blocks = self._P, self._block[seen.target]
        if (blocks < 0).any():  # as if they were held, but nobody makes room for them
            P, blocks = self.covariance(seen.target), np.arange(len(seen))
        delta, cov, _, _ = self._condition(map, fix.T_world_sensor, seen, P, blocks, 0)
        return fix.T_world_sensor @ Pose.exp(delta), cov

    def learn(self, map: ReferenceMap, points: SensorPoints, fix: Fix) -> "Knowledge":
        """Moves the targets by what a fix tells of them, and returns the pose with what its error owes to theirs."""
        self.follow(map)
        self._frames += 1
        seen = self._seen_of(points, fix)
        if len(fix.point) < _FEWEST or len(seen) < _FEWEST:
            return Knowledge(fix.T_world_sensor, fix.cov, np.zeros((6, len(self._P))))
        self._seen[seen.target] = self._frames
        self._make_room(seen.target)
        self._recall(seen.target)
        blocks = self._block[seen.target]
        delta, cov, cross, shift = self._condition(map, fix.T_world_sensor, seen, self._P, blocks, self._used)
        self._move(map, shift)
        return Knowledge(
            fix.T_world_sensor @ Pose.exp(delta), cov, np.pad(cross, ((0, 0), (0, len(self._P) - self._used)))
        )

    def enter(
        self,
        map: ReferenceMap,
        points: SensorPoints,
        point: Int[np.ndarray, "a"],
        rows: Int[np.ndarray, "a"],
        known: "Knowledge",
    ) -> None:
        """Targets that have come into the map with a frame: these points became these rows."""
        self.follow(map)
        T = known.T_world_sensor
        noise = T.R @ points.cov_mm2[point] @ T.R.T
        H = kernels.pose_fields(floats(map.xyz_mm[rows]), floats(T.R), floats(T.t_mm)).reshape(-1, 3, 6)
        self._id[rows], self._xyz[rows], self._seen[rows] = map.id[rows], map.xyz_mm[rows], self._frames
        for k, row in enumerate(rows.tolist()):
            b = self._take(row)
            known.cross = np.pad(known.cross, ((0, 0), (0, len(self._P) - known.cross.shape[1])))
            kernels.enter_block(self._P, self._used, b, H[k], known.cov, known.cross, noise[k])
            self._block[row] = b

    def adopt(self, map: ReferenceMap, rows: Int[np.ndarray, "a"]) -> None:
        """Targets whose errors have nothing to do with those of others, as the map states them."""
        self._grow(len(map))
        self._id[rows], self._xyz[rows], self._own[rows] = map.id[rows], map.xyz_mm[rows], map.cov_mm2[rows]
        self._block[rows], self._place[rows] = _NOBODY, _NOBODY

    def covariance(self, rows: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r3 r3"]:
        """Covariance of the errors of some targets in world coordinates (mm²), be they held or put away."""
        J, blocks, own = self._in_blocks(rows)
        C = J @ self._P[np.ix_(blocks, blocks)] @ J.T
        for k in range(len(rows)):
            C[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own[k]
        return np.asarray(C)

    def told(self, map: ReferenceMap) -> ReferenceMap:
        """The map with each target's covariance in the world, of which what all errors have in common is a part."""
        self.follow(map)
        cov_mm2 = map.cov_mm2.copy()
        for row in np.flatnonzero(self._id[: len(map)] >= 0).tolist():
            cov_mm2[row] = self.covariance(np.array([row]))
        return replace(map, cov_mm2=cov_mm2)

    def rescale(self, ratio: float) -> None:
        """Follows a change of the noise scale: all covariances are in proportion to its square."""
        self._P *= ratio**2
        self._own *= ratio**2

    def follow(self, map: ReferenceMap) -> None:
        """Takes note of what others did to the map: of who has left it, and of what was moved."""
        self._grow(len(map))
        k = len(map)
        is_here = self._id[:k] >= 0
        is_gone = is_here & ((self._id[:k] != map.id) | (map.state > _ALIVE))
        for row in np.flatnonzero(is_gone).tolist():
            self._forget(row)
        moved = np.flatnonzero(is_here & ~is_gone & (self._xyz[:k] != map.xyz_mm).any(axis=1))
        for row in moved.tolist():
            d = map.xyz_mm[row] - self._xyz[row]
            extra, b = np.outer(d, d), 3 * int(self._block[row])
            if b >= 0:
                self._P[b : b + 3, b : b + 3] += extra
            else:
                self._own[row] += extra
            self._xyz[row] = map.xyz_mm[row]

    @property
    def unknowns(self) -> int:
        """Rows of the covariance."""
        return self._used

    @property
    def _used(self) -> int:
        """Rows and columns of P that blocks have taken."""
        return 3 * len(self._row)

    def _seen_of(self, points: SensorPoints, fix: Fix) -> "_Seen":
        """What a fix shows of the targets known here; if those are too many, as many as can be held.

        Those that are held come first, as putting targets away and recalling them costs knowledge; then the surest.
        """
        one = fix.single
        seen = _Seen(
            np.concatenate([fix.target, one.target]),
            np.concatenate([points.xyz_mm[fix.point], one.xyz_mm]),
            np.concatenate([points.cov_mm2[fix.point], one.cov_mm2]),
        )
        known = np.flatnonzero(self._id[seen.target] >= 0)
        if len(known) > self._capacity:
            sigma2 = np.trace(seen.cov_mm2[known], axis1=1, axis2=2)
            is_away = self._block[seen.target[known]] < 0
            known = known[np.lexsort((sigma2, is_away))[: self._capacity]]
        return seen if len(known) == len(seen) else seen.rows(known)

    @staticmethod
    def _condition(
        map: ReferenceMap,
        T: Pose,
        seen: "_Seen",
        P: Float[np.ndarray, "cap cap"],
        blocks: Int[np.ndarray, "c"],
        used: int,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        places, R, t = floats(map.xyz_mm[seen.target]), floats(T.R), floats(T.t_mm)
        r, noise = kernels.residuals(places, floats(seen.xyz_mm), floats(seen.cov_mm2), R, t)
        H = kernels.pose_fields(places, R, t)
        delta, cov, cross, shift = kernels.condition(P, used, integers(blocks), noise, H, r, -1.0)
        return delta, cov, cross, shift

    def _shared(self, map: ReferenceMap, T: Pose, rows: Int[np.ndarray, "r"]) -> Float[np.ndarray, "6 6"]:
        """Covariance of δ that the errors of some targets make together, each counting alike."""
        if len(rows) < _FEWEST:
            return np.zeros((6, 6))
        H = kernels.pose_fields(floats(map.xyz_mm[rows]), floats(T.R), floats(T.t_mm))
        F = np.linalg.pinv(H)
        return np.asarray(F @ self.covariance(rows) @ F.T)

    def _in_blocks(
        self, rows: Int[np.ndarray, "r"]
    ) -> tuple[Float[np.ndarray, "r3 b"], Int[np.ndarray, "b"], Float[np.ndarray, "r 3 3"]]:
        """Errors of targets as J times those of some rows of P, and what each has of its own."""
        J, own = np.zeros((3 * len(rows), self._used)), np.zeros((len(rows), 3, 3))
        for k, row in enumerate(rows.tolist()):
            b, a = 3 * int(self._block[row]), int(self._place[row])
            if b >= 0:
                J[3 * k : 3 * k + 3, b : b + 3] = np.eye(3)
                continue
            own[k] = self._own[row]
            if a >= 0:
                f, g = 3 * int(self._shift[a]), 3 * int(self._turn[a])
                J[3 * k : 3 * k + 3, f : f + 3] = np.eye(3)
                J[3 * k : 3 * k + 3, g : g + 3] = _turning(self._xyz[row] - self._centre[a])
        blocks = np.flatnonzero(J.any(axis=0))
        return J[:, blocks], blocks, own

    def _move(self, map: ReferenceMap, shift: Float[np.ndarray, "used"]) -> None:
        """Targets to where they are estimated to be: held ones each, those put away with their places."""
        k = len(map)
        kernels.carry(map.xyz_mm, self._block[:k], self._place[:k], self._shift, self._turn, self._centre, shift)
        self._xyz[:k] = map.xyz_mm

    def _recall(self, target: Int[np.ndarray, "c"]) -> None:
        """Targets that are seen again are held again."""
        away = target[self._block[target] < 0]
        for row in away.tolist():
            J, blocks, own = self._in_blocks(np.array([row]))
            cross = J @ self._P[blocks, : self._used]
            block = J @ self._P[np.ix_(blocks, blocks)] @ J.T + own[0]
            b = self._take(row)
            self._P[3 * b : 3 * b + 3, : cross.shape[1]] = cross
            self._P[: cross.shape[1], 3 * b : 3 * b + 3] = cross.T
            self._P[3 * b : 3 * b + 3, 3 * b : 3 * b + 3] = block
            self._leave_place(row)
            self._block[row] = b

    def _make_room(self, kept: Int[np.ndarray, "c"]) -> None:
        """Puts targets away, those first that have not been seen for longest, until no more than allowed are held."""
        coming = int((self._block[kept] < 0).sum())
        while (self._row >= 0).sum() + coming > self._capacity:
            held = self._row[self._row >= 0]
            held = held[~np.isin(held, kept)]
            if len(held) < _FEWEST:
                return
            held = held[np.argsort(self._seen[held], kind="stable")]
            old = held[: max(_GROUP, len(held) // 2)]
            near = np.argsort(np.linalg.norm(self._xyz[old] - self._xyz[old[0]], axis=1), kind="stable")[:_GROUP]
            self._put_away(np.sort(old[near]))

    def _put_away(self, rows: Int[np.ndarray, "g"]) -> None:
        """Targets become one place, of which only shift and turn stay correlated with what is held.

        Their errors are e = B f + ε: f is the best fit, uncorrelated with ε. Dropping X, the covariance of ε with the
        rest, is paid for by [0 X; Xᵀ 0] ≤ [β E 0; 0 Xᵀ E⁻¹ X / β], E that of ε; and E by its diagonal blocks times λ.
        """
        centre = self._xyz[rows].mean(axis=0)
        blocks = integers(self._block[rows])
        B = kernels.pose_fields(floats(self._xyz[rows]), np.eye(3), floats(centre))
        ridge = np.tile(_RIDGE_MM2 * np.eye(3), (len(rows), 1, 1))
        used = self._used
        cov = kernels.condition(self._P, 0, blocks, ridge, B, np.zeros(len(B)), 0.0)[1]
        own = kernels.own_errors(self._P, blocks, ridge, B, cov)
        _, cov, cross, _ = kernels.condition(self._P, used, blocks, ridge, B, np.zeros(len(B)), 1.0 / _DEAR)
        for row, b in zip(rows.tolist(), blocks.tolist(), strict=True):
            self._vacate(b)
            self._block[row] = _NOBODY
            cross[:, 3 * b : 3 * b + 3] = 0.0
        f, g = self._take(_PLACE), self._take(_PLACE)
        place = np.concatenate([np.arange(3 * f, 3 * f + 3), np.arange(3 * g, 3 * g + 3)])
        self._P[place, :used] = cross
        self._P[:used, place] = cross.T
        self._P[np.ix_(place, place)] = cov
        self._own[rows] = (1.0 + _DEAR) * own
        self._place[rows] = self._add_place(f, g, centre)

    def _add_place(self, f: int, g: int, centre: Float[np.ndarray, "3"]) -> int:
        free = np.flatnonzero(self._shift < 0)
        if len(free) == 0:
            free = np.array([len(self._shift)])
            self._shift, self._turn = np.append(self._shift, -1), np.append(self._turn, -1)
            self._centre = np.vstack([self._centre, np.zeros(3)])
        a = int(free[0])
        self._shift[a], self._turn[a], self._centre[a] = f, g, centre
        return a

    def _leave_place(self, row: int) -> None:
        """A target that is not put away any more; a place without targets is given up."""
        a = int(self._place[row])
        self._place[row] = _NOBODY
        if a >= 0 and not (self._place == a).any():
            self._vacate(int(self._shift[a]))
            self._vacate(int(self._turn[a]))
            self._shift[a] = self._turn[a] = _NOBODY

    def _forget(self, row: int) -> None:
        if self._block[row] >= 0:
            self._vacate(int(self._block[row]))
        self._leave_place(row)
        self._block[row] = self._id[row] = _NOBODY
        self._own[row] = 0.0

    def _take(self, owner: int) -> int:
        """An empty block for a target or a place."""
        free = np.flatnonzero(self._row == _NOBODY)
        if len(free):
            self._row[free[0]] = owner
            return int(free[0])
        self._row = np.append(self._row, owner)
        if self._used > len(self._P):
            more = max(3 * 32, 3 * (len(self._P) // 6))
            self._P = np.pad(self._P, ((0, more), (0, more)))
        return len(self._row) - 1

    def _vacate(self, block: int) -> None:
        self._row[block] = _NOBODY
        kernels.clear_block(self._P, block)

    def _grow(self, rows: int) -> None:
        if rows <= len(self._id):
            return
        more = max(rows, 2 * len(self._id)) - len(self._id)
        self._id, self._block, self._place = (
            np.pad(each, (0, more), constant_values=_NOBODY) for each in (self._id, self._block, self._place)
        )
        self._seen = np.pad(self._seen, (0, more))
        self._own, self._xyz = np.pad(self._own, ((0, more), (0, 0), (0, 0))), np.pad(self._xyz, ((0, more), (0, 0)))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Points, and rays of single dots, whose targets are known."""

    target: Int[np.ndarray, "c"]
    """Rows of the targets."""
    xyz_mm: Float[np.ndarray, "c 3"]
    """Where they were seen, sensor coordinates (mm)."""
    cov_mm2: Float[np.ndarray, "c 3 3"]
    """Covariance of that (mm²)."""

    def __len__(self) -> int:
        return len(self.target)

    def rows(self, rows: Int[np.ndarray, "r"]) -> "_Seen":
        return _Seen(self.target[rows], self.xyz_mm[rows], self.cov_mm2[rows])


class Knowledge:
    """The pose of a frame that a map has learnt from, and what its error has to do with those of the targets."""

    def __init__(self, T_world_sensor: Pose, cov: Float[np.ndarray, "6 6"], cross: Float[np.ndarray, "6 cap"]) -> None:
        self.T_world_sensor = T_world_sensor
        """The pose."""
        self.cov = cov
        """Covariance of its error δ = (translation mm, rotation rad)."""
        self.cross = cross
        """Covariance of δ with all rows of P."""


def _turning(lever: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """−[lever]×: how a place moves with a turn."""
    x, y, z = lever
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
