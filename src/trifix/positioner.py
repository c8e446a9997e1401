"""The loop: one stereo frame in, one Step out. The whole algorithm on this page, in the order of the work.

It does not know where frames come from nor who is watching.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import assert_never

import numpy as np

from trifix.config import Config
from trifix.doors import checked_map, in_order, with_usable_dots, with_usable_images, with_usable_points
from trifix.errors import MapError
from trifix.files.recordings import Recording
from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import Pose
from trifix.island import FEW_POINTS, NOTHING, Island, Stopwatch, define_world
from trifix.noise import Noise
from trifix.records import (
    Dots,
    Elsewhere,
    Event,
    Fix,
    Frame,
    GreyOrColour,
    Identification,
    NoFix,
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
from trifix.stages.detect import DetectOptions, detect
from trifix.stages.identify import Identifier
from trifix.stages.label import add_codes, add_hues
from trifix.stages.match import match
from trifix.stages.predict import across
from trifix.stages.triangulate import correct_eccentricity, triangulate
from trifix.stages.update import stored
from trifix.stages.verify import Evidence
from trifix.stages.weigh import add_prior_noise, scale_points

_HERE_PERHAPS = 1e-3  # no part of the object is new where what is known agrees so well
_COULD_BE_ELSEWHERE = (Reason.no_candidate, Reason.not_proven, Reason.out_of_time)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What was found in the images of a frame."""

    dots: StereoDots
    """The dots, with the noise to start from."""
    detect_ms: float
    """How long it took (ms)."""


class Positioner:
    """Positions frames one after another, each by what was known at its time, and lets the map grow.

    With a map given, poses are in its coordinates; without one, the first frame with three points defines the world.
    ``rig`` is that of the frames that are pushed; others bring their own.
    """

    def __init__(
        self,
        config: Config | None = None,
        map: ReferenceMap | None = None,
        is_map_frozen: bool = False,
        is_noise_stated: bool = False,
        rig: StereoRig | None = None,
    ) -> None:
        self.config = config or Config()
        self.rig = rig
        self.noise = Noise(self.config.noise, self.config.match.max_epipolar_sigmas, is_noise_stated)
        if is_map_frozen and (map is None or not map.alive.any()):
            raise MapError("A frozen map without targets was given: nothing could ever be found on it.")
        self._world = Island(0, self.config, stored(checked_map(map or ReferenceMap.empty())), is_map_frozen)
        self._next_id = int(self.map.id.max(initial=-1)) + 1
        self._last_ns = self._last_index = -(1 << 63)
        self._islands: list[Island] = []
        self._founded = 0
        self._joined: dict[int, int] = {}
        self._is_map_given = map is not None
        self._is_map_frozen = is_map_frozen
        self._cameras = ThreadPoolExecutor(2, thread_name_prefix="camera")

    @property
    def map(self) -> ReferenceMap:
        """The world's targets as they are known now; copy it to keep it."""
        return self._world.map

    def told_map(self) -> ReferenceMap:
        """The same targets with covariances in the world, the errors that all of them share included."""
        return self._world.told_map()

    @property
    def identifier(self) -> Identifier:
        """The matching technique, with its memory of the world."""
        return self._world.identifier

    def run(self, frames: Iterable[Frame]) -> Iterator[Step]:
        """A Step for every frame, in order, as soon as it is judged."""
        if isinstance(frames, Recording):
            self.noise.is_stated = frames.is_noise_stated
        for frame in frames:
            yield self.step(frame)

    def push(self, left: GreyOrColour | Dots, right: GreyOrColour | Dots, timestamp_ns: int) -> Step:
        """Judges what the two cameras saw at a time, images or dots; the rig is the one given at the beginning."""
        match left, right:
            case Dots(), Dots():
                return self._step_next(StereoDots(left, right), timestamp_ns)
            case np.ndarray(), np.ndarray():
                return self._step_next(StereoImages(left, right), timestamp_ns)
            case _:
                raise TypeError("Push two images or the dots of both, not one of each.")

    def push_points(self, points: SensorPoints, timestamp_ns: int) -> Step:
        """Judges points that were seen at a time."""
        return self._step_next(points, timestamp_ns)

    def _step_next(self, content: StereoImages | StereoDots | SensorPoints, timestamp_ns: int) -> Step:
        return self.step(Frame(max(self._last_index + 1, 0), timestamp_ns, self.rig, content))

    def find_dots(self, frame: Frame) -> Found | None:
        """The dots in the images of a frame, if it has images that can be used.

        Depends on no other frame: it may be called in another thread, for a frame that is yet to come.
        """
        content = frame.content
        if not isinstance(content, StereoImages) or with_usable_images(frame, content) is not frame:
            return None
        start = perf_counter()
        find = partial(_labelled_dots, options=self.config.detect)
        left, right = self._cameras.map(find, (content.left, content.right))
        dots = StereoDots(add_prior_noise(left, self.config.noise), add_prior_noise(right, self.config.noise))
        return Found(dots, 1e3 * (perf_counter() - start))

    def step(self, frame: Frame, found: Found | None = None) -> Step:
        """Judges one frame, and lets the map grow by it if it is positioned.

        ``found`` is what ``find_dots`` found in its images, if that has been done before.
        """
        frame = in_order(frame, self._last_ns, self._last_index)
        match frame.content:
            case SensorPoints():
                frame = with_usable_points(frame, frame.content)
            case StereoDots():
                frame = with_usable_dots(frame, frame.content)
            case StereoImages():
                frame = with_usable_images(frame, frame.content)
            case Unusable():
                pass
            case _:
                assert_never(frame.content)
        self._last_ns, self._last_index = max(self._last_ns, frame.timestamp_ns), max(self._last_index, frame.index)
        return self._judge(frame, learns=True, found=found)

    def _judge(self, frame: Frame, learns: bool, found: Found | None = None) -> Step:
        """The loop's body: sense, position, learn."""
        clock, events, added = Stopwatch(), list[Event](), NOTHING
        dots, matches, centres, points = self._sense(frame, found, clock)
        evidence = None if points is None else Evidence.of(points, matches, centres, frame.rig, self.noise.scale)
        island, identification, fix = self._position(frame, evidence, clock)
        there: Fix | None = fix if isinstance(fix, Fix) else None
        told = self._told(island, points, there, clock)
        if learns and points is not None and evidence is not None:
            if there is not None and island is not None:
                added = self._learn(frame, points, matches, island, there, clock)
                events += [Event("target_removed", int(each), "not seen again") for each in island.removed]
                events += island.events
            elif self._may_found(points, fix):
                island, there = self._found_island(frame, points)
                told = there
                events.append(Event("island_founded", None, f"island {island.number}, {len(points)} targets"))
            if there is not None and island is not None and (island is not self._world or len(added)):
                events += self._join_islands(frame, island, there, clock)
                if island.absorbed_by is not None:
                    island = island.absorbed_by
                    identification, placed = island.position(evidence, island.predicted(frame.timestamp_ns), clock)
                    there = placed if isinstance(placed, Fix) else None
                    fix = placed if island is self._world else fix
                    told = self._told(island, points, there, clock)
            if isinstance(fix, NoFix) and fix.weak is not None:
                self._take_weak(frame, points, matches, fix.weak, clock)
        elif there is not None and island is not None:
            island.follow(frame.timestamp_ns, there)
        elsewhere = None
        if island is not None and island is not self._world and told is not None:
            elsewhere, added = Elsewhere(island.number, told, island.map), NOTHING
            if isinstance(fix, Fix):
                fix = NoFix(Reason.other_island, f"It is on island {island.number}, of {len(island.map)} targets.")
        elif told is not None:
            fix = told
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
            events=tuple(events),
            timings_ms=clock.ms,
            elsewhere=elsewhere,
            centres=centres,
        )

    def _told(
        self, island: Island | None, points: SensorPoints | None, fix: Fix | None, clock: Stopwatch
    ) -> Fix | None:
        """The fix as it is told, with all that its map owes to its beginning."""
        if island is None or points is None or fix is None:
            return None
        with clock("update"):
            return island.told(points, fix)

    def _sense(
        self, frame: Frame, found: Found | None, clock: Stopwatch
    ) -> tuple[StereoDots | None, StereoMatches | None, StereoDots | None, SensorPoints | None]:
        """Images to dots to pairs to centres to points; each level of a recording enters at its own stage."""
        options = self.config
        content = frame.content
        if isinstance(content, StereoImages):
            found = found or self.find_dots(frame)
            assert found is not None, "frames are checked where they come in"
            content, clock.ms["detect"] = found.dots, found.detect_ms
        match content:
            case StereoDots():
                assert frame.rig is not None, "dots come with the rig that saw them"
                with clock("match"):
                    matches = match(content, frame.rig, options.match, self.noise.sought(content))
                    if not self.noise.is_settled:
                        self._rescale(self.noise.weigh_pairs(matches))
                with clock("triangulate"):
                    centres, scale = content, self.noise.scale
                    if options.triangulate.correct_eccentricity:
                        centres = correct_eccentricity(content, matches, frame.rig, scale)
                    points = triangulate(centres, matches, frame.rig, scale, options.triangulate)
                return content, matches, centres, points
            case SensorPoints():
                return None, None, None, scale_points(content, self.noise.found)
            case Unusable():
                return None, None, None, None
            case _:
                assert_never(content)

    def _position(
        self, frame: Frame, evidence: Evidence | None, clock: Stopwatch
    ) -> tuple[Island | None, Identification | None, Fix | NoFix]:
        """Where the frame was seen from: in the world, or else on the newest island that proves it."""
        if evidence is None:
            assert isinstance(frame.content, Unusable)
            return None, None, NoFix(frame.content.reason, frame.content.detail)
        points = evidence.points
        limit = self.config.identify.max_points
        if len(points) > limit:
            return None, None, NoFix(Reason.out_of_time, f"{len(points)} points, and at most {limit} are searched.")
        if len(self.map) == 0:
            fix = define_world(points)
            return (self._world if isinstance(fix, Fix) else None), None, fix
        identification, fix = self._world.position(evidence, self._world.predicted(frame.timestamp_ns), clock)
        if isinstance(fix, Fix):
            return self._world, identification, fix
        if fix.why in _COULD_BE_ELSEWHERE:
            for island in reversed(self._islands):
                there, elsewhere = island.position(evidence, island.predicted(frame.timestamp_ns), clock)
                if isinstance(elsewhere, Fix):
                    return island, there, elsewhere
        if len(points) < 3:
            fix = replace(fix, why=Reason.too_few_points, detail=f"{FEW_POINTS[len(points)]} {fix.detail}".strip())
        return None, identification, fix

    def _learn(
        self,
        frame: Frame,
        points: SensorPoints,
        matches: StereoMatches | None,
        island: Island,
        fix: Fix,
        clock: Stopwatch,
    ) -> np.ndarray:
        """A fix to a better map; returns the rows of the targets that are new."""
        self._rescale(self.noise.weigh(points, matches, island.map, fix))
        with clock("update"):
            added = island.learn(frame, points, matches, fix, self._next_id)
            self._next_id += len(added)
        return added

    def _take_weak(
        self, frame: Frame, points: SensorPoints, matches: StereoMatches | None, fix: Fix, clock: Stopwatch
    ) -> None:
        """What can be had from a fix that is too vague to be told: motion and noise, and as long as that is new, a map.

        Before the noise is known, it is taken for larger than it mostly is, and so is the pose's sigma.
        """
        if self.noise.is_settled:
            self._rescale(self.noise.weigh(points, matches, self.map, fix))
            self._world.follow(frame.timestamp_ns, fix)
        else:
            self._learn(frame, points, matches, self._world, fix, clock)

    def _may_found(self, points: SensorPoints, fix: Fix | NoFix) -> bool:
        """Whether a frame could belong to a part of the object that no map knows yet."""
        options = self.config.islands
        return (
            isinstance(fix, NoFix)
            and fix.why in _COULD_BE_ELSEWHERE
            and not fix.p_chance < _HERE_PERHAPS
            and options.max_islands > 0
            and not self._is_map_frozen
            and len(points) >= options.min_points
            and isinstance(define_world(points), Fix)
        )

    def _found_island(self, frame: Frame, points: SensorPoints) -> tuple[Island, Fix | None]:
        """A new map that begins with this frame; the smallest of the others makes room."""
        if len(self._islands) == self.config.islands.max_islands:
            self._islands.remove(min(self._islands, key=lambda island: island.frames))
        self._founded += 1
        link = self._world.predicted(frame.timestamp_ns)
        island = Island(self._founded, self.config, ReferenceMap.empty(), T_world_island=link)
        first = define_world(points)
        assert isinstance(first, Fix), "asked before"
        self._next_id += len(island.learn(frame, points, None, first, self._next_id))
        self._islands.append(island)
        return island, first

    def _join_islands(self, frame: Frame, island: Island, fix: Fix, clock: Stopwatch) -> list[Event]:
        """Maps become one as soon as common targets prove how they lie: the world takes in islands, large ones small.

        ``fix`` is that of the frame on ``island``, which may be the world. From where would each other map see what
        this one shows of the frame?
        """
        events: list[Event] = []
        for other in [self._world, *self._islands]:
            if other is island:
                continue
            T = fix.T_world_sensor
            there = other.bridge(island, T, self._expected(island, other, T), clock)
            if there is None:
                continue
            home, part, T_part_sensor, bridge = other, island, T, there
            if island is self._world or (other is not self._world and island.frames > other.frames):
                home, part, T_part_sensor = island, other, there.T_world_sensor
                back = island.bridge(other, T_part_sensor, self._expected(other, island, T_part_sensor), clock)
                if back is None:
                    continue
                bridge = back
            new = home.absorb(part, T_part_sensor, bridge, frame, self._next_id)
            self._next_id += new
            self._islands.remove(part)
            self._joined[part.number] = home.number
            at = "" if home is self._world else f" with island {home.number}"
            detail = f"island {part.number}{at}, {len(bridge.point)} common targets, {new} new"
            events.append(Event("island_joined", None, detail))
            if part is island:
                break
        return events

    def _expected(self, island: Island, other: Island, T_island_sensor: Pose) -> Prediction | None:
        """Where the sensor should be on another map, if one of the two is the world and the motion linked them."""
        if other is self._world and island.T_world_island is not None:
            return across(island.T_world_island, T_island_sensor, is_to_world=True)
        if island is self._world and other.T_world_island is not None:
            return across(other.T_world_island, T_island_sensor, is_to_world=False)
        return None

    def _rescale(self, ratio: float) -> None:
        """The noise scale has changed by a factor: what the maps owe to it follows."""
        if ratio != 1.0 and not self._is_map_given:
            for island in (self._world, *self._islands):
                island.rescale(ratio)

    def revise(self, steps: Sequence[Step]) -> Iterator[Step]:
        """Every frame again, by all that has become known since: what a recording allows and a live run does not.

        ``steps`` are those of the run, in order; ``Step.remembered`` is enough of each. Frames without a place are
        tried again backwards and forwards, and teach the map; then every frame is judged by the finished map. The
        island of most frames is the world, unless a map was given.
        """
        self._choose_world()
        placed = {k: step for k, step in enumerate(map(self._in_world, steps)) if step is not None}
        for backwards in (True, False):
            self._world.rest()
            for k in sorted(range(len(steps)), reverse=backwards):
                frame = steps[k].frame
                if backwards:  # time runs backwards, and so does the motion
                    frame = replace(frame, timestamp_ns=-frame.timestamp_ns)
                known = placed.get(k)
                if known is not None and isinstance(known.fix, Fix):
                    self._world.follow(frame.timestamp_ns, known.fix)
                    continue
                step = self._judge(frame, learns=False)
                if isinstance(step.fix, Fix):
                    if self._in_world(steps[k]) is None:  # the frames of an island that has joined have taught already
                        self._teach(step)
                    placed[k] = step.remembered()
        self._world.rest()
        for k, before in enumerate(steps):
            step = self._judge(before.frame, learns=False)
            earlier = placed.get(k, step)
            is_first = isinstance(earlier.fix, Fix) and earlier.fix.reason is PositionedReason.defines_world
            if (
                isinstance(earlier.fix, Fix)
                and earlier.points is not None
                and (is_first or isinstance(step.fix, NoFix))
            ):
                fix = earlier.fix.moved_to(earlier.map, self.map, earlier.points, earlier.centres, earlier.frame.rig)
                step = replace(earlier, fix=fix, map=self.map, elsewhere=None)
            yield replace(
                step, frame=before.frame, events=before.events, timings_ms=_sum(before.timings_ms, step.timings_ms)
            )

    def _teach(self, step: Step) -> None:
        """The world learns from a step that was judged without; islands may join by what it adds."""
        if step.points is not None and isinstance(step.fix, Fix):
            clock = Stopwatch()
            self._learn(step.frame, step.points, step.matches, self._world, step.fix, clock)
            self._join_islands(step.frame, self._world, step.fix, clock)

    def _choose_world(self) -> None:
        """The island of most frames is the world of a recording, unless a map was given."""
        largest = max(self._islands, key=lambda island: island.frames, default=self._world)
        if not self._is_map_given and largest.frames > self._world.frames:
            self._islands[self._islands.index(largest)] = self._world
            self._world = largest

    def _in_world(self, step: Step) -> Step | None:
        """The step, if the world's map has learnt from its frame; its fix is one in the world, if that is known."""
        if step.elsewhere is None:
            return step if isinstance(step.fix, Fix) and self._world.number == 0 else None
        if step.elsewhere.island == self._world.number:
            return replace(step, fix=step.elsewhere.fix, map=step.elsewhere.map)
        number = step.elsewhere.island
        while number in self._joined:
            number = self._joined[number]
        return step if number == self._world.number else None


def _labelled_dots(image: GreyOrColour, options: DetectOptions) -> Dots:
    """The dots of one image, with the labels that the options ask for."""
    dots = detect(image, options)
    if options.codes != "none":
        dots = add_codes(dots, image, options.codes)
    return add_hues(dots, image, options.hues_deg)


def _sum(first: dict[str, float], second: dict[str, float]) -> dict[str, float]:
    return {stage: first.get(stage, 0.0) + second.get(stage, 0.0) for stage in first | second}
