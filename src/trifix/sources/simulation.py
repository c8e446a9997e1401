"""Recordings that never happened: scenes with targets, seen by a rig on the path of a hand, and the truth about them.

``simulate_frames`` gives frames in memory, ``simulate`` writes them as a recording with its truth beside it. The same
seed gives the same bytes. Knows no stage: truth is not computed by the code that it is there to test.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import assert_never, overload

import numpy as np
from jaxtyping import Int

from trifix.errors import SimulationError
from trifix.files.calibrations import write_rig
from trifix.files.recordings import LEVELS, Level, write_dots, write_frames, write_points
from trifix.files.tables import write_table
from trifix.records import Frame, SensorPoints, StereoDots, StereoImages
from trifix.sources.rendering import Renderer
from trifix.sources.scenes import SCENES, Scene, recipe_of
from trifix.sources.sensing import Sightings, dots_of_frame, points_of_frame, sightings, with_centres
from trifix.sources.truth import SimulatedTruth, matrix_of, truth_of, write_truth

__all__ = ["SCENES", "Simulation", "simulate", "simulate_frames"]

Progress = Callable[[int, int], None]
"""Called with the number of frames done and the number of all."""

_FIRST_NS, _STEP_NS = 1_000_000_000, 50_000_000
_LAYOUT, _HAND, _SENSOR = range(3)  # independent streams of chance


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """A recording in memory, and the truth about it."""

    scene: Scene
    """The object, the sensor and its path."""
    level: Level
    """What the frames hold."""
    frames: Sequence[Frame]
    """The frames; those of level images are rendered anew whenever they are asked for."""
    seen: tuple[Sightings, Sightings]
    """Where the left and the right camera's dots are, free of noise."""
    truth: SimulatedTruth
    """What happened."""


def simulate_frames(
    scene: str, seed: int, level: Level, frames: int | None = None, progress: Progress | None = None
) -> Simulation:
    """A simulated recording in memory, of so many frames or the scene's own number.

    Dots and points carry their true covariance, which a recording on disk states for points only.

    Raises:
        SimulationError: no such scene or level, an impossible number, or no ray caster for a scene that needs one.
    """
    recipe = recipe_of(scene)
    n = recipe.frames if frames is None else frames
    if n < 1:
        raise SimulationError(f"A recording of {n} frames cannot be made: at least 1 is needed.")
    if seed < 0:
        raise SimulationError(f"The seed is {seed}: it must not be negative.")
    if level not in LEVELS:
        raise SimulationError(f"There is no level {level!r}: it is one of {', '.join(LEVELS)}.")
    made = recipe.build(n, np.random.default_rng([seed, _LAYOUT]), np.random.default_rng([seed, _HAND]))
    timestamp_ns = _FIRST_NS + _STEP_NS * np.arange(n)
    seen = sightings(made, 0), sightings(made, 1)
    if level == "images":
        in_left, in_right = (matrix_of(one, n, len(made.targets)) for one in seen)
        none = np.zeros(0, dtype=np.int64)
        truth = truth_of(made, timestamp_ns, seen, in_left & in_right, none, none)
        return Simulation(made, level, _Rendered(made, timestamp_ns, seed), seen, truth)
    return _sensed(made, level, timestamp_ns, seen, seed, progress)


def _sensed(
    scene: Scene,
    level: Level,
    timestamp_ns: Int[np.ndarray, "n"],
    seen: tuple[Sightings, Sightings],
    seed: int,
    progress: Progress | None,
) -> Simulation:
    """Frames of dots or points, with the label of every row."""
    n, k = len(timestamp_ns), len(scene.targets)
    found = np.zeros((2, n, k), dtype=bool)
    both = np.zeros((n, k), dtype=bool)
    frames: list[Frame] = []
    labels: list[np.ndarray] = []
    rows = 0
    for index, stamp in enumerate(timestamp_ns.tolist()):
        rng = np.random.default_rng([seed, _SENSOR, index])
        dots, label = dots_of_frame(scene, seen, index, rng, rows if level == "dots" else 0)
        left, right = (label[one.row - (rows if level == "dots" else 0)] for one in (dots.left, dots.right))
        found[0, index, left[left >= 0]] = True
        found[1, index, right[right >= 0]] = True
        content: StereoDots | SensorPoints = dots
        if level == "points":
            centred = with_centres(dots, (left, right), seen, index)
            content, label = points_of_frame(scene.rig, scene.sensing, centred, left, right, rng, rows)
            both[index, label[label >= 0]] = True
        rows += len(label)
        labels.append(label)
        frames.append(Frame(index, stamp, scene.rig, content))
        if progress is not None:
            progress(index + 1, n)
    if level == "dots":
        both = found[0] & found[1]
    kept = (
        seen[0].where(found[0, seen[0].frame, seen[0].target]),
        seen[1].where(found[1, seen[1].frame, seen[1].target]),
    )
    frame_of_row = np.repeat(np.arange(n), [len(label) for label in labels])
    truth = truth_of(scene, timestamp_ns, kept, both, np.concatenate(labels), frame_of_row)
    return Simulation(scene, level, frames, kept, truth)


class _Rendered(Sequence[Frame]):
    """Frames of images, rendered when asked for."""

    def __init__(self, scene: Scene, timestamp_ns: Int[np.ndarray, "n"], seed: int) -> None:
        self._timestamp_ns = timestamp_ns.tolist()
        self._seed = seed
        self._rig = scene.rig
        self._renderer = Renderer(scene)

    def __len__(self) -> int:
        return len(self._timestamp_ns)

    @overload
    def __getitem__(self, k: int) -> Frame: ...
    @overload
    def __getitem__(self, k: slice) -> list[Frame]: ...
    def __getitem__(self, k: int | slice) -> Frame | list[Frame]:
        if isinstance(k, slice):
            return [self[i] for i in range(*k.indices(len(self)))]
        k = range(len(self))[k]
        left, right = self._renderer.render(k, np.random.default_rng([self._seed, _SENSOR, k]))
        return Frame(k, self._timestamp_ns[k], self._rig, StereoImages(left, right))


# --- files ---------------------------------------------------------------------------------------------------------


def simulate(
    scene: str,
    out: Path,
    level: Level,
    seed: int,
    frames: int | None = None,
    progress: Progress | None = None,
) -> None:
    """Writes a simulated recording to ``out/recording`` and its truth to ``out/truth``.

    Raises:
        SimulationError: as ``simulate_frames``; or ``out`` holds a recording or a truth already.
    """
    recording, truth = out / "recording", out / "truth"
    for folder in (recording, truth):
        if folder.exists():
            raise SimulationError(f"{folder} exists already: choose another folder, or remove it first.")
    simulation = simulate_frames(scene, seed, level, frames, None if level == "images" else progress)
    with _whole_or_not_at_all(recording) as folder:
        write_rig(simulation.scene.rig, folder / "calibration.yaml")
        write_frames(folder / "frames.csv", simulation.truth.frames.index, simulation.truth.frames.timestamp_ns)
        match level:
            case "images":
                _write_images(simulation.frames, folder, progress)
            case "dots":
                _write_dots(simulation, folder / "dots.csv")
            case "points":
                _write_points(simulation, folder / "points.csv")
            case _:
                assert_never(level)
    with _whole_or_not_at_all(truth) as folder:
        write_truth(simulation.truth, folder, None if level == "images" else level)


@contextmanager
def _whole_or_not_at_all(folder: Path) -> Iterator[Path]:
    """A folder to write into, which gets its name when all is written; what an interruption left is removed."""
    part = folder.with_name(folder.name + ".part")
    if part.exists():
        shutil.rmtree(part)
    part.mkdir(parents=True)
    yield part
    part.rename(folder)


def _write_dots(simulation: Simulation, path: Path) -> None:
    """Centres and ellipses; the noise is left for the program to find."""
    frame = simulation.truth.label_frame
    camera, uv, ellipse = np.zeros(len(frame), dtype=np.int64), np.zeros((len(frame), 2)), np.zeros((len(frame), 3))
    for one in simulation.frames:
        if isinstance(one.content, StereoDots):
            for side, dots in enumerate((one.content.left, one.content.right)):
                camera[dots.row], uv[dots.row], ellipse[dots.row] = side, dots.uv_px, dots.ellipse
    write_dots(path, frame, simulation.truth.frames.timestamp_ns[frame], camera, uv, ellipse=ellipse)


def _write_points(simulation: Simulation, path: Path) -> None:
    points = [one.content for one in simulation.frames if isinstance(one.content, SensorPoints)]
    frame = simulation.truth.label_frame
    write_points(
        path,
        frame,
        simulation.truth.frames.timestamp_ns[frame],
        np.concatenate([one.xyz_mm for one in points]),
        cov_mm2=np.concatenate([one.cov_mm2 for one in points]),
    )


def _write_images(frames: Sequence[Frame], recording: Path, progress: Progress | None) -> None:
    """Both cameras' images in EuRoC's layout."""
    import cv2

    cameras = [recording / "cam0", recording / "cam1"]
    for camera in cameras:
        (camera / "data").mkdir(parents=True)
    names = []
    for done, frame in enumerate(frames, start=1):
        assert isinstance(frame.content, StereoImages)
        names.append((str(frame.timestamp_ns), f"{frame.timestamp_ns}.png"))
        for camera, image in zip(cameras, (frame.content.left, frame.content.right), strict=True):
            _, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            (camera / "data" / names[-1][1]).write_bytes(png.tobytes())
        if progress is not None:
            progress(done, len(frames))
    for camera in cameras:
        stamps, files = zip(*names, strict=True)
        write_table(camera / "data.csv", {"#timestamp [ns]": stamps, "filename": files})
