"""Speed and accuracy of the bundle adjustment.

Run: OPENBLAS_NUM_THREADS=1 python benchmarks/adjustment.py [--small]

Targets stand on a wavy sheet; a sensor passes over them and sees the nearest ones with both cameras, one dot in ten
missing. The adjustment begins from poses and targets that are off by millimetres. Seconds are the processor's, so that
others at work on the machine do not count. The map's error stands beside its bound, the root mean square that its
covariance foresees; in the gauge of the first frame a single run may be off by a third, as that frame's error is all
targets'. The squared normalised errors (NEES) should be 1, for the poses again with the scatter of that one frame.
"""

from time import process_time

import cyclopts
import numpy as np
from rich.console import Console
from rich.table import Table

from trifix.adjustment import DotObservations, adjust
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose, exp_rotation
from trifix.kernels import adjustment as kernels

SIZES = ((500, 28, 28), (1500, 28, 28), (5571, 28, 28), (1000, 900, 25), (2000, 900, 25), (4000, 900, 25))
"""Frames, targets, targets seen in a frame."""

SIGMA_PX = 0.1
CAMERA = Camera(1400.0, 1400.0, 640.0, 512.0, 1280, 1024, "radtan", (-0.08, 0.04, 0.0004, -0.0003))
RIG = StereoRig(CAMERA, CAMERA, Pose.exp(np.array([-142.0, 1.0, 24.0, 0.003, 0.33, -0.002])))
SPACING_MM = 30.0


def main(small: bool = False) -> None:
    """Prints the table.

    Parameters
    ----------
    small: the two smallest sizes only.
    """
    kernels.warm_up()
    names = (
        "frames",
        "targets",
        "seen",
        "dots",
        "CPU s",
        "steps",
        "map rmse/bound",
        "NEES pose",
        "NEES map",
        "chi2/dof",
    )
    table = Table(*names)
    for frames, targets, seen in SIZES[:2] if small else SIZES:
        table.add_row(*measured(frames, targets, seen))
    Console().print(table)


def measured(frames: int, targets: int, seen: int) -> tuple[str, ...]:
    rng = np.random.default_rng(1)
    xyz, T, observations = scene(rng, frames, targets, seen)
    T_start = [T[0]] + [one @ Pose.exp(rng.normal(size=6) * ([1.0] * 3 + [0.003] * 3)) for one in T[1:]]
    start = process_time()
    out = adjust(observations, T_start, xyz + rng.normal(size=xyz.shape), rig=RIG)
    seconds = process_time() - start
    ok = out.is_target_adjusted
    rows = np.repeat(ok, 3)
    cov = out.map_cov_mm2[np.ix_(rows, rows)]
    off = (out.xyz_mm - xyz)[ok].ravel()
    bound = np.sqrt(np.trace(cov) / len(off))
    nees_map = off @ np.linalg.solve(cov, off) / len(off)
    nees = []
    for k in range(1, frames):
        if out.is_frame_adjusted[k]:
            delta = (out.T_world_sensor[k].inverse() @ T[k]).log()
            nees.append(delta @ np.linalg.solve(out.pose_cov[k], delta) / 6)
    numbers = (np.sqrt(np.mean(off**2)) / bound, np.mean(nees), nees_map, out.chi2 / out.dof)
    return (
        *(f"{n}" for n in (frames, targets, seen, len(observations))),
        f"{seconds:.1f}",
        f"{out.steps}",
        *(f"{x:.3f}" for x in numbers),
    )


def scene(
    rng: np.random.Generator, frames: int, targets: int, seen: int
) -> tuple[np.ndarray, list[Pose], DotObservations]:
    """Places, poses and the dots of both images, one in ten missing."""
    side = int(np.ceil(np.sqrt(targets)))
    grid = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=2).reshape(-1, 2)[:targets] + 0.5) * SPACING_MM
    xy = grid + rng.uniform(-0.3, 0.3, grid.shape) * SPACING_MM
    xyz = np.c_[xy, 20.0 * np.sin(xy / 60.0).sum(axis=1)]
    turns = np.linspace(0, 2 * np.pi * np.sqrt(targets) / 4, frames)
    middle, reach = side * SPACING_MM / 2, 0.6 * side * SPACING_MM
    poses, parts = [], []
    for k, turn in enumerate(turns):  # a spiral over the sheet
        out = reach * np.sqrt(abs(2 * k / frames - 1))
        at = np.array([middle + out * np.cos(turn), middle + out * np.sin(turn), 0.0])
        R = exp_rotation(np.r_[rng.normal(0, 0.2, 2), 0.0]) @ exp_rotation(np.array([0.0, 0.0, rng.uniform(-3, 3)]))
        T = Pose(R, at - R @ np.array([70.0, 0.0, 470.0]))
        near = np.argsort(((xyz - at) ** 2).sum(axis=1))[:seen]
        in_left = T.inverse().apply(xyz[near])
        for camera, (lens, xyz_camera) in enumerate(
            ((RIG.left, in_left), (RIG.right, RIG.T_right_left.apply(in_left)))
        ):
            rows = np.flatnonzero(lens.sees(xyz_camera) & (rng.random(len(near)) < 0.9))
            uv = lens.project(xyz_camera[rows]) + SIGMA_PX * rng.normal(size=(len(rows), 2))
            parts.append((np.full(len(rows), k), near[rows], np.full(len(rows), camera), uv))
        poses.append(T)
    frame, target, camera, uv = (np.concatenate(column) for column in zip(*parts, strict=True))
    # the world is the first frame's own coordinates
    to_first = poses[0].inverse()
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(uv), 1, 1))
    return to_first.apply(xyz), [to_first @ T for T in poses], DotObservations(frame, target, camera, uv, cov)


if __name__ == "__main__":
    cyclopts.run(main)
