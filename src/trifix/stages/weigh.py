"""How noisy the recording really is: one factor on all standard deviations, learnt as frames pass.

Everything rests on it: tolerances, probabilities, covariances. Dots tell by their epipolar residuals, which need no
map; given points tell by their residuals on identified targets. Only what is past is used, so a live run and a
recording agree. Knows no pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from trifix.errors import ConfigError
from trifix.kernels import floats, integers
from trifix.kernels.mapping import squared_distances
from trifix.kernels.stereo import likeliest_scale
from trifix.records import Dots, Fix, ReferenceMap, SensorPoints, StereoDots, StereoMatches

_CHI2_3_MEDIAN = 2.366  # median of chi-square with three degrees of freedom
_SCALES = np.geomspace(0.02, 100.0, 176)  # candidates, 5 % apart
_DECISIVE = float(np.log(1e4))  # of a likelihood ratio


@dataclass(frozen=True, slots=True)
class NoiseOptions:
    """When to believe a stated noise, and how much evidence to await."""

    sigma_px: float = 0.3
    """Standard deviation of a dot's centre along each axis to start from, where the recording states none (px)."""
    min_samples: int = 100
    """Residuals to await before a stated noise is doubted."""
    few_samples: int = 12
    """Residuals to await before the scale leaves 1 where none is stated; it is taken larger while they are few."""
    max_samples: int = 4000
    """Residuals to remember; the oldest go first."""
    stated_low: float = 0.7
    """A stated noise is kept unless the scale falls below this."""
    stated_high: float = 1.4
    """A stated noise is kept unless the scale rises above this."""

    def __post_init__(self) -> None:
        if self.sigma_px <= 0:
            raise ConfigError(f"noise.sigma_px is {self.sigma_px}, expected a positive number of pixels.")
        if min(self.few_samples, self.min_samples) <= 0 or self.min_samples > self.max_samples:
            raise ConfigError("noise.few_samples and min_samples must be positive and at most noise.max_samples.")


@dataclass(frozen=True, slots=True, eq=False)
class NoiseScale:
    """What is known of the noise so far."""

    scale: float = 1.0
    """Factor on all standard deviations."""
    sigmas: tuple[Float[np.ndarray, "_"], ...] = ()
    """Remembered residuals, those of a frame together, in standard deviations as stated: epipolar ones, or roots of
    chi-square over its median."""
    gates: tuple[float, ...] = ()
    """The largest value that those of each frame could have had."""
    fitted_at: int = 0
    """Residuals seen when the scale was last fitted."""
    seen: int = 0
    """Residuals seen altogether."""
    is_doubted: bool = False
    """Whether the first pairs already contradict a stated noise: they lie too far from their epipolar lines."""

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


def starting_scale(dots: StereoDots, options: NoiseOptions) -> float:
    """Factor that makes the dots as noisy as where nothing is stated, and at least 1.

    A stated noise that is far too small would hide the evidence against it: no true pair is near enough to its line.
    Pairs are sought as widely as this until the noise is known.
    """
    variance = np.concatenate([dots.left.cov_px2[:, 0, 0], dots.right.cov_px2[:, 0, 0]])
    return max(1.0, options.sigma_px / float(np.sqrt(np.median(variance)))) if len(variance) else 1.0


def weigh_matches(
    noise: NoiseScale, matches: StereoMatches, max_sigmas: float, is_stated: bool, options: NoiseOptions
) -> NoiseScale:
    """The noise after the epipolar residuals of some pairs of dots, false ones among them.

    True pairs are normal and false ones uniform across the gate, which is ``max_sigmas`` at the scale given; the
    likelihood of that mixture is maximised over the scale and the share of true pairs. A stated noise that is too small
    is doubted as soon as that is beyond question, and the scale given stays for lack of a better one.
    """
    if len(matches) == 0:
        return noise
    z = np.abs(matches.epipolar_px) / matches.epipolar_sigma_px
    noise = _remember(noise, z, max_sigmas * noise.scale)
    if _is_due(noise, is_stated, options):
        noise = _recent(noise, options)
        return _with_scale(noise, _likeliest_scale(noise)[0], is_stated, options)
    if is_stated and not noise.is_known and not noise.is_doubted:
        scale, gain = _likeliest_scale(noise)
        return replace(noise, is_doubted=scale > options.stated_high and gain > _DECISIVE)
    return noise


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
    chi2 = squared_distances(
        floats(map.xyz_mm),
        floats(map.cov_mm2),
        floats(points.xyz_mm),
        floats(points.cov_mm2),
        integers(fix.point),
        integers(fix.target),
        floats(fix.T_world_sensor.R),
        floats(fix.T_world_sensor.t_mm),
    )
    noise = _remember(noise, noise.scale * np.sqrt(chi2 * (c / (c - 2) / _CHI2_3_MEDIAN)), np.inf)
    if not _is_due(noise, is_stated, options):
        return noise
    noise = _recent(noise, options)
    return _with_scale(noise, float(np.median(np.concatenate(noise.sigmas))), is_stated, options)


def scale_points(points: SensorPoints, noise: NoiseScale) -> SensorPoints:
    """Given points with the noise that was found in place of the one that was stated, as compiled loops take them."""
    return replace(
        points,
        xyz_mm=floats(points.xyz_mm),
        cov_mm2=floats(points.cov_mm2) if noise.scale == 1.0 else floats(points.cov_mm2) * noise.scale**2,
        match=integers(points.match),
        label=integers(points.label),
        row=integers(points.row),
    )


def _remember(noise: NoiseScale, z: Float[np.ndarray, "n"], gate: float) -> NoiseScale:
    return replace(noise, sigmas=(*noise.sigmas, z), gates=(*noise.gates, gate), seen=noise.seen + len(z))


def _is_due(noise: NoiseScale, is_stated: bool, options: NoiseOptions) -> bool:
    """A new fit pays when a quarter more has been seen."""
    grown = noise.seen >= 1.25 * noise.fitted_at or noise.seen - noise.fitted_at >= options.max_samples // 2
    return noise.seen >= (options.min_samples if is_stated else options.few_samples) and grown


def _recent(noise: NoiseScale, options: NoiseOptions) -> NoiseScale:
    """The same without the residuals that are too many, the oldest ones."""
    sigmas, room = [], options.max_samples
    for z in reversed(noise.sigmas):
        if room <= 0:
            break
        sigmas.append(z[-room:])
        room -= len(z)
    return replace(noise, sigmas=tuple(reversed(sigmas)), gates=noise.gates[-len(sigmas) :])


def _with_scale(noise: NoiseScale, scale: float, is_stated: bool, options: NoiseOptions) -> NoiseScale:
    if not is_stated:
        scale *= 1 + 1 / np.sqrt(2 * noise.seen)  # one standard deviation more: too large does less harm than too small
    elif options.stated_low <= scale <= options.stated_high:
        scale = 1.0
    return replace(noise, scale=float(np.clip(scale, _SCALES[0], _SCALES[-1])), fitted_at=noise.seen)


def _likeliest_scale(noise: NoiseScale) -> tuple[float, float]:
    """Scale of the true ones among all pairs remembered, and the logarithm of how much likelier than 1 it is."""
    gate = np.repeat(noise.gates, [len(z) for z in noise.sigmas])
    scale, gain = likeliest_scale(np.concatenate(noise.sigmas), gate, _SCALES)
    return float(scale), float(gain)
