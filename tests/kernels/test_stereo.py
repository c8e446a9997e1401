"""The compiled cameras are those of the geometry, and pairs and points are what its plain formulas make of them."""

from dataclasses import replace

import numpy as np
import pytest

from constellations import PARALLEL, RIG, seen_dots
from trifix.geometry import triangulation
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.epipolar import essential_matrix
from trifix.kernels.stereo import expected_targets, likeliest_scale, prepare_dots
from trifix.records import Dots, StereoDots
from trifix.stages.match import MatchOptions, match
from trifix.stages.triangulate import triangulate

EQUIDISTANT = Camera(700.0, 702.0, 640.0, 500.0, 1280, 1024, "equidistant", (0.01, -0.02, 0.003, -0.001))
FOLDING = Camera(700.0, 702.0, 640.0, 500.0, 1280, 1024, "radtan", (-0.35, 0.15, 0.001, -0.001, -0.03))
RIGS = {
    "radtan": RIG,
    "none": PARALLEL,
    "equidistant": StereoRig(EQUIDISTANT, EQUIDISTANT, RIG.T_right_left),
    "folding": StereoRig(FOLDING, FOLDING, RIG.T_right_left),
}
EACH = pytest.mark.parametrize("rig", list(RIGS.values()), ids=list(RIGS))


def undistort_dots(dots: Dots, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Slopes and their covariances by the compiled camera."""
    prepared = prepare_dots(dots.uv_px, dots.cov_px2, camera.parameters)
    return prepared[:, :2], prepared[:, [[2, 3], [3, 4]]]


def anywhere(rng: np.random.Generator, n: int) -> Dots:
    """Dots all over the image and a little beyond, of any covariance."""
    A = rng.normal(size=(n, 2, 2))
    dots = Dots.of(rng.uniform([-100, -100], [1380, 1120], (n, 2)))
    return replace(dots, cov_px2=A @ A.transpose(0, 2, 1) + 0.01 * np.eye(2))


@EACH
def test_dots_are_undistorted_as_by_the_camera(rig: StereoRig):
    dots = anywhere(np.random.default_rng(1), 500)
    xy, cov = undistort_dots(dots, rig.left)
    np.testing.assert_allclose(xy, rig.left.unproject(dots.uv_px), atol=1e-11)
    good = np.isfinite(xy).all(axis=1)
    assert good.sum() > 200
    assert good.all() == (rig is not RIGS["folding"])
    J = rig.left.unproject_jacobian(xy[good])
    np.testing.assert_allclose(cov[good], J @ dots.cov_px2[good] @ J.transpose(0, 2, 1), rtol=1e-8, atol=1e-18)
    per_px = prepare_dots(dots.uv_px, dots.cov_px2, rig.left.parameters)[good][:, [[5, 6], [6, 7]]]
    np.testing.assert_allclose(per_px, J @ J.transpose(0, 2, 1), rtol=1e-8, atol=1e-18)


@EACH
def test_pairs_are_those_that_every_single_test_lets_pass(rig: StereoRig):
    rng = np.random.default_rng(2)
    left, right = anywhere(rng, 150), anywhere(rng, 150)
    matches = match(StereoDots(left, right), rig, MatchOptions(max_epipolar_sigmas=3.0), 1.5)
    (xy_left, C_left), (xy_right, C_right) = undistort_dots(left, rig.left), undistort_dots(right, rig.right)
    i, j = (each.ravel() for each in np.indices((150, 150)))
    E = essential_matrix(rig)
    h_left, h_right = np.c_[xy_left, np.ones(150)][i], np.c_[xy_right, np.ones(150)][j]
    l_left, l_right = (h_right @ E)[:, :2], (h_left @ E.T)[:, :2]
    value = np.einsum("ni,ij,nj->n", h_right, E, h_left)
    variance = np.einsum("ni,nij,nj->n", l_left, C_left[i], l_left)
    variance += np.einsum("ni,nij,nj->n", l_right, C_right[j], l_right)
    xyz = triangulation.midpoint(rig, xy_left[i], xy_right[j])
    z = np.stack([xyz[:, 2], rig.T_right_left.apply(xyz)[:, 2]]) / rig.baseline_mm
    with np.errstate(invalid="ignore"):
        is_pair = (np.abs(value) <= 4.5 * np.sqrt(variance)) & (z.min(axis=0) >= 1) & (z.max(axis=0) <= 15)
    assert 30 < is_pair.sum() < 3000
    np.testing.assert_array_equal(matches.left, i[is_pair])
    np.testing.assert_array_equal(matches.right, j[is_pair])
    z_score = matches.epipolar_px / matches.epipolar_sigma_px
    np.testing.assert_allclose(z_score, (value / np.sqrt(variance))[is_pair], atol=1e-8)


@EACH
def test_points_are_those_of_the_plain_formulas(rig: StereoRig):
    rng = np.random.default_rng(3)
    left, right = anywhere(rng, 150), anywhere(rng, 150)
    matches = match(StereoDots(left, right), rig)
    points = triangulate(StereoDots(left, right), matches, rig, 0.7)
    (xy_left, C_left), (xy_right, C_right) = undistort_dots(left, rig.left), undistort_dots(right, rig.right)
    rows = matches.left, matches.right
    xyz, cov = triangulation.triangulate(
        rig, xy_left[rows[0]], xy_right[rows[1]], 0.49 * C_left[rows[0]], 0.49 * C_right[rows[1]]
    )
    assert len(points) > 10
    np.testing.assert_allclose(points.xyz_mm, xyz[points.match], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(points.cov_mm2, cov[points.match], rtol=1e-5, atol=1e-9)


@EACH
def test_targets_are_expected_where_both_cameras_see_them(rig: StereoRig):
    rng = np.random.default_rng(4)
    xyz = np.vstack([rng.uniform([-400, -400, -100], [600, 400, 900], (2000, 3)), [[60, 0, 700]]])
    view, state = np.tile([0.0, 0.0, -1.0], (len(xyz), 1)), np.zeros(len(xyz), np.int64)
    points = np.array([[0.0, 0.0, 200.0], [0.0, 0.0, 800.0]])
    found = expected_targets(xyz, view, state, np.eye(3), np.zeros(3), points, rig.parameters, 10.0)
    seen = rig.left.sees(xyz, 10.0) & rig.right.sees(rig.T_right_left.apply(xyz), 10.0)
    in_range = (xyz[:, 2] >= 200) & (xyz[:, 2] <= 800)
    facing = xyz[:, 2] >= 0.5 * np.linalg.norm(xyz, axis=1)
    np.testing.assert_array_equal(found, seen & in_range & facing)
    assert 100 < found.sum() < 1500


@pytest.mark.parametrize("true_scale", [0.05, 0.3, 1.0, 4.0, 20.0])
@pytest.mark.parametrize("false_share", [0.0, 0.5])
def test_the_coarse_search_finds_the_likeliest_of_all_scales(true_scale: float, false_share: float):
    rng = np.random.default_rng(5)
    z = np.abs(rng.normal(0, true_scale, 1000))
    gate = np.full(1000, 3.5 * max(1.0, true_scale))
    is_false = (rng.random(1000) < false_share) | (z > gate)
    z[is_false] = rng.uniform(0, gate[is_false])
    scales = np.geomspace(0.02, 100, 180)
    best, gain = likeliest_scale(z, gate, scales)
    each = [likeliest_scale(z, gate, scales[k : k + 1])[1] for k in range(len(scales))]
    assert best == scales[int(np.argmax(each))]
    assert gain == pytest.approx(max(each))
    assert abs(best / true_scale - 1) < 0.15


def test_arrays_of_any_layout_compile_nothing_more():
    """Read-only, not in one piece, single precision: the records of a user."""
    rng = np.random.default_rng(6)
    xyz = np.c_[rng.uniform(-50, 50, (20, 2)) + [70, 0], rng.uniform(400, 500, 20)]
    dots = seen_dots(xyz, rng, 0.1)
    expected = match(dots, RIG)
    before = len(prepare_dots.signatures)

    def odd(d: Dots) -> Dots:
        uv, cov = np.asfortranarray(d.uv_px), np.repeat(d.cov_px2, 2, axis=0)[::2]
        uv.flags.writeable = False
        return Dots(uv, cov, d.ellipse[::-1][::-1], d.label.astype(np.int32), d.row)

    T = RIG.T_right_left
    rig = replace(RIG, T_right_left=replace(T, R=np.asfortranarray(T.R)))
    found = match(StereoDots(odd(dots.left), odd(dots.right)), rig)
    np.testing.assert_array_equal(found.left, expected.left)
    np.testing.assert_array_equal(found.epipolar_px, expected.epipolar_px)
    assert len(prepare_dots.signatures) == before
