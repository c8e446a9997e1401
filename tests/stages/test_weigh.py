"""The noise scale: found among false pairs, kept where it was stated well, left alone without evidence."""

from dataclasses import replace

import numpy as np
import pytest

from constellations import looking, points_of, scattered, seen_points
from trifix.errors import ConfigError
from trifix.geometry.alignment import align_weighted
from trifix.records import Dots, Fix, PositionedReason, ReferenceMap, StereoDots, StereoMatches
from trifix.stages.weigh import (
    NoiseOptions,
    NoiseScale,
    add_prior_noise,
    scale_points,
    starting_scale,
    weigh_matches,
    weigh_residuals,
)

OPTIONS = NoiseOptions()
GATE = 3.5  # sigmas


def pairs_of_a_frame(rng: np.random.Generator, true_scale: float, noise: NoiseScale, false_share: float, n: int = 150):
    """What matching lets pass of pairs that state 0.2 px: true ones normal, false ones uniform about the line.

    ``false_share`` is that within the gate of the true scale.
    """
    is_false = rng.random(20 * n) < false_share
    z = np.where(is_false, rng.uniform(-GATE, GATE, 20 * n), rng.normal(size=20 * n)) * true_scale
    # false pairs are as dense beyond the gate as within
    beyond = rng.uniform(-1, 1, 400 * n) * 10 * GATE * true_scale
    within_per_unit = false_share * 20 * n / (2 * GATE * true_scale)
    beyond = beyond[np.abs(beyond) > GATE * true_scale][: int(within_per_unit * 18 * GATE * true_scale)]
    z = rng.permutation(np.concatenate([z, beyond]))
    z = z[np.abs(z) <= GATE * noise.scale][:n]
    zero = np.zeros(len(z), dtype=np.int64)
    return StereoMatches(zero, zero, 0.2 * z, np.full(len(z), 0.2))


def found_among(true_scale: float, false_share: float, seed: int, is_stated: bool = False, frames: int = 30) -> float:
    rng, noise = np.random.default_rng(seed), NoiseScale()
    for _ in range(frames):
        noise = weigh_matches(noise, pairs_of_a_frame(rng, true_scale, noise, false_share), GATE, is_stated, OPTIONS)
    return noise.scale


@pytest.mark.parametrize("true_scale", [0.2, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("false_share", [0.0, 0.3, 0.7])
def test_the_scale_is_found_among_false_pairs(true_scale: float, false_share: float):
    found = np.array([found_among(true_scale, false_share, seed) for seed in range(2)])
    assert np.abs(found / true_scale - 1).max() < 0.15
    assert abs(found.mean() / true_scale - 1) < 0.10


@pytest.mark.parametrize(("true_scale", "is_kept"), [(0.55, False), (0.8, True), (1.25, True), (1.7, False)])
def test_a_stated_noise_is_kept_unless_it_is_far_off(true_scale: float, is_kept: bool):
    found = found_among(true_scale, 0.2, 4, is_stated=True)
    if is_kept:
        assert found == 1.0
    else:
        assert abs(found / true_scale - 1) < 0.15
    assert found_among(true_scale, 0.2, 4, is_stated=False) == pytest.approx(true_scale, rel=0.15)


@pytest.mark.parametrize(("true_scale", "is_doubted"), [(10.0, True), (6.0, True), (1.0, False), (0.1, False)])
def test_a_stated_noise_that_is_far_too_small_is_doubted_at_once(true_scale: float, is_doubted: bool):
    """Twenty-five pairs, sought at thirty times the stated noise, and ten false ones."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        z = np.concatenate([rng.normal(0, true_scale, 25), rng.uniform(-30 * GATE, 30 * GATE, 10)])
        rows = np.zeros(len(z), dtype=np.int64)
        pairs, wide = StereoMatches(rows, rows, 0.2 * z, np.full(len(z), 0.2)), replace(NoiseScale(), scale=30.0)
        stated, unstated = (weigh_matches(wide, pairs, GATE, is_stated, OPTIONS) for is_stated in (True, False))
        assert (stated.is_doubted, stated.is_known, stated.scale) == (is_doubted, False, 30.0)
        assert not unstated.is_doubted


@pytest.mark.parametrize(("sigma_px", "scale"), [(0.01, 30.0), (0.1, 3.0), (0.3, 1.0), (2.0, 1.0)])
def test_pairs_are_first_sought_as_widely_as_without_a_stated_noise(sigma_px: float, scale: float):
    dots = Dots.of(np.zeros((5, 2)), sigma_px)
    assert starting_scale(StereoDots(dots, dots), OPTIONS) == pytest.approx(scale)
    none = Dots.of(np.zeros((0, 2)))
    assert starting_scale(StereoDots(none, none), OPTIONS) == 1.0


def test_old_residuals_are_forgotten():
    rng, noise, options = np.random.default_rng(11), NoiseScale(), NoiseOptions(max_samples=400)
    rows = np.zeros(30, dtype=np.int64)
    for _ in range(100):
        pairs = StereoMatches(rows, rows, rng.normal(0, 0.2, 30), np.full(30, 0.2))
        noise = weigh_matches(noise, pairs, GATE, False, options)
    assert noise.seen == 3000
    assert 400 <= sum(map(len, noise.sigmas)) <= 630
    assert len(noise.gates) == len(noise.sigmas)


def test_too_few_pairs_say_nothing():
    rng, noise = np.random.default_rng(5), NoiseScale()
    noise = weigh_matches(noise, pairs_of_a_frame(rng, 0.3, noise, 0.0, OPTIONS.few_samples - 1), GATE, False, OPTIONS)
    assert noise.scale == 1.0
    assert not noise.is_known
    noise = weigh_matches(noise, pairs_of_a_frame(rng, 0.3, noise, 0.0, 100), GATE, False, OPTIONS)
    assert noise.is_known
    assert abs(noise.scale / 0.3 - 1) < 0.15


def test_no_pairs_change_nothing():
    none = np.zeros(0, dtype=np.int64)
    empty = StereoMatches(none, none, np.zeros(0), np.zeros(0))
    noise = NoiseScale()
    for _ in range(3):
        noise = weigh_matches(noise, empty, GATE, False, OPTIONS)
    assert noise.scale == 1.0
    assert not noise.is_known


def test_a_noise_that_changes_is_followed():
    rng, noise = np.random.default_rng(6), NoiseScale()
    for true_scale, frames in ((0.5, 40), (0.9, 80)):
        for _ in range(frames):
            noise = weigh_matches(noise, pairs_of_a_frame(rng, true_scale, noise, 0.1), GATE, False, OPTIONS)
        assert abs(noise.scale / true_scale - 1) < 0.15


# --- given points ----------------------------------------------------------------------------------------------------


def residuals_of_frames(true_scale: float, wrong: int, is_stated: bool, seed: int) -> NoiseScale:
    """60 frames of twelve points on an exact map, whose noise is not what they state; a few are on wrong targets."""
    rng, noise = np.random.default_rng(seed), NoiseScale()
    world = scattered(rng, 12)
    map = ReferenceMap.given(world)
    rows = np.arange(12)
    for _ in range(60):
        T = looking(rng)
        seen = seen_points(world, T, rng)
        exact = T.inverse().apply(world)
        xyz = exact + true_scale * (seen.xyz_mm - exact)
        xyz[:wrong] += 8.0
        points = scale_points(points_of(xyz, seen.cov_mm2), noise)
        right = rows[wrong:]
        fitted, cov = align_weighted(xyz[right], world[right], points.cov_mm2[right], map.cov_mm2[right])
        fix = Fix(fitted, cov, rows, rows, np.zeros(12), 1e-20)
        noise = weigh_residuals(noise, points, map, fix, is_stated, OPTIONS)
    return noise


@pytest.mark.parametrize("true_scale", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("wrong", [0, 1])
def test_the_scale_is_found_from_residuals(true_scale: float, wrong: int):
    found = residuals_of_frames(true_scale, wrong, False, 7).scale
    assert abs(found / true_scale - 1) < (0.12 if wrong else 0.06)


@pytest.mark.parametrize(("true_scale", "is_kept"), [(0.5, False), (0.85, True), (1.2, True), (2.0, False)])
def test_a_stated_covariance_is_kept_unless_it_is_far_off(true_scale: float, is_kept: bool):
    assert (residuals_of_frames(true_scale, 0, True, 8).scale == 1.0) == is_kept


def test_a_frame_that_defines_the_world_says_nothing():
    rng = np.random.default_rng(9)
    world = scattered(rng, 200, apart_mm=1.0)
    points = seen_points(world, looking(rng), rng)
    rows = np.arange(200)
    for p_chance, rows_of_fix in ((float("nan"), rows), (1e-20, rows[:3])):
        fix = Fix(
            looking(rng), np.eye(6), rows_of_fix, rows_of_fix, np.zeros(len(rows_of_fix)), p_chance,
            PositionedReason.defines_world if np.isnan(p_chance) else None,
        )  # fmt: skip
        noise = weigh_residuals(NoiseScale(), points, ReferenceMap.given(world), fix, False, OPTIONS)
        assert noise.scale == 1.0
        assert not noise.is_known


def test_points_are_scaled_by_what_was_found():
    rng = np.random.default_rng(10)
    points = seen_points(scattered(rng, 5), looking(rng), rng)
    scaled = scale_points(points, replace(NoiseScale(), scale=0.5))
    np.testing.assert_allclose(scaled.cov_mm2, 0.25 * points.cov_mm2)
    np.testing.assert_array_equal(scaled.xyz_mm, points.xyz_mm)


def test_detected_dots_start_with_the_prior_noise_on_top_of_their_own():
    dots = Dots.of(np.array([[10.0, 20.0], [30.0, 40.0]]), 0.4)
    np.testing.assert_allclose(
        add_prior_noise(dots, NoiseOptions(sigma_px=0.3)).cov_px2, np.tile(0.25 * np.eye(2), (2, 1, 1))
    )


@pytest.mark.parametrize(
    ("values", "text"),
    [({"sigma_px": 0.0}, "noise.sigma_px is 0.0"), ({"min_samples": 0}, "noise.few_samples and min_samples")],
)
def test_impossible_options_are_refused(values, text):
    with pytest.raises(ConfigError, match=text):
        NoiseOptions(**values)
