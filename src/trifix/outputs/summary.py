"""What a whole run amounts to, in numbers, gathered as Steps pass. Knows neither files nor how they are shown."""

import platform
import tomllib
from collections import Counter
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from jaxtyping import Float

from trifix.bundle import Adjusted, NotAdjusted
from trifix.geometry.pose import Pose
from trifix.outputs.advice import advice_for_run
from trifix.outputs.history import Thinned
from trifix.records import Fix, NoFix, ReferenceMap, Step, TargetState

STAGES = ("detect", "match", "triangulate", "identify", "orient", "verify", "update")
"""What is timed, in the order of the work."""

_TIMED = (*STAGES, "total")


@dataclass(frozen=True, slots=True)
class Residuals:
    """How far the identified points or dots were from their targets."""

    rms: float | None
    """Root mean square over all of them; None if there are none."""
    median: float | None
    """Median over the frames of the root mean square within a frame (of a long run, over some of them)."""
    worst: float | None
    """The largest root mean square within a frame."""
    count: int
    """How many there are."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long one stage took."""

    median_ms: float
    """Median over the frames in which it ran; of a long run, over some of them (ms)."""
    p99_ms: float
    """99th percentile (ms)."""
    frames: int
    """Frames in which it ran."""


@dataclass(frozen=True, slots=True)
class Tip:
    """What would help the next run over the same object."""

    sentence: str
    """What to do."""
    place_mm: tuple[float, float, float] | None
    """Where, world coordinates (mm); None where no place is meant."""


@dataclass(frozen=True, slots=True)
class Summary:
    """A run in numbers: the content of summary.json."""

    recording: str
    """Name of the recording."""
    level: str
    """images, dots or points."""
    is_online: bool
    """Every frame was judged by what was known at its time."""
    finished: bool
    """The run reached its end; False while it goes on and after it was cut short."""
    frames: int
    """Frames judged."""
    positioned: int
    """Frames with a pose."""
    refused: int
    """Frames without."""
    dropped: int
    """Frames of a live run that came faster than they could be judged, and were left out."""
    reasons: dict[str, int]
    """Frames per reason: of refusals, and of what is special about a positioned frame."""
    targets: dict[str, int]
    """Targets per state."""
    residual_mm: Residuals
    """Distances of identified points from their targets (mm)."""
    residual_px: Residuals
    """Distances of identified dots from their reprojected targets (px); none if the recording begins with points."""
    noise_scale: float
    """Factor on all stated or assumed standard deviations that the residuals asked for."""
    rig: str
    """What seems to be wrong with the rig, in a sentence; empty if nothing does."""
    timings: dict[str, Timing]
    """Per stage, in the order of the work, and ``total``."""
    seconds: float
    """Time from start to end (s)."""
    frames_per_s: float
    """Frames judged per second of it."""
    options: dict[str, object]
    """All options used."""
    versions: dict[str, str]
    """Of trifix and of what its numbers depend on."""
    advice: tuple[Tip, ...] = ()
    """What the refusals of a finished run suggest, the most rewarding first."""
    adjustment: Adjusted | None = None
    """What came of adjusting everything together; None where nothing was adjusted."""
    not_adjusted: str = ""
    """Why nothing was adjusted, in a sentence, if it should have been."""


class Tally:
    """Gathers a ``Summary`` from Steps, a few numbers a frame, and no more in a day than in an hour."""

    def __init__(self, recording: str, level: str, config_toml: str, is_online: bool) -> None:
        self._recording, self._level, self._is_online = recording, level, is_online
        self._options: dict[str, object] = tomllib.loads(config_toml)
        self._frames = self._positioned = 0
        self._reasons: Counter[str] = Counter()
        self._judged: Thinned[tuple[str, int, Pose | None]] = Thinned()
        """Reason, points and pose of frames."""
        self._mm, self._px = _Spread(), _Spread()
        self._timings_ms: Thinned[tuple[float, ...]] = Thinned()
        self._timed = dict.fromkeys(_TIMED, 0)
        self._noise_scale = 1.0
        self._dropped = 0

    def add(self, step: Step, residual_px: Float[np.ndarray, "d"], dropped: int = 0) -> None:
        """Count one frame, with the distances of its identified dots from their reprojected targets (px).

        ``dropped`` are the frames left out so far.
        """
        self._frames += 1
        self._dropped = dropped
        points = 0 if step.points is None else len(step.points)
        pose: Pose | None = None
        match step.fix:
            case Fix() as fix:
                self._positioned += 1
                reason, pose = "" if fix.reason is None else fix.reason.name, fix.T_world_sensor
                self._mm.add(fix.residual_mm)
                self._px.add(residual_px)
            case NoFix() as refusal:
                reason = refusal.why.name
        self._judged.add((reason, points, pose))
        if reason:
            self._reasons[reason] += 1
        ms = {**step.timings_ms, "total": sum(step.timings_ms.values())}
        self._timings_ms.add(tuple(ms.get(stage, np.nan) for stage in _TIMED))
        for stage in ms:
            self._timed[stage] += 1
        self._noise_scale = step.noise_scale

    def summary(
        self,
        targets: ReferenceMap,
        seconds: float,
        finished: bool,
        rig: str = "",
        adjusted: Adjusted | NotAdjusted | None = None,
    ) -> Summary:
        """The numbers so far, with the map as it now is, what is wrong with the rig and what came of the adjustment."""
        timings_ms = np.array(self._timings_ms.items).reshape(-1, len(_TIMED))
        return Summary(
            recording=self._recording,
            level=self._level,
            is_online=self._is_online,
            finished=finished,
            frames=self._frames,
            positioned=self._positioned,
            refused=self._frames - self._positioned,
            dropped=self._dropped,
            reasons=dict(self._reasons.most_common()),
            targets={
                state.name: int((targets.state == state).sum())
                for state in (TargetState.trusted, TargetState.provisional, TargetState.quarantined)
            },
            residual_mm=self._mm.residuals(),
            residual_px=self._px.residuals(),
            noise_scale=self._noise_scale,
            rig=rig,
            timings={
                name: Timing(float(np.median(known)), float(np.percentile(known, 99)), self._timed[name])
                for name, ms in zip(_TIMED, timings_ms.T, strict=True)
                if len(known := ms[~np.isnan(ms)])
            },
            seconds=seconds,
            frames_per_s=self._frames / seconds if seconds > 0 else 0.0,
            options=self._options,
            versions=versions(),
            advice=self._advice(targets) if finished else (),
            adjustment=adjusted if isinstance(adjusted, Adjusted) else None,
            not_adjusted=adjusted.why if isinstance(adjusted, NotAdjusted) else "",
        )

    def _advice(self, targets: ReferenceMap) -> tuple[Tip, ...]:
        kept = self._judged.items
        points = np.array([points for _, points, _ in kept], dtype=np.int64)
        told = advice_for_run([reason for reason, _, _ in kept], points, [pose for _, _, pose in kept], targets)
        return tuple(Tip(each.sentence, None if each.place_mm is None else _rounded(each.place_mm)) for each in told)


def _rounded(place_mm: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (round(float(each), 1) for each in place_mm)
    return x, y, z


class _Spread:
    """Residuals of a run, gathered frame by frame: their sum of squares, and each frame's rms."""

    def __init__(self) -> None:
        self._count, self._sum = 0, 0.0
        self._worst = 0.0
        self._frame_rms: Thinned[float] = Thinned()

    def add(self, residual: Float[np.ndarray, "n"]) -> None:
        known = residual[np.isfinite(residual)]
        if not len(known):
            return
        squares = float((known**2).sum())
        self._count += len(known)
        self._sum += squares
        rms = (squares / len(known)) ** 0.5
        self._worst = max(self._worst, rms)
        self._frame_rms.add(rms)

    def residuals(self) -> Residuals:
        if not self._count:
            return Residuals(None, None, None, 0)
        return Residuals(
            rms=(self._sum / self._count) ** 0.5,
            median=float(np.median(self._frame_rms.items)),
            worst=self._worst,
            count=self._count,
        )


def versions() -> dict[str, str]:
    """Of trifix, of what its numbers depend on, and of Python."""
    packages = {"trifix": "trifix", "numpy": "numpy", "opencv": "opencv-python-headless", "numba": "numba"}
    return {name: version(package) for name, package in packages.items()} | {"python": platform.python_version()}
