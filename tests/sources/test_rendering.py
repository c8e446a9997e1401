"""Rendered images: the targets are where the truth has them, and hidden ones are not drawn."""

import cv2
import numpy as np
import pytest

from trifix.geometry.camera import Camera
from trifix.kernels.rendering import draw_faces, warm_up
from trifix.sources.rendering import _BLUR_PX, Renderer
from trifix.sources.simulation import Simulation, simulate_frames


@pytest.fixture(scope="module")
def demo() -> Simulation:
    return simulate_frames("demo", 0, "images", 60)


def weighted_centre(image: np.ndarray, uv: np.ndarray, diameter: float) -> np.ndarray:
    """Grey-weighted centre of what is brighter than half-way between the sticker and the disc."""
    reach = round(0.66 * diameter + 2)
    u0, v0 = np.rint(uv).astype(int) - reach
    window = image[v0 : v0 + 2 * reach + 1, u0 : u0 + 2 * reach + 1].astype(float)
    v, u = np.mgrid[v0 : v0 + 2 * reach + 1, u0 : u0 + 2 * reach + 1]
    inside = np.hypot(u - uv[0], v - uv[1]) < 0.7 * diameter
    weight = np.where(inside, (window - 40).clip(0, None), 0)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def test_bright_dots_are_where_the_truth_has_them(demo):
    off = []
    for k in (0, 30, 59):
        content = demo.frames[k].content
        for image, seen in ((content.left, demo.seen[0]), (content.right, demo.seen[1])):
            rows = seen.of_frame(k)
            for uv, diameter, sigma in zip(seen.uv_px[rows], seen.diameter_px[rows], seen.sigma_px[rows], strict=True):
                if sigma < 1.2 * demo.scene.sensing.sigma_px:  # nearly head-on: the sticker surrounds the dot evenly
                    off.append(weighted_centre(image, uv, diameter) - uv)
    off = np.array(off)
    assert len(off) > 10
    assert np.abs(off.mean(axis=0)).max() < 0.02
    assert 0.002 < np.sqrt((off**2).mean()) < 0.06


def projected_circle(camera: Camera, centre: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """2000 points of the image of a circle (px), distortion and perspective as the camera has them."""
    a = np.cross(normal, [0.3, -0.5, 0.8])
    a /= np.linalg.norm(a)
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)[:, None]
    return camera.project(centre + radius * (np.cos(angle) * a + np.sin(angle) * np.cross(normal, a)))


def polygon_areas(uv: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Share of each pixel's area within a polygon, exactly: Green's theorem, pixel by pixel along its edges."""
    first = uv + 0.5  # pixel (0, 0) reaches from 0 to 1
    last = np.roll(first, -1, axis=0)
    cuts = [np.zeros(len(uv)), np.ones(len(uv))]
    for k in (0, 1):  # edges are shorter than a pixel: each crosses at most one line of the grid each way
        line = np.floor(np.maximum(first[:, k], last[:, k]))
        length = last[:, k] - first[:, k]
        crosses = np.floor(first[:, k]) != np.floor(last[:, k])
        cuts.append(np.where(crosses, (line - first[:, k]) / np.where(crosses, length, 1.0), 0.0))
    points = first[:, None] + np.sort(np.stack(cuts, axis=1), axis=1)[:, :, None] * (last - first)[:, None]
    middle, dv = (points[:, 1:] + points[:, :-1]) / 2, np.diff(points[:, :, 1], axis=1)
    column, row = np.floor(middle[:, :, 0]).astype(int), np.floor(middle[:, :, 1]).astype(int)
    beside = dv * (column + 1 - middle[:, :, 0])  # within its pixel, to the right of the edge
    areas = np.zeros((shape[0], shape[1] + 1))
    np.add.at(areas, (row, column), beside)
    np.add.at(areas, (row, column + 1), dv - beside)
    return np.abs(areas.cumsum(axis=1)[:, :-1])


@pytest.mark.parametrize(
    ("diameter_px", "tilt_deg", "grey_off", "centre_off_px"),
    [(6, 0, 0.1, 3e-4), (6, 60, 0.3, 8e-4), (12, 60, 0.1, 3e-4), (40, 30, 0.1, 3e-4), (40, 65, 0.1, 3e-4)],
)
def test_discs_are_drawn_by_their_exact_area(demo, diameter_px, tilt_deg, grey_off, centre_off_px):
    """Grey values (of a step of 200) and centres of gravity, all over the image, after the renderer's blur."""
    scene, camera, rng = demo.scene, demo.scene.rig.left, np.random.default_rng(2)
    renderer, size = Renderer(scene), (camera.height_px, camera.width_px)
    radius = 0.5 * scene.diameter_mm
    grey_errors, centre_errors = [], []
    for _ in range(12):
        ray = np.append(camera.unproject(rng.uniform(60, np.array(size)[None, ::-1] - 60))[0], 1.0)
        centre = ray * camera.fu_px * scene.diameter_mm / diameter_px
        to_camera = -ray / np.linalg.norm(ray)
        aside = np.cross(to_camera, rng.standard_normal(3))
        tilt = np.radians(tilt_deg)
        normal = np.cos(tilt) * to_camera + np.sin(tilt) * aside / np.linalg.norm(aside)
        grey = np.full(size, 20, dtype=np.float32)
        value, nothing = np.array([[220.0, 20.0]]), np.zeros(size, dtype=np.float32)
        renderer._draw_discs(0, centre[None], normal[None], radius, value, nothing, grey)
        exact = 200 * polygon_areas(projected_circle(camera, centre, normal, radius), size)
        off = cv2.GaussianBlur(grey - 20 - exact, (0, 0), _BLUR_PX)
        v, u = np.mgrid[: size[0], : size[1]]
        grey_errors.append(np.abs(off).max())
        centre_errors.append(
            [np.average(x, weights=grey - 20.0) - np.average(x, weights=exact) for x in (u, v)],
        )
    assert 0 < max(grey_errors) < grey_off
    assert 0 < np.linalg.norm(centre_errors, axis=1).max() < centre_off_px
    assert np.abs(np.mean(centre_errors, axis=0)).max() < 0.5 * centre_off_px


def test_the_image_has_a_dark_room_a_lit_object_and_white_targets(demo):
    image = demo.frames[10].content.left
    assert image.dtype == np.uint8
    assert image.shape == (720, 960)
    assert np.median(image[:60]) < 40
    assert 70 < image[300:420, 400:560].mean() < 170
    assert (image > 160).sum() > 300
    assert image.max() < 255


def test_the_object_hides_what_is_behind_it(demo):
    """At every target turned to the camera, the image is dark or bright as the truth says."""
    k = 20
    image, seen = demo.frames[k].content.left, demo.seen[0]
    visible = set(seen.target[seen.of_frame(k)].tolist())
    pose = demo.truth.frames.T_map_sensor[k].inverse()
    targets = demo.scene.targets
    in_camera = pose.apply(targets.xyz_mm)
    cosine = -np.einsum("ki,ki->k", in_camera, targets.normal @ pose.R.T) / np.linalg.norm(in_camera, axis=1)
    uv = np.rint(demo.scene.rig.left.project(in_camera)).astype(int)
    for i in range(len(targets)):
        if i in visible:
            assert image[uv[i, 1], uv[i, 0]] > 90
        elif cosine[i] < 0:
            assert image[uv[i, 1], uv[i, 0]] < 190


def test_a_nearer_triangle_covers_a_farther_one_and_backs_are_not_drawn():
    uv = np.array([[0.0, 0.0], [0.0, 9.0], [9.0, 0.0]])
    uv, z = np.tile(uv, (2, 1)), np.array([200.0] * 3 + [100.0] * 3)
    depth, owner = np.zeros((10, 10), dtype=np.float32), np.full((10, 10), -1, dtype=np.int32)
    draw_faces(uv, z, np.array([[3, 4, 5], [0, 1, 2]]), depth, owner)
    assert owner[2, 2] == 0
    assert depth[2, 2] == pytest.approx(0.01)
    assert owner[9, 9] == -1
    owner[:] = -1
    draw_faces(uv, z, np.array([[3, 5, 4]]), np.zeros_like(depth), owner)
    assert (owner == -1).all()


def test_rendered_frames_can_be_asked_for_like_any_sequence(demo):
    assert [frame.index for frame in demo.frames[1:5:3]] == [1, 4]
    assert demo.frames[-1].index == 59
    with pytest.raises(IndexError):
        demo.frames[60]
    np.testing.assert_array_equal(demo.frames[4].content.left, demo.frames[4].content.left)


def test_everything_is_compiled_after_the_warm_up(demo):
    warm_up()
    before = len(draw_faces.signatures)
    demo.frames[1]
    assert len(draw_faces.signatures) == before
