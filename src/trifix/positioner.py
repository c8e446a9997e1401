"""The loop: one stereo frame in, one Step out. The whole algorithm on this page, in the order of the work.

It does not know where frames come from nor who is watching.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import assert_never

import numpy as np
from jaxtyping import Int

from trifix.config import Config
from trifix.files.recordings import Recording, read_recording
from trifix.geometry.alignment import spread_off_line_mm
from trifix.geometry.pose import Pose
from trifix.records import (
    Fix,
    Frame,
    Identification,
    NoFix,
    Orientations,
    PositionedReason,
    Prediction,
    Reason,
    ReferenceMap,
    SensorPoints,
    Step,
    StereoDots,
    StereoImages,
    StereoMatches,
    Unusable,
)
from trifix.stages.detect import detect
from trifix.stages.identify import identifier
from trifix.stages.match import match
from trifix.stages.orient import orient
from trifix.stages.predict import Motion, follow, predict
from trifix.stages.triangulate import triangulate
from trifix.stages.update import found_map, update
from trifix.stages.verify import verify
from trifix.stages.verify_residual import verify_residual
from trifix.stages.weigh import NoiseScale, add_prior_noise, scale_points, weigh_matches, weigh_residuals


class Positioner:
    """Positions frames one after another, each by what was known at its time, and lets the map grow.

    With a map given, poses are in its coordinates; without one, the first frame with three points defines the world.
    """

    def __init__(
        self,
        config: Config | None = None,
        map: ReferenceMap | None = None,
        is_map_frozen: bool = False,
        is_noise_stated: bool = False,
    ) -> None:
        self.config = config or Config()
        self.map = map or ReferenceMap.empty()
        self.noise = NoiseScale()
        self._is_map_frozen = is_map_frozen
        self._is_noise_stated = is_noise_stated
        self._next_id = int(self.map.id.max(initial=-1)) + 1
        self._last_ns = -(1 << 63)
        self._motion: Motion | None = None
        self._identifier = identifier(self.config.identify)
        self._identifier.learn(self.map, np.zeros(0, dtype=np.int64))
        self._cameras = ThreadPoolExecutor(2, thread_name_prefix="camera")

    def run(self, frames: Iterable[Frame]) -> Iterator[Step]:
        """A Step for every frame, in order, as soon as it is judged."""
        if isinstance(frames, Recording):
            self._is_noise_stated = frames.is_noise_stated
        for frame in frames:
            yield self.step(frame)

    def step(self, frame: Frame) -> Step:
        """Judges one frame, and lets the map grow by it if it is positioned."""
        clock = Stopwatch()
        if frame.timestamp_ns < self._last_ns:
            frame = _reversed(frame, self._last_ns)
        self._last_ns = max(self._last_ns, frame.timestamp_ns)

        dots, matches, points = self._sense(frame, clock)
        identification, fix = self._position(frame, points, matches, clock)
        added = self._learn(frame, points, matches, fix, clock)
        return Step(
            frame=frame,
            dots=dots,
            matches=matches,
            points=points,
            identification=identification,
            fix=fix,
            added=added,
            map=self.map,
            noise_scale=self.noise.scale,
            timings_ms=clock.ms,
        )

    def _sense(
        self, frame: Frame, clock: "Stopwatch"
    ) -> tuple[StereoDots | None, StereoMatches | None, SensorPoints | None]:
        """Images to dots to pairs to points; each level of a recording enters at its own stage."""
        options = self.config
        content = frame.content
        if isinstance(content, StereoImages):
            with clock("detect"):
                find = partial(detect, options=options.detect)
                left, right = self._cameras.map(find, (content.left, content.right))
            content = StereoDots(add_prior_noise(left, options.noise), add_prior_noise(right, options.noise))
        match content:
            case StereoDots():
                assert frame.rig is not None, "dots come with the rig that saw them"
                with clock("match"):
                    matches = match(content, frame.rig, options.match, self.noise.scale)
                    if not self.noise.is_known:
                        self._weigh(matches)
                with clock("triangulate"):
                    points = triangulate(content, matches, frame.rig, self.noise.scale)
                return content, matches, points
            case SensorPoints():
                return None, None, scale_points(content, self.noise)
            case Unusable():
                return None, None, None
            case _:
                assert_never(content)

    def _position(
        self, frame: Frame, points: SensorPoints | None, matches: StereoMatches | None, clock: "Stopwatch"
    ) -> tuple[Identification | None, Fix | NoFix]:
        """Points to hypotheses to poses to the one that is proven."""
        if points is None:
            assert isinstance(frame.content, Unusable)
            return None, NoFix(frame.content.reason, frame.content.detail)
        if len(points) < 3:
            return None, NoFix(Reason.too_few_points, f"{len(points)} points.")
        if len(self.map) == 0:
            return None, _define_world(points)
        best, tried = NoFix(Reason.no_candidate), 0
        prediction = predict(self._motion, frame.timestamp_ns, self.config.predict)
        last_pose = self._motion.newest if self._motion else None
        portions = self._identifier.identify(points, self.map, last_pose)
        identification = None
        while best.why in (Reason.no_candidate, Reason.not_proven, Reason.residual):
            with clock("identify"):
                portion = next(portions, None)
            if portion is None:
                break
            identification = portion
            with clock("orient"):
                orientations = orient(points, self.map, identification)
            with clock("verify"):
                fix = self._verify(points, matches, identification, orientations, tried, prediction)
            if isinstance(fix, Fix):
                return identification, fix
            if fix.why is not Reason.no_candidate:
                best = fix
            tried += len(identification)
        return identification, best

    def _verify(
        self,
        points: SensorPoints,
        matches: StereoMatches | None,
        identification: Identification,
        orientations: Orientations,
        tried: float,
        prediction: Prediction | None,
    ) -> Fix | NoFix:
        """Poses to the one that is proven, by the method that the options name."""
        options = self.config.verify
        match options.method:
            case "probability":
                return verify(points, self.map, identification, orientations, matches, tried, prediction, options)
            case "residual":
                return verify_residual(points, self.map, orientations, options.counterpart_mm, options.max_residual_mm)
            case _:
                assert_never(options.method)

    def _learn(
        self,
        frame: Frame,
        points: SensorPoints | None,
        matches: StereoMatches | None,
        fix: Fix | NoFix,
        clock: "Stopwatch",
    ) -> np.ndarray:
        """A fix to a better map; returns the rows of the targets that are new."""
        none = np.zeros(0, dtype=np.int64)
        if points is None or isinstance(fix, NoFix):
            return none
        self._motion = follow(self._motion, frame.timestamp_ns, fix.T_world_sensor)
        if matches is None:
            self.noise = weigh_residuals(self.noise, points, self.map, fix, self._is_noise_stated, self.config.noise)
        elif fix.reason is not PositionedReason.defines_world:
            self._weigh(matches.rows(points.match[fix.point]))
        if self._is_map_frozen:
            self._identifier.learn(self.map, fix.target)
            return none
        with clock("update"):
            if fix.reason is PositionedReason.defines_world:
                self.map, added = found_map(points, frame.index)
            else:
                self.map, added = update(
                    self.map, points, matches, fix, frame.index, frame.rig, self._next_id, self.config.update
                )
            self._next_id += len(added)
            self._identifier.learn(self.map, np.unique(np.concatenate([fix.target, added])))
        return added

    def _weigh(self, matches: StereoMatches) -> None:
        """Epipolar residuals to the recording's noise: those of identified points, or all before anything is known."""
        options = self.config
        self.noise = weigh_matches(
            self.noise, matches, options.match.max_epipolar_sigmas, self._is_noise_stated, options.noise
        )


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """A whole recording, positioned."""

    frame: Int[np.ndarray, "n"]
    """Numbers of the frames."""
    timestamp_ns: Int[np.ndarray, "n"]
    """Their times (ns)."""
    fixes: tuple[Fix | NoFix, ...]
    """The answer for each of them."""
    map: ReferenceMap
    """The targets, as known in the end."""
    noise_scale: float
    """Factor on all standard deviations that the recording turned out to need."""


def position(
    recording: Recording | Path | str,
    config: Config | None = None,
    map: ReferenceMap | None = None,
    is_map_frozen: bool = False,
) -> Positions:
    """Every frame of a recording positioned, in one call.

    Raises:
        TrifixError: the recording cannot be read.
    """
    positioner = Positioner(config, map, is_map_frozen)
    if not isinstance(recording, Recording):
        recording = read_recording(Path(recording), sigma_px=positioner.config.noise.sigma_px)
    fixes = tuple(step.fix for step in positioner.run(recording))
    return Positions(recording.index, recording.timestamp_ns, fixes, positioner.map.copy(), positioner.noise.scale)


class Stopwatch:
    """Milliseconds per stage."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Times what happens inside."""
        start = perf_counter()
        yield
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (perf_counter() - start)


def _define_world(points: SensorPoints) -> Fix | NoFix:
    """The first frame is where the world begins, if its points could ever be recognised."""
    if spread_off_line_mm(points.xyz_mm) < 3.0:
        return NoFix(Reason.weak_geometry, "The points lie on one line.")
    rows = np.arange(len(points))
    return Fix(
        T_world_sensor=Pose.identity(),
        cov=np.zeros((6, 6)),
        point=rows,
        target=rows,
        residual_mm=np.zeros(len(points)),
        p_chance=float("nan"),
        reason=PositionedReason.defines_world,
    )


def _reversed(frame: Frame, last_ns: int) -> Frame:
    """The same frame, refused because it is older than one already judged."""
    detail = f"It was taken at {frame.timestamp_ns} ns, after one of {last_ns} ns."
    return Frame(frame.index, frame.timestamp_ns, frame.rig, Unusable(Reason.time_reversed, detail))
