"""What the cameras see, checked by other means: OpenCV's projection, and every triangle tried for every ray."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from trifix.geometry.camera import Camera
from trifix.geometry.pose import Pose
from trifix.sources.scenes import SCENES, Scene
from trifix.sources.sensing import camera_poses, sightings


def made(name: str, frames: int, seed: int = 0) -> Scene:
    return SCENES[name].build(frames, np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1]))


def opencv_projection(camera: Camera, T_camera_map: Pose, xyz: np.ndarray) -> np.ndarray:
    coefficients = np.array(camera.coefficients)
    uv, _ = cv2.projectPoints(xyz, cv2.Rodrigues(T_camera_map.R)[0], T_camera_map.t_mm, camera.K, coefficients)
    return uv.reshape(-1, 2)


def is_hit(origin: np.ndarray, end: np.ndarray, triangles: np.ndarray) -> bool:
    """Whether any triangle is met between 0.1 and 99.5 % of the way (Möller & Trumbore 1997, in doubles)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ray = end - origin
    p = np.cross(ray, c - a)
    det = np.einsum("fi,fi->f", b - a, p)
    det = np.where(np.abs(det) < 1e-9, np.nan, det)
    u = np.einsum("fi,fi->f", origin - a, p) / det
    q = np.cross(origin - a, b - a)
    v = q @ ray / det
    t = np.einsum("fi,fi->f", c - a, q) / det
    with np.errstate(invalid="ignore"):
        return bool(np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.001) & (t < 0.995)))


@pytest.mark.parametrize("name", ["head", "steps", "corridor", "moved"])
@pytest.mark.parametrize("side", [0, 1])
def test_seen_is_what_is_there_in_the_image_in_range_not_oblique_and_not_hidden(name, side):
    scene = made(name, 90)
    camera = scene.rig.left if side == 0 else scene.rig.right
    seen, poses = sightings(scene, side), camera_poses(scene, side)
    triangles = scene.surface.vertex_mm[scene.surface.face]
    targets, near_far = scene.targets, scene.sensing.depth_mm
    for k in (0, 40, 89):
        here = set(seen.target[seen.of_frame(k)].tolist())
        centre = poses[k].inverse().t_mm
        depth = poses[k].apply(targets.xyz_mm)[:, 2]
        uv = opencv_projection(camera, poses[k], targets.xyz_mm)
        for i, (xyz, normal) in enumerate(zip(targets.xyz_mm, targets.normal, strict=True)):
            to_camera = (centre - xyz) / np.linalg.norm(centre - xyz)
            incidence = np.degrees(np.arccos(to_camera @ normal))
            there = targets.valid_from[i] <= k < targets.valid_to[i]
            inside = [np.all(uv[i] > edge) and np.all(uv[i] < [1279 - edge, 1023 - edge]) for edge in (0, 40)]
            possible = there and incidence < 65 and near_far[0] < depth[i] < near_far[1]
            if i in here:
                assert possible
                assert inside[0]
                assert not is_hit(centre, xyz, triangles)
            elif possible and inside[1]:
                assert is_hit(centre, xyz, triangles)


@pytest.mark.parametrize(("name", "least", "most"), [("closure", 0.005, 0.1), ("steps", 0.05, 0.2), ("plane", 0, 0)])
def test_hollows_and_walls_hide_targets(name, least, most):
    scene = made(name, 200)
    convex = replace(scene, surface=replace(scene.surface, is_convex=True))
    share = 1 - len(sightings(scene, 0).frame) / len(sightings(convex, 0).frame)
    assert least <= share <= most


def test_dots_are_the_centres_of_ellipses():
    """The conic of a circle, projected by an undistorted camera: Hartley & Zisserman 2004, eq. 8.2."""
    scene = made("sphere", 1)
    camera = Camera(1400, 1400, 640, 512, 1280, 1024)
    pose = Pose.identity()
    from trifix.sources.sensing import _images_of_circles

    rng = np.random.default_rng(0)
    centre = rng.uniform([-100, -80, 350], [100, 80, 500], (20, 3))
    normal = rng.normal([0, 0, -2], 0.8, (20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    R, t = np.tile(pose.R, (20, 1, 1)), np.zeros((20, 3))
    uv, root, _ = _images_of_circles(camera, R, t, centre, normal, scene.diameter_mm)
    shift = 0.0
    for i in range(20):
        a = np.linalg.svd(normal[i : i + 1])[2][1:]  # two directions in the circle's plane
        H = camera.K @ np.stack([a[0], a[1], centre[i]], axis=1)
        inverse = np.linalg.inv(H)
        C = inverse.T @ np.diag([1, 1, -((0.5 * scene.diameter_mm) ** 2)]) @ inverse
        middle = np.linalg.solve(C[:2, :2], -C[:2, 2])
        scale = -(C[2, 2] + C[:2, 2] @ middle)
        axes = np.sqrt(scale / np.linalg.eigvalsh(C[:2, :2]))
        np.testing.assert_allclose(uv[i], middle, atol=1e-6)
        np.testing.assert_allclose(np.linalg.eigvalsh(root[i])[::-1], axes, rtol=1e-3)
        shift = max(shift, float(np.linalg.norm(middle - camera.project(centre[i : i + 1])[0])))
    assert shift > 0.03  # the image of the centre is elsewhere


@pytest.mark.parametrize("name", ["plane", "sphere", "grid", "demo"])
def test_both_cameras_look_at_the_same_place_from_the_same_distance(name):
    scene = made(name, 40)
    left, right = sightings(scene, 0), sightings(scene, 1)
    assert 0.8 < len(left.frame) / len(right.frame) < 1.25
    assert 0.9 < np.median(left.diameter_px) / np.median(right.diameter_px) < 1.1
    axis = scene.rig.T_right_left.inverse().R[:, 2]  # the right camera's, which leans to the left and meets the left's
    assert 0.1 < -axis[0] / axis[2] < 0.5


def test_noise_grows_with_obliquity():
    scene = made("head", 30)
    seen = sightings(scene, 0)
    centre = np.array([pose.t_mm for pose in scene.T_map_sensor])[seen.frame]
    to_camera = centre - scene.targets.xyz_mm[seen.target]
    cosine = np.einsum("si,si->s", to_camera, scene.targets.normal[seen.target]) / np.linalg.norm(to_camera, axis=1)
    np.testing.assert_allclose(seen.sigma_px * cosine, scene.sensing.sigma_px, rtol=1e-9)
    assert seen.sigma_px.max() > 1.5 * seen.sigma_px.min()


@pytest.mark.parametrize("name", ["head", "statue", "steps", "mirror", "corridor", "sphere"])
def test_targets_stand_on_the_surface_apart_from_one_another(name):
    scene = made(name, 1)
    triangles = scene.surface.vertex_mm[scene.surface.face]
    xyz = scene.targets.xyz_mm
    plane = np.abs(np.einsum("fki,fi->fk", xyz[None] - triangles[:, :1], scene.surface.face_normal))
    near = np.linalg.norm(triangles.mean(axis=1)[:, None] - xyz, axis=2)
    assert np.where(near < 60, plane, np.inf).min(axis=0).max() < (
        0.2 if name == "mirror" else 1e-6
    )  # triangles are not mirrored
    apart = np.linalg.norm(xyz[:, None] - xyz, axis=2) + 1e9 * np.eye(len(xyz))
    assert apart.min() > 1.5 * scene.diameter_mm
    np.testing.assert_allclose(np.linalg.norm(scene.targets.normal, axis=1), 1, atol=1e-9)
