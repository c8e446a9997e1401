"""Errors of poses against an exact map follow their covariance: neither too large for it nor too small."""

from math import sqrt

import numpy as np
import pytest

from constellations import chi2_limits, fixed, frame_of, looking, nees, scattered, seen_dots, seen_points
from trifix.positioner import Positioner
from trifix.records import ReferenceMap

TRIALS = 200


@pytest.mark.parametrize("level", ["dots", "points"])
def test_errors_of_poses_follow_their_covariance(level):
    """Chi-square of six degrees of freedom, in the mean and in both tails; each pose has noise of its own."""
    rng = np.random.default_rng(1)
    errors = np.empty(TRIALS)
    for k in range(TRIALS):
        if k % 20 == 0:
            world = scattered(rng, 14)
            positioner = Positioner(map=ReferenceMap.given(world), is_map_frozen=True, is_noise_stated=True)
        T = looking(rng)
        seen = seen_dots(T.inverse().apply(world), rng) if level == "dots" else seen_points(world, T, rng)
        fix = fixed(positioner.step(frame_of(k, seen)).fix)
        errors[k] = nees(fix.T_world_sensor, fix.cov, T)
    assert positioner.noise.scale == 1.0
    low, high = chi2_limits(6 * TRIALS)
    assert low < errors.sum() < high
    below, above = chi2_limits(6, 0.05)
    for share in (np.mean(errors < below), np.mean(errors > above)):
        assert abs(share - 0.05) < 4 * sqrt(0.05 * 0.95 / TRIALS)


def test_an_unstated_noise_is_found_before_it_misleads():
    """Dots that state three times their noise: once it is learnt, the covariances are right."""
    rng = np.random.default_rng(2)
    world = scattered(rng, 14)
    positioner = Positioner(map=ReferenceMap.given(world), is_map_frozen=True)
    errors = []
    for k in range(TRIALS):
        T = looking(rng)
        dots = seen_dots(T.inverse().apply(world), rng, 0.1)
        for one in (dots.left, dots.right):
            one.cov_px2[:] = 0.3**2 * np.eye(2)
        fix = fixed(positioner.step(frame_of(k, dots)).fix)
        errors.append(nees(fix.T_world_sensor, fix.cov, T))
    assert abs(positioner.noise.scale * 3 - 1) < 0.1
    assert 0.75 < np.mean(errors[40:]) / 6 < 1.3
