"""The image of a circle's centre, from the ellipses that two cameras see: against circles projected point by point."""

from dataclasses import replace
from math import radians, sqrt

import numpy as np
import pytest

from constellations import LEFT, PARALLEL, PINHOLE, RIG, scattered
from trifix.config import Config
from trifix.geometry.camera import Camera, StereoRig
from trifix.kernels.stereo import prepare_dots, views_of_circles
from trifix.positioner import Positioner
from trifix.records import Dots, Frame, StereoDots, StereoMatches
from trifix.sources.sensing import circle_rim
from trifix.stages.match import match
from trifix.stages.triangulate import TriangulateOptions, correct_eccentricity

BENT = Camera(1000.0, 1002.0, 640.0, 500.0, 1280, 1024, "radtan", (-0.25, 0.1, 0.0004, -0.0003))
FISHEYE = Camera(700.0, 702.0, 640.0, 500.0, 1280, 1024, "equidistant", (0.01, -0.02, 0.003, -0.001))
NONE = StereoMatches(*np.zeros((2, 0), dtype=np.int64), *np.zeros((2, 0)))


def tilted(ray: np.ndarray, tilt_rad: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Unit normals at an angle to the way back along the rays, any way round."""
    back = -ray / np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.cross(back, rng.normal(size=back.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.cos(tilt_rad)[:, None] * back + np.sin(tilt_rad)[:, None] * across


def images(camera: Camera, centre: np.ndarray, normal: np.ndarray, diameter_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres of area and shapes (symmetric roots of a² and b²) of circles in camera coordinates: sums over the area.

    The area is cut into rings and sectors, each of which counts by what it has in the image.
    """
    radius = (np.arange(12) + 0.5) / 12
    rings = np.stack([circle_rim(centre, normal, diameter_mm * r) for r in radius], axis=1)  # n, rings, rim, 3
    inner, outer = (
        np.stack([circle_rim(centre, normal, diameter_mm * (r + s / 24)) for r in radius], axis=1) for s in (-1, 1)
    )

    def project(xyz: np.ndarray) -> np.ndarray:
        return camera.project(xyz.reshape(-1, 3)).reshape(*xyz.shape[:3], 2)

    uv, across = project(rings), project(outer) - project(inner)
    wave = 1j * np.arange(uv.shape[2] // 2 + 1)
    around = np.fft.irfft(wave[:, None] * np.fft.rfft(uv, axis=2), uv.shape[2], axis=2)
    weight = np.abs(across[..., 0] * around[..., 1] - across[..., 1] * around[..., 0])
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    middle = (uv * weight[..., None]).sum(axis=(1, 2))
    off = uv - middle[:, None, None]
    value, vector = np.linalg.eigh(4 * np.einsum("nkri,nkrj,nkr->nij", off, off, weight))
    return middle, (vector * np.sqrt(value)[:, None]) @ np.swapaxes(vector, 1, 2)


def conics(camera: Camera, centre: np.ndarray, normal: np.ndarray, diameter_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """The same for a camera without distortion: H diag(r², r², -1) Hᵀ, H the circle's plane to the image."""
    middle, root = np.empty((len(centre), 2)), np.empty((len(centre), 2, 2))
    for i in range(len(centre)):
        one, other = np.linalg.svd(normal[i : i + 1])[2][1:]
        H = camera.K @ np.stack([one, other, centre[i]], axis=1)
        dual = H @ np.diag([diameter_mm**2 / 4, diameter_mm**2 / 4, -1.0]) @ H.T
        dual /= dual[2, 2]
        middle[i] = dual[:2, 2]
        value, vector = np.linalg.eigh(np.outer(middle[i], middle[i]) - dual[:2, :2])
        root[i] = (vector * np.sqrt(value)) @ vector.T
    return middle, root


def as_dots(uv: np.ndarray, root: np.ndarray, sigma_px: float) -> Dots:
    value, vector = np.linalg.eigh(root)
    ellipse = np.column_stack([value[:, ::-1], np.arctan2(vector[:, 1, 1], vector[:, 0, 1])])
    return replace(Dots.of(uv, sigma_px), ellipse=ellipse)


def spoilt(root: np.ndarray, sigma_px: float, rng: np.random.Generator) -> np.ndarray:
    """Shapes of an edge that errs, as in the derivation: mean radius by σ/√2, both ways of being oval by σ.

    The targets themselves are oval by a hundredth.
    """
    oval_px = np.hypot(sigma_px, 0.005 * np.linalg.norm(root, ord=2, axis=(1, 2)))
    mean, along, across = np.stack([np.full(len(root), sigma_px / sqrt(2)), oval_px, oval_px]) * rng.normal(
        size=(3, len(root))
    )
    return root + np.stack([mean + along, across, across, mean - along], axis=1).reshape(-1, 2, 2)


def seen(
    rig: StereoRig,
    xyz: np.ndarray,
    normal: np.ndarray,
    diameter_mm: float,
    noise: np.random.Generator | None,
    sigma_px: float,
) -> tuple[StereoDots, StereoDots]:
    """Dots with exact centres and noisy shapes, and the same at the images of the circles' centres."""
    there, true = [], []
    for camera, R, t in ((rig.left, np.eye(3), np.zeros(3)), (rig.right, rig.T_right_left.R, rig.T_right_left.t_mm)):
        uv, root = images(camera, xyz @ R.T + t, normal @ R.T, diameter_mm)
        there.append(as_dots(uv, root if noise is None else spoilt(root, sigma_px, noise), sigma_px))
        true.append(replace(there[-1], uv_px=camera.project(xyz @ R.T + t)))
    return StereoDots(*there), StereoDots(*true)


def all_paired(n: int) -> StereoMatches:
    return StereoMatches(np.arange(n), np.arange(n), np.zeros(n), np.zeros(n))


def in_view(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.c_[RIG.left.unproject(rng.uniform([250, 150], [1050, 870], (n, 2))), np.ones(n)] * 450.0


@pytest.mark.parametrize(
    ("camera", "diameter_px", "most_px"),
    [(PINHOLE, 40, 1e-9), (LEFT, 20, 1e-4), (LEFT, 40, 5e-4), (BENT, 20, 1e-3), (FISHEYE, 20, 1e-3)],
    ids=["none", "radtan", "large", "bent", "fisheye"],
)
def test_one_answer_of_an_exact_ellipse_is_the_circle(camera: Camera, diameter_px: float, most_px: float):
    """All over the image, up to 65 degrees; area and ellipse are the same for a camera that does not distort."""
    rng = np.random.default_rng(1)
    n = 300
    xy = camera.unproject(rng.uniform([0, 0], [1279, 1023], (n, 2)))
    centre = 400.0 * np.c_[xy, np.ones(n)]
    normal = tilted(centre, np.radians(rng.uniform(1, 65, n)), rng)
    of = conics if camera is PINHOLE else images
    uv, root = of(camera, centre, normal, diameter_px * 400.0 / camera.fu_px)
    dots = as_dots(uv, root, 0.1)
    prepared = prepare_dots(uv, dots.cov_px2, camera.parameters)
    views = views_of_circles(prepared, dots.ellipse, np.full(n, 0.1), camera.parameters)
    shift, normals = views[:, :4].reshape(n, 2, 2), views[:, 4:10].reshape(n, 2, 3)
    true = camera.project(centre) - uv
    error = np.linalg.norm(shift - true[:, None], axis=2)
    best = error.argmin(axis=1)
    assert np.linalg.norm(true, axis=1).max() > 0.03
    assert error.min(axis=1).max() < most_px
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-12)
    angle = np.linalg.norm(normals[np.arange(n), best] - normal, axis=1)
    assert angle.max() < (1e-8 if camera is PINHOLE else 0.03)


@pytest.mark.parametrize("tilt_deg", [3, 20, 40, 60])
@pytest.mark.parametrize(("diameter_px", "sigma_px"), [(6, 0.1), (20, 0.1), (40, 0.05)])
def test_both_cameras_settle_which_answer_is_right(tilt_deg: float, diameter_px: float, sigma_px: float):
    """Less than 0.005 px of the bias is left, and what chance leaves is no larger than said, nor far less."""
    rng = np.random.default_rng(2)
    n, draws = 60, 40
    xyz = in_view(rng, n)
    normal = tilted(xyz - 0.5 * RIG.right_centre_mm, np.full(n, radians(tilt_deg)), rng)
    repeated = (np.repeat(each, draws, axis=0) for each in (xyz, normal))
    dots, true = seen(RIG, *repeated, diameter_px * 450 / 1400, rng, sigma_px)
    found = correct_eccentricity(dots, all_paired(n * draws), RIG)
    for before, after, right in ((dots.left, found.left, true.left), (dots.right, found.right, true.right)):
        left_px = (after.uv_px - right.uv_px).reshape(n, draws, 2)
        chance = left_px.var(axis=1).sum(axis=1) / draws
        bias2 = (left_px.mean(axis=1) ** 2).sum(axis=1) - chance
        assert bias2.mean() < (0.005 if diameter_px < 40 or tilt_deg > 10 else 0.01) ** 2
        added = after.cov_px2 - before.cov_px2
        e = left_px.reshape(-1, 2)
        nees = np.einsum("ni,ni->n", e, np.linalg.solve(added, e[:, :, None])[:, :, 0]).mean() / 2
        assert 0.1 < nees < 1.1
        assert np.trace(added, axis1=1, axis2=2).mean() < 0.5 * 2 * sigma_px**2
    if diameter_px > 6:
        assert np.linalg.norm(dots.left.uv_px - true.left.uv_px, axis=1).mean() > 0.01


def test_corrected_centres_err_as_they_say():
    """Normalised errors of whole dots: chi-square with two degrees of freedom."""
    rng = np.random.default_rng(3)
    n, sigma_px = 3000, 0.1
    xyz = in_view(rng, n)
    normal = tilted(xyz, np.radians(rng.uniform(0, 60, n)), rng)
    dots, true = seen(RIG, xyz, normal, 40 * 450 / 1400, rng, sigma_px)
    noise = rng.normal(0, sigma_px, (2, n, 2))
    dots = StereoDots(*(replace(d, uv_px=d.uv_px + e) for d, e in zip((dots.left, dots.right), noise, strict=True)))
    for matches, least in ((all_paired(n), 0.93), (NONE, 0.9)):
        found = correct_eccentricity(dots, matches, RIG)
        for after, right in ((found.left, true.left), (found.right, true.right)):
            e = after.uv_px - right.uv_px
            d2 = np.einsum("ni,ni->n", e, np.linalg.solve(after.cov_px2, e[:, :, None])[:, :, 0])
            assert least < d2.mean() / 2 < 1.04
            assert 0.003 < np.mean(d2 > 9.21) < 0.02  # of chi-square: 0.01


def test_false_pairs_beside_the_true_one_change_little():
    rng = np.random.default_rng(4)
    n = 40
    xyz = in_view(rng, n)
    normal = tilted(xyz, np.full(n, radians(45)), rng)
    dots, true = seen(RIG, xyz, normal, 8.0, rng, 0.1)
    left, right = (each.ravel() for each in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    zero = np.zeros(n * n)
    few = (left == right) | (rng.random(n * n) < 2 / n)
    matches = StereoMatches(left, right, zero, zero).rows(np.flatnonzero(few))
    found = correct_eccentricity(dots, matches, RIG)
    error = np.linalg.norm(found.left.uv_px - true.left.uv_px, axis=1)
    assert np.median(error) < 0.2 * np.median(np.linalg.norm(dots.left.uv_px - true.left.uv_px, axis=1))
    assert np.mean(error > 0.02) < 0.15


def test_dots_of_one_camera_take_the_mean_and_its_spread():
    rng = np.random.default_rng(5)
    xyz = in_view(rng, 30)
    dots, true = seen(RIG, xyz, tilted(xyz, np.full(30, radians(40)), rng), 9.0, None, 0.1)
    found = correct_eccentricity(dots, NONE, RIG)
    error = found.left.uv_px - true.left.uv_px
    added = found.left.cov_px2 - dots.left.cov_px2
    along = error / np.linalg.norm(error, axis=1, keepdims=True)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", along, added, along))
    np.testing.assert_allclose(sigma, np.linalg.norm(error, axis=1), rtol=0.1)


@pytest.mark.parametrize("known", ["nothing", "size"])
def test_dots_without_a_shape_stay_where_they_are(known: str):
    """Of a known size, they are as uncertain as any tilt of such a circle would make them."""
    uv = np.array([[500.0, 400.0], [700.0, 600.0]])
    dots = Dots.of(uv, 0.1, None if known == "nothing" else np.array([20.0, 40.0]))
    found = correct_eccentricity(StereoDots(dots, dots), all_paired(2), PARALLEL)
    np.testing.assert_allclose(found.left.uv_px, uv, atol=1e-12)
    size = 0.0 if known == "nothing" else np.array([10.0, 20.0]) ** 2 / (4 * 1000.0)
    np.testing.assert_allclose(found.left.cov_px2[:, 0, 0], 0.01 + size**2, rtol=1e-9)


def test_the_spread_does_not_shrink_with_the_noise_scale():
    rng = np.random.default_rng(6)
    xyz = in_view(rng, 30)
    dots, _ = seen(RIG, xyz, tilted(xyz, np.full(30, radians(40)), rng), 9.0, None, 0.1)
    full, small = correct_eccentricity(dots, NONE, RIG), correct_eccentricity(dots, NONE, RIG, 0.1)
    spread = full.left.cov_px2 - dots.left.cov_px2, 0.1**2 * (small.left.cov_px2 - dots.left.cov_px2)
    np.testing.assert_allclose(spread[1], spread[0], atol=2e-5)
    np.testing.assert_array_equal(small.left.uv_px, full.left.uv_px)


def test_the_order_of_dots_and_pairs_means_nothing():
    rng = np.random.default_rng(7)
    xyz = in_view(rng, 25)
    dots, _ = seen(RIG, xyz, tilted(xyz, np.full(25, radians(40)), rng), 9.0, rng, 0.1)
    order = rng.permutation(25)
    other = StereoDots(dots.left, replace(dots.right, uv_px=dots.right.uv_px[order], ellipse=dots.right.ellipse[order]))
    matches = StereoMatches(order, np.arange(25), np.zeros(25), np.zeros(25))
    one, two = correct_eccentricity(dots, all_paired(25), RIG), correct_eccentricity(other, matches, RIG)
    np.testing.assert_allclose(two.left.uv_px, one.left.uv_px, atol=1e-12)
    np.testing.assert_allclose(two.right.uv_px, one.right.uv_px[order], atol=1e-12)


@pytest.mark.parametrize("is_corrected", [True, False])
def test_a_step_keeps_dots_as_they_were_found_beside_their_centres(is_corrected: bool):
    rng = np.random.default_rng(8)
    xyz = scattered(rng, 12) + [70, 0, 450]
    dots, true = seen(RIG, xyz, tilted(xyz, np.full(12, radians(35)), rng), 12.0, None, 0.1)
    config = Config(triangulate=TriangulateOptions(correct_eccentricity=is_corrected))
    step = Positioner(config, is_noise_stated=True).step(Frame(0, 0, RIG, dots))
    assert step.dots is not None
    assert step.centres is not None
    np.testing.assert_array_equal(step.dots.left.uv_px, dots.left.uv_px)
    error = np.linalg.norm(step.centres.left.uv_px - true.left.uv_px, axis=1)
    assert error.max() < 0.01 if is_corrected else error.min() > 0.03
    assert step.points is not None
    off = np.linalg.norm(step.points.xyz_mm[:, None] - xyz, axis=2).min(axis=1)
    assert (np.median(off) < 0.01) == is_corrected


def test_no_dots_are_no_trouble():
    nothing = Dots.of(np.zeros((0, 2)))
    found = correct_eccentricity(StereoDots(nothing, nothing), match(StereoDots(nothing, nothing), RIG), RIG)
    assert len(found.left) == len(found.right) == 0
