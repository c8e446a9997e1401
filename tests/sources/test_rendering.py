"""Rendered images: the targets are where the truth has them, and hidden ones are not drawn."""

import numpy as np
import pytest

from trifix.kernels.rendering import draw_faces, warm_up
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
