"""What the viewer shows of one frame, in the same words whether it comes from a Step or from a results folder."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.outputs.advice import Advice, advice_for
from trifix.outputs.samples import HEIGHT_PX, WIDTH_PX, dots_by_kind, points_by_kind
from trifix.records import Fix, GreyOrColour, NoFix, Step, StereoImages

SHOWN_PX = 720
"""Width of a picture as it is sent to the page (px)."""
DOT_COLOUR = {
    "identified": (98, 196, 255),
    "refused": (255, 127, 69),
    "unidentified": (245, 197, 66),
    "single": (185, 192, 200),
}
"""Of dots, by what became of them: the report's colours."""

_CANVAS = (38, 43, 49)
_WANTED = (232, 122, 224)
_FINE = 3  # bits of a pixel to which OpenCV draws


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """What one camera saw."""

    image: GreyOrColour | None
    """The image; None where there is none."""
    width_px: int
    """Columns of the canvas, in the units of the dots."""
    height_px: int
    """Rows of the canvas."""
    dots: dict[str, Float[np.ndarray, "n 2"]]
    """Centres of the dots by what became of them (px)."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame, as it is shown."""

    frame: int
    """Its number."""
    timestamp_ns: int
    """Its time (ns)."""
    pose: Pose | None
    """Where the sensor was, or where it was last while there is no pose; None if it never had one."""
    is_positioned: bool
    """Whether the pose is this frame's."""
    reason: str
    """Name of the reason; empty if there is none."""
    detail: str
    """More about it, in words."""
    points: int
    """Points seen by both cameras."""
    matched: int
    """Points identified."""
    residual_mm: float
    """Root mean square residual of these (mm); NaN where unknown."""
    p_chance: float
    """Probability that the agreement is chance; NaN where unknown."""
    sigma_mm: float
    """Standard deviation of the position along its least certain axis (mm); NaN where unknown."""
    targets: Int[np.ndarray, "c"]
    """Identities of the targets that were identified."""
    rig: StereoRig | None
    """The stereo geometry; None where it is not known."""
    shots: tuple[Shot, ...] = ()
    """Left and right; one for points; none where nothing is known."""
    advice: Advice | None = None
    """What the operator could do."""
    events: tuple[str, ...] = field(default=())
    """What happened to the map, newest first."""


def moment_of(step: Step, last_pose: Pose | None) -> Moment:
    """What is shown of a Step; ``last_pose`` is the newest known before it."""
    pose: Pose | None
    match step.fix:
        case Fix() as fix:
            pose, reason = fix.T_world_sensor, "" if fix.reason is None else fix.reason.name
            matched, residual_mm, targets = len(fix.point), fix.rms_mm, step.map.id[fix.target].copy()
            sigma_mm = sigma_of(fix.cov)
        case NoFix() as refusal:
            pose, reason, sigma_mm = last_pose, refusal.why.name, float("nan")
            matched, residual_mm, targets = refusal.matched, refusal.residual_mm, np.zeros(0, dtype=np.int64)
    return Moment(
        frame=step.frame.index,
        timestamp_ns=step.frame.timestamp_ns,
        pose=pose,
        is_positioned=isinstance(step.fix, Fix),
        reason=reason,
        detail=step.fix.detail,
        points=0 if step.points is None else len(step.points),
        matched=matched,
        residual_mm=residual_mm,
        p_chance=step.fix.p_chance,
        sigma_mm=sigma_mm,
        targets=targets,
        rig=step.frame.rig,
        shots=_shots(step),
        advice=advice_for(step, last_pose),
        events=tuple(
            event_words(step.frame.index, each.event, each.target, each.detail) for each in reversed(step.events)
        ),
    )


def sigma_of(cov: Float[np.ndarray, "6 6"]) -> float:
    """Standard deviation of a pose's position along its least certain axis (mm)."""
    return float(np.sqrt(max(np.linalg.eigvalsh(cov[:3, :3])[-1], 0.0)))


def event_words(frame: int, event: str, target: int | None, detail: str) -> str:
    """An event in words."""
    what = event.replace("_", " ") if target is None else event.replace("target_", f"target {target} ")
    return f"frame {frame}: {what}{', ' if detail else ''}{detail}"


def _shots(step: Step) -> tuple[Shot, ...]:
    """Left and right, or the points on one canvas."""
    dots, content, rig = step.dots, step.frame.content, step.frame.rig
    if dots is None:
        if step.points is None:
            return ()
        return (Shot(None, WIDTH_PX, HEIGHT_PX, points_by_kind(step.points, step.fix)),)
    assert rig is not None, "dots come with the rig that saw them"
    left, right = (content.left, content.right) if isinstance(content, StereoImages) else (None, None)
    of_left = of_right = np.zeros(0, dtype=np.int64)
    if step.matches is not None and step.points is not None:
        of_left, of_right = step.matches.left[step.points.match], step.matches.right[step.points.match]
    return (
        Shot(left, rig.left.width_px, rig.left.height_px, dots_by_kind(dots.left, of_left, step.fix)),
        Shot(right, rig.right.width_px, rig.right.height_px, dots_by_kind(dots.right, of_right, step.fix)),
    )


def drawn(shot: Shot, wanted_px: Float[np.ndarray, "n 2"]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of what a camera saw (RGB), its dots drawn over it; ``wanted_px`` is where a target is wanted.

    Circles are identified, squares of a refused frame, diamonds not identified, small crosses of one camera alone.
    """
    scale = SHOWN_PX / shot.width_px
    size = (SHOWN_PX, max(round(shot.height_px * scale), 1))
    if shot.image is None:
        picture = np.full((size[1], size[0], 3), _CANVAS, dtype=np.uint8)
    else:
        area = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        picture = _rgb(np.asarray(cv2.resize(shot.image, size, interpolation=area)))
    r = 8.0
    for kind in reversed(DOT_COLOUR):
        for at in (shot.dots.get(kind, np.zeros((0, 2))) + 0.5) * scale - 0.5:
            _outline(picture, _mark(kind, at, r), DOT_COLOUR[kind])
    for at in (wanted_px + 0.5) * scale - 0.5:
        for radius in (14.0, 22.0):
            _outline(picture, [_circle(at, radius)], _WANTED)
    return picture


def _rgb(image: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    """Grey or BGR of 8 or 16 bits as RGB; 16 bits are stretched to what they use."""
    if image.dtype == np.uint16:
        low, high = int(image.min()), int(image.max())
        image = ((image - low) * (255.0 / max(high - low, 1))).astype(np.uint8)
    code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


def _mark(kind: str, at: Float[np.ndarray, "2"], r: float) -> list[Float[np.ndarray, "p 2"]]:
    """The lines of a mark around a dot."""
    if kind == "identified":
        return [_circle(at, r)]
    if kind == "single":
        return [at + np.array([(-1, -1), (1, 1)]) * r / 2, at + np.array([(-1, 1), (1, -1)]) * r / 2]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], dtype=float)
    if kind == "unidentified":
        corners = np.array([(0, -1.25), (1.25, 0), (0, 1.25), (-1.25, 0), (0, -1.25)])
    return [at + corners * r]


def _circle(at: Float[np.ndarray, "2"], r: float) -> Float[np.ndarray, "p 2"]:
    angle = np.linspace(0, 2 * np.pi, 25)
    return np.asarray(at + r * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _outline(
    picture: UInt8[np.ndarray, "h w 3"], lines: list[Float[np.ndarray, "p 2"]], colour: tuple[int, int, int]
) -> None:
    """Lines in a colour over a wider dark one, so that they show on any ground."""
    fine = [np.round(line * (1 << _FINE)).astype(np.int32) for line in lines if np.isfinite(line).all()]
    for width, ink in ((4, (0, 0, 0)), (2, colour)):
        cv2.polylines(picture, fine, False, ink, width, cv2.LINE_AA, _FINE)
