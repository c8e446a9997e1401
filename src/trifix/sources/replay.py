"""A recording that plays as if its cameras were there: at its own pace, or any other. Knows no stage."""

import math
import time
from collections.abc import Iterator
from threading import Event

from trifix.files.recordings import Recording
from trifix.records import Frame


class Replay:
    """The frames of a recording when they are due; with an infinite speed, whenever the next one is asked for.

    A frame whose successor is due already, because reading takes too long, is left out and counted.
    """

    def __init__(self, recording: Recording, speed: float = 1.0) -> None:
        self.dropped = 0
        self._recording, self._speed = recording, speed
        self._closed = Event()

    def __iter__(self) -> Iterator[Frame]:
        due_s = 1e-9 * (self._recording.timestamp_ns - self._recording.timestamp_ns[0]) / self._speed
        start_s, last = time.monotonic(), len(due_s) - 1
        for k in range(len(due_s)):
            if math.isfinite(self._speed):
                since_s = time.monotonic() - start_s
                if k < last and due_s[k + 1] < since_s:
                    self.dropped += 1
                    continue
                self._closed.wait(max(0.0, due_s[k] - since_s))
            if self._closed.is_set():
                return
            yield self._recording.frame(k)

    def close(self) -> None:
        """No more frames."""
        self._closed.set()
