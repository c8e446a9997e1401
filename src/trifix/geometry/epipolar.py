"""Epipolar geometry of a calibrated rig: which dots of the two images lie on one another's lines.

Everything happens in undistorted slopes (x/z, y/z); the essential matrix E satisfies x_rightᵀ E x_left = 0
(Longuet-Higgins 1981; Hartley & Zisserman 2004, eq. 9.12). The paper's part P4.
"""

import numpy as np
from jaxtyping import Float, Int

from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import skew

_ROWS = 1024  # left dots at a time


def essential_matrix(rig: StereoRig) -> Float[np.ndarray, "3 3"]:
    """E = [t]× R of ``T_right_left``, with the baseline scaled to one."""
    t = rig.T_right_left.t_mm / rig.baseline_mm
    return np.asarray(skew(t) @ rig.T_right_left.R)


def epipolar_lines(E: Float[np.ndarray, "3 3"], xy_left: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Lines (a, b, c) with a x + b y + c = 0 in the right image of left slopes, a² + b² = 1."""
    lines = np.c_[xy_left, np.ones(len(xy_left))] @ E.T
    return np.asarray(lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True))


def pairs_near_epipolar_lines(
    E: Float[np.ndarray, "3 3"],
    xy_left: Float[np.ndarray, "n 2"],
    xy_right: Float[np.ndarray, "m 2"],
    gate: float,
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """All pairs (left row, right row) whose right slope lies within ``gate`` of the left one's epipolar line."""
    lines = epipolar_lines(E, xy_left)
    right_h = np.c_[xy_right, np.ones(len(xy_right))].T
    pairs = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
    for first in range(0, len(lines), _ROWS):  # a block at a time: all distances at once may not fit into memory
        left, right = np.nonzero(np.abs(lines[first : first + _ROWS] @ right_h) < gate)
        pairs.append((left + first, right))
    return np.concatenate([left for left, _ in pairs]), np.concatenate([right for _, right in pairs])
