"""How noisy the recording really is: one factor on all standard deviations, learnt as frames pass.

Everything rests on it: tolerances, probabilities, covariances. Dots tell by their epipolar residuals, which need no
map; given points tell by their residuals on identified targets. Only what is past is used, so a live run and a
recording agree. Knows no pose.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from trifix.errors import ConfigError
from trifix.records import Dots, Fix, ReferenceMap, SensorPoints, StereoMatches

_CHI2_3_MEDIAN = 2.366  # median of chi-square with three degrees of freedom
_SCALES = np.geomspace(0.02, 10.0, 128)  # candidates, 5 % apart


@dataclass(frozen=True, slots=True)
class NoiseOptions:
    """When to believe a stated noise, and how much evidence to await."""

    sigma_px: float = 0.3
    """Standard deviation of a dot's centre along each axis to start from, where the recording states none (px)."""
    min_samples: int = 100
    """Residuals to await before the scale leaves 1."""
    max_samples: int = 4000
    """Residuals to remember; the oldest go first."""
    stated_low: float = 0.7
    """A stated noise is kept unless the scale falls below this."""
    stated_high: float = 1.4
    """A stated noise is kept unless the scale rises above this."""

    def __post_init__(self) -> None:
        if self.sigma_px <= 0:
            raise ConfigError(f"noise.sigma_px is {self.sigma_px}, expected a positive number of pixels.")
        if not 0 < self.min_samples <= self.max_samples:
            raise ConfigError("noise.min_samples must be positive and at most noise.max_samples.")


@dataclass(frozen=True, slots=True, eq=False)
class NoiseScale:
    """What is known of the noise so far."""

    scale: float = 1.0
    """Factor on all standard deviations."""
    sigmas: Float[np.ndarray, "s"] = field(default_factory=lambda: np.zeros(0))
    """Remembered residuals in standard deviations as stated: epipolar ones, or roots of chi-square over its median."""
    gate: Float[np.ndarray, "s"] = field(default_factory=lambda: np.zeros(0))
    """The largest value that each could have had."""
    fitted_at: int = 0
    """Residuals seen when the scale was last fitted."""
    seen: int = 0
    """Residuals seen altogether."""

    @property
    def is_known(self) -> bool:
        """Whether the scale has been fitted at all."""
        return self.fitted_at > 0


def add_prior_noise(dots: Dots, options: NoiseOptions) -> Dots:
    """Detected dots with the noise to start from on top of their own.

    The image tells how well a dot's edge is seen. What calibration, synchronisation and a dot's own shape add, it
    cannot tell: that is most of the error in practice, alike for all dots, and is learnt from the residuals.
    """
    return replace(dots, cov_px2=dots.cov_px2 + options.sigma_px**2 * np.eye(2))


def weigh_matches(
    noise: NoiseScale, matches: StereoMatches, max_sigmas: float, is_stated: bool, options: NoiseOptions
) -> NoiseScale:
    """The noise after the epipolar residuals of some pairs of dots, false ones among them.

    True pairs are normal and false ones uniform across the gate; the likelihood of that mixture is maximised over the
    scale and the share of true pairs.
    """
    if len(matches) == 0:
        return noise
    z = np.abs(matches.epipolar_px) / matches.epipolar_sigma_px
    noise = _remember(noise, z, np.full(len(z), max_sigmas * noise.scale), options)
    if not _is_due(noise, options):
        return noise
    return _with_scale(noise, _fit_mixture(noise.sigmas, noise.gate), is_stated, options)


def weigh_residuals(
    noise: NoiseScale,
    points: SensorPoints,
    map: ReferenceMap,
    fix: Fix,
    is_stated: bool,
    options: NoiseOptions,
) -> NoiseScale:
    """The noise after the residuals of a frame's points on the targets that they were identified as.

    Squared Mahalanobis distances are chi-square with three degrees of freedom, less the six that the pose took; their
    median is not moved by a few wrong pairs.
    """
    c = len(fix.point)
    if c < 4 or not np.isfinite(fix.p_chance):
        return noise
    T = fix.T_world_sensor
    r = map.xyz_mm[fix.target] - T.apply(points.xyz_mm[fix.point])
    S = T.R @ points.cov_mm2[fix.point] @ T.R.T + map.cov_mm2[fix.target]
    chi2 = np.einsum("ni,ni->n", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
    z = noise.scale * np.sqrt(chi2 * c / (c - 2) / _CHI2_3_MEDIAN)
    noise = _remember(noise, z, np.full(c, np.inf), options)
    if not _is_due(noise, options):
        return noise
    return _with_scale(noise, float(np.median(noise.sigmas)), is_stated, options)


def scale_points(points: SensorPoints, noise: NoiseScale) -> SensorPoints:
    """Given points with the noise that was found in place of the one that was stated."""
    return points if noise.scale == 1.0 else replace(points, cov_mm2=points.cov_mm2 * noise.scale**2)


def _remember(noise: NoiseScale, z: np.ndarray, gate: np.ndarray, options: NoiseOptions) -> NoiseScale:
    keep = options.max_samples
    return NoiseScale(
        noise.scale,
        np.concatenate([noise.sigmas, z])[-keep:],
        np.concatenate([noise.gate, gate])[-keep:],
        noise.fitted_at,
        noise.seen + len(z),
    )


def _is_due(noise: NoiseScale, options: NoiseOptions) -> bool:
    """A new fit pays when a quarter more has been seen."""
    grown = noise.seen >= 1.25 * noise.fitted_at or noise.seen - noise.fitted_at >= options.max_samples // 2
    return noise.seen >= options.min_samples and grown


def _with_scale(noise: NoiseScale, scale: float, is_stated: bool, options: NoiseOptions) -> NoiseScale:
    if is_stated and options.stated_low <= scale <= options.stated_high:
        scale = 1.0
    scale = float(np.clip(scale, _SCALES[0], _SCALES[-1]))
    return NoiseScale(scale, noise.sigmas, noise.gate, noise.seen, noise.seen)


def _fit_mixture(z: np.ndarray, gate: np.ndarray) -> float:
    """Scale of the normal part of |z| < gate: normal (cut at the gate) with some share, uniform with the rest."""
    from scipy.special import erf

    best, best_value = 1.0, -np.inf
    uniform = 1.0 / gate
    for scale in _SCALES:
        normal = np.sqrt(2 / np.pi) / scale * np.exp(-0.5 * (z / scale) ** 2) / erf(gate / scale / np.sqrt(2))
        share = 0.5
        for _ in range(8):  # expectation-maximisation of the share alone
            share = float(np.mean(share * normal / (share * normal + (1 - share) * uniform)))
        value = float(np.log(share * normal + (1 - share) * uniform).sum()) - np.log(scale) ** 2
        if value > best_value:
            best, best_value = float(scale), value
    return best
