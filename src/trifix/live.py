"""Frames in, Steps out, as fast as they come: capture, detection, positioning and display, each in a thread of its own.

Bounded queues lie between them. Where frames come faster than they are judged, the latest one wins and the others are
counted; or, if none may be lost, whoever brings them waits. Nothing here grows with the frames. Knows neither cameras
nor files, and of those who watch only what to call.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import closing
from dataclasses import dataclass, replace
from statistics import median
from threading import Condition, Thread
from typing import Generic, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np

from trifix.positioner import Found, Positioner
from trifix.records import Fix, Frame, NoFix, Reason, Step

_WINDOW = 120  # frames over which rates are taken
_SILENCE_S = 1.0  # without a frame, after which something is wrong
_ROOM = 1  # frames between two threads
_USUAL_FRAMES = 30  # frames until it is known what epipolar residuals are usual
_RISEN = 2.0  # times the usual
_FAST, _SLOW = 0.1, 0.002  # weights of the newest frame
_FEW_DOTS = 3

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Rates:
    """How a live run keeps up."""

    frames_per_s: float
    """Frames judged per second, of late."""
    latency_ms: float
    """Median time from a frame's arrival to its pose, of late (ms)."""
    dropped: int
    """Frames left out so far, because later ones had come."""


@dataclass(frozen=True, slots=True)
class Status:
    """How it goes with one body, for whoever stands beside it."""

    light: Literal["green", "amber", "red"]
    """Positioned; positioned, but something is about to go wrong; not positioned."""
    sentence: str
    """The reason."""
    rates: Rates
    """How the run keeps up."""
    points: int
    """Points of the newest frame."""
    matched: int
    """Those of them that were identified."""


@runtime_checkable
class Source(Protocol):
    """Where frames come from."""

    @property
    def dropped(self) -> int:
        """Frames that the source itself has left out."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Frames, in order; waits for each until it is there."""
        ...

    def close(self) -> None:
        """No more frames, soon."""
        ...


@runtime_checkable
class Viewer(Protocol):
    """Who looks at Steps, perhaps slowly."""

    def show(self, step: Step, rates: Rates) -> None:
        """Look at a step."""
        ...


Watcher = Callable[[str, Step, Rates], None]
"""Is told of every step before the next one is judged: the name of the body, the step, and how the run keeps up."""


class Queue(Generic[T]):
    """A bounded queue between two threads, that may be closed at both ends."""

    def __init__(self, room: int, is_lossless: bool) -> None:
        self.dropped = 0
        """Items that had to make room for later ones."""
        self._items: deque[T] = deque()
        self._room, self._is_lossless = room, is_lossless
        self._is_closed = False
        self._changed = Condition()

    def put(self, item: T) -> bool:
        """Adds an item; if the queue is full, the oldest one goes, or this waits. False when the queue is closed."""
        with self._changed:
            if len(self._items) == self._room and not self._is_lossless and not self._is_closed:
                self._items.popleft()
                self.dropped += 1
            while len(self._items) == self._room and not self._is_closed:
                self._changed.wait()
            if not self._is_closed:
                self._items.append(item)
            self._changed.notify_all()
            return not self._is_closed

    def __iter__(self) -> Iterator[T]:
        """Waits for items and takes them out, until the queue is closed and empty."""
        while True:
            with self._changed:
                while not self._items and not self._is_closed:
                    self._changed.wait()
                if not self._items:
                    return
                item = self._items.popleft()
                self._changed.notify_all()
            yield item

    def close(self) -> None:
        """Nothing more goes in; what is inside may still be taken out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """A frame on its way."""

    frame: Frame
    came_s: float
    """When it came (s)."""
    found: Found | None = None


class Live:
    """A live run: one positioner a body, each of which judges every frame that is not left out.

    live = Live({"cup": positioner}, [lambda body, step, rates: results.write(step, rates.dropped)])
    live.follow(source)              # or live.push(frame), again and again
    while not live.wait(0.1):
        print(live.status("cup").sentence)

    ``is_lossless`` leaves out no frame: whoever pushes one waits until there is room. Viewers have threads of their own
    and see the latest step that they have time for.
    """

    def __init__(
        self,
        bodies: Mapping[str, Positioner],
        watchers: Sequence[Watcher] = (),
        viewers: Mapping[str, Viewer] | None = None,
        is_lossless: bool = False,
    ) -> None:
        self._bodies, self._watchers = dict(bodies), tuple(watchers)
        self._finder = next(iter(self._bodies.values()))  # the options are the same for all
        self._taken: Queue[_Taken] = Queue(_ROOM, is_lossless)
        self._found: Queue[_Taken] = Queue(_ROOM, is_lossless)
        self._source: Source | None = None
        self._judged_s: deque[float] = deque([time.monotonic()], maxlen=_WINDOW)
        self._latency_ms: deque[float] = deque(maxlen=_WINDOW)
        self._rates = Rates(0.0, float("nan"), 0)
        self._newest: dict[str, Status] = {
            name: Status("red", "No frame has come yet.", self._rates, 0, 0) for name in self._bodies
        }
        self._epipolar = {name: _Epipolar() for name in self._bodies}
        self._shown: dict[str, Queue[tuple[Step, Rates]]] = {name: Queue(1, False) for name in viewers or {}}
        self._entrance: Future[None] | None = None
        self._work = [_started(self._detect, "detect"), _started(self._position, "position")]
        self._views = [
            _started(_Showing(self._shown[name], viewer), "show") for name, viewer in (viewers or {}).items()
        ]

    def push(self, frame: Frame) -> bool:
        """Takes a frame in and returns at once, unless no frame may be lost; False when the run is over."""
        return self._taken.put(_Taken(frame, time.monotonic()))

    def follow(self, source: Source) -> None:
        """Takes in all frames of a source, in a thread of its own; the run ends with them."""
        self._source = source
        self._entrance = _started(self._capture, "capture")

    def stop(self) -> None:
        """Takes no more frames in; those that are inside are still judged."""
        if self._source is not None:
            self._source.close()
        self._taken.close()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Waits until the run is over, or for a time; True if it is over.

        A camera that does not answer is not waited for. Raises what went wrong in any thread; in a viewer's, last.
        """
        _, others = wait([*self._work, *self._views], timeout_s)
        failed = [
            each for each in (*self._work, self._entrance) if each is not None and each.done() and each.exception()
        ]
        if not others:
            failed += [each for each in self._views if each.exception()]
        if failed:
            self.stop()
            failed[0].result()
        return not others

    @property
    def rates(self) -> Rates:
        """How the run keeps up."""
        return replace(self._rates, dropped=self._dropped)

    def status(self, body: str) -> Status:
        """How it goes with a body."""
        silent_s = time.monotonic() - self._judged_s[-1]
        newest = replace(self._newest[body], rates=self.rates)
        if silent_s < _SILENCE_S:
            return newest
        sentence = f"No frame for {silent_s:.0f} s: is a camera unplugged, or its trigger off?"
        return Status("red", sentence, replace(newest.rates, frames_per_s=0.0), 0, 0)

    @property
    def _dropped(self) -> int:
        source = 0 if self._source is None else self._source.dropped
        return self._taken.dropped + self._found.dropped + source

    def _capture(self) -> None:
        assert self._source is not None
        with closing(self._taken):
            for frame in self._source:
                if not self.push(frame):
                    break

    def _detect(self) -> None:
        with closing(self._taken), closing(self._found):
            for taken in self._taken:
                self._found.put(replace(taken, found=self._finder.find_dots(taken.frame)))

    def _position(self) -> None:
        queues: list[Queue[_Taken] | Queue[tuple[Step, Rates]]] = [self._taken, self._found, *self._shown.values()]
        try:
            for taken in self._found:
                for body, positioner in self._bodies.items():
                    self._tell(body, positioner.step(taken.frame, taken.found), taken.came_s)
                self._judged_s.append(time.monotonic())
        finally:
            for queue in queues:
                queue.close()

    def _tell(self, body: str, step: Step, came_s: float) -> None:
        now_s = time.monotonic()
        self._latency_ms.append(1e3 * (now_s - came_s))
        elapsed_s = now_s - self._judged_s[0]
        frames_per_s = len(self._judged_s) / elapsed_s if elapsed_s > 0 else 0.0
        self._rates = rates = Rates(frames_per_s, median(self._latency_ms), self._dropped)
        for watch in self._watchers:
            watch(body, step, rates)
        self._newest[body] = _status(step, rates, self._epipolar[body].follow(step))
        if body in self._shown:
            self._shown[body].put((_apart(step), rates))


def _status(step: Step, rates: Rates, warning: str) -> Status:
    points = 0 if step.points is None else len(step.points)
    match step.fix:
        case Fix() as fix:
            sentence = warning or ("Positioned." if fix.reason is None else f"Positioned. {fix.reason.value}")
            return Status("amber" if warning else "green", sentence, rates, points, len(fix.point))
        case NoFix() as refusal:
            sentence = " ".join(filter(None, (_why(refusal), warning)))
            return Status("red", sentence, rates, points, refusal.matched)


def _why(refusal: NoFix) -> str:
    """What was found of a frame that could not be had says more than the reason's own sentence."""
    if refusal.why in (Reason.unreadable_image, Reason.no_calibration, Reason.bad_points) and refusal.detail:
        return refusal.detail
    return refusal.why.value


def _apart(step: Step) -> Step:
    """The same step, whose maps no longer change with the positioner's."""
    elsewhere = step.elsewhere
    if elsewhere is not None:
        elsewhere = replace(elsewhere, map=elsewhere.map.copy())
    return replace(step, map=step.map.copy(), elsewhere=elsewhere)


class _Epipolar:
    """Whether pairs of dots lie farther from their epipolar lines than they used to.

    Cameras that expose at different moments, or a rig that was bent, show by that first.
    """

    def __init__(self) -> None:
        self._frames = 0
        self._usual = self._now = 0.0

    def follow(self, step: Step) -> str:
        """A warning after one more frame; empty if there is nothing to warn of."""
        if step.matches is None or step.dots is None:
            return ""
        if len(step.matches):
            residual = float(np.median(np.abs(step.matches.epipolar_px) / step.matches.epipolar_sigma_px))
        elif min(len(step.dots.left), len(step.dots.right)) >= _FEW_DOTS:
            residual = 2 * _RISEN * self._usual  # beyond what is taken for a pair
        else:
            return ""
        self._frames += 1
        if self._frames <= _USUAL_FRAMES:
            self._usual += (residual - self._usual) / self._frames
            self._now = self._usual
            return ""
        self._now += _FAST * (residual - self._now)
        if self._now <= _RISEN * self._usual:
            self._usual += _SLOW * (residual - self._usual)
            return ""
        return (
            f"Dots lie {self._now / self._usual:.1f} times as far from their epipolar lines as before: are the cameras "
            f"synchronised, is the rig bent?"
        )


class _Showing:
    """What a viewer's thread does."""

    def __init__(self, steps: Queue[tuple[Step, Rates]], viewer: Viewer) -> None:
        self._steps, self._viewer = steps, viewer

    def __call__(self) -> None:
        for step, rates in self._steps:
            self._viewer.show(step, rates)


def _started(work: Callable[[], None], name: str) -> "Future[None]":
    """Work that goes on in a thread, which does not keep the program from ending; and what will come of it."""
    done: Future[None] = Future()

    def run() -> None:
        try:
            work()
        except BaseException as error:  # whoever waits is told
            done.set_exception(error)
        else:
            done.set_result(None)

    Thread(target=run, name=name, daemon=True).start()
    return done
