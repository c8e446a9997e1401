"""A small rig and the poses in which it is shown a board, for the tests of calibration."""

import numpy as np
from jaxtyping import Float, Int

from trifix.calibration import BoardView, Sighting
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose

RIG = StereoRig(
    left=Camera(420.0, 421.5, 158.0, 121.5, 320, 240, "radtan", (-0.11, 0.06, 0.0008, -0.0006)),
    right=Camera(417.0, 418.0, 162.5, 118.0, 320, 240, "radtan", (-0.10, 0.05, -0.0005, 0.0009)),
    T_right_left=Pose.exp(np.array([-60.0, 1.0, 4.0, 0.01, 0.15, -0.02])),
)


def poses(
    count: int, rng: np.random.Generator, middle_mm: tuple[float, float], tilt_rad: float = 0.5, far_mm: float = 300.0
) -> list[Pose]:
    """T_left_board of boards about in the middle of both images, each tilted about another axis."""
    found = []
    for k in range(count):
        direction = 2 * np.pi * k / count
        turn = [tilt_rad * np.cos(direction), tilt_rad * np.sin(direction), rng.uniform(-0.2, 0.2)]
        T = Pose.exp(np.array([0.0, 0.0, 0.0, *turn]))
        centre = np.array([rng.uniform(10, 50), rng.uniform(-25, 25), far_mm * rng.uniform(0.85, 1.15)])
        found.append(Pose(T.R, centre - T.R @ np.array([*middle_mm, 0.0])))
    return found


def bent(cell: Int[np.ndarray, "n 2"], columns: int, rows: int) -> Float[np.ndarray, "n"]:
    """Height of the points of a dome: 1 in the middle, −1 at the corners."""
    from_middle = 2 * cell / np.array([columns - 1, rows - 1]) - 1
    return np.asarray(1 - np.sum(from_middle**2, axis=1))


def views(
    T_left_board: list[Pose],
    columns: int,
    rows: int,
    pitch_mm: float,
    sigma_px: float,
    rng: np.random.Generator,
    board_mm: float = 0.0,
    rig: StereoRig = RIG,
    bow_mm: float = 0.0,
) -> list[BoardView]:
    """What a rig sees of the points of a board, where it sees them; they may be out of place, the board bent."""
    cell = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    xyz = np.c_[cell * pitch_mm, np.zeros(len(cell))] + board_mm * rng.standard_normal((len(cell), 3))
    xyz[:, 2] += bow_mm * bent(cell, columns, rows)
    found = []
    for k, T in enumerate(T_left_board):
        both = []
        for camera, T_camera_board in ((rig.left, T), (rig.right, rig.T_right_left @ T)):
            seen = camera.sees(T_camera_board.apply(xyz))
            uv = camera.project(T_camera_board.apply(xyz[seen]))
            both.append(Sighting(cell[seen], uv + sigma_px * rng.standard_normal(uv.shape), np.zeros(len(uv))))
        found.append(BoardView(str(k), *both))
    return found
