"""Recordings played as if they happened, by a clock of the test's own."""

import math
from pathlib import Path

import numpy as np
import pytest

from trifix.files.recordings import Recording
from trifix.records import Frame, SensorPoints
from trifix.sources import replay
from trifix.sources.replay import Replay


class Clock:
    """Time that passes only when it is waited for."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> bool:
        self.now_s += seconds
        return False


def played(
    monkeypatch: pytest.MonkeyPatch, speed: float, reading_s: float, count: int = 6
) -> tuple[list[tuple[int, float]], int]:
    """Frames of 0.1 s in the order played, when each came, and how many were left out."""
    clock = Clock()
    nothing = np.zeros((0, 3))

    def content(k: int, rig: object) -> SensorPoints:
        clock.now_s += reading_s
        return SensorPoints(nothing, np.zeros((0, 3, 3)), *(np.zeros(0, dtype=np.int64),) * 3)

    stamps = 7_000_000_000 + 100_000_000 * np.arange(count)
    recording = Recording(Path("made"), "points", np.arange(count), stamps, True, None, {}, content)
    monkeypatch.setattr(replay.time, "monotonic", clock.monotonic)
    source = Replay(recording, speed)
    monkeypatch.setattr(source._closed, "wait", clock.wait)
    came: list[tuple[int, float]] = []
    for frame in source:
        assert isinstance(frame, Frame)
        came.append((frame.index, clock.now_s - 100.0))
    return came, source.dropped


@pytest.mark.parametrize(("speed", "step_s"), [(1.0, 0.1), (4.0, 0.025), (0.5, 0.2)])
def test_frames_come_when_they_are_due(monkeypatch: pytest.MonkeyPatch, speed: float, step_s: float) -> None:
    came, dropped = played(monkeypatch, speed, reading_s=0.0)
    assert [index for index, _ in came] == list(range(6))
    np.testing.assert_allclose([at for _, at in came], step_s * np.arange(6), atol=1e-9)
    assert dropped == 0


def test_frames_that_cannot_be_read_in_time_are_left_out_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    came, dropped = played(monkeypatch, 1.0, reading_s=0.15)
    assert [index for index, _ in came] == [0, 1, 3, 4, 5]
    assert dropped == 1


def test_at_any_speed_nothing_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    came, dropped = played(monkeypatch, math.inf, reading_s=0.15)
    assert [index for index, _ in came] == list(range(6))
    assert dropped == 0


def test_a_closed_replay_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = 100_000_000_000 * np.arange(3)
    points = SensorPoints(np.zeros((0, 3)), np.zeros((0, 3, 3)), *(np.zeros(0, dtype=np.int64),) * 3)
    recording = Recording(Path("made"), "points", np.arange(3), stamps, True, None, {}, lambda k, rig: points)
    source = Replay(recording)
    came = []
    for frame in source:
        came.append(frame.index)
        source.close()
    assert came == [0]
