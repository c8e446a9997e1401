"""One technique on one scene: a recording in, a ``Part`` out, all that tables and figures need of it.

Knows nothing of other parts, of processes, nor of how a part is shown.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float, Int

from trifix.config import Config, to_toml
from trifix.evaluation import Spread, compare_poses, evaluate
from trifix.files.maps import read_map
from trifix.files.recordings import read_recording
from trifix.files.trajectories import read_poses
from trifix.files.truth import read_truth
from trifix.outputs.results import ResultsWriter
from trifix.positioner import Positioner
from trifix.records import Fix, Step
from trifix.stages.identify import IdentifyOptions, identifier

Show = Callable[[int, int], None]
"""Called with the number of frames done and the number of all."""
Xyz = list[tuple[float, float, float]]
"""Positions (mm)."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Absolute errors of poses or targets; None where there are none."""

    median: float | None
    """Half are smaller."""
    rms: float | None
    """Root mean square."""
    max: float | None
    """The largest."""

    @staticmethod
    def of(spread: Spread) -> "Errors":
        """The same, ready for JSON, which has no NaN."""
        return Errors(*(None if np.isnan(value) else value for value in (spread.median, spread.rmse, spread.max)))


@dataclass(frozen=True, slots=True)
class Cost:
    """What frames cost in which the technique was asked; None where there is none."""

    median: float | None
    """Half cost less."""
    p99: float | None
    """99 of 100 cost less."""

    @staticmethod
    def of(values: list[float]) -> "Cost":
        """Of all these frames."""
        if not values:
            return Cost(None, None)
        return Cost(float(np.median(values)), float(np.percentile(values, 99)))


@dataclass(frozen=True, slots=True)
class Part:
    """What one technique made of one scene."""

    key: str
    """Stands for all that the part depends on: equal keys, equal parts."""
    scene: str
    """Name of the scene."""
    technique: str
    """Name of the technique."""
    frames: int
    """Frames of the recording."""
    positioned: int
    """Frames with a pose."""
    reachable: int
    """Frames that a map growing frame by frame can reach, whatever the technique."""
    positioned_of_reachable: int
    """Those of them with a pose."""
    sharing: int
    """Frames that show three targets, not on one line, of the map which the technique itself had by then."""
    positioned_of_sharing: int
    """Those of them with a pose."""
    refused: dict[str, int]
    """Frames without a pose, per reason."""
    misidentified: list[int]
    """Frames with a pose that the labels of their own points contradict."""
    drifted: int
    """Frames whose pose is wrong by drift alone."""
    error_mm: Errors
    """Positions against truth, all positioned frames (mm)."""
    error_deg: Errors
    """Rotations against truth, all positioned frames (degrees)."""
    drift_mm: Errors
    """Positions against truth, misidentified frames left out (mm)."""
    drift_deg: Errors
    """Rotations against truth, misidentified frames left out (degrees)."""
    target_mm: Errors
    """Trusted targets against truth (mm)."""
    targets_found: int
    """True targets that stand in the map, trusted."""
    targets_true: int
    """True targets of the scene."""
    duplicates: int
    """Trusted targets that are the same true one as another."""
    unknown_targets: int
    """Trusted targets that are none."""
    frame_ms: Cost
    """Time of a frame in which the technique was asked, all stages (ms)."""
    comparisons: Cost
    """Comparisons of triangles or distances in such a frame."""
    targets: list[int]
    """Targets in the list after each frame."""
    sizes: list[int]
    """Triangles, or distances, that the technique forms of the list after each frame."""
    without_triangle: int
    """Targets that stand in none of the final triangles."""
    kept: float | None
    """Share of the list's triangles that outlive the next positioned frame, mean; None without triangles."""
    map_mm: Xyz
    """Final targets, coordinates of the object (mm)."""
    sightings: list[int]
    """Frames in which each of them was seen."""
    triangles: list[tuple[int, int, int]]
    """Final triangles, rows of ``map_mm``; left out where they are too many to be drawn."""
    path_mm: Xyz
    """Where the sensor was, positioned frames only, coordinates of the object (mm)."""
    path_frame: list[int]
    """Numbers of these frames."""
    true_mm: Xyz
    """The true targets (mm)."""


DRAWN_AT_MOST = 2000
"""More triangles than this are not kept for a figure."""


def measure(key: str, scene: str, room: Path, scratch: Path, options: Config, show: Show) -> Part:
    """Positions ``room/recording`` by what was known at each frame, and compares with ``room/truth``.

    The results are evaluated in ``scratch`` and not kept.
    """
    recording = read_recording(room / "recording", "dots", options.noise.sigma_px)
    positioner = Positioner(options)
    watch = Watch(options.identify)
    with TemporaryDirectory(dir=scratch) as folder:
        results = Path(folder)
        with ResultsWriter(results, scene, "dots", to_toml(options), is_online=True) as writer:
            for done, step in enumerate(positioner.run(recording), start=1):
                writer.write(step)
                watch.show(step)
                show(done, len(recording))
            writer.finish()
        found = evaluate(results, room / "truth")
        frame, _, poses, _ = read_poses(results / "poses.csv")
        targets = read_map(results / "map.csv")
    truth = read_truth(room / "truth")
    row_of = {index: row for row, index in enumerate(truth.frames.index.tolist())}
    true_poses = [truth.frames.T_map_sensor[row_of[index]] for index in frame.tolist()]
    T_object_world = compare_poses(poses, true_poses).T_truth_world
    alive = np.flatnonzero(targets.alive)
    row_of_id = dict(zip(targets.id[alive].tolist(), range(len(alive)), strict=True))
    triangles = watch.triangles if len(watch.triangles) <= DRAWN_AT_MOST else watch.triangles[:0]
    return Part(
        key=key,
        scene=scene,
        technique=options.identify.technique,
        frames=found.frames,
        positioned=found.positioned,
        reachable=found.of_reachable_online.of,
        positioned_of_reachable=found.of_reachable_online.count,
        sharing=found.of_sharing.of,
        positioned_of_sharing=found.of_sharing.count,
        refused=found.refused,
        misidentified=list(found.misidentified),
        drifted=found.drifted,
        error_mm=Errors.of(found.error_mm),
        error_deg=Errors.of(found.error_deg),
        drift_mm=Errors.of(found.drift_mm),
        drift_deg=Errors.of(found.drift_deg),
        target_mm=Errors.of(found.target_mm),
        targets_found=found.targets.count,
        targets_true=found.targets.of,
        duplicates=found.duplicates,
        unknown_targets=found.unknown_targets,
        frame_ms=Cost.of(watch.frame_ms),
        comparisons=Cost.of(watch.comparisons),
        targets=watch.targets,
        sizes=watch.sizes,
        without_triangle=len(alive) - len(np.unique(watch.triangles)) if len(watch.triangles) else 0,
        kept=float(np.mean(watch.kept)) if watch.kept else None,
        map_mm=_xyz(T_object_world.apply(targets.xyz_mm[alive])),
        sightings=targets.sightings[alive].tolist(),
        triangles=[(row_of_id[a], row_of_id[b], row_of_id[c]) for a, b, c in triangles.tolist()],
        path_mm=_xyz(np.array([(T_object_world @ T).t_mm for T in poses]).reshape(-1, 3)),
        path_frame=frame.tolist(),
        true_mm=_xyz(truth.targets.xyz_mm),
    )


class Watch:
    """Follows what a technique keeps of the map, and what frames cost it, as Steps pass."""

    def __init__(self, options: IdentifyOptions) -> None:
        # A technique of its own, told the same as the positioner's: whoever watches, watches Steps alone.
        self._technique = identifier(options)
        self.frame_ms: list[float] = []
        self.comparisons: list[float] = []
        self.targets: list[int] = []
        self.sizes: list[int] = []
        self.kept: list[float] = []
        self.triangles: Int[np.ndarray, "t 3"] = np.zeros((0, 3), dtype=np.int64)
        """The triangles after the newest frame, as identities of targets."""

    def show(self, step: Step) -> None:
        """Looks at the next frame."""
        if "identify" in step.timings_ms and step.points is not None and len(step.points) >= 3:
            self.frame_ms.append(sum(step.timings_ms.values()))
            self.comparisons.append(step.identification.comparisons if step.identification else 0)
        if isinstance(step.fix, Fix):
            self._technique.learn(step.map, np.unique(np.concatenate([step.fix.target, step.added])))
            triangles = np.sort(step.map.id[self._technique.triangles()], axis=1)
            if len(self.triangles):
                survivors = _in_common(self.triangles, triangles)
                self.kept.append(survivors / len(self.triangles))
            self.triangles = triangles
        self.targets.append(int(step.map.alive.sum()))
        self.sizes.append(self._technique.size)


def _in_common(a: Int[np.ndarray, "m 3"], b: Int[np.ndarray, "n 3"]) -> int:
    """How many triangles stand in both tables, which name none twice."""
    base = 1 + max(int(a.max(initial=0)), int(b.max(initial=0)))
    place = np.array([base * base, base, 1])
    return len(np.intersect1d(a @ place, b @ place, assume_unique=True))


def _xyz(xyz_mm: Float[np.ndarray, "n 3"]) -> Xyz:
    """Rounded to micrometres."""
    return [(x, y, z) for x, y, z in np.round(xyz_mm, 3).tolist()]


def growth(targets: Iterable[int], sizes: Iterable[int]) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """The numbers of targets that the list had, and the median number of triangles or distances at each."""
    at, size = np.array(list(targets), dtype=np.int64), np.array(list(sizes), dtype=np.float64)
    counts = np.unique(at[at > 0])
    return counts, np.array([np.median(size[at == count]) for count in counts])


def slope(targets: Iterable[int], sizes: Iterable[int]) -> float | None:
    """Triangles or distances more per target more, least squares over all sizes of the list; None for one size."""
    count, size = growth(targets, sizes)
    if len(count) < 2:
        return None
    return float(np.polyfit(count, size, 1)[0])
