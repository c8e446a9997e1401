"""What the operator could do about a frame that has no firm pose, and where: one sentence and one place.

Pure: from what a Step or a run's rows say. Knows neither how it is shown nor how poses are found.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.records import Fix, NoFix, PositionedReason, Reason, ReferenceMap, Step

_NUMBER = ("no", "one", "two", "three")
_FACING_COS = 0.2  # targets seen more obliquely are taken for hidden
_CONE = 0.35  # slopes that a sensor sees whose rig is not known
_RIM = 0.14  # of the image: nothing is proposed nearer to its edge
_GRID = 11  # places tried along each side of the image
_ENOUGH = 0.3  # of the width of the view: to lie further from the other targets is of no more use
_NEARBY_FRAMES = 50  # between a refused frame and one whose pose tells about where it was
_WORTH_TELLING = 0.01  # of a run's frames


@dataclass(frozen=True, slots=True, eq=False)
class Advice:
    """What to do, and where."""

    sentence: str
    """For the operator; it names the place, if there is one."""
    place_mm: Float[np.ndarray, "3"] | None = None
    """Where, world coordinates (mm)."""


def advice_for(step: Step, last_pose: Pose | None = None) -> Advice | None:
    """What would help this frame, if anything; ``last_pose`` is where the sensor was or should be, if that is known."""
    points = 0 if step.points is None else len(step.points)
    reason: Reason | PositionedReason | None
    match step.fix:
        case Fix() as fix:
            pose, reason, points = fix.T_world_sensor, fix.reason, len(fix.point)
        case NoFix(weak=Fix() as weak, why=reason):
            pose = weak.T_world_sensor
        case NoFix(why=reason):
            if last_pose is None:
                return advice_on(reason, points)
            pose = last_pose
    seen_mm = np.zeros((0, 3)) if step.points is None else pose.apply(step.points.xyz_mm)
    return advice_on(reason, points, pose, step.frame.rig, step.map, seen_mm)


def advice_on(
    reason: Reason | PositionedReason | None,
    points: int,
    pose: Pose | None = None,
    rig: StereoRig | None = None,
    targets: ReferenceMap | None = None,
    seen_mm: Float[np.ndarray, "n 3"] | None = None,
) -> Advice | None:
    """The same from what is known of a frame: how many points it shows, where it was taken, what is around there.

    ``seen_mm`` are places of what it saw besides the targets of the map (world coordinates).
    """
    place = None
    if pose is not None:
        taken = [] if targets is None else [targets.xyz_mm[_facing(targets, pose)]]
        taken += [] if seen_mm is None else [seen_mm]
        place = room_in_view(pose, rig, np.concatenate([*taken, np.zeros((0, 3))]))
    match reason:
        case None | PositionedReason.defines_world:
            return None
        case PositionedReason.few_points:
            start = f"{_counted(points)} {_of(points)} this pose, with the motion or dots of one camera"
            return _with_place(start, f"stick {_NUMBER[max(3 - points, 1)]} more", place)
        case Reason():
            return _advice_for_refusal(reason, points, place)
        case _:
            assert_never(reason)


def _advice_for_refusal(why: Reason, points: int, place: Float[np.ndarray, "3"] | None) -> Advice:
    """What to do about a refusal; a place where there is room in view is named only where a target there would help."""
    match why:
        case Reason.too_few_points:
            if points == 0:
                return _with_place("No target in view of both cameras", "look at the targets, or stick three", place)
            few = min(points, 2)
            only = f"Only {_counted(few).lower()} in view of both cameras"
            return _with_place(only, f"stick {_NUMBER[3 - few]} more", place)
        case Reason.weak_geometry:
            return _with_place("The targets in view lie almost on one line", "stick one more off it", place)
        case Reason.ambiguous:
            return _with_place("The targets in view resemble another group", "break the pattern with one more", place)
        case Reason.not_proven:
            return _with_place(
                "Too few known targets in view to be sure", "show more of them, or stick one more", place
            )
        case Reason.no_candidate:
            return Advice("Nothing here is known yet: go back to known targets, and on with three of them in view.")
        case Reason.other_island:
            return Advice("This part is not joined yet: sweep slowly to known targets, with three of both in one view.")
        case Reason.residual:
            return Advice("What is seen does not fit the map: has a target moved, or the calibration changed?")
        case Reason.out_of_time:
            return Advice("Hold still for a moment: the search ran out of time.")
        case Reason.unreadable_image:
            return Advice("Check the cameras and their cables: an image could not be read.")
        case Reason.no_calibration:
            return Advice("Give this frame a calibration: calibration.yaml, or one of its own.")
        case Reason.bad_points:
            return Advice("Check what measures the points: some values are not finite, or out of all bounds.")
        case Reason.time_reversed:
            return Advice("Check the clock: frames must come in the order in which they were taken.")
        case _:
            assert_never(why)


def advice_for_run(
    reason: Sequence[str],
    points: Int[np.ndarray, "n"],
    poses: Sequence[Pose | None],
    targets: ReferenceMap,
) -> list[Advice]:
    """What would help the next run over the same object, the most rewarding first.

    Of each frame: the name of its reason, empty if there is none; the points it showed; its pose, None if refused.
    """
    names = np.array(reason, dtype=object)
    told: list[tuple[float, Advice]] = []

    def tell(meant: Bool[np.ndarray, "n"], saw: str, then: str, number: str = "") -> None:
        share = float(meant.mean()) if len(meant) else 0.0
        if share < _WORTH_TELLING or meant.sum() < 2:
            return
        start = f"{max(round(100 * share), 1)} % of the frames {saw}"
        found = _where(np.flatnonzero(meant), poses, targets)
        if found is None:
            told.append((share, Advice(f"{start}: {then}{number}.")))
            return
        place, around = found
        amount = "most" if around > 0.5 else "many"
        told.append((share, Advice(f"{start}, {amount} of them around {_xyz(place)}: {then}{number} there.", place)))

    few = np.isin(names, [Reason.too_few_points.name, PositionedReason.few_points.name])
    if few.any():
        lacking = int(np.clip(3 - np.round(points[few].mean()), 1, 3))
        plural = "" if lacking == 1 else "s"
        tell(few, "saw fewer than three targets", "add ", f"{_NUMBER[lacking]} target{plural}")
    tell(names == Reason.ambiguous.name, "could be in several places", "break the pattern with one more target")
    tell(names == Reason.weak_geometry.name, "saw targets almost on one line", "add a target off that line")
    tell(names == Reason.not_proven.name, "saw too few known targets to be sure", "add a target, or dwell")
    unknown = np.isin(names, [Reason.no_candidate.name, Reason.other_island.name])
    tell(unknown, "saw nothing that joins the map", "go over it slowly, known targets in view, starting")
    return [advice for _, advice in sorted(told, key=lambda each: -each[0])]


def _with_place(start: str, what: str, place: Float[np.ndarray, "3"] | None) -> Advice:
    where = "" if place is None else f" near {_xyz(place)}"
    return Advice(f"{start}: {what}{where}.", place)


def _counted(count: int) -> str:
    return f"{_NUMBER[count].capitalize()} target{'' if count == 1 else 's'}" if count < 4 else f"{count} targets"


def _of(count: int) -> str:
    return "holds" if count == 1 else "hold"


def _xyz(place_mm: Float[np.ndarray, "3"]) -> str:
    return f"({', '.join(f'{round(float(x))}' for x in place_mm)}) mm".replace("-", "−")


def room_in_view(
    T_world_sensor: Pose, rig: StereoRig | None, taken_mm: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "3"] | None:
    """A place in view of both cameras with room for a target, world coordinates; None where no distance is known.

    At the distance of the targets around it; far from all in view and from the line through them, rather in the middle
    than at the edge. ``taken_mm`` are places of targets (world coordinates).
    """
    taken = T_world_sensor.inverse().apply(taken_mm)
    taken = taken[np.isfinite(taken).all(axis=1) & (taken[:, 2] > 0)]
    if not len(taken):
        return None
    slopes = _slopes_in_view(rig)
    half = np.abs(slopes - slopes.mean(axis=0)).max(axis=0)
    of_taken = taken[:, :2] / taken[:, 2:]
    is_in_view = (np.abs(of_taken - slopes.mean(axis=0)) < 1.4 * half).all(axis=1)
    if is_in_view.any():
        taken, of_taken = taken[is_in_view], of_taken[is_in_view]
    # the surface there, from the depths around: weights of the inverse squared distance between slopes
    away2 = ((slopes[:, None] - of_taken[None]) ** 2).sum(axis=2)
    weight = 1 / (away2 + (0.1 * half.min()) ** 2)
    depth = (weight * taken[:, 2]).sum(axis=1) / weight.sum(axis=1)
    places = np.c_[slopes, np.ones(len(slopes))] * depth[:, None]
    if rig is not None:
        is_seen = rig.right.sees(rig.T_right_left.apply(places), 0.05 * rig.right.width_px)
        if not is_seen.any():
            return None
        places, slopes, away2 = places[is_seen], slopes[is_seen], away2[is_seen]
    width = 2 * half.max()
    gain = np.sqrt(away2.min(axis=1)) / width
    if is_in_view.any() and len(of_taken) > 1:
        gain = np.minimum(gain, _off_line(slopes, of_taken) / width)
    off_centre = np.linalg.norm(slopes - slopes.mean(axis=0), axis=1) / width
    best = int(np.argmax(np.minimum(gain, _ENOUGH) - 0.25 * off_centre))
    return np.asarray(T_world_sensor.apply(places[best : best + 1])[0])


def _slopes_in_view(rig: StereoRig | None) -> Float[np.ndarray, "p 2"]:
    """Directions (x/z, y/z) all over the left camera's view but its rim."""
    steps = np.linspace(_RIM, 1 - _RIM, _GRID)
    u, v = (each.ravel() for each in np.meshgrid(steps, steps))
    if rig is None:
        return np.stack([(2 * u - 1) * _CONE, (2 * v - 1) * _CONE], axis=1)
    slopes = rig.left.unproject(np.stack([u * rig.left.width_px, v * rig.left.height_px], axis=1))
    return np.asarray(slopes[np.isfinite(slopes).all(axis=1)])


def _off_line(slopes: Float[np.ndarray, "p 2"], taken: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "p"]:
    """Distances from the line that runs along the longest extent of what is there."""
    centre = taken.mean(axis=0)
    normal = np.linalg.svd(taken - centre)[2][1]
    return np.asarray(np.abs((slopes - centre) @ normal))


def _facing(targets: ReferenceMap, T_world_sensor: Pose) -> Bool[np.ndarray, "k"]:
    """Targets that are believed and do not look away from the sensor."""
    towards = T_world_sensor.t_mm - targets.xyz_mm
    cos = (towards * targets.view).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    return np.asarray(targets.alive & ~(cos < _FACING_COS))


def _where(
    frames: Int[np.ndarray, "m"], poses: Sequence[Pose | None], targets: ReferenceMap
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """The place that most of these frames looked at, by the poses around them, and their share that looked there."""
    known = np.array([k for k, pose in enumerate(poses) if pose is not None], dtype=np.int64)
    if not len(known):
        return None
    looked, depths = [], []
    for k in frames:
        at = int(known[np.argmin(np.abs(known - k))])
        pose = poses[at]
        if pose is None or abs(at - k) > _NEARBY_FRAMES:
            continue
        ahead = pose.inverse().apply(targets.xyz_mm[_facing(targets, pose)])
        ahead = ahead[ahead[:, 2] > 0]
        in_view = ahead[(np.abs(ahead[:, :2] / ahead[:, 2:]) < 2 * _CONE).all(axis=1)]
        if len(in_view):
            depths.append(float(np.median(in_view[:, 2])))
            looked.append(pose.apply(np.array([[0.0, 0.0, depths[-1]]]))[0])
    if not looked:
        return None
    places, radius = np.array(looked), _CONE * float(np.median(depths))
    some = places[np.unique(np.linspace(0, len(places) - 1, 500).astype(int))]
    near = np.linalg.norm(places[None] - some[:, None], axis=2) < radius
    most = near[int(near.sum(axis=1).argmax())]
    return places[most].mean(axis=0), float(most.sum() / len(frames))
