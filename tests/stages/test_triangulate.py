"""Triangulation: points and covariances against truth."""

from dataclasses import replace
from math import sqrt
from typing import Literal

import numpy as np
import pytest

from constellations import PARALLEL, RIG, chi2_limits, seen_dots
from trifix.errors import ConfigError
from trifix.geometry import triangulation
from trifix.geometry.camera import StereoRig
from trifix.records import Dots, StereoDots, StereoMatches
from trifix.stages.triangulate import TriangulateOptions, triangulate


def paired(left: list[int], right: list[int]) -> StereoMatches:
    zero = np.zeros(len(left))
    return StereoMatches(np.array(left, dtype=np.int64), np.array(right, dtype=np.int64), zero, zero)


def before_the_sensor(rng: np.random.Generator, n: int) -> np.ndarray:
    z = rng.uniform(300, 900, n)
    return np.c_[(rng.uniform(-0.2, 0.2, (n, 2)) + [0.1, 0.0]) * z[:, None], z]


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
def test_exact_dots_give_exact_points(rig: StereoRig):
    rng = np.random.default_rng(1)
    xyz = before_the_sensor(rng, 50)
    dots = seen_dots(xyz, rng, 0.0, rig)
    points = triangulate(dots, paired([*range(50)], [*range(50)]), rig)
    np.testing.assert_allclose(points.xyz_mm, xyz, atol=1e-6)


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
@pytest.mark.parametrize(("stated_px", "noise_scale"), [(0.15, 1.0), (0.3, 0.5)])
def test_errors_follow_their_covariance(rig: StereoRig, stated_px: float, noise_scale: float):
    """Chi-square of three degrees of freedom, in the mean and in both tails; the dots' noise is 0.15 px."""
    rng = np.random.default_rng(2)
    n = 4000
    xyz = before_the_sensor(rng, n)
    dots = seen_dots(xyz, rng, 0.15, rig)
    stated = np.tile(stated_px**2 * np.eye(2), (n, 1, 1))
    dots = StereoDots(replace(dots.left, cov_px2=stated), replace(dots.right, cov_px2=stated))
    points = triangulate(dots, paired([*range(n)], [*range(n)]), rig, noise_scale)
    r = points.xyz_mm - xyz
    chi2 = np.einsum("ni,ni->n", r, np.linalg.solve(points.cov_mm2, r[:, :, None])[:, :, 0])
    low, high = chi2_limits(3 * n)
    assert low < chi2.sum() < high
    below, above = chi2_limits(3, 0.025)
    for share in (np.mean(chi2 < below), np.mean(chi2 > above)):
        assert abs(share - 0.025) < 4 * sqrt(0.025 * 0.975 / n)


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
def test_each_method_is_that_of_geometry(rig: StereoRig):
    """For dots of equal noise, the weighted optimum is that of Hartley and Sturm; distortion makes it unequal."""
    rng = np.random.default_rng(7)
    dots = seen_dots(before_the_sensor(rng, 60), rng, 0.15, rig)
    slopes = rig.left.unproject(dots.left.uv_px), rig.right.unproject(dots.right.uv_px)
    matches = paired([*range(60)], [*range(60)])
    for name, atol_mm in (("optimal", 1e-3 if rig is PARALLEL else 0.02), ("linear", 1e-9), ("midpoint", 1e-9)):
        points = triangulate(dots, matches, rig, options=TriangulateOptions(method=name))
        np.testing.assert_allclose(points.xyz_mm, getattr(triangulation, name)(rig, *slopes), atol=atol_mm)
    np.testing.assert_array_equal(
        triangulate(dots, matches, rig).xyz_mm,
        triangulate(dots, matches, rig, options=TriangulateOptions(method="optimal")).xyz_mm,
    )


@pytest.mark.parametrize("method", ["linear", "midpoint"])
def test_the_noise_scale_is_in_the_covariance_of_every_method(method: Literal["linear", "midpoint"]):
    rng = np.random.default_rng(8)
    dots, matches = seen_dots(before_the_sensor(rng, 20), rng, 0.15), paired([*range(20)], [*range(20)])
    options = TriangulateOptions(method=method)
    once, twice = (triangulate(dots, matches, RIG, scale, options).cov_mm2 for scale in (1.0, 2.0))
    np.testing.assert_allclose(twice, 4 * once)


def test_dots_of_unequal_noise_are_weighted():
    """One camera ten times as noisy: the error stays what the covariance says, and most of it is the noisy one's."""
    rng = np.random.default_rng(3)
    n = 2000
    xyz = before_the_sensor(rng, n)
    exact = seen_dots(xyz, rng, 0.0)
    dots = StereoDots(
        *(Dots.of(d.uv_px + s * rng.normal(size=(n, 2)), s) for d, s in ((exact.left, 0.05), (exact.right, 0.5)))
    )
    points = triangulate(dots, paired([*range(n)], [*range(n)]), RIG)
    r = points.xyz_mm - xyz
    chi2 = float(np.einsum("ni,ni->", r, np.linalg.solve(points.cov_mm2, r[:, :, None])[:, :, 0]))
    low, high = chi2_limits(3 * n)
    assert low < chi2 < high
    in_left = RIG.left.project(points.xyz_mm) - exact.left.uv_px
    assert 0.04 < np.sqrt(np.mean(in_left**2)) < 0.06


def test_a_dot_in_several_pairs_gives_several_points():
    xyz = np.array([[0.0, 10.0, 400.0], [4.1, 10.25, 410.0]])
    dots = seen_dots(xyz, np.random.default_rng(4), 0.0, PARALLEL)
    points = triangulate(dots, paired([0, 0, 1], [0, 1, 1]), PARALLEL)
    np.testing.assert_array_equal(points.match, [0, 1, 2])
    np.testing.assert_array_equal(points.row, [0, 1, 2])
    np.testing.assert_allclose(points.xyz_mm[[0, 2]], xyz, atol=1e-6)
    assert abs(points.xyz_mm[1, 2] - 400) > 5


@pytest.mark.parametrize("method", ["optimal", "linear", "midpoint"])
def test_pairs_that_meet_behind_a_camera_or_nowhere_give_no_point(method: Literal["optimal", "linear", "midpoint"]):
    uv = np.array([[600.0, 500.0]])
    left = Dots.of(np.repeat(uv, 3, axis=0))
    right = Dots.of(uv - [[-50.0, 0.0], [0.0, 0.0], [300.0, 0.0]])  # behind, parallel, before
    points = triangulate(
        StereoDots(left, right), paired([0, 1, 2], [0, 1, 2]), PARALLEL, 1.0, TriangulateOptions(method)
    )
    np.testing.assert_array_equal(points.match, [2])
    np.testing.assert_array_equal(points.row, [0])
    np.testing.assert_allclose(points.xyz_mm[0, 2], 400.0, atol=1e-6)
    assert np.isfinite(points.cov_mm2).all()


def test_a_point_has_the_label_of_either_dot():
    dots = seen_dots(np.tile([[50.0, 0.0, 450.0]], (3, 1)), np.random.default_rng(5), 0.0)
    dots = StereoDots(replace(dots.left, label=np.array([7, -1, -1])), replace(dots.right, label=np.array([-1, 3, -1])))
    np.testing.assert_array_equal(triangulate(dots, paired([0, 1, 2], [0, 1, 2]), RIG).label, [7, 3, -1])


def test_a_point_of_two_labels_has_none():
    dots = seen_dots(np.array([[50.0, 0.0, 450.0]]), np.random.default_rng(5), 0.0)
    dots = StereoDots(replace(dots.left, label=np.array([7])), replace(dots.right, label=np.array([3])))
    np.testing.assert_array_equal(triangulate(dots, paired([0], [0]), RIG).label, [-1])


def test_points_are_labelled_by_the_size_of_their_ellipses():
    """3, 6 and 12 mm wide, tilted, between two classes, unknown, and with a label already."""
    xyz = np.tile([[50.0, 0.0, 450.0]], (6, 1))
    dots, a = seen_dots(xyz, np.random.default_rng(5), 0.0), np.array([1.5, 3.0, 6.0, 2.1, np.nan, 3.0])
    sides = []
    for one, camera, z in (
        (dots.left, RIG.left, xyz[:, 2]),
        (dots.right, RIG.right, RIG.T_right_left.apply(xyz)[:, 2]),
    ):
        px = a * camera.fu_px / z
        sides.append(replace(one, ellipse=np.c_[px, 0.5 * px, 0 * px], label=np.array([-1, -1, -1, -1, -1, 9])))
    options = TriangulateOptions(diameters_mm="3, 6 12")
    points = triangulate(StereoDots(*sides), paired([*range(6)], [*range(6)]), RIG, 1.0, options)
    np.testing.assert_array_equal(points.label, [0, 1, 2, -1, -1, 9])
    for wrong in ("small", "3 3", "-1 2"):
        with pytest.raises(ConfigError, match="different lengths"):
            TriangulateOptions(diameters_mm=wrong)


def test_without_pairs_there_are_no_points():
    dots = seen_dots(np.array([[50.0, 0.0, 450.0]]), np.random.default_rng(6))
    points = triangulate(dots, paired([], []), RIG)
    assert len(points) == 0
    assert points.cov_mm2.shape == (0, 3, 3)
