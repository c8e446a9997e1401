"""Folders of small recordings for the tests of their readers."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from trifix.files.calibrations import write_rig
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose

SIZE = (32, 24)
"""Width and height of the images."""

STAMPS = [1_000_000_000, 1_040_000_000, 1_080_000_000]
"""Time stamps (ns)."""


def made_rig(baseline_mm: float = 100.0) -> StereoRig:
    camera = Camera(40.0, 40.0, 15.5, 11.5, *SIZE)
    return StereoRig(camera, camera, Pose(np.eye(3), np.array([-baseline_mm, 0.0, 0.0])))


def made_image(k: int, side: int) -> UInt8[np.ndarray, "h w"]:
    """Different for each frame and side."""
    return np.random.default_rng(2 * k + side).integers(0, 255, SIZE[::-1], dtype=np.uint8)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_euroc(folder: Path) -> None:
    """Three pairs in EuRoC layout, with a calibration; the right camera lists them in another order."""
    for side in (0, 1):
        lines = []
        for k, stamp in enumerate(STAMPS):
            write_image(folder / f"cam{side}" / "data" / f"{stamp}.png", made_image(k, side))
            lines.append(f"{stamp},{stamp}.png\n")
        (folder / f"cam{side}" / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(lines[:: 1 - 2 * side]))
    write_rig(made_rig(), folder / "calibration.yaml")


def write_tables(folder: Path, name: str, rows: str) -> None:
    """A table of dots or points beside frames.csv with frames 0, 1 and 3, and a calibration."""
    frames = zip((0, 1, 3), STAMPS, strict=True)
    (folder / "frames.csv").write_text("frame,timestamp_ns\n" + "".join(f"{i},{s}\n" for i, s in frames))
    (folder / name).write_text(rows)
    write_rig(made_rig(), folder / "calibration.yaml")
