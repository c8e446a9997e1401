"""Steps against truth: rates, errors, consistency of the covariances. Computed once, for report, tests and benchmarks.

Every rate is counted on truth alone, never on what the program trusts. ``compare_poses``, ``normalised_errors`` and
``compare_targets`` work on arrays; ``evaluate`` feeds them from a results folder and a truth folder. How the results
came about is not its business, nor how the figures are shown.
"""

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.errors import RecordingError
from trifix.files.images import holds_images
from trifix.files.maps import read_map
from trifix.files.recordings import LEVELS, Level, Recording, read_recording
from trifix.files.tables import Table, read_table
from trifix.files.trajectories import read_poses
from trifix.files.truth import Truth, read_truth
from trifix.geometry.alignment import align, align_weighted, point_jacobian, spread_off_line_mm
from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.records import (
    Dots,
    PositionedReason,
    ReferenceMap,
    SensorPoints,
    StereoDots,
    StereoMatches,
    TargetState,
)
from trifix.stages.triangulate import correct_eccentricity, triangulate

SIGMAS = 5.0
"""A wrong pose that is nearer than this to the pose of the true labels is drift, not misidentification."""
LINE_RMS_MM = 3.0
"""Targets lie on one line if they are nearer to it than this (mm rms)."""
SOON_S = 0.2
"""A frame so little after a fix may be positioned by three targets, as the motion speaks too."""
FEW_EQUATIONS = 7
"""As many equations overdetermine a pose, be they of fewer than three points and of dots of a single camera."""
NEAR_PX = 2.0
"""A detected dot is the nearest imaged target within this distance (px)."""


@dataclass(frozen=True, slots=True)
class Share:
    """So many of so many."""

    count: int
    """How many."""
    of: int
    """Of how many."""

    def __str__(self) -> str:
        return f"{self.count} of {self.of}" + (f" ({100 * self.count / self.of:.1f} %)" if self.of else "")


@dataclass(frozen=True, slots=True)
class Spread:
    """Absolute errors in three numbers; NaN where there are none."""

    median: float
    """Half are smaller."""
    rmse: float
    """Root mean square."""
    max: float
    """The largest."""

    @staticmethod
    def of(errors: Float[np.ndarray, "n"]) -> "Spread":
        """Of n absolute errors."""
        if not len(errors):
            return Spread(math.nan, math.nan, math.nan)
        return Spread(float(np.median(errors)), float(np.sqrt(np.mean(errors**2))), float(errors.max()))


@dataclass(frozen=True, slots=True)
class Consistency:
    """Whether covariances tell the truth: normalised squared errors (NEES), 6 degrees of freedom a pose.

    The limits hold for independent errors. Poses share the errors of the map, so honest covariances may leave them,
    all the more the fewer targets there are.
    """

    poses: int
    """Poses with a covariance; those that define the world and misidentified ones are left out."""
    mean: float
    """Mean squared error in units of the covariance, over the degrees of freedom: 1 is honest, more overconfident."""
    low: float
    """The mean lies above this with 97.5 % probability."""
    high: float
    """The mean lies below this with 97.5 % probability."""
    inside: Share
    """Poses whose own squared error lies between its 2.5 % and 97.5 % limits; expected 95 %."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """n poses against their truth."""

    T_truth_world: Pose
    """The one rigid motion from the poses' world to the truth's; the identity if the map was given."""
    error_mm: Float[np.ndarray, "n"]
    """Distance from the true position (mm)."""
    error_deg: Float[np.ndarray, "n"]
    """Angle to the true rotation (degrees)."""
    is_wrong: Bool[np.ndarray, "n"]
    """Off by more than one of the limits."""
    ape_rmse_mm: float
    """Absolute pose error as the field reports it (evo): rms distance after aligning the positions alone (mm)."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetErrors:
    """Targets of a map against their truth."""

    error_mm: Float[np.ndarray, "n"]
    """Distance from the true position (mm), after alignment unless the map was given."""
    found: Share
    """True targets that stand in the map."""
    duplicates: int
    """Targets that are the same true target as another."""
    unknown: int
    """Targets that are no true target: clutter, or reflections."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A run against truth. ``table`` puts it in words, ``to_dict`` makes it ready for JSON."""

    frames: int
    """Frames of the recording."""
    positioned: int
    """Frames with a pose."""
    refused: dict[str, int]
    """Frames without, per reason."""
    is_map_given: bool
    """Poses were compared in the coordinates of the given map, without alignment."""
    is_online: bool
    """Every frame was judged by what was known at its time."""
    of_positionable: Share
    """Positioned frames, of those with three targets seen by both cameras here and in two earlier frames."""
    of_reachable_online: Share
    """Positioned frames, of those that a map growing frame by frame can reach."""
    of_reachable_offline: Share
    """Positioned frames, of those linked in any order."""
    of_sharing: Share
    """Positioned frames, of those that share three targets not on one line with the program's own map as of then."""
    of_online4: Share
    """Positioned frames, of those that share four targets or more, not on one line, with the map as of then that truth
    lets grow: from the first usable frame, by every frame that shares three. A given map is whole from the start."""
    of_online3: Share
    """Positioned frames, of those that share exactly three with it, within ``SOON_S`` of the last positioned frame."""
    of_few: Share
    """Positioned frames, of those with fewer than three points, but ``FEW_EQUATIONS`` equations or more on targets of
    that map which are not on one line: three for a target that both cameras saw, two for one that one of them saw."""
    wrong: int
    """Poses off truth by more than the limits."""
    wrong_mm: float
    """Limit on the position (mm)."""
    wrong_deg: float
    """Limit on the rotation (degrees)."""
    misidentified: tuple[int, ...]
    """Frames whose pose is off by more than the limits, and by more than five sigma, from the pose that the frame's
    true labels give against the same map. This must never happen."""
    drifted: int
    """Wrong poses that are not misidentified."""
    unlabelled: int
    """Poses of frames with too few true labels for a pose, single dots among them: these are misidentified when wrong
    against truth."""
    error_mm: Spread
    """Position against truth, all positioned frames (mm)."""
    error_deg: Spread
    """Rotation against truth, all positioned frames (degrees)."""
    drift_mm: Spread
    """Position against truth, misidentified frames left out (mm)."""
    drift_deg: Spread
    """Rotation against truth, misidentified frames left out (degrees)."""
    ape_rmse_mm: float
    """Absolute pose error as evo reports it (mm)."""
    sightings: Share
    """Sightings identified rightly, of those that concern a true target."""
    consistency: Consistency
    """Whether the poses' covariances tell the truth, in the gauge of the output."""
    targets: Share
    """True targets that stand in the map, of all."""
    duplicates: int
    """Targets that are the same true target as another."""
    unknown_targets: int
    """Targets of the map that are no true target."""
    target_mm: Spread
    """Targets against truth (mm)."""

    def to_dict(self) -> dict[str, object]:
        """The same as plain values for JSON, which has no NaN: those become null."""
        plain: dict[str, object] = json.loads(json.dumps(asdict(self)), parse_constant=lambda _: None)
        return plain


def table(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Rows of (what, figure with unit) for people."""
    e = evaluation
    limits = f"{e.wrong_mm:g} mm or {e.wrong_deg:g}°"
    return [
        ("frames", str(e.frames)),
        ("positioned", str(Share(e.positioned, e.frames))),
        *((f"refused: {reason}", str(count)) for reason, count in e.refused.items()),
        ("positioned of positionable", str(e.of_positionable)),
        ("positioned of reachable online", str(e.of_reachable_online)),
        ("positioned of reachable offline", str(e.of_reachable_offline)),
        ("positioned of those sharing three targets with the map", str(e.of_sharing)),
        *(_online_rows(e) if e.is_online else ()),
        ("positioned of those with few points, but dots enough", str(e.of_few)),
        (f"wrong poses (beyond {limits})", str(e.wrong)),
        ("misidentified", str(len(e.misidentified))),
        ("drifted", str(e.drifted)),
        ("poses without labels enough to judge them", str(e.unlabelled)),
        ("position error, median · rms · worst", _figures(e.error_mm, "mm")),
        ("rotation error, median · rms · worst", _figures(e.error_deg, "°")),
        ("drift in position, median · rms · worst", _figures(e.drift_mm, "mm")),
        ("drift in rotation, median · rms · worst", _figures(e.drift_deg, "°")),
        ("absolute pose error, rms", "none" if math.isnan(e.ape_rmse_mm) else f"{e.ape_rmse_mm:.3f} mm"),
        ("sightings identified rightly", str(e.sightings)),
        (
            "squared pose error over its covariance, mean",
            f"{e.consistency.mean:.2f} ({e.consistency.low:.2f} to {e.consistency.high:.2f} expected)"
            if e.consistency.poses
            else "none",
        ),
        ("poses within their own 95 % limits", str(e.consistency.inside)),
        ("true targets in the map", str(e.targets)),
        ("targets twice in the map", str(e.duplicates)),
        ("targets of the map that are none", str(e.unknown_targets)),
        ("target error, median · rms · worst", _figures(e.target_mm, "mm")),
    ]


def _online_rows(e: Evaluation) -> list[tuple[str, str]]:
    """What the whole recording, where a run may use it, would turn round: a later frame can help an earlier one."""
    return [
        ("positioned of those sharing four or more with the true map", str(e.of_online4)),
        (f"positioned of those sharing three, within {SOON_S:g} s of a fix", str(e.of_online3)),
    ]


def compare_poses(
    estimated: Sequence[Pose],
    truth: Sequence[Pose],
    *,
    is_map_given: bool = False,
    wrong_mm: float = 3.0,
    wrong_deg: float = 0.5,
) -> PoseErrors:
    """Poses of the sensor against the true ones, as they are if the map was given, else after one rigid alignment.

    The alignment uses positions and rotations, with the lever arm at which the two limits weigh the same, so that a
    short or straight path does not leave it open; and it goes with the majority, so that wrong poses do not hide.
    """
    T_truth_world, ape_rmse_mm = Pose.identity(), math.nan
    if estimated:
        positions = np.array([T.t_mm for T in estimated])
        true_positions = np.array([T.t_mm for T in truth])
        if not is_map_given:
            lever_mm = wrong_mm / math.radians(wrong_deg)
            corners = np.vstack([np.zeros((1, 3)), np.eye(3)]) * lever_mm
            T_truth_world, _ = _align_majority(
                np.array([T.apply(corners) for T in estimated]), np.array([T.apply(corners) for T in truth])
            )
            positions = align(positions, true_positions).apply(positions)
        ape_rmse_mm = float(np.sqrt(((positions - true_positions) ** 2).sum(axis=1).mean()))
    offsets = [T_true.inverse() @ T_truth_world @ T for T, T_true in zip(estimated, truth, strict=True)]
    error_mm = np.array([np.linalg.norm(T.t_mm) for T in offsets])
    error_deg = np.degrees([T.angle_rad() for T in offsets])
    return PoseErrors(T_truth_world, error_mm, error_deg, (error_mm > wrong_mm) | (error_deg > wrong_deg), ape_rmse_mm)


def normalised_errors(
    estimated: Sequence[Pose], truth: Sequence[Pose], cov: Float[np.ndarray, "n 6 6"], *, is_map_given: bool = False
) -> Float[np.ndarray, "n"]:
    """Squared errors in units of their covariance, δᵀ C⁻¹ δ with T_true = T_est · exp(δ), as the output means them.

    Unless the map was given, the world is the sensor of the first pose: truth is brought into that gauge, not aligned.
    NaN where the covariance is singular, as that of the pose which defines the world.
    """
    T_world_truth = Pose.identity() if is_map_given or not estimated else estimated[0] @ truth[0].inverse()
    nees = np.full(len(estimated), np.nan)
    for k, (T, T_true, C) in enumerate(zip(estimated, truth, cov, strict=True)):
        if np.linalg.eigvalsh(C)[0] > 0:
            delta = (T.inverse() @ T_world_truth @ T_true).log()
            nees[k] = delta @ np.linalg.solve(C, delta)
    return nees


def consistency(nees: Float[np.ndarray, "n"]) -> Consistency:
    """Squared normalised errors of n poses, NaN left out, against the chi-square law of 6 degrees of freedom."""
    from scipy.special import chdtri

    known = nees[np.isfinite(nees)]
    n = len(known)
    if not n:
        return Consistency(0, math.nan, math.nan, math.nan, Share(0, 0))
    low, high = (float(chdtri(6 * n, p)) / (6 * n) for p in (0.975, 0.025))
    inside = int(((known > chdtri(6, 0.975)) & (known < chdtri(6, 0.025))).sum())
    return Consistency(n, float(known.mean()) / 6, low, high, Share(inside, n))


def compare_targets(
    xyz_mm: Float[np.ndarray, "k 3"],
    identity: Int[np.ndarray, "k"],
    true_xyz_mm: Mapping[int, Float[np.ndarray, "3"]],
    *,
    is_map_given: bool = False,
) -> TargetErrors:
    """Targets of a map against the true targets that they are (-1: none), after one alignment of their own."""
    known = identity >= 0
    b, a = xyz_mm[known], np.array([true_xyz_mm[int(i)] for i in identity[known]]).reshape(-1, 3)
    if len(b) >= 3 and not is_map_given:
        T, _ = _align_majority(b[:, None], a[:, None])
        b = T.apply(b)
    found = len(set(identity[known].tolist()))
    return TargetErrors(
        error_mm=np.asarray(np.linalg.norm(b - a, axis=1)),
        found=Share(found, len(true_xyz_mm)),
        duplicates=int(known.sum()) - found,
        unknown=int((~known).sum()),
    )


def _align_majority(b: Float[np.ndarray, "n k 3"], a: Float[np.ndarray, "n k 3"]) -> tuple[Pose, Bool[np.ndarray, "n"]]:
    """``T_a_b`` of the items (k points each) that agree with the median, and which these are.

    Least trimmed squares (Rousseeuw 1984): align the nearer half until it stays the same, then all within three
    medians. Up to a good third of the items may be off, even if they agree among themselves.
    """
    n, k = b.shape[:2]
    half = min(n, max(n // 2 + 1, math.ceil(3 / k)))
    kept = np.ones(n, dtype=bool)
    for _ in range(30):
        T = align(b[kept].reshape(-1, 3), a[kept].reshape(-1, 3))
        distance = _rms_distance(T, b, a)
        nearer = np.zeros(n, dtype=bool)
        nearer[np.argsort(distance, kind="stable")[:half]] = True
        if (nearer == kept).all():
            break
        kept = nearer
    kept = distance <= max(3 * float(np.median(distance)), 1e-6)
    return align(b[kept].reshape(-1, 3), a[kept].reshape(-1, 3)), kept


def _rms_distance(T: Pose, b: Float[np.ndarray, "n k 3"], a: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n"]:
    moved = T.apply(b.reshape(-1, 3)).reshape(b.shape)
    return np.asarray(np.sqrt(((moved - a) ** 2).sum(axis=2).mean(axis=1)))


def _figures(spread: Spread, unit: str) -> str:
    if math.isnan(spread.rmse):
        return "none"
    return f"{spread.median:.3f} · {spread.rmse:.3f} · {spread.max:.3f} {unit}"


# --- from the folders ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Labelled:
    """Points of one frame of which it is known which true targets they are, each target once."""

    id: Int[np.ndarray, "p"]
    xyz_mm: Float[np.ndarray, "p 3"]
    cov_mm2: Float[np.ndarray, "p 3 3"]
    single: "_LabelledDots | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class _LabelledDots:
    """Dots of targets that one camera alone saw, of which it is known which they are."""

    rig: StereoRig
    camera: Int[np.ndarray, "d"]
    id: Int[np.ndarray, "d"]
    uv_px: Float[np.ndarray, "d 2"]
    cov_px2: Float[np.ndarray, "d 2 2"]


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """What was said to be which target, and which true target it is; -1: none."""

    frame: Int[np.ndarray, "s"]
    target: Int[np.ndarray, "s"]
    label: Int[np.ndarray, "s"]


def evaluate(
    out: Path,
    truth: Path,
    *,
    wrong_mm: float = 3.0,
    wrong_deg: float = 0.5,
    is_map_given: bool | None = None,
    recording: Path | None = None,
) -> Evaluation:
    """The results folder ``out`` against the truth folder ``truth``.

    The limits say from where a pose is wrong; some recordings state their own. Without ``is_map_given`` the map counts
    as given if no frame defines the world. ``recording`` holds the points or dots from which the poses of the true
    labels are worked out; without it, it is sought beside the truth.

    Raises:
        RecordingError: a file is missing or broken, or results and truth are not of one recording.
    """
    results = read_table(out / "frames.csv", {"frame": int, "timestamp_ns": int, "status": str}, {"reason": str})
    is_positioned = results["status"] == "positioned"
    reasons = results.get("reason", np.full(len(is_positioned), "", dtype=object))
    frame, _, estimated, cov = read_poses(out / "poses.csv")
    targets = read_map(out / "map.csv")
    if is_map_given is None:
        is_map_given = len(targets) > 0 and PositionedReason.defines_world.name not in reasons
    level, is_online = _level_of(out)
    known = read_truth(truth)
    source = _recording_beside(truth, level) if recording is None else read_recording(recording, level)

    true_poses = _true_poses(known, frame)
    _refuse_other_times(out / "frames.csv", results, known)
    errors = compare_poses(estimated, true_poses, is_map_given=is_map_given, wrong_mm=wrong_mm, wrong_deg=wrong_deg)
    labelled, labels = _labels(out, level, source, known)
    sightings = _read_sightings(out / "sightings.csv", labels)
    true_xyz_mm = dict(zip(known.targets.id.tolist(), known.targets.xyz_mm, strict=True))
    identity = _identities(targets, sightings, true_xyz_mm, wrong_mm if is_map_given else None)
    is_misidentified, is_judged = _misidentified(
        frame, estimated, true_poses, errors, targets, identity, labelled, wrong_mm, wrong_deg
    )
    if is_online:  # the map has moved on since: poses are told by the map of their time
        is_misidentified &= ~np.isin(frame, list(_frames_identified_rightly(sightings, identity, labelled)))
    is_right = ~is_misidentified

    is_trusted = targets.state == TargetState.trusted
    target_errors = compare_targets(
        targets.xyz_mm[is_trusted],
        np.array([identity.get(i, -1) for i in targets.id[is_trusted].tolist()], dtype=np.int64),
        true_xyz_mm,
        is_map_given=is_map_given,
    )
    judged, positioned = set(results["frame"].tolist()), set(results["frame"][is_positioned].tolist())

    def share_of(frames: Iterable[int]) -> Share:
        which = judged & set(frames)
        return Share(len(which & positioned), len(which))

    index = known.frames.index
    shared = _shared_with_truth(
        known, labelled, true_xyz_mm, set(identity.values()) & set(true_xyz_mm) if is_map_given else None
    )
    return Evaluation(
        frames=len(judged),
        positioned=len(positioned),
        refused=dict(Counter(reasons[~is_positioned].tolist()).most_common()),
        is_map_given=is_map_given,
        is_online=is_online,
        of_positionable=share_of(index[known.frames.positionable].tolist()),
        of_reachable_online=share_of(index[known.frames.reachable_online].tolist()),
        of_reachable_offline=share_of(index[known.frames.reachable_offline].tolist()),
        of_sharing=share_of(
            _sharing(labelled, sightings, set(identity.values()) if is_map_given else set(), true_xyz_mm)
        ),
        of_online4=share_of(frame for frame, each in shared.items() if each.both >= 4),
        of_online3=share_of(
            {frame for frame, each in shared.items() if each.both == 3} & _soon(results, is_positioned)
        ),
        of_few=share_of(frame for frame, each in shared.items() if each.is_few),
        wrong=int(errors.is_wrong.sum()),
        wrong_mm=wrong_mm,
        wrong_deg=wrong_deg,
        misidentified=tuple(frame[is_misidentified].tolist()),
        drifted=int((errors.is_wrong & is_right).sum()),
        unlabelled=int((~is_judged).sum()),
        error_mm=Spread.of(errors.error_mm),
        error_deg=Spread.of(errors.error_deg),
        drift_mm=Spread.of(errors.error_mm[is_right]),
        drift_deg=Spread.of(errors.error_deg[is_right]),
        ape_rmse_mm=errors.ape_rmse_mm,
        sightings=_identified_rightly(sightings, identity),
        consistency=consistency(normalised_errors(estimated, true_poses, cov, is_map_given=is_map_given)[is_right]),
        targets=target_errors.found,
        duplicates=target_errors.duplicates,
        unknown_targets=target_errors.unknown,
        target_mm=Spread.of(target_errors.error_mm),
    )


def _level_of(out: Path) -> tuple[Level, bool]:
    """The level at which the run began, and whether it judged every frame by what was known at its time."""
    file = out / "summary.json"
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
        level, is_online = summary.get("level"), summary.get("is_online") is True
    except (OSError, ValueError) as fault:
        raise RecordingError(f"{file} cannot be read ({fault}); is {out} a results folder?") from fault
    for known in LEVELS:
        if level == known:
            return known, is_online
    raise RecordingError(f"{file}: found level {level!r}, expected one of {', '.join(LEVELS)}.")


def _recording_beside(truth: Path, level: Level) -> Recording | None:
    """The recording of some level in the folder that holds the truth; None if there is none."""
    for name in (f"recording_{level}", "recording"):
        folder = truth.resolve().parent / name
        if folder.is_dir() and (holds_images(folder) if level == "images" else (folder / f"{level}.csv").exists()):
            return read_recording(folder, level)
    return None


def _true_poses(truth: Truth, frames: Int[np.ndarray, "n"]) -> list[Pose]:
    row_of = {frame: row for row, frame in enumerate(truth.frames.index.tolist())}
    for frame in frames.tolist():
        if frame not in row_of:
            raise RecordingError(
                f"{truth.path} knows no frame {frame} of the results; do they belong to the same recording?"
            )
    return [truth.frames.T_map_sensor[row_of[frame]] for frame in frames.tolist()]


def _refuse_other_times(file: Path, results: Table, truth: Truth) -> None:
    """Refuses results whose frames were taken at other times than the true ones of the same number."""
    true_ns = dict(zip(truth.frames.index.tolist(), truth.frames.timestamp_ns.tolist(), strict=True))
    for frame, stamp in zip(results["frame"].tolist(), results["timestamp_ns"].tolist(), strict=True):
        if true_ns.get(frame, stamp) != stamp:
            raise RecordingError(
                f"{file}: frame {frame} has time stamp {stamp}, in {truth.path} it has {true_ns[frame]}; do they "
                f"belong to the same recording?"
            )


def _labels(
    out: Path, level: Level, source: Recording | None, truth: Truth
) -> tuple[dict[int, _Labelled], dict[str, Int[np.ndarray, "r"]]]:
    """The labelled points of each frame, and per kind of sighting the label of each row of its table."""
    if level == "points":
        ids = truth.id_of_point
        if ids is None:
            return {}, {}
        seen = ((frame.index, frame.content) for frame in source or ())
        points = {k: _once_each(p, _labels_of(p.row, ids)) for k, p in seen if isinstance(p, SensorPoints)}
        return points, {"point": ids}
    if level == "dots":
        ids = truth.id_of_dot
        frames = [
            (frame.index, frame.rig, frame.content) for frame in source or () if isinstance(frame.content, StereoDots)
        ]
    else:
        frames = [] if source is None else _detected(out / "dots.csv", source)
        ids = None if source is None else _labels_by_projection(frames, truth)
    if ids is None:
        return {}, {}
    points = {
        k: _triangulated(dots, rig, _labels_of(dots.left.row, ids), _labels_of(dots.right.row, ids))
        for k, rig, dots in frames
        if rig is not None
    }
    return points, {"left": ids, "right": ids}


def _labels_of(rows: Int[np.ndarray, "n"], ids: Int[np.ndarray, "r"]) -> Int[np.ndarray, "n"]:
    """The labels of some rows of a table."""
    strange = rows[(rows < 0) | (rows >= len(ids))]
    if len(strange):
        raise RecordingError(
            f"row {strange[0]} has no label in the truth, which knows {len(ids)} rows; do recording, results and truth "
            "belong together?"
        )
    return np.asarray(ids[rows])


def _once_each(points: SensorPoints, label: Int[np.ndarray, "n"]) -> _Labelled:
    """The points that are targets; of two with the same label, the first."""
    ids, first = np.unique(label, return_index=True)
    ids, first = ids[ids >= 0], first[ids >= 0]
    return _Labelled(ids, points.xyz_mm[first], points.cov_mm2[first])


def _triangulated(
    dots: StereoDots, rig: StereoRig, label_left: Int[np.ndarray, "l"], label_right: Int[np.ndarray, "r"]
) -> _Labelled:
    """The targets that both cameras saw, where their ellipses say that their centres are."""
    ids, left, right = np.intersect1d(label_left, label_right, return_indices=True)
    left, right = left[ids >= 0], right[ids >= 0]
    unused = np.zeros(len(left))
    matches = StereoMatches(left, right, unused, unused)
    dots = correct_eccentricity(dots, matches, rig)
    points = triangulate(dots, matches, rig)
    single = [
        (np.full(len(own), camera), own, seen.uv_px[row], seen.cov_px2[row])
        for camera, (seen, label, other) in enumerate(
            ((dots.left, label_left, label_right), (dots.right, label_right, label_left))
        )
        for own, row in [_unshared(label, other)]
    ]
    camera, own, uv_px, cov_px2 = (np.concatenate(column) for column in zip(*single, strict=True))
    seen_by_one = _LabelledDots(rig, camera, own, uv_px, cov_px2)
    return replace(_once_each(points, label_left[left[points.match]]), single=seen_by_one)


def _unshared(
    label: Int[np.ndarray, "n"], other: Int[np.ndarray, "m"]
) -> tuple[Int[np.ndarray, "d"], Int[np.ndarray, "d"]]:
    """The targets among one camera's labels that are not among the other's, and the row of each."""
    ids, row = np.unique(label, return_index=True)
    own = (ids >= 0) & ~np.isin(ids, other)
    return ids[own], row[own]


def _detected(file: Path, source: Recording) -> list[tuple[int, StereoRig | None, StereoDots]]:
    """The dots that the run itself found in the images, with the rig of each frame."""
    shape = ("a_px", "b_px", "theta_rad")
    numbers = dict.fromkeys(("u", "v", "sigma_px"), float)
    table = read_table(file, {"frame": int, "camera": int, **numbers}, dict.fromkeys(shape, float))
    unknown = np.full(len(table["u"]), np.nan)
    dots = replace(
        Dots.of(np.stack([table["u"], table["v"]], axis=1)),
        cov_px2=table["sigma_px"][:, None, None] ** 2 * np.eye(2),
        ellipse=np.stack([table.get(name, unknown) for name in shape], axis=1),
    )

    image = 2 * np.searchsorted(source.index, table["frame"]) + table["camera"]
    order = np.argsort(image, kind="stable")
    start = np.searchsorted(image[order], np.arange(2 * len(source) + 1))

    def of(i: int) -> Dots:
        at = order[start[i] : start[i + 1]]
        return Dots(dots.uv_px[at], dots.cov_px2[at], dots.ellipse[at], dots.label[at], at)

    return [
        (int(index), source.rigs.get(k, source.rig), StereoDots(of(2 * k), of(2 * k + 1)))
        for k, index in enumerate(source.index)
    ]


def _labels_by_projection(
    frames: Sequence[tuple[int, StereoRig | None, StereoDots]], truth: Truth
) -> Int[np.ndarray, "r"]:
    """Labels of detected dots: each target that faces the camera claims the dot nearest to its image.

    Unlike a table of labels this does not know what hides a target, but a hidden target rarely has a dot so near.
    """
    ids = np.full(sum(len(dots.left) + len(dots.right) for _, _, dots in frames), -1)
    targets = truth.targets
    T_of = dict(zip(truth.frames.index.tolist(), truth.frames.T_map_sensor, strict=True))
    for index, rig, dots in frames:
        if rig is None or index not in T_of:
            continue
        is_there = (targets.valid_from <= index) & (index < targets.valid_to)
        T_sensor_map = T_of[index].inverse()
        for camera, T_camera_map, seen in (
            (rig.left, T_sensor_map, dots.left),
            (rig.right, rig.T_right_left @ T_sensor_map, dots.right),
        ):
            towards = T_camera_map.inverse().t_mm - targets.xyz_mm
            in_camera = T_camera_map.apply(targets.xyz_mm)
            shown = is_there & ~((towards * targets.normal).sum(axis=1) < 0) & camera.sees(in_camera)
            if not len(seen) or not shown.any():
                continue
            uv = camera.project(in_camera[shown])
            distance = np.linalg.norm(uv[:, None] - seen.uv_px[None], axis=2)
            dot = distance.argmin(axis=1)
            near = distance.min(axis=1) < NEAR_PX
            ids[seen.row[dot[near]]] = targets.id[shown][near]
    return ids


def _read_sightings(file: Path, labels: Mapping[str, Int[np.ndarray, "r"]]) -> _Sightings:
    """The sightings whose kind has labels."""
    table = read_table(file, {"frame": int, "kind": str, "row": int, "target": int})
    label = np.full(len(table["row"]), -1)
    has_label = np.zeros(len(label), dtype=bool)
    for kind, ids in labels.items():
        of_kind = table["kind"] == kind
        label[of_kind] = _labels_of(table["row"][of_kind], ids)
        has_label |= of_kind
    return _Sightings(table["frame"][has_label], table["target"][has_label], label[has_label])


def _identities(
    targets: ReferenceMap,
    sightings: _Sightings,
    true_xyz_mm: Mapping[int, Float[np.ndarray, "3"]],
    near_mm: float | None,
) -> dict[int, int]:
    """Which true target each target of the program is, -1: none.

    By place, for targets within ``near_mm`` of a true one where both have the same coordinates; else by the vote of
    the labels of its sightings. (A vote alone would not see that a given map was taken for a shifted copy of itself.)
    """
    votes: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for target, label in zip(sightings.target.tolist(), sightings.label.tolist(), strict=True):
        votes[target][label] += 1
    identity = {target: count.most_common(1)[0][0] for target, count in votes.items()}
    if near_mm is not None and true_xyz_mm:
        ids, xyz_mm = np.array(list(true_xyz_mm)), np.array(list(true_xyz_mm.values()))
        for target, xyz in zip(targets.id.tolist(), targets.xyz_mm, strict=True):
            distance = np.linalg.norm(xyz_mm - xyz, axis=1)
            if distance.min() < near_mm:
                identity[target] = int(ids[distance.argmin()])
    return identity


def _identified_rightly(sightings: _Sightings, identity: Mapping[int, int]) -> Share:
    """Sightings of a true target as what it is; clutter that is always the same target is neither right nor wrong."""
    said = np.array([identity[target] for target in sightings.target.tolist()], dtype=np.int64)
    counts = (said >= 0) | (sightings.label >= 0)
    return Share(int((said == sightings.label)[counts].sum()), int(counts.sum()))


def _frames_identified_rightly(
    sightings: _Sightings, identity: Mapping[int, int], labelled: Mapping[int, _Labelled]
) -> Iterator[int]:
    """Frames of three true points or more of whose sightings nine in ten say what they are.

    A pose against another place of the map has them all wrong.
    """
    said = np.array([identity[target] for target in sightings.target.tolist()], dtype=np.int64)
    is_right = said == sightings.label
    for frame, points in labelled.items():
        is_here = (sightings.frame == frame) & (sightings.label >= 0)
        if len(points.id) >= 3 and is_here.any() and is_right[is_here].mean() >= 0.9:
            yield frame


def _sharing(
    labelled: Mapping[int, _Labelled],
    sightings: _Sightings,
    given: set[int],
    true_xyz_mm: Mapping[int, Float[np.ndarray, "3"]],
) -> Iterator[int]:
    """Frames that show three targets not on one line which were given, or entered the program's map before."""
    entered: dict[int, int] = dict.fromkeys(given, -1)
    for frame, label in sorted(zip(sightings.frame.tolist(), sightings.label.tolist(), strict=True)):
        entered.setdefault(label, frame)
    for frame, points in labelled.items():
        xyz = [true_xyz_mm[i] for i in points.id.tolist() if entered.get(i, frame) < frame]
        if len(xyz) >= 3 and spread_off_line_mm(np.array(xyz)) >= LINE_RMS_MM:
            yield frame


@dataclass(frozen=True, slots=True)
class _Shared:
    """What one frame has in common with the map that truth lets grow."""

    both: int
    """Targets seen by both cameras, if they are not on one line; else 0."""
    is_few: bool
    """Fewer than three points, and equations enough."""


def _shared_with_truth(
    truth: Truth,
    labelled: Mapping[int, _Labelled],
    true_xyz_mm: Mapping[int, Float[np.ndarray, "3"]],
    given: set[int] | None,
) -> dict[int, _Shared]:
    """Of each frame after the one that founds the map, what it shares with it; the same process as reachable_online.

    Without a given map, it starts with the first frame that shows three targets not on one line, and takes in all
    targets that both cameras see in a frame which shares three such with it.
    """

    def spans(ids: Iterable[int]) -> bool:
        return spread_off_line_mm(np.array([true_xyz_mm[i] for i in ids]).reshape(-1, 3)) >= LINE_RMS_MM

    shared: dict[int, _Shared] = {}
    mapped = set(given or ())
    for frame in truth.frames.index.tolist():
        points = labelled.get(frame)
        if points is None:
            continue
        both = set(points.id.tolist())
        if mapped:
            single = set() if points.single is None else set(points.single.id.tolist())
            near, alone = both & mapped, single & mapped
            equations = 3 * len(near) + 2 * len(alone)
            is_few = len(both) < 3 and equations >= FEW_EQUATIONS and spans(near | alone)
            shared[frame] = _Shared(len(near) if spans(near) else 0, is_few)
        if given is None and spans(both & mapped if mapped else both):
            mapped |= both
    return shared


def _soon(results: Table, is_positioned: Bool[np.ndarray, "n"]) -> set[int]:
    """Frames within ``SOON_S`` of the positioned frame that came last before them."""
    soon: set[int] = set()
    last_ns = -math.inf
    for frame, stamp, fixed in zip(
        results["frame"].tolist(), results["timestamp_ns"].tolist(), is_positioned, strict=True
    ):
        if stamp - last_ns <= SOON_S * 1e9:
            soon.add(frame)
        last_ns = stamp if fixed else last_ns
    return soon


def _misidentified(
    frames: Int[np.ndarray, "n"],
    estimated: Sequence[Pose],
    truth: Sequence[Pose],
    errors: PoseErrors,
    targets: ReferenceMap,
    identity: Mapping[int, int],
    labelled: Mapping[int, _Labelled],
    wrong_mm: float,
    wrong_deg: float,
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Which poses are misidentified, and which of them the labels of their frame could judge."""
    row_of: dict[int, int] = {}  # of the same true target twice, the one seen more often
    for row in np.argsort(targets.sightings, kind="stable"):
        row_of[identity.get(int(targets.id[row]), -1)] = int(row)
    row_of.pop(-1, None)
    by_label: list[_LabelPose | None] = []
    for frame, T_true in zip(frames.tolist(), truth, strict=True):
        points = labelled.get(frame)
        if points is None:
            by_label.append(None)
            continue
        pairs = _pairs(points.id, row_of)
        fit = _pose_of_labels(points, targets, pairs, wrong_mm)
        if fit is None and points.single is not None:
            near = errors.T_truth_world.inverse() @ T_true
            fit = _pose_of_few_labels(points, points.single, targets, pairs, _pairs(points.single.id, row_of), near)
        by_label.append(fit)
    # the noise of the points may be stated wrongly: what the true labels leave over says by how much
    looseness = [fit[2] for fit in by_label if fit is not None and np.isfinite(fit[2])]
    variance = float(np.median(looseness)) if looseness else 1.0

    is_misidentified = errors.is_wrong.copy()
    is_judged = np.zeros(len(frames), dtype=bool)
    for k, (T, fit) in enumerate(zip(estimated, by_label, strict=True)):
        if fit is None:
            continue
        offset = fit[0].inverse() @ T
        delta = offset.log()
        is_off = np.linalg.norm(offset.t_mm) > wrong_mm or math.degrees(offset.angle_rad()) > wrong_deg
        is_misidentified[k] = is_off and delta @ np.linalg.solve(fit[1], delta) > SIGMAS**2 * variance
        is_judged[k] = True
    return is_misidentified, is_judged


def _pairs(ids: Int[np.ndarray, "n"], row_of: Mapping[int, int]) -> Int[np.ndarray, "c 2"]:
    """Rows of true targets, and of the same in the program's map, of those that stand in it."""
    pairs = [(k, row_of[i]) for k, i in enumerate(ids.tolist()) if i in row_of]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


_LabelPose = tuple[Pose, Float[np.ndarray, "6 6"], float]


def _pose_of_labels(
    points: _Labelled, targets: ReferenceMap, pairs: Int[np.ndarray, "c 2"], wrong_mm: float
) -> _LabelPose | None:
    """The pose that the true labels give against the program's map, its covariance, and chi-square per freedom.

    Targets that the map by itself has in a wrong place (more than ``wrong_mm``, and five medians, from where the
    others put them) take no part. None with fewer than three targets, or with all on one line.
    """
    while True:
        if len(pairs) < 3:
            return None
        b, a = points.xyz_mm[pairs[:, 0]], targets.xyz_mm[pairs[:, 1]]
        T = align(b, a)
        distance = np.linalg.norm(T.apply(b) - a, axis=1)
        if distance.max() <= max(wrong_mm, 5 * float(np.median(distance))):
            break
        pairs = np.delete(pairs, int(distance.argmax()), axis=0)
    if spread_off_line_mm(a) < LINE_RMS_MM:
        return None
    C_b, C_a = points.cov_mm2[pairs[:, 0]], targets.cov_mm2[pairs[:, 1]]
    T, cov = align_weighted(b, a, C_b, C_a)
    r = T.apply(b) - a
    chi2 = float(np.einsum("ni,ni->", r, np.linalg.solve(T.R @ C_b @ T.R.T + C_a, r[:, :, None])[:, :, 0]))
    return T, cov, chi2 / (3 * len(b) - 6)


def _pose_of_few_labels(
    points: _Labelled,
    dots: _LabelledDots,
    targets: ReferenceMap,
    pairs: Int[np.ndarray, "c 2"],
    single: Int[np.ndarray, "d 2"],
    T: Pose,
) -> _LabelPose | None:
    """The same from points and dots of a single camera, next to the pose ``T``; None where they leave it open.

    Gauss-Newton on T · exp(δ): p − x in millimetres for points, uv − π(x) in pixels for dots, x the target in sensor
    coordinates; both move by [I, −[x]×] δ.
    """
    freedom = 3 * len(pairs) + 2 * len(single) - 6
    at = targets.xyz_mm[np.concatenate([pairs[:, 1], single[:, 1]])]
    if freedom + 6 < FEW_EQUATIONS or spread_off_line_mm(at) < LINE_RMS_MM:
        return None
    rig, (dot, row), camera = dots.rig, single.T, dots.camera[single[:, 0]]
    for _ in range(10):
        T_sensor_world = T.inverse()
        R = T_sensor_world.R
        x = T_sensor_world.apply(targets.xyz_mm[pairs[:, 1]])
        parts = [
            (
                points.xyz_mm[pairs[:, 0]] - x,
                point_jacobian(x),
                points.cov_mm2[pairs[:, 0]] + R @ targets.cov_mm2[pairs[:, 1]] @ R.T,
            )
        ]
        for side, one, T_camera_sensor in ((0, rig.left, Pose.identity()), (1, rig.right, rig.T_right_left)):
            here = camera == side
            x = T_sensor_world.apply(targets.xyz_mm[row[here]])
            in_camera = T_camera_sensor.apply(x)
            P = one.project_jacobian(in_camera) @ T_camera_sensor.R
            S = dots.cov_px2[dot[here]] + P @ R @ targets.cov_mm2[row[here]] @ R.T @ np.swapaxes(P, 1, 2)
            parts.append((dots.uv_px[dot[here]] - one.project(in_camera), P @ point_jacobian(x), S))
        information = sum((np.einsum("nij,nik->jk", J, np.linalg.solve(S, J)) for _, J, S in parts), np.zeros((6, 6)))
        slope = sum((np.einsum("nij,ni->j", np.linalg.solve(S, J), r) for r, J, S in parts), np.zeros(6))
        if not np.isfinite(slope).all() or np.linalg.cond(information) > 1e14:
            return None
        cov = np.linalg.inv(information)
        delta = -cov @ slope
        if np.abs(delta).max() < 1e-9:
            break
        T = T @ Pose.exp(delta)
    chi2 = sum(float(np.einsum("ni,ni->", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])) for r, _, S in parts)
    return T, cov, chi2 / freedom
