"""Dots of the left image x dots of the right one -> pairs that may be the same target (the paper's part P4).

Identical dots can only be paired by geometry. *All* plausible pairs are kept, several to a dot where several lie on its
epipolar line: the map decides later. Knows no map and no pose.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from trifix.errors import ConfigError
from trifix.geometry.camera import StereoRig
from trifix.kernels import floats, integers
from trifix.kernels.stereo import pair_dots, prepare_dots
from trifix.records import Dots, StereoDots, StereoMatches


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How far from the epipolar line, and between which depths, a pair is plausible."""

    max_epipolar_sigmas: float = 3.5
    """Largest distance from the epipolar line, in standard deviations of the two dots."""
    min_depth_mm: float = 0.0
    """Nearest depth of a target before either camera (mm); 0: one baseline."""
    max_depth_mm: float = 0.0
    """Farthest depth of a target before either camera (mm); 0: fifteen baselines."""
    max_size_ratio: float = 2.0
    """Largest ratio of the two dots' diameters, each scaled by its camera's focal length and depth."""
    target_diameter_mm: float = 0.0
    """Diameter of the targets (mm): a pair whose dots are not that large, within the ratio, is none; 0 if unknown."""

    def __post_init__(self) -> None:
        if self.max_epipolar_sigmas <= 0:
            raise ConfigError(f"match.max_epipolar_sigmas is {self.max_epipolar_sigmas}, expected a positive number.")
        if self.min_depth_mm < 0 or self.max_depth_mm < 0:
            raise ConfigError("match.min_depth_mm and match.max_depth_mm must not be negative.")
        if self.max_depth_mm and self.max_depth_mm <= self.min_depth_mm:
            raise ConfigError(
                f"match.max_depth_mm is {self.max_depth_mm}, expected more than min_depth_mm = {self.min_depth_mm}."
            )
        if self.target_diameter_mm < 0:
            raise ConfigError(
                f"match.target_diameter_mm is {self.target_diameter_mm}, expected a length, or 0 where it is unknown."
            )
        if self.max_size_ratio < 1:
            raise ConfigError(f"match.max_size_ratio is {self.max_size_ratio}, expected at least 1.")


def match(
    dots: StereoDots, rig: StereoRig, options: MatchOptions = MatchOptions(), noise_scale: float = 1.0
) -> StereoMatches:
    """All pairs near each other's epipolar line, within the depth limits and of similar size.

    Dots of different labels are no pair; but a label may be wrong, so a dot that finds none of its own is sought again
    as if it had no label. ``noise_scale`` multiplies the dots' standard deviations.
    """
    parameters = rig.parameters
    prepared = _prepared(dots.left, parameters[:12]), _prepared(dots.right, parameters[12:24])
    ellipses = floats(dots.left.ellipse), floats(dots.right.ellipse)
    limits = (
        float(options.max_epipolar_sigmas),
        float(noise_scale),
        float(options.min_depth_mm or rig.baseline_mm),
        float(options.max_depth_mm or 15 * rig.baseline_mm),
        float(options.max_size_ratio),
        float(options.target_diameter_mm),
    )
    labels = integers(dots.left.label), integers(dots.right.label)
    pairs = pair_dots(*prepared, *ellipses, *labels, parameters, *limits)
    alone = [
        (label >= 0) & (np.bincount(row, minlength=len(label)) == 0)
        for label, row in zip(labels, pairs[:2], strict=True)
    ]
    if alone[0].any() or alone[1].any():
        doubted = (np.where(is_alone, -1, label) for label, is_alone in zip(labels, alone, strict=True))
        pairs = pair_dots(*prepared, *ellipses, *doubted, parameters, *limits)
    return StereoMatches(*pairs)


def _prepared(dots: Dots, camera: Float[np.ndarray, "12"]) -> Float[np.ndarray, "n 8"]:
    return np.asarray(prepare_dots(floats(dots.uv_px), floats(dots.cov_px2), camera))
