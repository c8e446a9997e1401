"""What ``space.js`` draws in three dimensions: targets, path and cameras as compact JSON. Decides no colour."""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.outputs.course import Course, object_axes
from trifix.outputs.scene3d import default_magnification, worst_shown_mm
from trifix.outputs.summary import Tip
from trifix.records import ReferenceMap, TargetState

_MOST_POSES = 1500
_SIGMAS = 3.0  # of the ellipsoids
_SLOPE = 0.3  # of the view of a sensor whose cameras are not known


@dataclass(frozen=True, slots=True)
class Space:
    """What is drawn of a run."""

    worst: float
    """The residual at the end of the colours (mm)."""
    has_advice: bool
    """Whether places are marked where something would help."""
    json: str
    """All numbers, as ``space.js`` expects them."""


def space_of(
    course: Course,
    targets: ReferenceMap,
    rig: StereoRig | None,
    identified: Sequence[Int[np.ndarray, "_"]],
    advice: Sequence[Tip] = (),
) -> Space | None:
    """A run to be drawn, its poses thinned out; None where there is nothing to show.

    Of each frame, ``identified`` holds the identities of the targets that it shows. Places of the advice are marked,
    numbered from 1.
    """
    shown = targets.rows(np.flatnonzero(targets.state != TargetState.removed))
    is_found = course.is_positioned
    if not len(shown) and not is_found.any():
        return None
    kept, is_after_gap = _thinned(is_found)
    row_of = dict(zip(shown.id.tolist(), range(len(shown)), strict=True))
    seen = [[row_of[each] for each in identified[k].tolist() if each in row_of] for k in kept.tolist()]
    trusted = shown.rows(np.flatnonzero(shown.state == TargetState.trusted))
    extent = float(np.ptp(trusted.xyz_mm, axis=0).max()) if len(trusted) else 0.0
    worst = worst_shown_mm(course.residual_mm)
    record = {
        "axes": _rounded(object_axes(course, targets), 5),
        "worst": worst,
        "magnify": default_magnification(_SIGMAS**2 * trusted.cov_mm2, extent),
        "cameras": [_pyramid(Pose.identity(), None)] if rig is None else [
            _pyramid(Pose.identity(), rig.left), _pyramid(rig.T_right_left.inverse(), rig.right)
        ],
        "advice": [
            {"number": k, "xyz": tip.place_mm} for k, tip in enumerate(advice, start=1) if tip.place_mm is not None
        ],
        "targets": {
            "id": shown.id.tolist(),
            "xyz": _rounded(shown.xyz_mm, 2),
            "cov": [float(f"{c:.3g}") for c in (_SIGMAS**2 * shown.cov_mm2)[:, *np.triu_indices(3)].ravel()],
            "state": shown.state.tolist(),
            "seen": shown.sightings.tolist(),
        },
        "path": {
            "frame": course.frame[kept].tolist(),
            "xyz": _rounded(course.position_mm[kept], 2),
            "down": _rounded(course.down[kept], 4),
            "forward": _rounded(course.forward[kept], 4),
            "um": [round(1000 * mm) if np.isfinite(mm) else -1 for mm in course.residual_mm[kept].tolist()],
            "gap": is_after_gap.astype(int).tolist(),
            "targets": seen,
        },
    }  # fmt: skip
    return Space(worst, bool(record["advice"]), msgspec.json.encode(record).decode())


def _thinned(is_found: Bool[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "p"], Bool[np.ndarray, "p"]]:
    """Frames to draw, evenly and where the path begins and ends, and which of them follow a gap.

    Of a long run, a gap shorter than what lies between two poses drawn is left out.
    """
    found = np.flatnonzero(is_found)
    stride = max(-(-len(found) // _MOST_POSES), 1)
    ends = np.flatnonzero(np.diff(found) > stride)
    last = np.arange(len(found))[-1:]
    order = np.unique(np.concatenate([np.arange(0, len(found), stride), ends, ends + 1, last]))
    return found[order], np.isin(order, ends + 1)


def _pyramid(T_left_camera: Pose, camera: Camera | None) -> list[float]:
    """Where a camera is and what it sees: its centre, then the way to its corners a millimetre ahead, in sensor
    coordinates."""
    slopes = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    if camera is None:
        slopes = slopes * _SLOPE
    else:
        size = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
        slopes = camera.unproject((slopes + 1) / 2 * size)
        if not np.isfinite(slopes).all():  # distorted beyond what can be undone: the corners as of a pinhole
            slopes = ((np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size) - [camera.pu_px, camera.pv_px]) / [
                camera.fu_px,
                camera.fv_px,
            ]
    corners = T_left_camera.apply(np.c_[slopes, np.ones(4)])
    return [*_rounded(T_left_camera.t_mm, 3), *_rounded(corners - T_left_camera.t_mm, 4)]


def _rounded(values: Float[np.ndarray, "..."], decimals: int) -> list[float]:
    return [round(value, decimals) for value in np.asarray(values, dtype=float).ravel().tolist()]
