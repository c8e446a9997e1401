"""Images of a scene: bright round targets on dark stickers on a matt, textured object in a dark room.

The targets are circles, projected exactly through perspective and distortion and drawn by area; the rest is there to
look like an image. Knows no noise-free truth and no stage.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from trifix.geometry.camera import Camera
from trifix.kernels.rendering import draw_discs, draw_faces, shade
from trifix.sources.scenes import Scene
from trifix.sources.sensing import camera_poses, circle_rim

_GRID_PX = 3  # undistorted slopes are computed on a grid of this pitch: bilinear between is good to 0.0002 px
_LINES = 16  # into which a pixel is cut
_STICKER = 1.5  # radius of the dark sticker, in radii of the target
_BULGE_MM = 4.0  # by which a curved surface may stand before the plane of its target
_WIDEST_SLOPE = 1.5  # triangles with corners beyond are far outside every image
_BLUR_PX = 0.7
_NOISE_GREY = 2.0
_WHITE, _BLACK = 205.0, 26.0


class Renderer:
    """Draws the image pairs of one scene; what does not change from frame to frame is prepared once."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._vertex_normal = scene.surface.vertex_normal
        self._cameras = (scene.rig.left, scene.rig.right)
        self._poses = camera_poses(scene, 0), camera_poses(scene, 1)
        self._slopes = [_slope_grid(camera) for camera in self._cameras]
        self._working_mm = _working_distance(scene)
        self._vignettes = [_vignette(camera) for camera in self._cameras]

    def render(self, k: int, rng: np.random.Generator) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
        """The left and the right image of frame k."""
        left, right = (self._draw(side, k, rng) for side in (0, 1))
        return left, right

    def _draw(self, side: int, k: int, rng: np.random.Generator) -> UInt8[np.ndarray, "h w"]:
        scene, camera, T_camera_map = self._scene, self._cameras[side], self._poses[side][k]
        size = (camera.height_px, camera.width_px)
        vertex = T_camera_map.apply(scene.surface.vertex_mm)
        z = np.where(np.abs(vertex[:, :2]).max(axis=1) < _WIDEST_SLOPE * vertex[:, 2], vertex[:, 2], 0.0)
        uv = camera.project(np.where(z[:, None] > 0, vertex, [0.0, 0.0, 1.0]))
        inverse_depth, owner = np.zeros(size, dtype=np.float32), np.full(size, -1, dtype=np.int32)
        grey = np.zeros(size, dtype=np.float32)
        draw_faces(uv, z, scene.surface.face, inverse_depth, owner)
        # the lamp sits above the middle of the sensor
        lamp = scene.T_map_sensor[k].apply(np.array([0.5 * scene.rig.right_centre_mm + [0, -40, 0]]))[0]
        shade(
            *(uv, z, scene.surface.face, owner, scene.surface.vertex_mm, self._vertex_normal),
            *(lamp, self._working_mm, T_camera_map.R, camera.fu_px, grey),
        )
        self._draw_targets(side, k, inverse_depth, grey)
        self._draw_glints(side, rng, grey)
        grey = cv2.GaussianBlur(grey * self._vignettes[side], (0, 0), _BLUR_PX)
        grey += _NOISE_GREY * rng.standard_normal(size, dtype=np.float32)
        return np.asarray(np.rint(grey.clip(0, 255)), dtype=np.uint8)

    def _draw_targets(
        self, side: int, k: int, inverse_depth: Float32[np.ndarray, "h w"], grey: Float32[np.ndarray, "h w"]
    ) -> None:
        targets, T_camera_map = self._scene.targets, self._poses[side][k]
        centre = T_camera_map.apply(targets.xyz_mm)
        normal = targets.normal @ T_camera_map.R.T
        distance = np.linalg.norm(centre, axis=1)
        cosine = -np.einsum("ki,ki->k", centre, normal) / distance
        there = (targets.valid_from <= k) & (k < targets.valid_to)
        drawn = np.nonzero(there & (cosine > 0.1) & (centre[:, 2] > 0))[0]
        # retro-reflective: as bright from everywhere, but for the steepest views
        bright = np.interp(np.degrees(np.arccos(cosine[drawn].clip(0, 1))), [0, 58, 75, 84], [1.0, 0.9, 0.4, 0.15])
        near = (self._working_mm / distance[drawn]) ** 0.3
        value = np.stack([_WHITE * bright * near, np.full(len(drawn), _BLACK)], axis=1)
        self._draw_discs(side, centre[drawn], normal[drawn], 0.5 * self._scene.diameter_mm, value, inverse_depth, grey)

    def _draw_glints(self, side: int, rng: np.random.Generator, grey: Float32[np.ndarray, "h w"]) -> None:
        """Round reflections that are no target, anywhere in the image."""
        camera = self._cameras[side]
        n = rng.poisson(self._scene.sensing.ghosts_per_image)
        uv = rng.uniform(0, 1, (n, 2)) * [camera.width_px - 1, camera.height_px - 1]
        ray = np.c_[camera.unproject(uv), np.ones(n)]
        centre = ray * self._working_mm
        normal = -ray / np.linalg.norm(ray, axis=1, keepdims=True)
        value = np.tile(rng.uniform(90, 190, (n, 1)), 2)
        nothing = np.zeros_like(grey)
        self._draw_discs(side, centre, normal, 0.3 * self._scene.diameter_mm, value, nothing, grey)

    def _draw_discs(
        self,
        side: int,
        centre: Float[np.ndarray, "d 3"],
        normal: Float[np.ndarray, "d 3"],
        radius_mm: float,
        value: Float[np.ndarray, "d 2"],
        inverse_depth: Float32[np.ndarray, "h w"],
        grey: Float32[np.ndarray, "h w"],
    ) -> None:
        camera = self._cameras[side]
        rim = circle_rim(centre, normal, 2 * _STICKER * radius_mm)
        inside = (np.abs(rim[:, :, :2]).max(axis=2) < _WIDEST_SLOPE * rim[:, :, 2]).all(axis=1)
        centre, normal, value, rim = centre[inside], normal[inside], value[inside], rim[inside]
        uv = camera.project(rim.reshape(-1, 3)).reshape(*rim.shape[:2], 2)
        last = np.array([camera.width_px - 1, camera.height_px - 1])
        low, high = np.floor(uv.min(axis=1) - 2), np.ceil(uv.max(axis=1) + 2)
        box = np.concatenate([low.clip(0, last + 1), high.clip(-1, last)], axis=1).astype(np.int64)
        radius = np.tile([radius_mm, _STICKER * radius_mm], (len(box), 1))
        draw_discs(
            *(centre, normal, radius, value, box, self._slopes[side], _GRID_PX, inverse_depth, _BULGE_MM, _LINES),
            grey,
        )


def _working_distance(scene: Scene) -> float:
    """The usual distance of the nearest target (mm), for which the lamp is set."""
    places = np.array([pose.t_mm for pose in scene.T_map_sensor[::5]])
    return float(np.median([np.linalg.norm(scene.targets.xyz_mm - place, axis=1).min() for place in places]))


def _slope_grid(camera: Camera) -> Float[np.ndarray, "gh gw 2"]:
    """Undistorted slopes at every ``_GRID_PX``-th pixel, from one such step outside the image to two."""
    u = np.arange(-_GRID_PX, camera.width_px + 2 * _GRID_PX, _GRID_PX)
    v = np.arange(-_GRID_PX, camera.height_px + 2 * _GRID_PX, _GRID_PX)
    nodes = np.stack(np.meshgrid(u, v), axis=-1).astype(float)
    return camera.unproject(nodes.reshape(-1, 2)).reshape(nodes.shape)


def _vignette(camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Uneven light: brightest a little beside the middle, two thirds in the corners."""
    x = (np.arange(camera.width_px) / camera.width_px - 0.46) ** 2
    y = (np.arange(camera.height_px) / camera.height_px - 0.53) ** 2
    return (1 - 0.65 * (x[None, :] + y[:, None])).astype(np.float32)
