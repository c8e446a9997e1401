"""A results folder, read back to be looked at frame by frame. Judges nothing again; asks a recording for its images."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, Int

from trifix.errors import RecordingError, TrifixError
from trifix.files.maps import read_map
from trifix.files.recordings import LEVELS, Level, Recording, read_recording
from trifix.files.tables import Table, read_table
from trifix.files.trajectories import read_poses
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.outputs.advice import Advice, advice_on
from trifix.outputs.moments import Moment, Shot, event_words, sigma_of
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
        self.path = out
        summary = _summary(out)
        self.name = str(summary.get("recording", out.name))
        self.is_finished = summary.get("finished") is True
        self.frames_per_s = _number(summary.get("frames_per_s"))
        numbers = {"points": int, "matched": int}
        self._frames = read_table(
            out / "frames.csv",
            {"frame": int, "timestamp_ns": int, "status": str},
            {"reason": str, "detail": str, "residual_mm": float, "p_chance": float} | numbers,
        )
        self.frame: np.ndarray = self._frames["frame"]
        """Numbers of the frames."""
        if not len(self.frame):
            raise RecordingError(f"{out} holds a run that has not positioned or refused any frame yet.")
        self.is_positioned: np.ndarray = self._frames["status"] == "positioned"
        """Which of them have a pose."""
        empty = np.full(len(self.frame), "", dtype=object)
        self.reason: tuple[str, ...] = tuple(self._frames.get("reason", empty))
        """Names of their reasons, empty where there is none."""
        self._detail = self._frames.get("detail", empty)
        nan = np.full(len(self.frame), np.nan)
        self.residual_mm = np.where(self.is_positioned, self._frames.get("residual_mm", nan), np.nan)
        """Rms residuals of the positioned frames (mm)."""
        self._p_chance = self._frames.get("p_chance", nan)
        none = np.zeros(len(self.frame), dtype=np.int64)
        self.points, self.matched = self._frames.get("points", none), self._frames.get("matched", none)
        posed, _, poses, cov = read_poses(out / "poses.csv")
        row_of = {int(frame): k for k, frame in enumerate(posed)}
        rows = [row_of.get(int(frame)) for frame in self.frame]
        self.poses: tuple[Pose | None, ...] = tuple(None if row is None else poses[row] for row in rows)
        """Their poses, None where refused."""
        self._sigma_mm = [float("nan") if row is None else sigma_of(cov[row]) for row in rows]
        self.targets = read_map(out / "map.csv")
        """The targets in the end."""
        self._sightings = read_table(
            out / "sightings.csv",
            {"frame": int, "kind": str, "row": int, "target": int},
            {"residual_mm": float, "residual_px": float},
        )
        self._of_frame = _rows_of(self._sightings["frame"])
        self._of_target = _rows_of(self._sightings["target"])
        self._events = _events(out)
        self._total_ms = _timings(out)
        self._recording = None if recording is None else _recording(recording, summary)
        self._at = {} if self._recording is None else {int(f): k for k, f in enumerate(self._recording.index)}
        if self._recording is not None and not set(self._at) & set(self.frame.tolist()):
            raise RecordingError(
                f"{recording} has none of the frames in {out}: name the recording that was positioned."
            )
        is_detected = self._recording is not None and self._recording.level == "images"
        self._dots = _dots(out / "dots.csv") if is_detected else None
        self._dots_of = {} if self._dots is None else _rows_of(self._dots["frame"])

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def rig(self) -> StereoRig | None:
        """The stereo geometry of all frames, if the recording is at hand and they share one."""
        return None if self._recording is None else self._recording.rig

    def latency_ms(self, k: int) -> float:
        """How long the k-th frame took (ms); NaN where that is not known."""
        return self._total_ms.get(int(self.frame[k]), float("nan"))

    def position(self, frame: int) -> int:
        """Which of the frames has this number, or the next one after it."""
        return min(int(np.searchsorted(self.frame, frame)), len(self) - 1)

    def sightings(self, target: int) -> Sightings:
        """Where a target was identified; nowhere, if there is no such target."""
        rows = self._of_target.get(target, np.zeros(0, dtype=np.int64))
        table = self._sightings
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
        index, stamp = int(self.frame[k]), int(self._frames["timestamp_ns"][k])
        rows = self._of_frame.get(index, np.zeros(0, dtype=np.int64))
        seen = None
        if self._recording is not None and index in self._at:
            seen = self._recording.frame(self._at[index])
        return Moment(
            frame=index,
            timestamp_ns=stamp,
            pose=self.poses[k] or self._last_pose(k),
            is_positioned=bool(self.is_positioned[k]),
            reason=self.reason[k],
            detail=str(self._detail[k]),
            points=int(self.points[k]),
            matched=int(self.matched[k]),
            residual_mm=float(self._frames["residual_mm"][k]) if "residual_mm" in self._frames else float("nan"),
            p_chance=float(self._p_chance[k]),
            sigma_mm=self._sigma_mm[k],
            targets=np.unique(self._sightings["target"][rows]),
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
        count = self.matched[k] if self.is_positioned[k] else self.points[k]
        return advice_on(
            reasons.get(self.reason[k]), int(count), self.poses[k] or self._last_pose(k), rig, self.targets
        )

    def _shots(self, seen: Frame, k: int, rows: Int[np.ndarray, "s"]) -> tuple[Shot, ...]:
        """What the cameras saw, with its dots by what became of them."""
        kind, row = self._sightings["kind"][rows], self._sightings["row"][rows]
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
            "unidentified" if self.is_positioned[k] else "refused": uv_px[~is_found],
        }
        return Shot(image, camera.width_px, camera.height_px, dots)


def _summary(out: Path) -> dict[str, object]:
    if not out.is_dir():
        raise RecordingError(f"{out} is not a folder, expected the results of `trifix run`.")
    try:
        summary = msgspec.json.decode((out / "summary.json").read_bytes())
    except OSError:
        raise RecordingError(f"{out} holds no summary.json, expected the results of `trifix run`.") from None
    except msgspec.DecodeError as fault:
        raise RecordingError(f"{out / 'summary.json'} is not JSON: {fault}.") from None
    if not isinstance(summary, dict):
        raise RecordingError(f"{out / 'summary.json'} holds no table, expected the summary of a run.")
    return summary


def _recording(path: Path, summary: Mapping[str, object]) -> Recording:
    """The recording at the level at which it was positioned."""
    named = summary.get("level")
    level: Level | None = next((each for each in LEVELS if each == named), None)
    return read_recording(path, level)


def recording_beside(out: Path) -> Path | None:
    """The recording of a run, if it lies beside its results."""
    try:
        path = out.resolve().parent / str(_summary(out).get("recording", ""))
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


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
