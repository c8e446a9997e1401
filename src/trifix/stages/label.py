"""Labels for dots: coded markers beside the round ones, and classes of colour.

A label is evidence, never truth: it narrows where to look, and a wrong one costs time at most. Labels of different
kinds share their numbers; two that happen to be equal merely say nothing. Knows one image at a time, and no camera.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from trifix.records import Dots, GreyOrColour

_CORNER_PX = 0.05  # error of a marker's corner along either axis, as rendered images have it
_AROUND = 1.15  # a marker with its margin, in which no round dot is one
_CORE = 0.7  # of a dot's axes, within which its colour is its own
_LEAST_SATURATION = 0.2
_FARTHEST_DEG = 30.0  # from its hue


def add_codes(dots: Dots, image: GreyOrColour, dictionary: str) -> Dots:
    """The dots and the coded markers of an image: each a dot at its centre, labelled by its code.

    The centre is where the diagonals cross, which perspective leaves in its place; its covariance is carried from the
    corners. Round dots within a marker are parts of it.
    """
    markers = cv2.aruco.DetectorParameters()
    markers.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers.relativeCornerRefinmentWinSize = 0.8
    code = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, label, _ = cv2.aruco.ArucoDetector(code, markers).detectMarkers(_eight_bit_grey(image))
    if not corners:
        return dots
    quad = np.array(corners, dtype=float).reshape(-1, 4, 2)
    uv_px, cov_px2 = _centres(quad)
    middle = quad.mean(axis=1, keepdims=True)
    kept = ~_is_within(dots.uv_px, middle + _AROUND * (quad - middle))
    n = int(kept.sum()) + len(quad)
    return Dots(
        uv_px=np.concatenate([dots.uv_px[kept], uv_px]),
        cov_px2=np.concatenate([dots.cov_px2[kept], cov_px2]),
        ellipse=np.concatenate([dots.ellipse[kept], np.full((len(quad), 3), np.nan)]),
        label=np.concatenate([dots.label[kept], label.ravel().astype(np.int64)]),
        row=np.arange(n),
    )


def add_hues(dots: Dots, image: GreyOrColour, hues_deg: Float[np.ndarray, "h"]) -> Dots:
    """The dots with the number of the nearest hue for a label, unless they are grey or between hues; codes stay."""
    if image.ndim == 2 or len(hues_deg) == 0:
        return dots
    label = dots.label.copy()
    around = np.abs((hues_deg[:, None] - hues_deg + 180) % 360 - 180) + 360 * np.eye(len(hues_deg))
    reach_deg = min(_FARTHEST_DEG, around.min() / 2)
    for k in np.flatnonzero((label < 0) & np.isfinite(dots.ellipse).all(axis=1)):
        blue, green, red = _colour(image, dots.uv_px[k], dots.ellipse[k])
        most, least = max(blue, green, red), min(blue, green, red)
        if not most - least > _LEAST_SATURATION * most:  # black has no hue, nor what has no core
            continue
        hue_deg = np.degrees(np.arctan2(np.sqrt(3) * (green - blue), 2 * red - green - blue))
        off_deg = np.abs((hues_deg - hue_deg + 180) % 360 - 180)
        if off_deg.min() <= reach_deg:
            label[k] = int(off_deg.argmin())
    return Dots(dots.uv_px, dots.cov_px2, dots.ellipse, label, dots.row)


def _centres(quad: Float[np.ndarray, "m 4 2"]) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 2"]]:
    """Where the diagonals of quadrangles cross, and the covariance of that.

    p = c₀ + s (c₂ − c₀) lies on the other diagonal. A corner's error e moves its own diagonal at p by (1 − s) e, or s e
    for the far one, and only across itself: n₁·δp = n₁·e₁, n₂·δp = n₂·e₂.
    """
    c0, c1, c2, c3 = (quad[:, k] for k in range(4))
    d, e = c2 - c0, c3 - c1
    across = np.stack([np.stack([-d[:, 1], d[:, 0]], axis=1), np.stack([-e[:, 1], e[:, 0]], axis=1)], axis=1)
    n = across / np.linalg.norm(across, axis=2, keepdims=True)
    s = (n[:, 1] * (c1 - c0)).sum(axis=1) / (n[:, 1] * d).sum(axis=1)
    p = c0 + s[:, None] * d
    t = ((p - c1) * e).sum(axis=1) / (e * e).sum(axis=1)
    variance = np.stack([(1 - s) ** 2 + s**2, (1 - t) ** 2 + t**2], axis=1) * _CORNER_PX**2
    inverse = np.linalg.inv(n)
    return p, np.asarray(inverse @ (variance[:, :, None] * np.swapaxes(inverse, 1, 2)))


def _is_within(uv_px: Float[np.ndarray, "n 2"], quad: Float[np.ndarray, "m 4 2"]) -> Bool[np.ndarray, "n"]:
    """Which points lie within any of some convex quadrangles."""
    side = np.roll(quad, -1, axis=1) - quad
    to = uv_px[:, None, None] - quad
    turn = side[None, :, :, 0] * to[..., 1] - side[None, :, :, 1] * to[..., 0]
    return np.asarray(((turn > 0).all(axis=2) | (turn < 0).all(axis=2)).any(axis=1))


def _eight_bit_grey(image: GreyOrColour) -> UInt8[np.ndarray, "_ _"]:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    if grey.dtype == np.uint8:
        return np.ascontiguousarray(grey)
    return cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)  # type: ignore[call-overload, no-any-return]


def _colour(
    image: GreyOrColour, uv_px: Float[np.ndarray, "2"], ellipse: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Mean colour (BGR) of the core of a dot."""
    a, b, theta = ellipse
    h, w = image.shape[:2]
    u0, v0 = np.maximum(np.floor(uv_px - a), 0).astype(int)
    u1, v1 = np.minimum(np.ceil(uv_px + a).astype(int) + 1, [w, h])
    v, u = np.mgrid[v0:v1, u0:u1]
    x, y = u - uv_px[0], v - uv_px[1]
    along, across = np.cos(theta) * x + np.sin(theta) * y, np.cos(theta) * y - np.sin(theta) * x
    core = (along / a) ** 2 + (across / b) ** 2 <= _CORE**2
    return np.asarray(image[v0:v1, u0:u1][core].mean(axis=0)) if core.any() else np.zeros(3)
