"""Stereo matching: every true pair is kept, and of the false ones only what geometry cannot tell."""

from dataclasses import replace
from math import erf, sqrt

import numpy as np
import pytest

from constellations import PARALLEL, PINHOLE, RIG, seen_dots, some_dots
from trifix.errors import ConfigError
from trifix.geometry.camera import StereoRig
from trifix.records import Dots, StereoDots, StereoMatches
from trifix.stages.match import MatchOptions, match


def before_the_sensor(rng: np.random.Generator, n: int) -> np.ndarray:
    z = rng.uniform(350, 650, n)
    return np.c_[(rng.uniform(-0.12, 0.12, (n, 2)) + [0.1, 0.0]) * z[:, None], z]


def pairs(matches: StereoMatches) -> set[tuple[int, int]]:
    return set(zip(matches.left.tolist(), matches.right.tolist(), strict=True))


def true_pairs_kept(dots: StereoDots, options: MatchOptions, noise_scale: float = 1.0) -> float:
    matches = match(dots, RIG, options, noise_scale)
    return float(np.sum(matches.left == matches.right)) / len(dots.left)


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
def test_all_true_pairs_are_kept_whatever_the_order_of_the_dots(rig):
    rng = np.random.default_rng(1)
    dots = seen_dots(before_the_sensor(rng, 60), rng, 0.1, rig)
    order = rng.permutation(60)
    found = pairs(match(StereoDots(dots.left, some_dots(dots.right, order)), rig))
    assert {(int(target), row) for row, target in enumerate(order)} <= found


@pytest.mark.parametrize("sigmas", [1.0, 2.0, 3.5])
@pytest.mark.parametrize(("noise_px", "noise_scale"), [(0.1, 1.0), (0.3, 3.0), (0.3, 1.0)])
def test_the_gate_keeps_the_share_that_it_promises(sigmas, noise_px, noise_scale):
    """Dots that state 0.1 px: with noise_scale the gate follows the noise there is, without it cuts more."""
    rng = np.random.default_rng(2)
    n = 3000
    dots = seen_dots(before_the_sensor(rng, n), rng, noise_px)
    stated = np.tile(0.01 * np.eye(2), (n, 1, 1))
    dots = StereoDots(replace(dots.left, cov_px2=stated), replace(dots.right, cov_px2=stated))
    promised = erf(sigmas * noise_scale * 0.1 / noise_px / sqrt(2))
    kept = np.mean(
        [
            true_pairs_kept(
                StereoDots(some_dots(dots.left, rows), some_dots(dots.right, rows)),
                MatchOptions(max_epipolar_sigmas=sigmas),
                noise_scale,
            )
            for rows in np.arange(n).reshape(100, 30)
        ]
    )
    assert abs(kept - promised) <= 4 * sqrt(promised * (1 - promised) / n) + 1e-3


def test_distances_from_the_line_follow_their_sigma():
    rng = np.random.default_rng(3)
    n = 3000
    dots = seen_dots(before_the_sensor(rng, n), rng, 0.2)
    z, sigma_px = [], []
    for rows in np.arange(n).reshape(100, 30):
        dots_of_rows = StereoDots(some_dots(dots.left, rows), some_dots(dots.right, rows))
        matches = match(dots_of_rows, RIG, MatchOptions(max_epipolar_sigmas=8))
        matches = matches.rows(np.flatnonzero(matches.left == matches.right))
        z.append(matches.epipolar_px / matches.epipolar_sigma_px)
        sigma_px.append(matches.epipolar_sigma_px)
    z = np.concatenate(z)
    assert len(z) == n
    assert abs(np.mean(z)) < 4 / sqrt(n)
    assert abs(np.mean(z**2) - 1) < 4 * sqrt(2 / n)
    np.testing.assert_allclose(np.concatenate(sigma_px), 0.2, rtol=1e-6)


def test_several_dots_on_one_epipolar_line_are_all_kept():
    xyz = np.array([[0.0, 10.0, 400.0], [4.1, 10.25, 410.0], [8.4, 10.5, 420.0]])
    dots = seen_dots(xyz, np.random.default_rng(4), 0.05, PARALLEL)
    assert pairs(match(dots, PARALLEL)) == {(i, j) for i in range(3) for j in range(3)}


def test_a_dot_off_the_line_is_no_partner():
    dots = seen_dots(np.array([[0.0, 0.0, 400.0]]), np.random.default_rng(5), 0.1, PARALLEL)
    for offset_px, is_kept in ((0.3, True), (1.5, False)):
        moved = replace(dots.right, uv_px=dots.left.uv_px - [[300.0, offset_px]])
        assert len(match(StereoDots(dots.left, moved), PARALLEL)) == is_kept


@pytest.mark.parametrize(
    ("options", "kept_mm"),
    [
        (MatchOptions(), (150, 400, 1700)),  # one to fifteen baselines of 120 mm
        (MatchOptions(min_depth_mm=300), (400, 1700)),
        (MatchOptions(max_depth_mm=1000), (150, 400)),
        (MatchOptions(min_depth_mm=50, max_depth_mm=3000), (100, 150, 400, 1700, 2000)),
    ],
)
def test_depths_beyond_the_limits_are_dropped(options, kept_mm):
    depth = np.array([100.0, 150.0, 400.0, 1700.0, 2000.0])
    row = np.array([-200.0, -100.0, 0.0, 100.0, 200.0]) / 1000  # each on an epipolar line of its own
    xyz = np.c_[np.full(5, 60.0), row * depth, depth]
    dots = seen_dots(xyz, np.random.default_rng(6), 0.01, PARALLEL)
    assert pairs(match(dots, PARALLEL, options)) == {(k, k) for k in range(5) if depth[k] in kept_mm}


@pytest.mark.parametrize("x_mm", [-60.0, 160.0], ids=["nearer to the right one", "nearer to the left one"])
def test_depth_counts_before_both_cameras(x_mm):
    xyz = np.array([[x_mm, 0.0, 500.0]])
    dots = seen_dots(xyz, np.random.default_rng(7), 0.05)
    depths = sorted((500.0, float(RIG.T_right_left.apply(xyz)[0, 2])))
    assert depths[1] - depths[0] > 1
    between = 0.5 * sum(depths)
    assert len(match(dots, RIG, MatchOptions(min_depth_mm=between))) == 0
    assert len(match(dots, RIG, MatchOptions(max_depth_mm=between))) == 0
    assert len(match(dots, RIG, MatchOptions(min_depth_mm=depths[0] - 1, max_depth_mm=depths[1] + 1))) == 1


def sized(dots: StereoDots, left_px: float, right_px: float) -> StereoDots:
    return StereoDots(
        *(Dots.of(d.uv_px, 0.1, np.array([px])) for d, px in ((dots.left, left_px), (dots.right, right_px)))
    )


def test_dots_of_different_size_are_no_pair():
    one = seen_dots(np.array([[60.0, 0.0, 400.0]]), np.random.default_rng(8), 0.05, PARALLEL)
    for left, right, ratio, is_kept in (
        (10.0, 19.0, 2.0, True),
        (10.0, 21.0, 2.0, False),
        (21.0, 10.0, 2.0, False),
        (10.0, 21.0, 3.0, True),
        (np.nan, 21.0, 2.0, True),
        (np.nan, np.nan, 2.0, True),
    ):
        assert len(match(sized(one, left, right), PARALLEL, MatchOptions(max_size_ratio=ratio))) == is_kept


def test_sizes_are_compared_as_they_are_in_space():
    """A camera of twice the focal length shows the same dot twice as large."""
    long = replace(PINHOLE, fu_px=2000.0, fv_px=2000.0)
    rig = StereoRig(PINHOLE, long, PARALLEL.T_right_left)
    one = seen_dots(np.array([[60.0, 0.0, 400.0]]), np.random.default_rng(9), 0.05, rig)
    options = MatchOptions(max_size_ratio=1.2)
    assert len(match(sized(one, 10.0, 20.0), rig, options)) == 1
    assert len(match(sized(one, 10.0, 10.0), rig, options)) == 0


def test_dots_of_another_size_than_the_targets_are_left_out():
    one = seen_dots(np.array([[60.0, 0.0, 400.0]]), np.random.default_rng(9), 0.05, PARALLEL)
    for diameter_mm, is_kept in ((0.0, True), (4.0, True), (2.5, True), (1.5, False), (9.0, False)):
        options = MatchOptions(target_diameter_mm=diameter_mm)
        assert len(match(sized(one, 10.0, 10.0), PARALLEL, options)) == is_kept  # 10 px at 400 mm: 4 mm
    assert len(match(sized(one, np.nan, np.nan), PARALLEL, MatchOptions(target_diameter_mm=4.0))) == 1


def test_labels_must_agree_where_both_dots_have_one():
    xyz = np.array([[0.0, 10.0, 400.0], [4.1, 10.25, 410.0], [8.4, 10.5, 420.0]])
    dots = seen_dots(xyz, np.random.default_rng(4), 0.05, PARALLEL)
    dots = StereoDots(replace(dots.left, label=np.array([1, 2, -1])), replace(dots.right, label=np.array([1, -1, 2])))
    assert pairs(match(dots, PARALLEL)) == {(i, j) for i in range(3) for j in range(3)} - {(0, 2), (1, 0)}


def test_a_dot_that_finds_none_of_its_label_is_sought_as_if_it_had_none():
    xyz = np.array([[0.0, 10.0, 400.0], [30.0, 60.0, 410.0]])
    dots = seen_dots(xyz, np.random.default_rng(4), 0.05, PARALLEL)
    dots = StereoDots(replace(dots.left, label=np.array([1, 2])), replace(dots.right, label=np.array([1, 3])))
    assert pairs(match(dots, PARALLEL)) == {(0, 0), (1, 1)}


@pytest.mark.parametrize(("left", "right"), [(0, 0), (0, 3), (3, 0)])
def test_without_dots_there_are_no_pairs(left, right):
    uv = np.array([[600.0, 500.0], [640.0, 510.0], [700.0, 520.0]])
    matches = match(StereoDots(Dots.of(uv[:left]), Dots.of(uv[:right])), RIG)
    assert len(matches) == 0
    assert matches.epipolar_px.shape == matches.epipolar_sigma_px.shape == (0,)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"max_epipolar_sigmas": 0.0}, "match.max_epipolar_sigmas is 0.0"),
        ({"min_depth_mm": -1.0}, "must not be negative"),
        ({"min_depth_mm": 500.0, "max_depth_mm": 400.0}, "expected more than min_depth_mm = 500.0"),
        ({"target_diameter_mm": -1.0}, "match.target_diameter_mm is -1.0"),
        ({"max_size_ratio": 0.5}, "match.max_size_ratio is 0.5"),
    ],
)
def test_impossible_options_are_refused(values, text):
    with pytest.raises(ConfigError, match=text):
        MatchOptions(**values)
