"""Find the dots of one image: bright or dark round targets, each with a sub-pixel centre and its covariance.

Knows grey values and nothing else: no camera, no map, no earlier image.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from trifix.errors import ConfigError
from trifix.kernels.detection import (
    AROUND,
    COV_UU,
    COV_UV,
    COV_VV,
    RESIDUAL,
    STEP,
    THETA,
    A,
    B,
    Grey,
    U,
    V,
    blobs,
    fit_ellipses,
)
from trifix.records import Dots, GreyOrColour

_SIGNS = (-1.0, 1.0)  # dark, bright
# A level of the pyramid answers for blobs from 6.5 to 14 of its own pixels across (the finest also for smaller ones);
# the limits overlap, since a dot may be measured a little larger or smaller from one level to the next.
_LEVEL_MIN_PX, _LEVEL_MAX_PX, _WINDOW_PX = 6.5, 14.0, 25
_MIN_FILL = 0.75
_NOISE_RANGE = 9.0  # standard deviations that noise alone does not span within a window


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """One level of the pyramid."""

    grey: Grey
    """The image."""
    darkest: Grey
    """Least grey value in the window about each pixel."""
    brightest: Grey
    """Largest grey value in the window about each pixel."""
    size: int
    """Side of its pixels (px of the image)."""


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

    def __post_init__(self) -> None:
        if not 0 < self.min_diameter_px < self.max_diameter_px:
            raise ConfigError(
                f"detect.min_diameter_px is {self.min_diameter_px}, expected more than 0 and less than "
                f"max_diameter_px = {self.max_diameter_px}."
            )
        for name in ("min_axis_ratio", "min_contrast", "max_misfit"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"detect.{name} is {getattr(self, name)}, expected a fraction above 0 and at most 1.")


def detect(image: GreyOrColour, options: DetectOptions = DetectOptions()) -> Dots:
    """Dots of one image, from top to bottom.

    Blobs on the local threshold at every level of a pyramid; then least squares of a blurred ellipse to the grey
    values, which gives centre, axes and covariance and tells dots from clutter by what it leaves.
    """
    grey = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)
    levels, noise = list(_pyramid(grey, options)), _noise(grey)
    signs = _SIGNS if options.polarity == "auto" else (_SIGNS[options.polarity == "bright"],)
    fits = max(
        (_fits(grey, levels, noise, sign, options) for sign in signs),
        key=lambda fits: _evidence(_misfit(fits, noise), options),
    )
    fits = fits[np.lexsort((fits[:, U], fits[:, V]))]
    n = len(fits)
    return Dots(
        uv_px=fits[:, [U, V]],
        cov_px2=fits[:, [COV_UU, COV_UV, COV_UV, COV_VV]].reshape(n, 2, 2),
        ellipse=fits[:, [A, B, THETA]],
        label=np.full(n, -1),
        row=np.arange(n),
    )


def _pyramid(grey: Grey, options: DetectOptions) -> Iterator[_Level]:
    """The image at halved sizes, as far as dots of the wanted size need them."""
    window = cv2.getStructuringElement(cv2.MORPH_RECT, (_WINDOW_PX, _WINDOW_PX))
    size = 1
    while size == 1 or (_LEVEL_MIN_PX * size <= options.max_diameter_px and min(grey.shape) > _LEVEL_MIN_PX):
        if size > 1:
            h, w = grey.shape
            grey = cv2.resize(grey[: h - h % 2, : w - w % 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        if _LEVEL_MAX_PX * size >= options.min_diameter_px:
            yield _Level(grey, cv2.erode(grey, window), cv2.dilate(grey, window), size)
        size *= 2


def _candidates(
    levels: list[_Level], noise: float, sign: float, options: DetectOptions
) -> tuple[Float[np.ndarray, "m 5"], Float[np.ndarray, "m"]]:
    """Centre and second moments (px, px²) of elliptic blobs, and how far off they may be (px)."""
    # The short axis of the smallest dot, less what a blob of few pixels may lose.
    least_px = 0.7 * options.min_diameter_px * np.sqrt(options.min_axis_ratio)
    start, coarseness = [np.zeros((0, 5))], [np.zeros(0)]
    for level in levels:
        found = blobs(
            level.grey,
            level.darkest,
            level.brightest,
            sign,
            options.min_contrast,
            _NOISE_RANGE * noise / level.size,
            max(least_px / level.size, 0.0 if level.size == 1 else _LEVEL_MIN_PX),
            _LEVEL_MAX_PX,
            0.9 * options.min_axis_ratio,
            _MIN_FILL,
        ) * np.array([level.size] * 2 + [level.size**2] * 3)
        found[:, :2] += (level.size - 1) / 2
        start.append(found)
        coarseness.append(np.full(len(found), (level.size - 1) / 2))
    return np.concatenate(start), np.concatenate(coarseness)


def _fits(
    grey: Grey, levels: list[_Level], noise: float, sign: float, options: DetectOptions
) -> Float[np.ndarray, "n 12"]:
    """Accepted fits of one polarity."""
    start, coarseness = _candidates(levels, noise, sign, options)
    fits = fit_ellipses(grey, start, coarseness, sign, options.min_contrast, options.max_misfit, noise)
    fits = fits[np.isfinite(fits[:, U])]
    u, v, a, b = fits[:, U], fits[:, V], fits[:, A], fits[:, B]
    around, step = fits[:, AROUND], np.abs(fits[:, STEP])
    h, w = grey.shape
    good = (
        (2 * a >= options.min_diameter_px)
        & (2 * a <= options.max_diameter_px)
        & (b >= options.min_axis_ratio * a)
        & (step >= options.min_contrast * np.maximum(around, around + sign * step))
        & (_misfit(fits, noise) <= options.max_misfit)
        & (np.minimum(u, v) >= a)
        & (u + a <= w - 1)
        & (v + a <= h - 1)
    )
    return _distinct(fits[good], noise)


def _misfit(fits: Float[np.ndarray, "n 12"], noise: float) -> Float[np.ndarray, "n"]:
    """Residual beyond the noise, as a fraction of the step."""
    return np.asarray(np.sqrt(np.maximum(fits[:, RESIDUAL] ** 2 - noise**2, 0.0)) / np.abs(fits[:, STEP]))


def _distinct(fits: Float[np.ndarray, "n 12"], noise: float) -> Float[np.ndarray, "k 12"]:
    """The fits without the worse of any two whose centres lie within the short axis of one of them."""
    order = np.argsort(_misfit(fits, noise), kind="stable")
    fits = fits[order]
    close = np.hypot(*(fits[:, None, :2] - fits[None, :, :2]).transpose(2, 0, 1)) < np.maximum(
        fits[:, None, B], fits[None, :, B]
    )
    kept = np.ones(len(fits), dtype=bool)
    for k in range(len(fits)):
        if kept[k]:
            kept[k + 1 :] &= ~close[k, k + 1 :]
    return fits[kept]


def _evidence(misfit: Float[np.ndarray, "n"], options: DetectOptions) -> float:
    """How much a set of fits looks like targets: each counts by how far its misfit stays below the limit.

    Clutter that passes does so narrowly, a target leaves hardly more than noise; the square of the margin keeps many
    of the one from outvoting a few of the other.
    """
    return float(np.sum((1 - misfit / options.max_misfit) ** 2))


def _noise(grey: Grey) -> float:
    """Standard deviation of the image's noise (grey values).

    Immerkær's difference of two Laplacians (1996), which is blind to slopes, on every eighth row; its median instead of
    its mean is blind to edges too. Texture of a pixel's size counts as noise.
    """
    if min(grey.shape) < 3:
        return 0.0
    rows = [grey[i : len(grey) - 2 + i : 8].astype(np.float32) for i in range(3)]
    across = rows[0] - 2 * rows[1] + rows[2]
    mask = across[:, :-2] - 2 * across[:, 1:-1] + across[:, 2:]
    return float(np.median(np.abs(mask))) / (0.6745 * 6)
