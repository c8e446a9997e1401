"""A positioned recording to a better one: all poses and targets adjusted together, by everything that was identified.

Steps in, Steps out: what the frames identified becomes the observations of one least-squares problem, and its answer
goes back into their fixes and their map. No frame gains or loses a fix by it. Knows neither files nor how frames were
positioned.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.adjustment import (
    MOST_TARGETS,
    ControlTargets,
    DotObservations,
    PointObservations,
    ScaleBar,
    adjust,
)
from trifix.config import Config
from trifix.errors import AdjustmentError, MapError
from trifix.geometry.alignment import align, point_jacobian, spread_off_line_mm
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.records import (
    Dots,
    Fix,
    Frame,
    KnownLength,
    NoFix,
    PositionedReason,
    ReferenceMap,
    SensorPoints,
    SingleDots,
    Step,
    StereoDots,
    TargetState,
)
from trifix.stages.triangulate import (
    NORMAL_SIGMA,
    NORMALS,
    Circles,
    centres_by_normals,
    circles_of,
    triangulate,
)
from trifix.stages.verify import pose_sigma

_ROUNDS = 3  # of adjusting: with more dots, and by the noise that the residuals show
_SAME_NOISE = 0.05  # change of the noise scale that is not worth another round
_LEAST_CONTROL = 3
_MISFIT = 0.05  # of their extent, by which known targets may be off from where the map has them
_LEAST_ACROSS_MM = 3.0
_CHANCE = 0.01  # of finding some dot that near to where a target should be
_HOLDING = 3  # trusted targets that hold a pose without the others
_GROWTHS = np.arange(0.0, 3.01, 0.25)  # exponents by which dots may be the noisier the smaller they look
_SMALLEST = 0.5  # apparent size, as a share of the largest, below which nothing more is said
_LARGEST_PERCENT = 95.0  # of all apparent sizes: that of a target seen straight on
_SIGHTINGS_OF_NORMAL = 4  # at least, before a normal is believed
_TRIED = 40  # sightings whose normals are tried
_LEAST_NORMAL_RAD = 0.05  # so well do normals agree at best
_OTHER_RAD = 0.3  # normals farther apart are different
_DISSENT = 0.01  # share of sightings that agree with nothing
_DECISIVE = 20.0  # of twice a logarithm of likelihoods


@dataclass(frozen=True, slots=True, eq=False)
class Constraints:
    """What is known of targets by other means; they are named by their identity in the map."""

    given: ReferenceMap | None = None
    """The map that the frames were positioned on, if it was given: the world is that of its targets."""
    control: ReferenceMap | None = None
    """Targets whose places are known: the world becomes theirs."""
    lengths: Sequence[KnownLength] = ()
    """Distances between targets."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """What an adjustment amounts to."""

    frames: int
    """Frames whose poses were adjusted."""
    frames_kept: int
    """Positioned frames that saw too little to be adjusted: they are placed on the adjusted map, or as they were."""
    targets: int
    """Targets that were adjusted."""
    observations: int
    """Dots, or points, that it rests on."""
    dots_found: int
    """Those among them that were identified by the adjusted map alone."""
    rejected: int
    """Those that were so far off that they count for nothing."""
    unit: str
    """Of the residuals: px for dots, mm for points."""
    rms_before: float
    """Root mean square distance of the others from their targets, each by its weight, before the adjustment."""
    rms_after: float
    """The same when adjusted."""
    noise_scale: float
    """Factor on stated or assumed standard deviations that the residuals ask for, for the median observation."""
    noise_growth: float
    """Dots of targets seen at an angle are noisier by this power of one over its cosine, as the residuals show."""
    steps: int
    """Steps that it took."""
    seconds: float
    """Time that it took (s)."""
    rig_change: dict[str, float] = field(default_factory=dict)
    """How far each parameter of the rig moved, where it was refined: the frames of the steps have the refined one."""
    rig_sigma: dict[str, float] = field(default_factory=dict)
    """Standard deviation of each."""
    rig_change_sigmas: float | None = None
    """How far the rig moved in standard deviations: root mean square over its parameters, as they belong together."""


@dataclass(frozen=True, slots=True)
class NotAdjusted:
    """Why the steps are as they were."""

    why: str
    """One sentence."""


def adjust_steps(
    steps: Sequence[Step],
    config: Config | None = None,
    constraints: Constraints | None = None,
    *,
    is_noise_stated: bool = False,
    watch: Callable[[], None] | None = None,
) -> tuple[Sequence[Step], Adjusted | NotAdjusted]:
    """The steps of a whole recording, poses and targets adjusted together; the same steps where that cannot be done.

    ``steps`` are those of ``Positioner.revise``, with the finished map. The world stays that of its first frame or of
    the given map, or becomes that of the control targets. A noise that was not stated is learnt once more. ``watch`` is
    called before every step of the search, and may raise to end it.

    Raises:
        MapError: the constraints name targets that are not in the map.
    """
    config, start = config or Config(), perf_counter()
    if not config.adjust.adjusts:
        return steps, NotAdjusted("The options say that nothing is to be adjusted.")
    try:
        bundle = _Bundle(steps, config, constraints or Constraints())
        bundle.adjust(is_noise_stated, watch)
        return bundle.steps(), bundle.summary(perf_counter() - start)
    except AdjustmentError as error:
        return steps, NotAdjusted(str(error))


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """Which dot or point of which frame is which target."""

    frame: Int[np.ndarray, "m"]
    """Row of the positioned frame."""
    target: Int[np.ndarray, "m"]
    """Row of the target in the map."""
    camera: Int[np.ndarray, "m"]
    """0 left, 1 right; 0 for points."""
    row: Int[np.ndarray, "m"]
    """Row of the dot among those of its camera, or of the point."""

    def __len__(self) -> int:
        return len(self.frame)

    def of(self, rows: Int[np.ndarray, "r"] | Bool[np.ndarray, "m"]) -> "_Sightings":
        """Some of them."""
        return _Sightings(self.frame[rows], self.target[rows], self.camera[rows], self.row[rows])

    def and_also(self, more: "_Sightings") -> "_Sightings":
        """These and others."""
        pairs = zip(self.columns(), more.columns(), strict=True)
        return _Sightings(*(np.concatenate(pair) for pair in pairs))

    def columns(self) -> tuple[np.ndarray, ...]:
        """In the order of the fields."""
        return self.frame, self.target, self.camera, self.row

    @staticmethod
    def joined(parts: "Sequence[tuple[int, np.ndarray, np.ndarray | int, np.ndarray]]") -> "_Sightings":
        """Of (frame, targets, cameras, rows); what one camera saw of one target in one frame, once."""
        columns = [
            (np.full(len(target), k), target, np.broadcast_to(camera, len(target)), row)
            for k, target, camera, row in parts
        ] or [(np.zeros(0, np.int64),) * 4]
        whole = _Sightings(*(np.concatenate(each).astype(np.int64) for each in zip(*columns, strict=True)))
        first = np.unique(np.stack([whole.frame, whole.target, whole.camera]), axis=1, return_index=True)[1]
        return whole.of(np.sort(first))


class _Bundle:
    """The observations of a recording and what is adjusted by them."""

    def __init__(
        self,
        steps: Sequence[Step],
        config: Config,
        constraints: Constraints,
    ) -> None:
        self._steps, self._config = steps, config
        control, self._lengths = constraints.control, constraints.lengths
        self._placed = [step for step in steps if isinstance(step.fix, Fix)]
        if not self._placed:
            raise AdjustmentError("There is nothing to adjust: no frame is positioned.")
        self._fixes = [step.fix for step in self._placed if isinstance(step.fix, Fix)]
        self._map = steps[-1].map
        self._has_dots = any(step.centres is not None for step in self._placed)
        self._rigs = [step.frame.rig for step in self._placed if step.frame.rig is not None]
        self._scale = self._placed[-1].noise_scale
        self._growth = 0.0
        self._is_settled = False  # whether dots were moved to where all frames together have their centres
        self._row_of = {int(i): row for row, i in enumerate(self._map.id.tolist()) if self._map.alive[row]}
        self._known = constraints.given if control is None else control
        named = [] if self._known is None else [i for i in self._known.id.tolist() if i in self._row_of]
        named += [i for length in self._lengths for i in (length.target_a, length.target_b)]
        self._is_named = np.zeros(len(self._map), dtype=bool)

        # the world, and where everything is in it before the adjustment
        self._is_control = control is not None
        self._T_world_map = Pose.identity() if control is None else self._towards(control)
        for length in self._lengths:
            for each in (length.target_a, length.target_b):
                self._row(each, length.source)
        self._is_named[[self._row_of[each] for each in named]] = True
        self._T = [self._T_world_map @ fix.T_world_sensor for fix in self._fixes]
        self._xyz = self._T_world_map.apply(self._map.xyz_mm)
        self._cov = self._T_world_map.R @ self._map.cov_mm2 @ self._T_world_map.R.T
        self._view = self._map.view @ self._T_world_map.R.T
        self._started = self._T, self._xyz
        self._seen = self._with_a_say(self._collected())
        self._identified = len(self._seen)
        self._count = 0

    # what was seen

    def _collected(self) -> _Sightings:
        """All that the fixes identified, as rows of the finished map."""
        alive = np.flatnonzero(self._map.alive)
        order = alive[np.argsort(self._map.id[alive], kind="stable")]
        ids = self._map.id[order]
        parts: list[tuple[int, np.ndarray, np.ndarray | int, np.ndarray]] = []

        def add(k: int, identity: np.ndarray, camera: np.ndarray | int, row: np.ndarray) -> None:
            at = np.minimum(np.searchsorted(ids, identity), len(ids) - 1)
            is_there = ids[at] == identity
            cameras = np.broadcast_to(camera, len(identity))
            parts.append((k, order[at[is_there]], cameras[is_there], row[is_there]))

        for k, (step, fix) in enumerate(zip(self._placed, self._fixes, strict=True)):
            identity = step.map.id[fix.target]
            if step.centres is None or step.matches is None or step.points is None:
                add(k, identity, 0, fix.point)
                continue
            match = step.points.match[fix.point]
            add(k, identity, 0, step.matches.left[match])
            add(k, identity, 1, step.matches.right[match])
            add(k, step.map.id[fix.single.target], fix.single.camera, fix.single.dot)
        return _Sightings.joined(parts)

    def _with_a_say(self, seen: _Sightings) -> _Sightings:
        """All but the sightings of targets that are neither trusted nor named, in frames that show enough others.

        Who has been seen too seldom to be sure of may be none, but two dots that belong to different targets. Where the
        frame that defines the world does not show enough others, all of its own have a say: they tie the rest to it.
        """
        is_trusted = ((self._map.state == TargetState.trusted) | self._is_named)[seen.target]
        each_once = np.unique(np.stack([seen.frame[is_trusted], seen.target[is_trusted]]), axis=1)[0]
        trusted = np.bincount(each_once, minlength=len(self._placed))
        has_say = is_trusted | (trusted[seen.frame] < _HOLDING)
        for first in (k for k, fix in enumerate(self._fixes) if fix.reason is PositionedReason.defines_world):
            if trusted[first] < _HOLDING:
                has_say |= np.isin(seen.target, seen.target[seen.frame == first])
        return seen.of(has_say)

    def _observations(self, seen: _Sightings) -> tuple[DotObservations | PointObservations, Int[np.ndarray, "n"]]:
        """What was measured, and the rows of the map that its targets are."""
        rows, target = np.unique(seen.target, return_inverse=True)
        if len(rows) > MOST_TARGETS:
            raise AdjustmentError(
                f"{len(rows)} targets are too many to adjust together, the limit is {MOST_TARGETS}: poses stay as each "
                "frame by itself gave them."
            )
        if self._has_dots:
            uv, cov_px2 = self._gathered(seen, lambda dots: dots.uv_px), self._gathered(seen, lambda dots: dots.cov_px2)
            variance = (self._scale * self._apparent_size(seen) ** -self._growth) ** 2
            return DotObservations(seen.frame, target, seen.camera, uv, cov_px2 * variance[:, None, None]), rows
        points = [step.frame.content for step in self._placed]  # their covariances are as stated, not yet scaled
        start = np.searchsorted(seen.frame, np.arange(len(points) + 1))
        parts = [
            (each.xyz_mm[rows_], each.cov_mm2[rows_])
            for each, a, b in zip(points, start, start[1:], strict=False)
            if isinstance(each, SensorPoints)
            for rows_ in [seen.row[a:b]]
        ]
        xyz, cov = (np.concatenate(column) for column in zip(*parts, strict=True))
        return PointObservations(seen.frame, target, xyz, cov * self._scale**2), rows

    def _gathered(self, seen: _Sightings, of: Callable[[Dots], np.ndarray]) -> np.ndarray:
        """Something of each dot."""
        start = np.zeros((len(self._placed), 2), dtype=np.int64)
        images: list[np.ndarray] = []
        count = 0
        for k, step in enumerate(self._placed):
            assert step.centres is not None
            for camera, dots in enumerate((step.centres.left, step.centres.right)):
                start[k, camera] = count
                count += len(dots)
                images.append(of(dots))
        return np.asarray(np.concatenate(images)[start[seen.frame, seen.camera] + seen.row])

    def _apparent_size(self, seen: _Sightings) -> Float[np.ndarray, "m"]:
        """How large each target looks for its distance, as a share of the largest: √cos of its obliquity.

        All targets are alike, so what looks smaller is turned away. 1 where the dots' sizes are not known.
        """
        if not self._has_dots:
            return np.ones(len(seen))
        size = self._gathered(seen, lambda dots: dots.diameter_px)
        for lens, rows, place in _by_camera(seen, self._T, self._xyz, self._rigs):
            size[rows] *= place[:, 2] / lens.fu_px
        known = np.isfinite(size) & (size > 0)
        if not known.any():
            return np.ones(len(seen))
        largest = float(np.percentile(size[known], _LARGEST_PERCENT))
        return np.where(known, np.clip(size / largest, _SMALLEST, 1.0), 1.0)

    def _learn_noise(self, is_stated: bool) -> bool:
        """Scale of the noise, and how it grows with obliquity, by the residuals; whether that is news.

        With variances c·f(g), f = a^(−2g) at apparent size a, the likelihood of n dots is greatest at the growth g of
        least n ln c + Σ ln f, where c = mean(s²/2f) of residuals s (σ at f = 1).
        """
        out, options = self._out, self._config.noise
        if out.dof < (options.min_samples if is_stated else 1):
            return False
        ratio, growth = self._misfit(), self._growth
        if self._has_dots and not is_stated:
            observations, _ = self._observations(self._seen)
            assert isinstance(observations, DotObservations)
            off = _off(observations, self._seen, self._T, self._xyz, self._rigs_now())
            s2 = np.einsum("mi,mij,mj->m", off, np.linalg.inv(observations.cov_px2), off)
            counts = (out.weight > 0.99) & np.isfinite(s2)
            size = self._apparent_size(self._seen)[counts]
            s2 = s2[counts] * size ** (-2 * self._growth)
            f = size[None] ** (-2 * _GROWTHS[:, None])
            misfit = 2 * len(s2) * np.log((s2 / f).mean(axis=1)) + 2 * np.log(f).sum(axis=1)
            best = int(misfit.argmin())
            growth = float(_GROWTHS[best]) if misfit[0] - misfit[best] > _DECISIVE else 0.0
            c = float((s2 / f[growth == _GROWTHS][0]).mean() / (s2 / f[self._growth == _GROWTHS][0]).mean())
            ratio *= float(np.sqrt(c))
        scale = self._scale * ratio
        if is_stated and options.stated_low <= scale <= options.stated_high:
            scale = 1.0
        is_news = growth != self._growth or abs(scale / self._scale - 1) > _SAME_NOISE
        if is_news:
            self._scale, self._growth = scale, growth
        return is_news

    def _misfit(self) -> float:
        """Factor by which the residuals are larger than was thought."""
        return float(np.sqrt(self._out.chi2 / self._out.dof)) if self._out.dof > 0 else 1.0

    def _typical_scale(self) -> float:
        """Factor on the standard deviation of the median observation."""
        return float(self._scale * np.median(self._apparent_size(self._seen) ** -self._growth))

    # the world

    def _towards(self, control: ReferenceMap) -> Pose:
        """``T_control_map`` as the control targets say."""
        rows = np.array([self._row(each, "control") for each in control.id.tolist()], dtype=np.int64)
        if len(rows) < _LEAST_CONTROL or spread_off_line_mm(control.xyz_mm) < _LEAST_ACROSS_MM:
            raise AdjustmentError("The control targets do not hold the world: give three that are not on one line.")
        b = self._map.xyz_mm[rows]
        T = align(b, control.xyz_mm)
        off = float(np.sqrt(((T.apply(b) - control.xyz_mm) ** 2).sum(axis=1).mean()))
        extent = float(np.linalg.norm(np.ptp(control.xyz_mm, axis=0)))
        if off > _MISFIT * extent:
            raise AdjustmentError(
                f"The control targets do not fit the map: they are {off:.3g} mm off (rms) at an extent of {extent:.3g} "
                "mm; are they in millimetres, and their ids those of map.csv?"
            )
        return T

    def _row(self, identity: int, source: str) -> int:
        if identity not in self._row_of:
            raise MapError(f"{source}: target {identity} is not in the map: name targets by the id of map.csv.")
        return self._row_of[identity]

    def _gauge(self, rows: Int[np.ndarray, "n"]) -> int | ControlTargets:
        """The frame that defines the world, or the targets known beforehand, in terms of the rows adjusted."""
        if self._known is None:
            first = [k for k, fix in enumerate(self._fixes) if fix.reason is PositionedReason.defines_world]
            if not first:
                raise AdjustmentError("No frame defines the world, so nothing can be adjusted in its coordinates.")
            return first[0]
        position = {int(self._map.id[row]): k for k, row in enumerate(rows.tolist())}
        pairs = [(position[i], k) for k, i in enumerate(self._known.id.tolist()) if i in position]
        if not pairs:
            raise AdjustmentError("No target that is known beforehand was seen.")
        target, own = np.array(pairs).T
        return ControlTargets(target, self._known.xyz_mm[own], self._known.cov_mm2[own])

    def _bars(self, rows: Int[np.ndarray, "n"]) -> list[ScaleBar]:
        bars = []
        for each in self._lengths:
            ends = np.array([self._row_of[each.target_a], self._row_of[each.target_b]])
            at = np.minimum(np.searchsorted(rows, ends), len(rows) - 1)
            if (rows[at] != ends).any():
                raise AdjustmentError(f"{each.source}: one of its targets was not seen by any positioned frame.")
            bars.append(ScaleBar(int(at[0]), int(at[1]), each.length_mm, each.sigma_mm))
        return bars

    # the adjustment

    def adjust(self, is_noise_stated: bool, watch: Callable[[], None] | None) -> None:
        """Adjusts, with the dots that the adjusted map explains as well, by the noise that the residuals show."""
        options = self._config.adjust
        before = self._seen, self._scale, self._growth, self._placed
        for k in range(_ROUNDS):
            observations, rows = self._observations(self._seen)
            try:
                out = adjust(
                    observations,
                    self._T,
                    self._xyz[rows],
                    rig=self._rigs if self._has_dots else None,
                    gauge=self._gauge(rows),
                    scale_bars=self._bars(rows),
                    refine_rig=options.rig if options.refines_rig else None,
                    options=options.search,
                    watch=watch,
                )
            except AdjustmentError:
                if k == 0:
                    raise
                self._seen, self._scale, self._growth, self._placed = before  # what was had stands
                break
            self._out, self._rows = out, rows
            self._T = list(out.T_world_sensor)
            self._xyz = self._xyz.copy()
            self._xyz[rows] = out.xyz_mm
            self._count += out.steps
            if k == _ROUNDS - 1:
                break
            before = self._seen, self._scale, self._growth, [*self._placed]
            is_settled = k == 0 and self._has_dots and self._settle_centres()
            self._is_settled |= is_settled
            more = self._found() if k == 0 and self._has_dots else _Sightings.joined([])
            is_news = self._learn_noise(is_noise_stated)
            if not is_news and not is_settled and not len(more):
                break
            self._seen = self._seen.and_also(more)

    def _settle_centres(self) -> bool:
        """Moves dots to their targets' centres by the normals that all frames together give; whether any moved.

        An ellipse has two answers, and a dot that one camera alone saw leaves open which is right. Over many frames,
        the right ones are the same normal of the target in the world; the others lie about.
        """
        if not self._config.triangulate.correct_eccentricity:
            return False
        by_frame = self._seen.of(np.argsort(self._seen.frame, kind="stable"))
        frame, target, camera, row = by_frame.columns()
        start = np.searchsorted(frame, np.arange(len(self._placed) + 1))
        normal, sigma = np.full((len(frame), 2, 3), np.nan), np.full(len(frame), np.inf)
        circles: list[tuple[Circles, Circles]] = []
        for k, step in enumerate(self._placed):
            rig = self._rig(k)
            assert step.dots is not None
            assert rig is not None
            circles.append(circles_of(step.dots, rig, self._scale))
            for side, R in enumerate(_rotations(rig, self._T[k])):
                own = start[k] + np.flatnonzero(camera[start[k] : start[k + 1]] == side)
                seen = circles[k][side][row[own]]
                normal[own] = seen[:, NORMALS].reshape(-1, 2, 3) @ R.T
                sigma[own] = seen[:, NORMAL_SIGMA]
        of_target = np.full((len(self._map), 3), np.nan)
        for each in np.unique(target).tolist():
            own = np.flatnonzero((target == each) & np.isfinite(sigma))
            of_target[each] = _common_normal(normal[own], sigma[own])
        if not np.isfinite(of_target).any():
            return False
        for k, step in enumerate(self._placed):
            rig, dots, centres = self._rig(k), step.dots, step.centres
            assert rig is not None
            assert dots is not None
            assert centres is not None
            moved = []
            for side, (R, own_dots, own_centres) in enumerate(
                zip(_rotations(rig, self._T[k]), (dots.left, dots.right), (centres.left, centres.right), strict=True)
            ):
                own = start[k] + np.flatnonzero(camera[start[k] : start[k + 1]] == side)
                facing = np.full((len(own_dots), 3), np.nan)
                facing[row[own]] = of_target[target[own]] @ R
                moved.append(centres_by_normals(own_dots, own_centres, circles[k][side], facing, self._scale))
            self._placed[k] = replace(step, centres=StereoDots(*moved))
        return True

    def _rig(self, k: int) -> StereoRig | None:
        """The rig of a positioned frame, as refined where it was."""
        return self._out.rig or self._placed[k].frame.rig

    def _rigs_now(self) -> list[StereoRig]:
        return self._rigs if self._out.rig is None else [self._out.rig] * len(self._rigs)

    def _found(self) -> _Sightings:
        """Dots that are where the adjusted map has a target that their camera did not show yet; no other in reach."""
        gate = self._config.verify.gate_sigmas
        alive = np.zeros(len(self._map), dtype=bool)
        alive[self._rows[self._out.is_target_adjusted]] = True
        alive &= self._map.state == TargetState.trusted
        by_frame = np.argsort(self._seen.frame, kind="stable")
        start = np.searchsorted(self._seen.frame[by_frame], np.arange(len(self._placed) + 1))
        parts: list[tuple[int, np.ndarray, np.ndarray | int, np.ndarray]] = []
        for k, step in enumerate(self._placed):
            rig, T = self._rig(k), self._T[k]
            if not self._out.is_frame_adjusted[k] or step.centres is None or rig is None:
                continue
            own = self._seen.of(by_frame[start[k] : start[k + 1]])
            in_left = T.inverse().apply(self._xyz)
            is_facing = alive & ~(((T.t_mm - self._xyz) * self._view).sum(axis=1) < 0)
            in_right, centres = rig.T_right_left.apply(in_left), step.centres
            images = (rig.left, in_left, centres.left), (rig.right, in_right, centres.right)
            for camera, (lens, place, dots) in enumerate(images):
                is_sought, is_free = is_facing & (place[:, 2] > 0), np.ones(len(dots), dtype=bool)
                is_sought[own.target[own.camera == camera]] = False
                is_free[own.row[own.camera == camera]] = False
                target, dot = np.flatnonzero(is_sought), np.flatnonzero(is_free)
                target = target[lens.sees(place[target])]
                uv = lens.project(place[target])
                if not len(target) or not len(dot):
                    continue
                cov = dots.cov_px2[dot] * self._scale**2
                off = dots.uv_px[dot][:, None] - uv[None]
                is_near = np.einsum("dti,dij,dtj->dt", off, np.linalg.inv(cov), off) < gate**2
                area = np.pi * gate**2 * np.sqrt(np.linalg.det(cov))
                is_rare = area * len(dots) < _CHANCE * lens.width_px * lens.height_px
                is_only = is_near & (is_near.sum(axis=0) == 1)[None] & (is_near.sum(axis=1) == 1)[:, None]
                d, t = np.nonzero(is_only & is_rare[:, None])
                parts.append((k, target[t], camera, dot[d]))
        return _Sightings.joined(parts)

    # what came out

    def steps(self) -> list[Step]:
        """All steps with the adjusted poses, targets and covariances."""
        xyz, cov = self._xyz, self._cov.copy()
        is_in = self._out.is_target_adjusted
        cov[self._rows[is_in]] = self._out.target_cov_mm2[is_in]
        self._place_the_others(xyz, cov)
        map = replace(self._map, xyz_mm=xyz, cov_mm2=cov, view=self._view, joint_mm2=self._joint(cov))
        scale = self._typical_scale()
        left_out = self._placed_anew()
        new = self._seen.of(np.arange(len(self._seen)) >= self._identified)
        new = new.of(self._out.weight[self._identified :] > 0)
        order = np.argsort(new.frame, kind="stable")
        new = new.of(order)
        start = np.searchsorted(new.frame, np.arange(len(self._placed) + 1))
        done: list[Step] = []
        k = 0
        for step in self._steps:
            if isinstance(step.fix, Fix):
                more = new.of(np.arange(start[k], start[k + 1]))
                done.append(
                    replace(self._applied(k, self._placed[k], step.fix, map, more, left_out), noise_scale=scale)
                )
                k += 1
            else:
                moved, frame = self._moved(step.fix), self._with_rig(step.frame)
                done.append(replace(step, frame=frame, fix=moved, map=map, noise_scale=scale))
        return done

    def _joint(self, cov_mm2: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k3 k3"] | None:
        """Covariance of all targets together; those that were not adjusted are known each for itself.

        None where a map has too many: of a large one that was given, few may have been seen.
        """
        k, rows = len(cov_mm2), self._rows[self._out.is_target_adjusted]
        if k > MOST_TARGETS:
            return None
        joint = np.zeros((3 * k, 3 * k))
        joint.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)] = cov_mm2
        to = (3 * rows[:, None] + np.arange(3)).ravel()
        of = (3 * np.flatnonzero(self._out.is_target_adjusted)[:, None] + np.arange(3)).ravel()
        joint[np.ix_(to, to)] = self._out.map_cov_mm2[np.ix_(of, of)]
        return joint

    def _applied(
        self,
        k: int,
        step: Step,
        fix: Fix,
        map: ReferenceMap,
        more: _Sightings,
        left_out: Mapping[int, tuple[Pose, Float[np.ndarray, "6 6"]]],
    ) -> Step:
        T, cov = self._T[k], self._out.pose_cov[k]
        if not self._out.is_frame_adjusted[k]:
            T, cov = left_out.get(k, (T, fix.cov))
        if fix.reason is PositionedReason.few_points and step.frame.rig is not None:
            # the motion may have held it better than what it saw; of that, the adjustment knows nothing
            at = T.inverse().apply(map.xyz_mm[self._seen.target[self._seen.frame == k]])
            if len(at) and pose_sigma(cov, at)[0] > pose_sigma(fix.cov, at)[0]:
                T, cov = self._T_world_map @ fix.T_world_sensor, fix.cov
        frame, points = self._with_rig(step.frame), self._points(step)
        reason = None if self._is_control and fix.reason is PositionedReason.defines_world else fix.reason
        assert points is not None
        fix = replace(fix, T_world_sensor=T, cov=cov, reason=reason)
        fix = fix.moved_to(step.map, map, points, step.centres, frame.rig)
        if len(more) and step.centres is not None and frame.rig is not None:
            one = fix.single
            pairs = (one.camera, more.camera), (one.dot, more.row), (one.target, more.target)
            camera, dot, target = (np.concatenate(pair) for pair in pairs)
            fix = replace(fix, single=SingleDots.of(camera, dot, target, step.centres, frame.rig, T, map, self._scale))
        return replace(step, frame=frame, points=points, fix=fix, map=map)

    def _points(self, step: Step) -> SensorPoints | None:
        """The points of a step, triangulated anew where the rig was refined or the dots were moved."""
        rig, points = self._out.rig or step.frame.rig, step.points
        if self._out.rig is None and not self._is_settled:
            return points
        if rig is None or points is None or step.centres is None or step.matches is None:
            return points
        anew = triangulate(step.centres, step.matches, rig, self._scale, self._config.triangulate)
        return anew if np.array_equal(anew.match, points.match) else points

    def _with_rig(self, frame: Frame) -> Frame:
        """The frame, with the rig as it was refined."""
        return frame if self._out.rig is None or frame.rig is None else replace(frame, rig=self._out.rig)

    def _place_the_others(self, xyz_mm: Float[np.ndarray, "k 3"], cov_mm2: Float[np.ndarray, "k 3 3"]) -> None:
        """Targets that had no say, to where the adjusted poses see them on the average.

        The poses' errors may be the same in all n frames, and are taken to be: Cov Σ e ≤ n Σ Cov e, however alike.
        """
        row_of = {i: row for i, row in self._row_of.items() if not self._is_named[row]}
        for row in self._rows[self._out.is_target_adjusted].tolist():
            row_of.pop(int(self._map.id[row]), None)
        W_sum, Wx_sum = np.zeros((len(self._map), 3, 3)), np.zeros((len(self._map), 3))
        of_points, of_poses, n = np.zeros_like(W_sum), np.zeros_like(W_sum), np.zeros(len(self._map))
        for k, (step, fix) in enumerate(zip(self._placed, self._fixes, strict=True)):
            points = self._points(step)
            if points is None or not self._out.is_frame_adjusted[k]:
                continue
            T, P = self._T[k], self._out.pose_cov[k]
            for point, identity in zip(fix.point.tolist(), step.map.id[fix.target].tolist(), strict=True):
                if identity in row_of:
                    p = points.xyz_mm[point]
                    row, J = row_of[identity], T.R @ point_jacobian(p[None])[0]
                    of_point, of_pose = T.R @ points.cov_mm2[point] @ T.R.T, J @ P @ J.T
                    W = np.linalg.inv(of_point + of_pose)
                    W_sum[row] += W
                    Wx_sum[row] += W @ (T.R @ p + T.t_mm)
                    of_points[row] += W @ of_point @ W
                    of_poses[row] += W @ of_pose @ W
                    n[row] += 1
        for row in np.flatnonzero(W_sum.any(axis=(1, 2))).tolist():
            C = np.linalg.inv(W_sum[row])
            cov_mm2[row] = C @ (of_points[row] + n[row] * of_poses[row]) @ C
            xyz_mm[row] = C @ Wx_sum[row]

    def _moved(self, refusal: NoFix) -> NoFix:
        """A refusal whose rival poses are in the world's coordinates."""
        rivals = (replace(each, T_world_sensor=self._T_world_map @ each.T_world_sensor) for each in refusal.rivals)
        return replace(refusal, rivals=tuple(rivals))

    def _placed_anew(self) -> dict[int, tuple[Pose, Float[np.ndarray, "6 6"]]]:
        """Poses, on the adjusted map, of frames that the adjustment left out, as far as they can be had."""
        out = np.flatnonzero(~self._out.is_frame_adjusted)
        is_target_in = np.zeros(len(self._map), dtype=bool)
        is_target_in[self._rows[self._out.is_target_adjusted]] = True
        found: dict[int, tuple[Pose, Float[np.ndarray, "6 6"]]] = {}
        C = self._out.map_cov_mm2.reshape(len(self._rows), 3, len(self._rows), 3)
        for k in out.tolist():
            own = self._seen.of((self._seen.frame == k) & is_target_in[self._seen.target])
            if not len(own):
                continue
            observations, rows = self._observations(own)
            observations = replace(observations, frame=np.zeros(len(own), dtype=np.int64))
            held = ControlTargets(np.arange(len(rows)), self._xyz[rows], np.zeros((len(rows), 3, 3)))
            try:
                one = adjust(
                    observations,
                    [self._T[k]],
                    self._xyz[rows],
                    rig=self._rig(k),
                    gauge=held,
                    options=self._config.adjust.search,
                )
            except AdjustmentError:
                continue
            if not one.is_frame_adjusted[0]:
                continue
            # what the errors of the targets make together, each counting alike
            T = one.T_world_sensor[0]
            at = np.searchsorted(self._rows, rows)
            F = np.linalg.pinv((T.R @ point_jacobian(T.inverse().apply(self._xyz[rows]))).reshape(-1, 6))
            shared = F @ C[at][:, :, at].reshape(3 * len(at), 3 * len(at)) @ F.T
            found[k] = T, one.pose_cov[0] + shared
        return found

    def summary(self, seconds: float) -> Adjusted:
        """What it amounts to."""
        out, counts = self._out, self._out.weight > 0
        observations, _ = self._observations(self._seen)
        T, xyz = self._started
        before = np.linalg.norm(_off(observations, self._seen, T, xyz, self._rigs), axis=1)
        after = np.linalg.norm(_off(observations, self._seen, self._T, self._xyz, self._rigs_now()), axis=1)
        counts = counts & np.isfinite(before) & np.isfinite(after)
        cov = observations.cov_px2 if isinstance(observations, DotObservations) else observations.cov_mm2
        information = out.weight / np.trace(cov, axis1=1, axis2=2)
        sigma = np.sqrt(np.diag(out.rig_cov))
        change = None
        if len(sigma):
            change = float(np.sqrt(out.rig_change @ np.linalg.solve(out.rig_cov, out.rig_change) / len(sigma)))
        return Adjusted(
            frames=int(out.is_frame_adjusted.sum()),
            frames_kept=int((~out.is_frame_adjusted).sum()),
            targets=int(out.is_target_adjusted.sum()),
            observations=len(self._seen),
            dots_found=len(self._seen) - self._identified,
            rejected=int((out.weight == 0).sum()),
            unit="px" if self._has_dots else "mm",
            rms_before=float(np.sqrt(np.average(before[counts] ** 2, weights=information[counts]))),
            rms_after=float(np.sqrt(np.average(after[counts] ** 2, weights=information[counts]))),
            noise_scale=self._typical_scale() * self._misfit(),
            noise_growth=self._growth / 2,
            steps=self._count,
            seconds=seconds,
            rig_change=dict(zip(out.rig_parameters, out.rig_change.tolist(), strict=True)),
            rig_sigma=dict(zip(out.rig_parameters, sigma.tolist(), strict=True)),
            rig_change_sigmas=change,
        )


def _rotations(rig: StereoRig, T_world_sensor: Pose) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """R_world_camera of both cameras."""
    return T_world_sensor.R, T_world_sensor.R @ rig.T_right_left.R.T


def _common_normal(normal: Float[np.ndarray, "s 2 3"], sigma_rad: Float[np.ndarray, "s"]) -> Float[np.ndarray, "3"]:
    """The normal with which one of the two answers of most sightings agrees; NaN for none, or for more than one."""
    unknown = np.full(3, np.nan)
    if len(normal) < _SIGHTINGS_OF_NORMAL:
        return unknown
    variance = sigma_rad**2 + _LEAST_NORMAL_RAD**2

    def agreement(n: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "c s"]:
        apart2 = ((normal[None] - n[:, None, None]) ** 2).sum(axis=3).min(axis=2)
        return np.asarray(np.exp(-0.5 * apart2 / variance))

    tried = normal[np.linspace(0, len(normal) - 1, min(len(normal), _TRIED)).astype(int)].reshape(-1, 3)
    support = np.log(_DISSENT + agreement(tried)).sum(axis=1)
    best = tried[support.argmax()]
    other = np.linalg.norm(tried - best, axis=1) > _OTHER_RAD
    if support[other].max(initial=-np.inf) > support.max() - _DECISIVE:
        return unknown
    for _ in range(3):
        nearer = ((normal - best) ** 2).sum(axis=2).argmin(axis=1)
        weight = agreement(best[None])[0] / variance
        best = (normal[np.arange(len(normal)), nearer] * weight[:, None]).sum(axis=0)
        best /= np.linalg.norm(best)
    return best if agreement(best[None])[0].mean() > 0.5 else unknown


def _off(
    observations: DotObservations | PointObservations,
    seen: _Sightings,
    T: Sequence[Pose],
    xyz_mm: Float[np.ndarray, "k 3"],
    rigs: Sequence[StereoRig],
) -> Float[np.ndarray, "m d"]:
    """Each observation less where its target should be (px or mm); NaN behind the camera."""
    if isinstance(observations, PointObservations):
        return np.asarray(observations.xyz_mm - _in_sensor(seen, T, xyz_mm))
    uv = np.empty((len(seen), 2))
    for lens, rows, place in _by_camera(seen, T, xyz_mm, rigs):
        uv[rows] = lens.project(place)
    return np.asarray(observations.uv_px - uv)


def _by_camera(
    seen: _Sightings, T: Sequence[Pose], xyz_mm: Float[np.ndarray, "k 3"], rigs: Sequence[StereoRig]
) -> Iterator[tuple[Camera, Int[np.ndarray, "g"], Float[np.ndarray, "g 3"]]]:
    """Every camera, which sightings are its own, and where their targets are in its coordinates."""
    in_sensor = _in_sensor(seen, T, xyz_mm)
    number = {id(rig): k for k, rig in enumerate(rigs)}
    key = 2 * np.array([number[id(rig)] for rig in rigs], dtype=np.int64)[seen.frame] + seen.camera
    order = np.argsort(key, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(key) else ():
        k, camera = divmod(int(key[rows[0]]), 2)
        rig = rigs[k]
        yield (
            (rig.right, rows, rig.T_right_left.apply(in_sensor[rows])) if camera else (rig.left, rows, in_sensor[rows])
        )


def _in_sensor(seen: _Sightings, T: Sequence[Pose], xyz_mm: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "m 3"]:
    R, t = np.array([each.R for each in T])[seen.frame], np.array([each.t_mm for each in T])[seen.frame]
    return np.asarray(np.einsum("mji,mj->mi", R, xyz_mm[seen.target] - t))
