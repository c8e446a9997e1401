"""A finished run, to be looked at frame by frame. Judges nothing again; asks a recording for its images."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import RecordingError, TrifixError
from trifix.files.recordings import LEVELS, read_recording
from trifix.files.tables import Table, read_table
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.outputs.advice import Advice, advice_on
from trifix.outputs.moments import Moment, Shot, event_words, sigma_of
from trifix.outputs.runs import read_run
from trifix.outputs.samples import HEIGHT_PX, KINDS, WIDTH_PX, points_by_kind
from trifix.records import (
    Fix,
    Frame,
    GreyOrColour,
    NoFix,
    PositionedReason,
    Reason,
    SensorPoints,
    StereoDots,
    StereoImages,
)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The frames in which one target was identified."""

    frame: Int[np.ndarray, "s"]
    """Their numbers, ascending, each once."""
    residual_mm: Float[np.ndarray, "s"]
    """Distance of the point from the target (mm); NaN where only one camera saw it."""
    residual_px: Float[np.ndarray, "s"]
    """The larger distance of its two dots from the images of the target (px); NaN where there are no dots."""
    cameras: tuple[str, ...]
    """left and right, left, right, or point."""


class FinishedRun:
    """What a run left behind, frame by frame."""

    def __init__(self, out: Path, recording: Path | None = None) -> None:
        """Reads the folder; ``recording`` is where its images, dots or points are, if they are to be shown.

        Raises:
            RecordingError: the folder holds no results, or none yet, or the recording is another one.
            MapError: its map cannot be read.
        """
        self._run = run = read_run(out)
        self.name, self.is_finished = run.summary.recording, run.summary.finished
        self.frames_per_s = run.summary.frames_per_s
        self.course, self.targets = run.course, run.map
        if not len(self):
            raise RecordingError(f"{out} holds a run that has not positioned or refused any frame yet.")
        self.reason: tuple[str, ...] = run.reason
        """Names of the frames' reasons, empty where there is none."""
        self.poses: tuple[Pose | None, ...] = tuple(run.poses.get(frame) for frame in self.course.frame.tolist())
        """Their poses, None where refused."""
        self._of_frame = _rows_of(run.sightings["frame"])
        self._of_target = _rows_of(run.sightings["target"])
        self._events = _events(out)
        self._total_ms = _timings(out)
        self._recording = None
        if recording is not None:  # at the level at which it was positioned
            level = next((each for each in LEVELS if each == run.summary.level), None)
            self._recording = read_recording(recording, level)
        self._at = {} if self._recording is None else {int(f): k for k, f in enumerate(self._recording.index)}
        if self._recording is not None and not set(self._at) & set(self.course.frame.tolist()):
            raise RecordingError(
                f"{recording} has none of the frames in {out}: name the recording that was positioned."
            )
        is_detected = self._recording is not None and self._recording.level == "images"
        self._dots = _dots(out / "dots.csv") if is_detected else None
        self._dots_of = {} if self._dots is None else _rows_of(self._dots["frame"])

    def __len__(self) -> int:
        return len(self.course.frame)

    @property
    def rig(self) -> StereoRig | None:
        """The stereo geometry of all frames, if the recording is at hand and they share one."""
        return None if self._recording is None else self._recording.rig

    def latency_ms(self, k: int) -> float:
        """How long the k-th frame took (ms); NaN where that is not known."""
        return self._total_ms.get(int(self.course.frame[k]), float("nan"))

    def position(self, frame: int) -> int:
        """Which of the frames has this number, or the next one after it."""
        return min(int(np.searchsorted(self.course.frame, frame)), len(self) - 1)

    def sightings(self, target: int) -> Sightings:
        """Where a target was identified; nowhere, if there is no such target."""
        rows = self._of_target.get(target, np.zeros(0, dtype=np.int64))
        table = self._run.sightings
        nan = np.full(len(table["frame"]), np.nan)
        mm, px = table.get("residual_mm", nan)[rows], table.get("residual_px", nan)[rows]
        frames, first, inverse = np.unique(table["frame"][rows], return_index=True, return_inverse=True)
        largest_px = np.full(len(frames), np.nan)
        np.fmax.at(largest_px, inverse, px)
        kinds: list[list[str]] = [[] for _ in frames]
        for at, kind in zip(inverse, table["kind"][rows], strict=True):
            kinds[at].append(str(kind))
        return Sightings(frames, mm[first], largest_px, tuple(" and ".join(each) for each in kinds))

    def moment(self, k: int) -> Moment:
        """What is shown of the k-th frame."""
        run, index = self._run, int(self.course.frame[k])
        rows = self._of_frame.get(index, np.zeros(0, dtype=np.int64))
        seen = None
        if self._recording is not None and index in self._at:
            seen = self._recording.frame(self._at[index])
        return Moment(
            frame=index,
            timestamp_ns=int(run.timestamp_ns[k]),
            pose=self.poses[k] or self._last_pose(k),
            is_positioned=self.poses[k] is not None,
            reason=self.reason[k],
            detail=run.detail[k],
            points=int(self.course.points[k]),
            matched=int(self.course.matched[k]),
            residual_mm=float(run.residual_mm[k]),
            p_chance=float(run.p_chance[k]),
            sigma_mm=sigma_of(run.cov[index]) if index in run.cov else float("nan"),
            targets=np.unique(run.sightings["target"][rows]),
            rig=None if seen is None else seen.rig,
            shots=() if seen is None else self._shots(seen, k, rows),
            advice=self._advice(k, None if seen is None else seen.rig),
            events=tuple(words for frame, words in reversed(self._events) if frame <= index)[:4],
        )

    def _last_pose(self, k: int) -> Pose | None:
        return next((pose for pose in reversed(self.poses[:k]) if pose is not None), None)

    def _advice(self, k: int, rig: StereoRig | None) -> Advice | None:
        """What its reason calls for."""
        reasons = {each.name: each for each in (*Reason, *PositionedReason)}
        count = self.course.points[k] if self.poses[k] is None else self.course.matched[k]
        return advice_on(
            reasons.get(self.reason[k]), int(count), self.poses[k] or self._last_pose(k), rig, self.targets
        )

    def _shots(self, seen: Frame, k: int, rows: Int[np.ndarray, "s"]) -> tuple[Shot, ...]:
        """What the cameras saw, with its dots by what became of them."""
        kind, row = self._run.sightings["kind"][rows], self._run.sightings["row"][rows]
        identified = {name: set(row[kind == name].tolist()) for name in ("left", "right", "point")}
        match seen.content:
            case StereoImages() as images if seen.rig is not None:
                return (
                    self._detected(images.left, 0, seen, k, identified["left"]),
                    self._detected(images.right, 1, seen, k, identified["right"]),
                )
            case StereoDots() as dots if seen.rig is not None:
                return (
                    self._shot(None, seen.rig.left, dots.left.uv_px, dots.left.row, k, identified["left"]),
                    self._shot(None, seen.rig.right, dots.right.uv_px, dots.right.row, k, identified["right"]),
                )
            case SensorPoints() as points:
                found = np.flatnonzero(np.isin(points.row, list(identified["point"])))
                pose = self.poses[k]
                fix = (
                    NoFix(Reason.no_candidate)
                    if pose is None
                    else Fix(pose, np.eye(6), found, found, np.zeros(len(found)), float("nan"))
                )
                return (Shot(None, WIDTH_PX, HEIGHT_PX, points_by_kind(points, fix)),)
            case _:
                return ()

    def _detected(self, image: GreyOrColour, camera: int, seen: Frame, k: int, identified: set[int]) -> Shot:
        """An image with the dots of the results' own dots.csv."""
        assert seen.rig is not None, "images come with the rig that saw them"
        of = seen.rig.left if camera == 0 else seen.rig.right
        if self._dots is None:
            return self._shot(image, of, np.zeros((0, 2)), np.zeros(0, dtype=np.int64), k, identified)
        rows = self._dots_of.get(seen.index, np.zeros(0, dtype=np.int64))
        rows = rows[self._dots["camera"][rows] == camera]
        uv_px = np.stack([self._dots["u"][rows], self._dots["v"][rows]], axis=1)
        return self._shot(image, of, uv_px, rows, k, identified)

    def _shot(
        self,
        image: GreyOrColour | None,
        camera: Camera,
        uv_px: Float[np.ndarray, "n 2"],
        row: Int[np.ndarray, "n"],
        k: int,
        identified: set[int],
    ) -> Shot:
        is_found = np.isin(row, list(identified))
        dots = dict.fromkeys(KINDS, np.zeros((0, 2)))
        dots |= {
            "identified": uv_px[is_found],
            "refused" if self.poses[k] is None else "unidentified": uv_px[~is_found],
        }
        return Shot(image, camera.width_px, camera.height_px, dots)


def recording_beside(out: Path) -> Path | None:
    """The recording of a run, if it lies beside its results."""
    try:
        path = out.resolve().parent / read_run(out).summary.recording
        return path if path != out.resolve() and path.is_dir() and read_recording(path) else None
    except TrifixError:
        return None


def _rows_of(key: Int[np.ndarray, "n"]) -> dict[int, Int[np.ndarray, "m"]]:
    """Rows of each key, in their order."""
    order = np.argsort(key, kind="stable")
    names, start = np.unique(key[order], return_index=True)
    return dict(zip(names.tolist(), np.split(order, start[1:]), strict=True))


def _dots(file: Path) -> Table | None:
    return read_table(file, {"frame": int, "camera": int, "u": float, "v": float}) if file.exists() else None


def _events(out: Path) -> list[tuple[int, str]]:
    file = out / "events.csv"
    if not file.exists():
        return []
    table = read_table(file, {"frame": int, "event": str}, {"target": int, "detail": str})
    n = len(table["frame"])
    target, detail = table.get("target", np.full(n, -1)), table.get("detail", np.full(n, "", dtype=object))
    return [
        (int(frame), event_words(int(frame), str(event), None if each < 0 else int(each), str(words)))
        for frame, event, each, words in zip(table["frame"], table["event"], target, detail, strict=True)
    ]


def _timings(out: Path) -> dict[int, float]:
    file = out / "timings.csv"
    if not file.exists():
        return {}
    table = read_table(file, {"frame": int, "total_ms": float})
    return dict(zip(table["frame"].tolist(), table["total_ms"].tolist(), strict=True))
