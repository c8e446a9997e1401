"""A finished run made by hand: a recording of images and the results that were written from its Steps."""

from pathlib import Path

import cv2
from made_steps import rig, steps

from trifix.files.calibrations import write_rig
from trifix.outputs.results import ResultsWriter
from trifix.records import Step, StereoImages

FRAMES = 45
"""Of them 13 and 42 are refused as ambiguous, 30 for too few points, 40 for an image that cannot be read."""


def write_run(folder: Path, is_finished: bool = True) -> list[Step]:
    """Writes folder/plate, the recording, and folder/results."""
    made = list(steps(FRAMES, "images"))
    for side in ("left", "right"):
        (folder / "plate" / side).mkdir(parents=True)
    write_rig(rig(), folder / "plate" / "calibration.yaml")
    rows = ["frame,timestamp_ns"]
    for step in made:
        index, stamp, content = step.frame.index, step.frame.timestamp_ns, step.frame.content
        rows.append(f"{index},{stamp}")
        for side in ("left", "right"):
            file = folder / "plate" / side / f"{index:03d}.png"
            if isinstance(content, StereoImages):
                cv2.imwrite(str(file), getattr(content, side))
            else:
                file.write_bytes(b"no image")
    (folder / "plate" / "frames.csv").write_text("\n".join(rows) + "\n")
    with ResultsWriter(folder / "results", "plate", "images", "", is_online=True) as results:
        for step in made:
            results.write(step)
        if is_finished:
            results.finish()
    return made
