"""The results folder, written as Steps pass and usable whenever the process dies. Decides nothing, draws nothing.

A recording may be gone through several times. What one passage gave stands until the next, written beside it in a
hidden folder, is whole and takes its place.

Rows wait in memory for a quarter of a second at most; then a thread appends them to their files in blocks of whole
lines, one write a file, so that a slow frame holds no row back. ``frames.csv`` comes last in each round: the rows of
the frames that it names stand in all other files already. Map and summary are replaced, never rewritten in place.
Nothing depends on the clock but timings.csv and summary.json.
"""

import shutil
import threading
import time
import tomllib
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path
from types import TracebackType

import msgspec
import numpy as np
from jaxtyping import Float

from trifix.bundle import Adjusted, NotAdjusted
from trifix.config import Config, with_values
from trifix.errors import RecordingError
from trifix.files.maps import write_map, write_ply
from trifix.files.recordings import DOTS_HEADER, Level, dots_rows
from trifix.files.tables import fixed, significant, write_atomically
from trifix.files.trajectories import POSES_HEADER, poses_row, tum_row
from trifix.geometry.camera import Camera
from trifix.outputs.summary import STAGES, Summary, Tally
from trifix.records import Fix, NoFix, Reason, ReferenceMap, Step
from trifix.rigcheck import RigCheck

FLUSH_S = 0.25
"""Longest wait of a row in memory (s)."""
CHECKPOINT_S = 5.0
"""Longest wait of a changed map in memory (s)."""

_MOST_WAITING = 2000  # frames in memory
_ISLANDS = "islands"
_REVISED = ".revised"
_POSE = "x_mm,y_mm,z_mm,qx,qy,qz,qw"
# In the order in which they are written.
_HEADERS = {
    "dots.csv": DOTS_HEADER,
    "sightings.csv": "frame,kind,row,target,residual_mm,residual_px",
    "events.csv": "frame,timestamp_ns,event,target,detail",
    "rivals.csv": f"frame,timestamp_ns,rival,{_POSE},log_odds,odds_to_best,matched",
    "timings.csv": "frame," + ",".join(f"{stage}_ms" for stage in STAGES) + ",total_ms",
    "poses.csv": POSES_HEADER,
    "trajectory.tum": "",
    "frames.csv": "frame,timestamp_ns,status,reason,dots_left,dots_right,points,matched,residual_mm,p_chance,detail",
}


class ResultsWriter:
    """Writes Steps into a results folder.

    with ResultsWriter(out, "my recording", "dots", to_toml(config), is_online=True) as results:
        for step in positioner.run(recording):
            results.write(step)
        results.start_over()                        # not for a live run
        for step in positioner.revise(steps):
            results.write(step)
        summary = results.finish()                  # or start over once more, with adjusted steps

    Without ``finish``, as after an exception, the files are closed whole and the summary says ``finished: false``.
    """

    def __init__(self, out: Path, recording_name: str, level: Level, config_toml: str, is_online: bool) -> None:
        self._out = out
        self._level = level
        self._new_tally = partial(Tally, recording_name, level, config_toml, is_online)
        self._tally = self._new_tally()
        self._rig_check = RigCheck(with_values(Config(), tomllib.loads(config_toml), "options").match)
        self._map = ReferenceMap.empty()
        self._island_maps: dict[int, ReferenceMap] = {}
        self._dots_written = 0
        self._waiting: list[dict[str, list[str]]] = []
        self._is_finished = False
        self._adjusted: Adjusted | NotAdjusted | None = None
        self._failure: Exception | None = None
        self._lock = threading.Lock()  # held for moments: between the loop, which fills, and the thread, which empties
        self._files = threading.Lock()  # held while files are written or exchanged
        self._folder = out  # where rows go: the results folder, or the hidden one of a second passage
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_writing, name="results", daemon=True)

    def __enter__(self) -> "ResultsWriter":
        """Make the folder, or empty it of an earlier run's results.

        Raises:
            RecordingError: the folder holds something else, or cannot be written.
        """
        try:
            _make_folder(self._out)
            self._start = time.monotonic()
            self._write_state()  # first of all: from here on the summary says that the run is not finished
            for name in (*_HEADERS, "calibration.yaml", "report.html"):
                (self._out / name).unlink(missing_ok=True)
            for name in (_ISLANDS, _REVISED):
                shutil.rmtree(self._out / name, ignore_errors=True)
            self._logs = self._open_logs()
        except OSError as error:
            raise RecordingError(f"{self._out}: results cannot be written there ({error.strerror}).") from error
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close()

    def write(self, step: Step, dropped: int = 0) -> None:
        """Take over the rows of one frame; they reach the disk within ``FLUSH_S``, or this waits for a slow one.

        ``dropped`` are the frames that were left out so far.

        Raises:
            RecordingError: earlier rows could not be written.
        """
        while len(self._waiting) >= _MOST_WAITING and self._thread.is_alive():
            time.sleep(0.01)
        self._complain()
        if self._folder == self._out:  # once is enough
            self._rig_check.watch(step)
        sightings, residual_px = self._sightings(step)
        rows = {
            "sightings.csv": sightings,
            "events.csv": _event_rows(step),
            "rivals.csv": _rival_rows(step),
            "timings.csv": [_timing_row(step)],
            "frames.csv": [_frame_row(step)],
        }
        if isinstance(step.fix, Fix):
            pose, timestamp_ns = step.fix.T_world_sensor, step.frame.timestamp_ns
            rows["poses.csv"] = [poses_row(step.frame.index, timestamp_ns, pose, step.fix.cov)]
            rows["trajectory.tum"] = [tum_row(timestamp_ns, pose)]
        if self._level == "images" and step.dots is not None:
            rows["dots.csv"] = dots_rows(step.frame.index, step.frame.timestamp_ns, step.dots)
            self._dots_written += len(rows["dots.csv"])
        if step.elsewhere is not None:
            there, folder = step.elsewhere.fix, f"{_ISLANDS}/{step.elsewhere.island}"
            pose, timestamp_ns = there.T_world_sensor, step.frame.timestamp_ns
            rows[f"{folder}/poses.csv"] = [poses_row(step.frame.index, timestamp_ns, pose, there.cov)]
            rows[f"{folder}/trajectory.tum"] = [tum_row(timestamp_ns, pose)]
        targets = step.map.copy()
        with self._lock:
            self._waiting.append(rows)
            self._map = targets
            if step.elsewhere is not None:
                self._island_maps[step.elsewhere.island] = step.elsewhere.map
            self._tally.add(step, residual_px, dropped)

    def start_over(self, told_map: ReferenceMap | None = None) -> None:
        """Begin again with the first frame; what has been written stands until the new is whole and takes its place.

        That is when ``finish`` is called, or this once more. ``told_map`` is as there.

        Raises:
            RecordingError: the files cannot be written.
        """
        self._complain()
        self._tell(told_map)
        try:
            with self._files:
                self._flush()
                self._publish()
                self._write_state()
                with self._lock:
                    self._folder = self._out / _REVISED
                    self._tally = self._new_tally()
                    self._island_maps = {}
                self._folder.mkdir()
                self._logs = self._open_logs()
        except OSError as error:
            raise RecordingError(f"{self._out}: results cannot be written there ({error.strerror}).") from error
        self._dots_written = 0

    @property
    def doubt(self) -> str:
        """What seems to be wrong with the rig so far; empty if nothing does."""
        return self._rig_check.sentence

    def finish(self, adjusted: Adjusted | NotAdjusted | None = None, told_map: ReferenceMap | None = None) -> Summary:
        """Close the files of a run that reached its end; what it amounts to, and its adjustment if there was one.

        ``told_map`` is the last Step's map with covariances in the world, as ``Positioner.told_map`` gives it.

        Raises:
            RecordingError: something could not be written.
        """
        self._tell(told_map)
        self._rig_check.finish()
        self._is_finished, self._adjusted = True, adjusted
        self._close()
        self._complain()
        return self._summary

    def _tell(self, told_map: ReferenceMap | None) -> None:
        if told_map is not None:
            with self._lock:
                self._map = told_map

    def _close(self) -> None:
        self._closing.set()
        self._thread.join()
        for log in self._logs.values():
            log.close()

    def _complain(self) -> None:
        if isinstance(self._failure, OSError):
            raise RecordingError(
                f"{self._out}: results cannot be written there ({self._failure.strerror}); what stands there is whole."
            ) from self._failure
        if self._failure is not None:
            raise self._failure

    def _keep_writing(self) -> None:
        """The thread: everything that is written after the start is written here."""
        checkpoint = self._start
        try:
            while not self._closing.wait(FLUSH_S):
                with self._files:
                    self._flush()
                if time.monotonic() - checkpoint > CHECKPOINT_S:
                    checkpoint = time.monotonic()
                    self._write_state()
            self._flush()
            if self._is_finished:
                self._publish()
            self._write_state()
        except Exception as error:  # whoever writes next is told
            self._failure = error

    def _flush(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []

        def lines(name: str) -> str:
            return "".join(f"{row}\n" for row in chain.from_iterable(rows.get(name, ()) for rows in waiting))

        for name in sorted({name for rows in waiting for name in rows if name not in self._logs}):
            path = self._folder / name  # of an island; there may be too many to keep their files open
            path.parent.mkdir(parents=True, exist_ok=True)
            with closing(_Log(path, _HEADERS[path.name])) as log:
                log.append(lines(name))
        if waiting:
            for name, log in self._logs.items():
                log.append(lines(name))

    def _open_logs(self) -> "dict[str, _Log]":
        return {
            name: _Log(self._folder / name, header)
            for name, header in _HEADERS.items()
            if name != "dots.csv" or self._level == "images"
        }

    def _publish(self) -> None:
        """Put the files of a second passage in the place of the first's."""
        for log in self._logs.values():
            log.close()
        if self._folder == self._out:
            return
        shutil.rmtree(self._out / _ISLANDS, ignore_errors=True)
        for path in sorted(self._folder.iterdir()):
            path.replace(self._out / path.name)
        self._folder.rmdir()
        self._folder = self._out

    def _write_state(self) -> None:
        """Map and summary of what stands; those of a passage that is not whole yet wait for it."""
        if self._folder != self._out:
            return
        with self._lock:
            targets, islands, self._island_maps = self._map, self._island_maps, {}
            parent = self._folder / _ISLANDS
            self._summary = self._tally.summary(
                targets,
                time.monotonic() - self._start,
                finished=self._is_finished and self._closing.is_set(),
                rig=self._rig_check.sentence,
                adjusted=self._adjusted,
            )
        for number, there in islands.items():
            (parent / str(number)).mkdir(parents=True, exist_ok=True)
            write_map(there, parent / str(number) / "map.csv")
        write_map(targets, self._out / "map.csv")
        write_ply(targets, self._out / "map.ply")
        summary = msgspec.json.format(msgspec.json.encode(self._summary), indent=2).decode()
        write_atomically(self._out / "summary.json", summary + "\n")

    def _sightings(self, step: Step) -> tuple[list[str], Float[np.ndarray, "d"]]:
        """Rows of sightings.csv, and how far identified dots are from their reprojected targets (px)."""
        fix, points = step.fix, step.points
        if not isinstance(fix, Fix) or points is None:
            return [], np.zeros(0)
        frame, ids = step.frame.index, step.map.id[fix.target]
        mm = [fixed(value) for value in fix.residual_mm]
        if step.centres is None or step.matches is None or step.frame.rig is None:
            rows = points.row[fix.point]
            return [f"{frame},point,{r},{i},{e}," for r, i, e in zip(rows, ids, mm, strict=True)], np.zeros(0)
        rig, match = step.frame.rig, points.match[fix.point]
        in_left = fix.T_world_sensor.inverse().apply(step.map.xyz_mm[fix.target])
        left, right = step.matches.left[match], step.matches.right[match]
        px_left = _distance_px(rig.left, in_left, step.centres.left.uv_px[left])
        px_right = _distance_px(rig.right, rig.T_right_left.apply(in_left), step.centres.right.uv_px[right])
        row = step.centres.left.row, step.centres.right.row
        if self._level == "images":  # rows of the dots.csv among the results
            ends = self._dots_written + np.cumsum([0, len(step.centres.left), len(step.centres.right)])
            row = np.arange(ends[0], ends[1]), np.arange(ends[1], ends[2])
        sightings = []
        for k, target in enumerate(ids):
            sightings.append(f"{frame},left,{row[0][left[k]]},{target},{mm[k]},{fixed(px_left[k])}")
            sightings.append(f"{frame},right,{row[1][right[k]]},{target},{mm[k]},{fixed(px_right[k])}")
        one = fix.single
        for camera, dot, target, px in zip(one.camera, one.dot, one.target, one.residual_px, strict=True):
            kind = ("left", "right")[camera]
            sightings.append(f"{frame},{kind},{row[camera][dot]},{step.map.id[target]},,{fixed(px)}")
        return sightings, np.concatenate([px_left, px_right])


class _Log:
    """A file that grows by whole lines."""

    def __init__(self, path: Path, header: str) -> None:
        self._file = path.open("ab", buffering=0)
        self._length = path.stat().st_size
        if header and not self._length:
            self.append(f"{header}\n")

    def append(self, lines: str) -> None:
        """Write lines in one go; where not all of them fit, none stays.

        Raises:
            OSError: the disk is full, or worse.
        """
        block = lines.encode(errors="backslashreplace")  # names of files may be no text
        try:
            written = 0
            while written < len(block):
                written += self._file.write(block[written:])
        except OSError:
            self._file.truncate(self._length)
            raise
        self._length += len(block)

    def close(self) -> None:
        self._file.close()


def _make_folder(out: Path) -> None:
    """Make the folder, unless it is there already and empty, or holds results.

    Raises:
        RecordingError: it is no folder, or holds files of somebody else.
    """
    if out.exists() and not out.is_dir():
        raise RecordingError(f"{out} is a file, expected a folder for the results: name another.")
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()) and not _is_result(out):
        raise RecordingError(f"{out} holds files that are not results of trifix: name a new or an empty folder.")


def _is_result(out: Path) -> bool:
    """Whether the folder's summary.json was written by trifix."""
    try:
        summary = msgspec.json.decode((out / "summary.json").read_bytes())
    except (OSError, msgspec.DecodeError):
        return False
    return isinstance(summary, dict) and "trifix" in (summary.get("versions") or ())


def _frame_row(step: Step) -> str:
    frame, fix = step.frame, step.fix
    left, right = (0, 0) if step.dots is None else (len(step.dots.left), len(step.dots.right))
    counts = f"{left},{right},{0 if step.points is None else len(step.points)}"
    match fix:
        case Fix():
            reason = "" if fix.reason is None else fix.reason.name
            verdict, matched, residual_mm = f"positioned,{reason}", len(fix.point), fix.rms_mm
        case NoFix():
            verdict, matched, residual_mm = f"refused,{fix.why.name}", fix.matched, fix.residual_mm
    numbers = f"{matched},{fixed(residual_mm)},{significant(fix.p_chance, 6)}"
    return f"{frame.index},{frame.timestamp_ns},{verdict},{counts},{numbers},{_text(fix.detail)}"


def _event_rows(step: Step) -> list[str]:
    start = f"{step.frame.index},{step.frame.timestamp_ns}"
    return [
        f"{start},{each.event},{'' if each.target is None else each.target},{_text(each.detail)}"
        for each in step.events
    ]


def _rival_rows(step: Step) -> list[str]:
    if not isinstance(step.fix, NoFix) or step.fix.why is not Reason.ambiguous:
        return []
    start, rivals = f"{step.frame.index},{step.frame.timestamp_ns}", step.fix.rivals
    best = max((each.log_odds for each in rivals), default=0.0)
    rows = []
    for rank, each in enumerate(rivals):
        pose = each.T_world_sensor
        numbers = ",".join([*map(fixed, pose.t_mm), *(fixed(q, 12) for q in pose.quaternion_xyzw)])
        odds = f"{significant(each.log_odds)},{significant(np.exp(each.log_odds - best))}"
        rows.append(f"{start},{rank},{numbers},{odds},{each.matched}")
    return rows


def _timing_row(step: Step) -> str:
    ms = step.timings_ms
    stages = ",".join(fixed(ms[stage], 3) if stage in ms else "" for stage in STAGES)
    return f"{step.frame.index},{stages},{fixed(sum(ms.values(), start=0.0), 3)}"


def _distance_px(
    camera: Camera, xyz_mm: Float[np.ndarray, "n 3"], uv_px: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Distances of dots from the images of points in the camera's coordinates; NaN for points behind it."""
    return np.asarray(np.linalg.norm(camera.project(xyz_mm) - uv_px, axis=1))


def _text(words: str) -> str:
    """Free text as one cell of one line."""
    line = " ".join(words.split())
    return f'"{line.replace(chr(34), chr(34) * 2)}"' if "," in line or '"' in line else line
