"""Find the dots of one image: bright or dark round targets, each with a sub-pixel centre and its covariance.

Knows grey values and nothing else: no camera, no map, no earlier image.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

from trifix.errors import ConfigError
from trifix.kernels.detection import (
    AROUND,
    BLOCK_PX,
    BLUR,
    LOPSIDED,
    RESIDUAL,
    SIGN,
    STEP,
    THETA,
    UU,
    VV,
    A,
    B,
    Grey,
    U,
    V,
    blobs,
    block_extremes,
    distinct,
    fit_ellipses,
    noise_samples,
    share_gradients,
)
from trifix.records import Dots, GreyOrColour

# A level of the pyramid answers for blobs from 8.5 to 19 of its own pixels across (the finest also for smaller ones);
# the limits overlap, since a dot may be measured a little larger or smaller from one level to the next.
_LEVEL_MIN_PX, _LEVEL_MAX_PX, _WINDOW_BLOCKS = 8.5, 19.0, 7
_NOISE_RANGE = 9.0  # standard deviations that noise alone does not span within a window
_LAG_PX = 6  # beyond which noise is not correlated
_LEAST_STEP = 4.0  # standard deviations of the noise of single pixels
# Lumps of correlated noise or fine texture look like faint dots. Their steps are at most _LUMP of its standard
# deviations where it is of a pixel's size; and at most _NOISE_RANGE where they leave more than a fraction _CLEAN of the
# step or _WHITE times the noise of single pixels. Specks, of a short semi-axis up to _SPECK_PX, and twice that where
# neighbours have more in common than single pixels differ, have too few pixels to leave anything: theirs are at most
# _SPECK.
_LUMP, _CLEAN, _WHITE, _SPECK, _SPECK_PX = 4.5, 0.03, 1.3, 6.0, 1.5
_LOPSIDED = 0.17  # by which opposite sides of a whole dot's edge may differ (steps)
_QUANTILE = {1.0: 0.6745, 0.5: 0.3186}  # of the magnitude of a normal number: the middle of all, of the lower half
# Prior knowledge, as standard deviations: relative change of the light per pixel (u, v); departure from light that
# multiplies both sides of the edge alike, in contrasts per pixel (u, v).
_GRADIENT_PER_PX = np.array([0.001, 0.001, 0.0007, 0.0007])


Dictionary = Literal[
    "none",
    "DICT_4X4_50",
    "DICT_4X4_100",
    "DICT_4X4_250",
    "DICT_4X4_1000",
    "DICT_5X5_50",
    "DICT_5X5_100",
    "DICT_5X5_250",
    "DICT_5X5_1000",
    "DICT_6X6_50",
    "DICT_6X6_100",
    "DICT_6X6_250",
    "DICT_6X6_1000",
    "DICT_7X7_50",
    "DICT_7X7_100",
    "DICT_7X7_250",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_MIP_36h12",
]


@dataclass(frozen=True)
class DetectOptions:
    """What counts as a dot."""

    polarity: Literal["auto", "dark", "bright"] = "auto"
    """Dots darker or brighter than what surrounds them; auto takes what the image has more good ones of."""
    min_diameter_px: float = 3.5
    """Least length of a dot's long axis, which is the diameter that a tilted round target keeps (px)."""
    max_diameter_px: float = 250.0
    """Largest length of a dot's long axis (px)."""
    min_axis_ratio: float = 0.34
    """Least ratio of the short axis to the long one; a round target tilted by 70 degrees shows 0.34."""
    min_contrast: float = 0.2
    """Least step at the dot's edge, as a fraction of the brighter side."""
    max_misfit: float = 0.12
    """Largest rms residual of the fitted ellipse beyond the image's noise, as a fraction of the step; less refuses more
    clutter."""
    codes: Dictionary = "none"
    """Coded markers beside the round dots: OpenCV's dictionary of them. The code is the dot's label."""
    hues: str = ""
    """Hues of coloured dots (degrees: red 0, yellow 60, green 120, cyan 180, blue 240), such as "0 120 240": the number
    of the nearest, from 0, is the dot's label; in colour images only."""

    @property
    def hues_deg(self) -> Float[np.ndarray, "h"]:
        """The hues as numbers (degrees)."""
        return np.array(self.hues.replace(",", " ").split(), dtype=float)

    def __post_init__(self) -> None:
        if not 0 < self.min_diameter_px < self.max_diameter_px:
            raise ConfigError(
                f"detect.min_diameter_px is {self.min_diameter_px}, expected more than 0 and less than "
                f"max_diameter_px = {self.max_diameter_px}."
            )
        try:
            is_angle = bool(np.isfinite(self.hues_deg).all())
        except ValueError:
            is_angle = False
        if not is_angle or len(np.unique(self.hues_deg % 360)) < len(self.hues_deg):
            raise ConfigError(f"detect.hues is {self.hues!r}, expected different angles in degrees, as in '0 120 240'.")
        for name in ("min_axis_ratio", "min_contrast", "max_misfit"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"detect.{name} is {getattr(self, name)}, expected a fraction above 0 and at most 1.")


def detect(image: GreyOrColour, options: DetectOptions = DetectOptions()) -> Dots:
    """Dots of one image, from top to bottom.

    Blobs on the local threshold at every level of a pyramid; then least squares of a blurred ellipse to the grey
    values, which gives centre, axes and covariance and tells dots from clutter by what it leaves. What shows too large
    for the image itself is fitted at its level first, where that is cheap. Fits whose residuals differ between opposite
    sides of the edge are refused: something hides a part of the dot.

    The variance of a semi-axis is 1.2 to 1.9 times that of the centre along it, for short semi-axes of 2.5 px or more
    and edges blurred by no more than a quarter of these; the axes are then off by 0.05 px at most. Smaller and more
    blurred dots hardly tell their axes from their blur: off by 0.1 px at 6 px and 60 degrees, by 0.6 px at a blur of 2.
    """
    grey = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)
    noise = _noise(grey, 1, 1.0)
    start = [_candidates(level, size, noise / size, options) for level, size in _pyramid(grey, options)]
    fits, gradient, information = fit_ellipses(
        grey,
        _distinct_starts(np.concatenate([np.zeros((0, BLUR + 1)), *start])),
        _GRADIENT_PER_PX,
        options.min_contrast,
        options.max_misfit,
        noise,
        False,
    )
    row = np.flatnonzero(_is_good(fits, grey, noise, options))
    misfit = _misfit(fits[row], noise)
    if options.polarity == "auto":
        evidence = {sign: _evidence(misfit[fits[row, SIGN] == sign], options) for sign in (-1.0, 1.0)}
        chosen = fits[row, SIGN] == max(evidence, key=lambda sign: evidence[sign])
        row, misfit = row[chosen], misfit[chosen]
    row = row[distinct(fits[row, : V + 1], fits[row, B], np.argsort(misfit, kind="stable"))]
    row = row[np.lexsort((fits[row, U], fits[row, V]))]
    refined = share_gradients(fits[row], gradient[row], information[row], _GRADIENT_PER_PX)
    n = len(row)
    return Dots(
        uv_px=refined[:, :2],
        cov_px2=refined[:, [2, 3, 3, 4]].reshape(n, 2, 2),
        ellipse=fits[row][:, [A, B, THETA]],
        label=np.full(n, -1),
        row=np.arange(n),
    )


def _pyramid(grey: Grey, options: DetectOptions) -> Iterator[tuple[Grey, int]]:
    """The image at halved sizes, as far as dots of the wanted size need them, and the side of their pixels (px)."""
    size = 1
    while min(grey.shape) >= 2 * BLOCK_PX and (size == 1 or _LEVEL_MIN_PX * size <= options.max_diameter_px):
        if _LEVEL_MAX_PX * size >= options.min_diameter_px:
            yield grey, size
        h, w = grey.shape
        grey = cv2.resize(grey[: h - h % 2, : w - w % 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        size *= 2


def _candidates(level: Grey, size: int, noise: float, options: DetectOptions) -> Float[np.ndarray, "m 7"]:
    """Elliptic blobs of one level of the pyramid (px of the image), of the wanted polarity."""
    # The short axis of the smallest dot, less what a blob of few pixels may lose.
    least_px = 0.7 * options.min_diameter_px * np.sqrt(options.min_axis_ratio)
    low, high = block_extremes(level)
    window = cv2.getStructuringElement(cv2.MORPH_RECT, (_WINDOW_BLOCKS, _WINDOW_BLOCKS))
    found = blobs(
        level,
        *(low, high, cv2.erode(low, window), cv2.dilate(high, window)),
        options.min_contrast,
        _NOISE_RANGE * noise,
        max(least_px / size, 0.0 if size == 1 else _LEVEL_MIN_PX),
        _LEVEL_MAX_PX,
        options.min_diameter_px / size,
        0.9 * options.min_axis_ratio,
    )
    if options.polarity != "auto":
        found = found[found[:, SIGN] == (1.0 if options.polarity == "bright" else -1.0)]
    if size == 1 or len(found) == 0:
        return np.asarray(found)
    prior = _GRADIENT_PER_PX * size
    found = fit_ellipses(level, found, prior, options.min_contrast, 2 * options.max_misfit, noise, True)[0][
        :, : BLUR + 1
    ]
    found = found[np.isfinite(found[:, U])]
    found[:, [U, V]] = size * found[:, [U, V]] + (size - 1) / 2
    found[:, UU : VV + 1] *= size**2
    found[:, BLUR] = 0.8
    return np.asarray(found)


def _distinct_starts(start: Float[np.ndarray, "m 7"]) -> Float[np.ndarray, "k 7"]:
    """The starts without any that another level gave already, unless of other size or polarity."""
    kept = np.zeros(len(start), dtype=bool)
    for sign in (-1.0, 1.0):
        rows = np.flatnonzero(start[:, SIGN] == sign)
        reach = 0.25 * (start[rows, UU] + start[rows, VV]) ** 0.5
        kept[rows[distinct(start[rows, : V + 1], reach, np.arange(len(rows)))]] = True
    return np.asarray(start[kept])


def _is_good(
    fits: Float[np.ndarray, "m 18"], grey: Grey, noise: float, options: DetectOptions
) -> Bool[np.ndarray, "m"]:
    """Whether a fit is that of a dot as the options want it, whole within the image.

    Lumps of correlated noise look like faint dots, but none is clean.
    """
    u, v, a, b = fits[:, U], fits[:, V], fits[:, A], fits[:, B]
    around, step, misfit = fits[:, AROUND], fits[:, STEP], _misfit(fits, noise)
    common = _noise(grey, _LAG_PX, 0.5)
    lumps = np.abs(step) / max(common, 1e-9)
    speck_px = _SPECK_PX * (2 if common > _WHITE * noise else 1)
    is_clean = (misfit <= _CLEAN) | ((lumps >= _LUMP) & (fits[:, RESIDUAL] <= _WHITE * noise))
    is_no_lump = (lumps >= _NOISE_RANGE) | (is_clean & ((lumps >= _SPECK) | (b > speck_px)))
    h, w = grey.shape
    return np.asarray(
        (2 * a >= options.min_diameter_px)
        & (2 * a <= options.max_diameter_px)
        & (b >= options.min_axis_ratio * a)
        & (np.abs(step) >= options.min_contrast * np.maximum(around, around + step))
        & (misfit <= options.max_misfit)
        & is_no_lump
        & (fits[:, LOPSIDED] <= _LOPSIDED)
        & (np.abs(step) >= _LEAST_STEP * noise)
        & (np.minimum(u, v) >= a)
        & (u + a <= w - 1)
        & (v + a <= h - 1)
    )


def _misfit(fits: Float[np.ndarray, "m 18"], noise: float) -> Float[np.ndarray, "m"]:
    """Residual beyond the noise, as a fraction of the step."""
    return np.asarray(np.sqrt(np.maximum(fits[:, RESIDUAL] ** 2 - noise**2, 0.0)) / np.abs(fits[:, STEP]))


def _evidence(misfit: Float[np.ndarray, "n"], options: DetectOptions) -> float:
    """How much a set of fits looks like targets: each counts by how far its misfit stays below the limit.

    Clutter that passes does so narrowly, a target leaves hardly more than noise; the square of the margin keeps many
    of the one from outvoting a few of the other.
    """
    return float(np.sum((1 - misfit / options.max_misfit) ** 2))


def _noise(grey: Grey, lag_px: int, share: float) -> float:
    """Standard deviation of the noise (grey values), as the quietest ``share`` of the image has it.

    A lag of 1 px tells the noise of single pixels, a long one also noise that neighbours have in common.
    """
    if min(grey.shape) <= 2 * lag_px:
        return 0.0
    samples = noise_samples(grey, lag_px)
    k = int(0.5 * share * len(samples))
    # The middle of those, in standard deviations of one normal number.
    return float(np.partition(samples, k)[k]) / (6 * _QUANTILE[share])
