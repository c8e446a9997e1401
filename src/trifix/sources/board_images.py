"""Images of flat calibration boards, made so that the truth of what they show is known.

Rays are undistorted and cut with the board; a pixel through which an edge passes is the mean over many of them. Then
come blur and noise. Knows neither how boards are found nor how a rig is calibrated.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.records import StereoImages

_SAMPLES = 10  # across a pixel through which an edge passes; features must be wider than a pixel
_BLUR_PX = 0.7
_PAPER, _INK, _ROOM = 205.0, 28.0, 70.0  # grey values

Pattern = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n"]]
"""Grey values at places on a board (mm), NaN beyond its edge; (0, 0) is the first of the points to be found."""


def chessboard(columns: int, rows: int, square_mm: float) -> Pattern:
    """A chessboard of so many inner corners; the square whose first corner is (0, 0) is dark."""

    def grey(xy_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        i, j = np.floor(xy_mm / square_mm).astype(int).T
        is_board = (i >= -1) & (i < columns) & (j >= -1) & (j < rows)
        return _with_margin(np.where((i + j) % 2 == 0, _INK, _PAPER), is_board, xy_mm, columns, rows, square_mm)

    return grey


def charuco(columns: int, rows: int, square_mm: float, marker_mm: float, dictionary: str) -> Pattern:
    """OpenCV's ChArUco board of so many inner corners."""
    pixels = 240  # a square: many bits and margins end at whole pixels
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((columns + 1, rows + 1), square_mm, marker_mm, known)
    image = board.generateImage(((columns + 1) * pixels, (rows + 1) * pixels))

    def grey(xy_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        u, v = np.floor((xy_mm / square_mm + 1) * pixels).astype(int).T
        is_board = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
        is_paper = image[v.clip(0, image.shape[0] - 1), u.clip(0, image.shape[1] - 1)] > 127
        return _with_margin(np.where(is_paper, _PAPER, _INK), is_board, xy_mm, columns, rows, square_mm)

    return grey


def dot_grid(
    columns: int, rows: int, pitch_mm: float, diameter_mm: float, rings: tuple[tuple[int, int], ...] = ()
) -> Pattern:
    """Dark dots of which those in ``rings`` (column, row) have a bright core."""

    def grey(xy_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        cell = np.rint(xy_mm / pitch_mm)
        distance = np.linalg.norm(xy_mm - cell * pitch_mm, axis=1)
        is_ring = np.zeros(len(cell), dtype=bool)
        for ring in rings:
            is_ring |= (cell == ring).all(axis=1)
        is_dot = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1) & (distance < diameter_mm / 2)
        is_dark = is_dot & ~(is_ring & (distance < diameter_mm / 6))
        nowhere = np.zeros(len(cell), dtype=bool)
        plain = _with_margin(np.full(len(cell), _PAPER), nowhere, xy_mm, columns, rows, pitch_mm)
        return np.where(is_dark, _INK, plain)

    return grey


def _with_margin(
    grey: Float[np.ndarray, "n"],
    is_board: Bool[np.ndarray, "n"],
    xy_mm: Float[np.ndarray, "n 2"],
    columns: int,
    rows: int,
    pitch_mm: float,
) -> Float[np.ndarray, "n"]:
    """The pattern on paper that stands out by half a square, nothing around."""
    cell = xy_mm / pitch_mm
    is_paper = ((cell > -1.5) & (cell < [columns + 0.5, rows + 0.5])).all(axis=1)
    return np.where(is_board, grey, np.where(is_paper, _PAPER, np.nan))


class BoardRenderer:
    """Draws a board before a rig; the rays are undistorted once."""

    def __init__(self, rig: StereoRig, pattern: Pattern, noise_grey: float = 2.0) -> None:
        self._rig = rig
        self._pattern = pattern
        self._noise_grey = noise_grey
        self._slopes = [_corner_slopes(camera) for camera in (rig.left, rig.right)]

    def render(self, T_left_board: Pose, rng: np.random.Generator) -> StereoImages:
        """Both images of the board in one pose."""
        return StereoImages(self._draw(0, T_left_board, rng), self._draw(1, self._rig.T_right_left @ T_left_board, rng))

    def _draw(self, side: int, T_camera_board: Pose, rng: np.random.Generator) -> UInt8[np.ndarray, "h w"]:
        slopes = self._slopes[side]
        corner = self._grey(slopes.reshape(-1, 2), T_camera_board).reshape(slopes.shape[:2])
        around = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]])
        grey = around.mean(axis=0)
        v, u = np.nonzero(np.ptp(around, axis=0))  # an edge passes
        at = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        t, s = (x.reshape(-1, 1, 1) for x in np.meshgrid(at, at, indexing="ij"))
        above = slopes[v, u] * (1 - s) + slopes[v, u + 1] * s
        below = slopes[v + 1, u] * (1 - s) + slopes[v + 1, u + 1] * s
        samples = above * (1 - t) + below * t
        grey[v, u] = self._grey(samples.reshape(-1, 2), T_camera_board).reshape(samples.shape[:2]).mean(axis=0)
        image = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
        image += self._noise_grey * rng.standard_normal(image.shape)
        return np.asarray(np.rint(image.clip(0, 255)), dtype=np.uint8)

    def _grey(self, slopes: Float[np.ndarray, "n 2"], T_camera_board: Pose) -> Float[np.ndarray, "n"]:
        """Grey values along rays, before blur and noise."""
        ray = np.c_[slopes, np.ones(len(slopes))]
        normal = T_camera_board.R[:, 2]
        depth_mm = (normal @ T_camera_board.t_mm) / (ray @ normal)
        grey = self._pattern((ray * depth_mm[:, None] - T_camera_board.t_mm) @ T_camera_board.R[:, :2])
        return np.where((depth_mm > 0) & ~np.isnan(grey), grey, _ROOM)


def _corner_slopes(camera: Camera) -> Float[np.ndarray, "h1 w1 2"]:
    """Undistorted slopes of the corners of all pixels."""
    corners = np.stack(np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1)), axis=-1) - 0.5
    return camera.unproject(corners.reshape(-1, 2)).reshape(corners.shape)
