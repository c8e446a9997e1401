"""The nouns: frozen data that travels between stages.

Arrays are read-only by agreement. A later record names rows of an earlier one by index, so nothing is relabelled on
the way. Units are in the names; coordinates are ``sensor`` (left camera: x right, y down, z forward) or ``world``.
"""

from dataclasses import dataclass, field, fields, replace
from enum import Enum, IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose

GreyOrColour = (
    UInt8[np.ndarray, "_ _"] | UInt16[np.ndarray, "_ _"] | UInt8[np.ndarray, "_ _ 3"] | UInt16[np.ndarray, "_ _ 3"]
)

_RAY = 0.3  # standard deviation of a single dot's target along the ray, in depths: as good as unknown


class Reason(Enum):
    """Why a frame was refused: a closed list, each value a sentence for the operator."""

    unreadable_image = "An image of this frame cannot be read."
    no_calibration = "No calibration is known for this frame."
    bad_points = "The frame holds values that are not finite numbers, or out of all bounds."
    time_reversed = "The frame is older than the one before it."
    too_few_points = "Fewer than three points were seen by both cameras."
    no_candidate = "No constellation of the frame resembles one in the map."
    not_proven = "A pose was found, but its agreement with the map could be chance."
    residual = "A pose was found, but it leaves residuals above the threshold."
    ambiguous = "Several poses explain the frame about equally well."
    weak_geometry = "The targets were identified, but they do not hold the pose firmly enough."
    other_island = "The frame belongs to a part of the object that nothing connects to the map yet."
    out_of_time = "The search reached its limit before anything was proven."


class PositionedReason(Enum):
    """What is special about a positioned frame; most have none of these."""

    defines_world = "The first frame: its sensor coordinates are the world's."
    few_points = "Fewer than three points; carried by dots of a single camera or by the motion."


@dataclass(frozen=True, slots=True, eq=False)
class StereoImages:
    """What the two cameras delivered for one frame."""

    left: GreyOrColour
    """Image of camera 0, (h, w) grey or (h, w, 3) BGR, 8 or 16 bit."""
    right: GreyOrColour
    """Image of camera 1; it may have another size than the left one."""


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """The dots of one image."""

    uv_px: Float[np.ndarray, "n 2"]
    """Centre of the dot's ellipse (px), uncorrected for eccentricity; or among ``Step.centres`` the image of its
    target's centre."""
    cov_px2: Float[np.ndarray, "n 2 2"]
    """Covariance of the centre (px²), before the recording's noise scale."""
    ellipse: Float[np.ndarray, "n 3"]
    """Semi-axes a ≥ b (px) and the angle of the long one from the u axis (rad); NaN where unknown, a = b where only the
    size is known."""
    label: Int[np.ndarray, "n"]
    """Class of the dot (size, colour, code); -1 where it has none."""
    row: Int[np.ndarray, "n"]
    """Row in the recording's dots.csv, or 0..n-1 where the dots were detected."""

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def diameter_px(self) -> Float[np.ndarray, "n"]:
        """Diameter of the circle of the same area; NaN where unknown."""
        return np.asarray(2 * np.sqrt(self.ellipse[:, 0] * self.ellipse[:, 1]))

    @staticmethod
    def of(
        uv_px: Float[np.ndarray, "n 2"],
        sigma_px: float = 0.3,
        diameter_px: Float[np.ndarray, "n"] | None = None,
    ) -> "Dots":
        """Dots from their centres alone, all with the same circular error."""
        n = len(uv_px)
        radius = np.full(n, np.nan) if diameter_px is None else diameter_px / 2
        return Dots(
            uv_px=np.asarray(uv_px, dtype=float),
            cov_px2=np.tile(np.eye(2) * sigma_px**2, (n, 1, 1)),
            ellipse=np.stack([radius, radius, np.zeros(n)], axis=1),
            label=np.full(n, -1),
            row=np.arange(n),
        )


@dataclass(frozen=True, slots=True, eq=False)
class StereoDots:
    """The dots of both images of one frame."""

    left: Dots
    """Dots of camera 0."""
    right: Dots
    """Dots of camera 1."""


@dataclass(frozen=True, slots=True, eq=False)
class StereoMatches:
    """Pairs of dots that may be the same target; one dot may stand in several rows."""

    left: Int[np.ndarray, "m"]
    """Row of the left dot."""
    right: Int[np.ndarray, "m"]
    """Row of the right dot."""
    epipolar_px: Float[np.ndarray, "m"]
    """Signed misfit: the epipolar constraint's residual over what an error of one pixel in every coordinate makes."""
    epipolar_sigma_px: Float[np.ndarray, "m"]
    """Its standard deviation from the dots' covariances, before the recording's noise scale."""

    def __len__(self) -> int:
        return len(self.left)

    def rows(self, rows: Int[np.ndarray, "r"]) -> "StereoMatches":
        """Some of the pairs."""
        return StereoMatches(self.left[rows], self.right[rows], self.epipolar_px[rows], self.epipolar_sigma_px[rows])


@dataclass(frozen=True, slots=True, eq=False)
class SensorPoints:
    """Points of one frame in sensor coordinates."""

    xyz_mm: Float[np.ndarray, "n 3"]
    """Position, sensor coordinates (mm)."""
    cov_mm2: Float[np.ndarray, "n 3 3"]
    """Covariance (mm²), noise scale applied."""
    match: Int[np.ndarray, "n"]
    """Row of ``StereoMatches``; -1 where the points were given."""
    label: Int[np.ndarray, "n"]
    """Class of the target; -1 where it has none."""
    row: Int[np.ndarray, "n"]
    """Row in the recording's points.csv, or 0..n-1 where the points were triangulated."""
    is_cov_known: bool = True
    """False where the covariance is a default that awaits the recording's noise scale."""

    def __len__(self) -> int:
        return len(self.xyz_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Unusable:
    """A frame whose content could not be had."""

    reason: Reason
    """unreadable_image, no_calibration or bad_points."""
    detail: str
    """What was found, in one sentence."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One stereo exposure, at whatever level the source delivers it."""

    index: int
    """Number of the frame in its recording."""
    timestamp_ns: int
    """Time of the exposure (ns)."""
    rig: StereoRig | None
    """The stereo geometry of this exposure; None only with points, which need none."""
    content: StereoImages | StereoDots | SensorPoints | Unusable
    """What was seen."""


class TargetState(IntEnum):
    """How far a target is believed."""

    provisional = 0
    """Seen too seldom to be sure that it exists."""
    trusted = 1
    """Seen again from other poses, or given."""
    quarantined = 2
    """Known to have moved or to mislead; kept aside."""
    removed = 3
    """No longer part of the map; its row awaits a new target."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceMap:
    """All targets known so far, in world coordinates: the paper's list S (part P6, eq. 1-1).

    Rows keep their number for as long as the target lives. The arrays are views of storage that grows in place: copy
    them to keep a state. Rows in state ``removed`` hold nothing.
    """

    id: Int[np.ndarray, "k"]
    """Identity of the target, never used twice."""
    xyz_mm: Float[np.ndarray, "k 3"]
    """Position, world coordinates (mm)."""
    cov_mm2: Float[np.ndarray, "k 3 3"]
    """Covariance of the position (mm²)."""
    view: Float[np.ndarray, "k 3"]
    """Mean unit direction towards the sensors that saw it, or the given normal; NaN where unknown."""
    sightings: Int[np.ndarray, "k"]
    """Frames in which it was seen."""
    last_seen: Int[np.ndarray, "k"]
    """Index of the newest frame that saw it; -1 if none did."""
    misses: Int[np.ndarray, "k"]
    """Frames that should have seen it and did not."""
    state: Int[np.ndarray, "k"]
    """A ``TargetState``."""
    joint_mm2: Float[np.ndarray, "k3 k3"] | None = None
    """Covariance of all positions together (mm²), where the map was adjusted as a whole; its blocks are ``cov_mm2``."""

    def __len__(self) -> int:
        return len(self.id)

    def distance(self, a: int, b: int) -> tuple[float, float]:
        """Distance of the targets in two rows, and its standard deviation (mm).

        Where nothing is known of what their errors have in common, they are taken for independent.
        """
        offset = self.xyz_mm[a] - self.xyz_mm[b]
        length_mm = float(np.linalg.norm(offset))
        cov = self.cov_mm2[a] + self.cov_mm2[b]
        if self.joint_mm2 is not None:
            cross = self.joint_mm2[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
            cov = cov - cross - cross.T
        along = offset / max(length_mm, 1e-300)
        return length_mm, float(np.sqrt(max(along @ cov @ along, 0.0)))

    @property
    def alive(self) -> Bool[np.ndarray, "k"]:
        """Rows that may be identified: trusted or provisional."""
        return np.asarray(self.state <= TargetState.trusted)

    def rows(self, rows: Int[np.ndarray, "r"]) -> "ReferenceMap":
        """A map of some of the targets, in the order asked for, with storage of its own."""
        return ReferenceMap(
            self.id[rows],
            self.xyz_mm[rows],
            self.cov_mm2[rows],
            self.view[rows],
            self.sightings[rows],
            self.last_seen[rows],
            self.misses[rows],
            self.state[rows],
            None if self.joint_mm2 is None else _blocks_of(self.joint_mm2, rows),
        )

    def copy(self) -> "ReferenceMap":
        """The same map with storage of its own, but for the joint covariance, which never changes in place."""
        own = replace(self, joint_mm2=None).rows(np.arange(len(self)))
        return replace(own, joint_mm2=self.joint_mm2)

    @staticmethod
    def empty() -> "ReferenceMap":
        """A map without targets."""
        return ReferenceMap.given(np.zeros((0, 3)))

    @staticmethod
    def given(
        xyz_mm: Float[np.ndarray, "k 3"],
        cov_mm2: Float[np.ndarray, "k 3 3"] | None = None,
        view: Float[np.ndarray, "k 3"] | None = None,
        id: Int[np.ndarray, "k"] | None = None,
        sightings: Int[np.ndarray, "k"] | None = None,
        state: Int[np.ndarray, "k"] | None = None,
    ) -> "ReferenceMap":
        """A map of targets known beforehand, trusted unless ``state`` says otherwise."""
        k = len(xyz_mm)
        return ReferenceMap(
            id=np.arange(k) if id is None else id,
            xyz_mm=np.asarray(xyz_mm, dtype=float),
            cov_mm2=np.zeros((k, 3, 3)) if cov_mm2 is None else cov_mm2,
            view=np.full((k, 3), np.nan) if view is None else view,
            sightings=np.zeros(k, dtype=np.int64) if sightings is None else sightings,
            last_seen=np.full(k, -1),
            misses=np.zeros(k, dtype=np.int64),
            state=np.full(k, int(TargetState.trusted)) if state is None else state,
        )


def _blocks_of(joint: Float[np.ndarray, "k3 k3"], rows: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r3 r3"]:
    entries = (3 * rows[:, None] + np.arange(3)).ravel()
    return joint[np.ix_(entries, entries)]


@dataclass(frozen=True, slots=True)
class KnownLength:
    """The distance of two targets, measured by other means."""

    target_a: int
    """Identity of one target."""
    target_b: int
    """Identity of the other."""
    length_mm: float
    """Their distance (mm)."""
    sigma_mm: float
    """Its standard deviation (mm)."""
    source: str = "scale bar"
    """Where it was said, for complaints."""


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """h hypotheses, likeliest first, each saying of c points which targets they are."""

    point: Int[np.ndarray, "h c"]
    """Row of the point."""
    target: Int[np.ndarray, "h c"]
    """Row of the target."""
    comparisons: int = 0
    """Comparisons of triangles or distances that were made to find them."""
    expected_by_chance: float = float("inf")
    """Hypotheses that chance alone would have brought, by the technique's own estimate; infinite where it has none."""
    max_sigmas: float = 0.0
    """Lengths of their triangles agree within so many standard deviations; 0 where nothing is known of that."""

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True, slots=True, eq=False)
class Orientations:
    """The poses that h hypotheses lead to."""

    R: Float[np.ndarray, "h 3 3"]
    """Rotations of ``T_world_sensor``."""
    t_mm: Float[np.ndarray, "h 3"]
    """Translations (mm)."""
    cov: Float[np.ndarray, "h 6 6"]
    """Covariances of δ = (translation mm, rotation rad), T · exp(δ)."""
    is_valid: Bool[np.ndarray, "h"]
    """False where the pairs lie on one line and determine no pose."""
    d2: Float[np.ndarray, "h"]
    """Squared Mahalanobis distances of the pairs at that pose, summed; of three pairs, chi-square of three sides."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the sensor should be if it moved on as it did."""

    T_world_sensor: Pose
    """The pose."""
    cov: Float[np.ndarray, "6 6"]
    """Covariance of δ = (translation mm, rotation rad), T_true = T · exp(δ)."""
    turned: "Prediction | None" = None
    """The same if the sensor has turned off its way: as fast as before, in any direction."""


@dataclass(frozen=True, slots=True, eq=False)
class SingleDots:
    """Dots that one camera alone saw, and the targets that they are."""

    camera: Int[np.ndarray, "s"]
    """0: left, 1: right."""
    dot: Int[np.ndarray, "s"]
    """Row among the dots of that camera."""
    target: Int[np.ndarray, "s"]
    """Row of the target that it is."""
    residual_px: Float[np.ndarray, "s"]
    """Distance of the dot from the image of its target (px)."""
    xyz_mm: Float[np.ndarray, "s 3"]
    """Where the ray of the dot passes its target, sensor coordinates (mm)."""
    cov_mm2: Float[np.ndarray, "s 3 3"]
    """Its covariance (mm²), noise scale applied: that of a point of which nothing but the direction is known."""

    def __len__(self) -> int:
        return len(self.camera)

    def rows(self, rows: Int[np.ndarray, "r"] | Bool[np.ndarray, "s"]) -> "SingleDots":
        """Some of the dots."""
        return SingleDots(*(getattr(self, each.name)[rows] for each in fields(self)))

    @staticmethod
    def none() -> "SingleDots":
        """No such dots."""
        nothing = np.zeros(0, dtype=np.int64)
        return SingleDots(nothing, nothing, nothing, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))

    @staticmethod
    def of(
        camera: Int[np.ndarray, "s"],
        dot: Int[np.ndarray, "s"],
        target: Int[np.ndarray, "s"],
        dots: StereoDots,
        rig: StereoRig,
        T_world_sensor: Pose,
        map: ReferenceMap,
        noise_scale: float = 1.0,
    ) -> "SingleDots":
        """These dots as these targets, their residuals measured from the pose."""
        in_left = T_world_sensor.inverse().apply(map.xyz_mm[target])
        residual_px, xyz_mm, cov_mm2 = np.zeros(len(dot)), np.zeros((len(dot), 3)), np.zeros((len(dot), 3, 3))
        for side, (by, seen, T) in enumerate(
            ((rig.left, dots.left, Pose.identity()), (rig.right, dots.right, rig.T_right_left))
        ):
            rows = np.flatnonzero(camera == side)
            place, own = T.apply(in_left[rows]), dot[rows]
            residual_px[rows] = np.linalg.norm(by.project(place) - seen.uv_px[own], axis=1)
            slope = by.unproject(seen.uv_px[own])
            depth, ray = place[:, 2], np.c_[slope, np.ones(len(rows))]
            A = depth[:, None, None] * by.unproject_jacobian(slope)
            C = np.einsum("ni,nj,n->nij", ray, ray, (_RAY * depth) ** 2)
            C[:, :2, :2] += noise_scale**2 * A @ seen.cov_px2[own] @ A.transpose(0, 2, 1)
            xyz_mm[rows] = T.inverse().apply(ray * depth[:, None])
            cov_mm2[rows] = T.R.T @ C @ T.R
        return SingleDots(camera, dot, target, residual_px, xyz_mm, cov_mm2)


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A verified pose of the sensor."""

    T_world_sensor: Pose
    """The pose."""
    cov: Float[np.ndarray, "6 6"]
    """Covariance of δ = (translation mm, rotation rad), T_true = T · exp(δ); the map's uncertainty included."""
    point: Int[np.ndarray, "c"]
    """Rows of the identified points."""
    target: Int[np.ndarray, "c"]
    """Rows of the targets that they are."""
    residual_mm: Float[np.ndarray, "c"]
    """Distance of each identified point from its target (mm)."""
    p_chance: float
    """Upper bound of the probability that the agreement is chance; NaN where the frame defines the world."""
    reason: PositionedReason | None = None
    """What is special about this fix."""
    detail: str = ""
    """Free text."""
    single: SingleDots = field(default_factory=SingleDots.none)
    """What only one camera saw of the map."""

    def with_targets_of(self, map: ReferenceMap) -> "tuple[Fix, ReferenceMap]":
        """The same fix on a map of its own targets alone, and that map."""
        c, s = len(self.target), len(self.single)
        single = replace(self.single, target=np.arange(c, c + s))
        own = map.rows(np.concatenate([self.target, self.single.target]))
        return replace(self, target=np.arange(c), single=single), own

    def moved_to(
        self,
        targets: ReferenceMap,
        map: ReferenceMap,
        points: SensorPoints,
        dots: StereoDots | None,
        rig: StereoRig | None,
    ) -> "Fix":
        """The same fix with its targets' rows in another state of the map; those that have left it are left out."""
        alive = np.flatnonzero(map.alive)
        row_of = dict(zip(map.id[alive].tolist(), alive.tolist(), strict=True))

        def rows_of(target: Int[np.ndarray, "c"]) -> Int[np.ndarray, "c"]:
            return np.array([row_of.get(each, -1) for each in targets.id[target].tolist()], dtype=np.int64)

        rows, single_rows = rows_of(self.target), rows_of(self.single.target)
        point, target = self.point[rows >= 0], rows[rows >= 0]
        residual = map.xyz_mm[target] - self.T_world_sensor.apply(points.xyz_mm[point])
        single = SingleDots.none()
        if dots is not None and rig is not None:
            single = replace(self.single, target=single_rows).rows(single_rows >= 0)
            T = self.T_world_sensor
            again = SingleDots.of(single.camera, single.dot, single.target, dots, rig, T, map)
            single = replace(single, residual_px=again.residual_px)
        residual_mm = np.linalg.norm(residual, axis=1)
        return replace(self, point=point, target=target, residual_mm=residual_mm, single=single)

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals (mm)."""
        return float(np.sqrt(np.mean(self.residual_mm**2))) if len(self.residual_mm) else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """A pose that explained an ambiguous frame about as well as another."""

    T_world_sensor: Pose
    """The pose."""
    log_odds: float
    """Natural logarithm of its likelihood ratio against chance."""
    matched: int
    """Points that it explains."""


@dataclass(frozen=True, slots=True, eq=False)
class NoFix:
    """A refusal, with its reason."""

    why: Reason
    """The reason, whose value is a sentence for the operator."""
    detail: str = ""
    """Numbers, where there are some."""
    p_chance: float = float("nan")
    """That of the best candidate; NaN if there was none."""
    matched: int = 0
    """Points that the best candidate explains."""
    residual_mm: float = float("nan")
    """Root mean square residual of the best candidate (mm)."""
    rivals: tuple[Rival, ...] = ()
    """The poses that could not be told apart, best first."""
    weak: Fix | None = None
    """For weak_geometry: the fix that it would be, were it firmer; it still tells how noisy the frame is."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to the map."""

    event: str
    """target_moved, target_removed, target_merged, target_quarantined, island_founded, island_joined, update_undone."""
    target: int | None
    """Identity of the target, where it concerns one."""
    detail: str = ""
    """Free text."""


@dataclass(frozen=True, slots=True, eq=False)
class Elsewhere:
    """Where a frame stands that is not in the world: on an island, a map that nothing connects to it yet."""

    island: int
    """Number of the island, from 1."""
    fix: Fix
    """The pose in the island's own coordinates."""
    map: ReferenceMap
    """The island's targets after this frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """All that is known about one frame once it has been judged. Who watches, watches Steps."""

    frame: Frame
    """What came in."""
    dots: StereoDots | None
    """Dots, unless the recording begins with points."""
    matches: StereoMatches | None
    """Stereo pairs, unless the recording begins with points."""
    points: SensorPoints | None
    """Points; None for an unusable frame."""
    identification: Identification | None
    """The hypotheses, best first; None where none were sought."""
    fix: Fix | NoFix
    """The answer."""
    added: Int[np.ndarray, "a"]
    """Rows of targets that entered the map with this frame."""
    map: ReferenceMap
    """The map after this frame: a view that shares storage, copy it to keep it."""
    noise_scale: float
    """Factor on all standard deviations found so far."""
    events: tuple[Event, ...] = ()
    """What happened to the map."""
    timings_ms: dict[str, float] = field(default_factory=dict)
    """Milliseconds per stage."""
    elsewhere: Elsewhere | None = None
    """Where the frame stands if it is on an island."""
    centres: StereoDots | None = None
    """The dots, row by row, at the images of their targets' centres, with the covariances that they have there: what
    points, poses, residuals and any adjustment rest on. ``dots`` are as they were found, at their ellipses' centres.
    Where ``matches`` has no row for a dot, its centre is the mean of two answers, and their spread no chance error."""

    def remembered(self) -> "Step":
        """The same without what is large: images, hypotheses, and of the map all but the identified targets."""
        step = replace(
            self,
            frame=self.frame if self.dots is None else replace(self.frame, content=self.dots),
            identification=None,
            added=np.zeros(0, dtype=np.int64),
        )
        if isinstance(step.fix, Fix):
            fix, targets = step.fix.with_targets_of(step.map)
            step = replace(step, fix=fix, map=targets)
        else:
            step = replace(step, map=ReferenceMap.empty())
        if step.elsewhere is not None:
            fix, targets = step.elsewhere.fix.with_targets_of(step.elsewhere.map)
            step = replace(step, elsewhere=replace(step.elsewhere, fix=fix, map=targets))
        return step
