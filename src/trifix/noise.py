"""How noisy a recording is, as its frames pass: by how far dots are off their epipolar lines, and points their targets.

Keeps what ``stages/weigh.py`` works out of each frame, and says which of the two counts. Knows no island: whoever asks
hands on a change of scale.
"""

from dataclasses import replace

from trifix.records import Fix, ReferenceMap, SensorPoints, StereoDots, StereoMatches
from trifix.stages.weigh import NoiseOptions, NoiseScale, starting_scale, weigh_matches, weigh_residuals


class Noise:
    """The noise of one recording, or of one live run."""

    def __init__(self, options: NoiseOptions, gate_sigmas: float, is_stated: bool) -> None:
        """``gate_sigmas`` is how far from its epipolar line a dot is sought."""
        self.is_stated = is_stated
        self.found = self._epipolar = self._residuals = NoiseScale()
        self._options, self._gate_sigmas = options, gate_sigmas
        self._sought = 1.0
        """Scale at which the newest frame's pairs were sought."""

    @property
    def scale(self) -> float:
        """Factor on all standard deviations, as it is known now."""
        return self.found.scale

    @property
    def is_settled(self) -> bool:
        """Whether enough pairs of dots have been seen, so that from now on only identified ones count."""
        return self._epipolar.seen >= self._options.min_samples

    def sought(self, dots: StereoDots) -> float:
        """The scale at which the pairs of the next frame are to be sought."""
        is_first_guess = self.is_stated and not self.found.is_known
        self._sought = starting_scale(dots, self._options) if is_first_guess else self.scale
        return self._sought

    def weigh(self, points: SensorPoints, matches: StereoMatches | None, map: ReferenceMap, fix: Fix) -> float:
        """Takes in what identified points tell, by their residuals, and their dots by epipolar ones.

        Returns the factor by which the scale has changed, as does ``weigh_pairs``.
        """
        before = replace(self._residuals, scale=self.scale)
        now = weigh_residuals(before, points, map, fix, self.is_stated, self._options)
        self._residuals = _newest(self._residuals, now)
        if matches is None:
            return self._take(self._residuals)
        return self.weigh_pairs(matches.rows(points.match[fix.point])) if self.is_settled else 1.0

    def weigh_pairs(self, matches: StereoMatches) -> float:
        """Takes in epipolar residuals: those of identified points, or all before anything is known.

        They see the dots' errors across the epipolar lines alone, and a calibration that was fitted to the same dots
        hides some of them: where the residuals on targets are larger, these count.
        """
        before = replace(self._epipolar, scale=self._sought)
        now = weigh_matches(before, matches, self._gate_sigmas, self.is_stated, self._options)
        self._epipolar = _newest(self._epipolar, now)
        is_larger = self._residuals.is_known and self._residuals.scale > self._epipolar.scale
        return self._take(self._residuals if is_larger else self._epipolar)

    def _take(self, noise: NoiseScale) -> float:
        ratio = noise.scale / self.scale
        self.found = noise
        return ratio


def _newest(before: NoiseScale, now: NoiseScale) -> NoiseScale:
    """What is known now, with the scale last fitted, or the one to start from where a stated noise became doubtful."""
    is_other = now.fitted_at != before.fitted_at or now.is_doubted != before.is_doubted
    return now if is_other else replace(now, scale=before.scale)
