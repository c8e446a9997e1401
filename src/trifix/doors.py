"""What may come in: frames and maps from a user's own program, checked once where they enter.

What cannot be positioned becomes a frame with its reason, and the run goes on; a map that is none is refused. Files are
read, and refused, elsewhere.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from trifix.errors import MapError
from trifix.geometry.camera import Camera
from trifix.records import Frame, GreyOrColour, Reason, ReferenceMap, SensorPoints, StereoDots, StereoImages, Unusable

_FARTHEST_MM = 1e6  # no point lies, and no error reaches, a kilometre off
_LEAST_VARIANCE_PX2 = 1e-12  # a millionth of a pixel: no dot is known better
_LEAST_VARIANCE_MM2 = 1e-12  # a nanometre: nothing is known better
_LEAST_VARIANCE_SHARE = 1e-12  # of the largest along another axis


def in_order(frame: Frame, last_ns: int, last_index: int) -> Frame:
    """The frame, refused if it is older than one already judged, or numbered as if it were."""
    if frame.timestamp_ns < last_ns:
        detail = f"It was taken at {frame.timestamp_ns} ns, after one of {last_ns} ns."
    elif frame.index < last_index:
        detail = f"It is frame {frame.index}, after frame {last_index}."
    else:
        return frame
    return replace(frame, content=Unusable(Reason.time_reversed, detail))


def with_usable_images(frame: Frame, images: StereoImages) -> Frame:
    """The same frame, refused where its images are not those of its rig's cameras, or nobody knows the rig."""
    if frame.rig is None:
        return _without_rig(frame, "images")
    for side, image, camera in (("left", images.left, frame.rig.left), ("right", images.right, frame.rig.right)):
        if fault := image_fault(image, camera):
            return replace(frame, content=Unusable(Reason.unreadable_image, f"The {side} image {fault}."))
    return frame


def image_fault(image: GreyOrColour, camera: Camera) -> str:
    """What an image is that the camera cannot have taken; empty where it can."""
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        return f"is {image.dtype} of shape {image.shape}, expected grey or BGR of 8 or 16 bit"
    if image.shape[:2] != (camera.height_px, camera.width_px):
        size = f"{image.shape[1]} x {image.shape[0]} pixels"
        return f"is {size}, its calibration is for {camera.width_px} x {camera.height_px}"
    return ""


def with_usable_dots(frame: Frame, dots: StereoDots) -> Frame:
    """The same frame, refused where a dot is not a number or has no covariance, or nobody knows the rig."""
    if frame.rig is None:
        return _without_rig(frame, "dots")
    for side, each in (("left", dots.left), ("right", dots.right)):
        finite = np.isfinite(each.uv_px).all(axis=1) & np.isfinite(each.cov_px2).all(axis=(1, 2))
        if not finite.all():
            detail = (
                f"{(~finite).sum()} of {len(each)} {side} dots are not finite, the first is dot {np.argmin(finite)}."
            )
            return replace(frame, content=Unusable(Reason.bad_points, detail))
        is_none = np.linalg.eigvalsh(each.cov_px2)[:, 0] < _LEAST_VARIANCE_PX2
        if is_none.any():
            detail = (
                f"{is_none.sum()} of {len(each)} {side} dots have a covariance that is singular or negative, the first "
                f"is dot {np.argmax(is_none)}."
            )
            return replace(frame, content=Unusable(Reason.bad_points, detail))
    return frame


def _without_rig(frame: Frame, what: str) -> Frame:
    return replace(frame, content=Unusable(Reason.no_calibration, f"{what.capitalize()} came without a rig."))


def with_usable_points(frame: Frame, points: SensorPoints) -> Frame:
    """The same frame, refused where a point is not a number, beyond all reach, or has no covariance to weigh it by."""
    finite = np.isfinite(points.xyz_mm).all(axis=1) & np.isfinite(points.cov_mm2).all(axis=(1, 2))
    if not finite.all():
        return _refused(frame, points, ~finite, "are not finite")
    is_far = np.abs(points.xyz_mm).max(axis=1, initial=0.0) > _FARTHEST_MM
    if is_far.any():
        return _refused(frame, points, is_far, f"are farther off than {_FARTHEST_MM:g} mm")
    transposed = points.cov_mm2.transpose(0, 2, 1)
    low, _, high = np.linalg.eigvalsh(0.5 * (points.cov_mm2 + transposed)).T
    is_none = (low < _LEAST_VARIANCE_MM2) | (low < _LEAST_VARIANCE_SHARE * high) | (high > _FARTHEST_MM**2)
    is_none |= np.abs(points.cov_mm2 - transposed).max(axis=(1, 2), initial=0.0) > _LEAST_VARIANCE_SHARE * high
    if is_none.any():
        return _refused(frame, points, is_none, "have a covariance that is singular, negative or out of all bounds")
    return frame


def _refused(frame: Frame, points: SensorPoints, bad: Bool[np.ndarray, "n"], what: str) -> Frame:
    detail = f"{bad.sum()} of {len(points)} points {what}, the first in row {points.row[np.argmax(bad)]}."
    return replace(frame, content=Unusable(Reason.bad_points, detail))


def checked_map(map: ReferenceMap) -> ReferenceMap:
    """The map, if its targets are somewhere.

    Raises:
        MapError: a target's place or covariance is not finite, its covariance has a negative variance, or two targets
            lie at one place or bear one identity.
    """
    alive = map.rows(np.flatnonzero(map.alive))
    finite = np.isfinite(alive.xyz_mm).all(axis=1) & np.isfinite(alive.cov_mm2).all(axis=(1, 2))
    if not finite.all():
        raise MapError(f"Target {alive.id[np.argmin(finite)]} of the map given holds a value that is not finite.")
    least = np.linalg.eigvalsh(alive.cov_mm2)[:, 0]
    negative = least < -1e-6 * np.abs(alive.cov_mm2).max(axis=(1, 2), initial=0.0)  # 1e-6: as printed in files
    if negative.any():
        raise MapError(f"The covariance of target {alive.id[np.argmax(negative)]} of the map given is none.")
    for what, values in (("place", alive.xyz_mm), ("identity", alive.id)):
        _, first, counts = np.unique(values, axis=0, return_index=True, return_counts=True)
        if (counts > 1).any():
            twice = alive.id[first[np.argmax(counts > 1)]]
            raise MapError(f"Target {twice} of the map given shares its {what} with another: leave one of them out.")
    return map
