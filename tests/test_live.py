"""Live runs: what is kept and what is dropped, who may be slow, what is said, and how much memory an hour takes."""

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from constellations import PARALLEL, front_map, looking, scattered, seen_dots, seen_points
from trifix.errors import RecordingError
from trifix.geometry.pose import Pose
from trifix.live import Live, Queue, Rates, _Epipolar
from trifix.positioner import Found, Positioner
from trifix.records import Fix, Frame, NoFix, Reason, Step, StereoDots, StereoImages, Unusable

LONG_S = 60.0


class Given:
    """A source of frames that are there already."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.dropped = 0
        self._frames = frames

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def world() -> np.ndarray:
    return scattered(np.random.default_rng(0), 20)


@pytest.fixture(scope="module")
def frames(world: np.ndarray) -> list[Frame]:
    """Points, from a sensor that hardly moves."""
    rng = np.random.default_rng(1)
    start = looking(rng)
    poses = [start @ Pose.exp(np.array([2.0 * np.sin(k / 9), 0, 0, 0, 0.02 * np.sin(k / 7), 0])) for k in range(40)]
    points = [seen_points(world, pose, rng) for pose in poses]
    return [Frame(k, 50_000_000 * k, None, each) for k, each in enumerate(points)]


def judged(
    positioner: Positioner, frames: Sequence[Frame], watch: Callable[[str, Step, Rates], None] | None = None
) -> tuple[Live, list[Step]]:
    """A run without loss, when it is over."""
    steps: list[Step] = []
    watchers = [lambda body, step, rates: steps.append(step), *([watch] if watch else [])]
    live = Live({"": positioner}, watchers, is_lossless=True)
    live.follow(Given(frames))
    assert live.wait(LONG_S)
    return live, steps


# --- queues ----------------------------------------------------------------------------------------------------------


def test_the_latest_item_wins_and_the_others_are_counted() -> None:
    queue = Queue[int](2, is_lossless=False)
    assert all(queue.put(k) for k in range(7))
    queue.close()
    assert list(queue) == [5, 6]
    assert queue.dropped == 5


def test_a_lossless_queue_makes_who_fills_it_wait() -> None:
    queue = Queue[int](1, is_lossless=True)
    taken: list[int] = []
    reader = Thread(target=lambda: taken.extend(queue), daemon=True)
    reader.start()
    for k in range(500):
        queue.put(k)
    queue.close()
    reader.join(LONG_S)
    assert taken == list(range(500))
    assert queue.dropped == 0


@pytest.mark.parametrize("is_lossless", [False, True])
def test_a_closed_queue_takes_nothing_and_keeps_nobody_waiting(is_lossless: bool) -> None:
    queue = Queue[int](1, is_lossless)
    queue.put(1)
    answers: list[bool] = []
    if is_lossless:
        waiting = Thread(target=lambda: answers.append(queue.put(2)), daemon=True)
        waiting.start()
        queue.close()
        waiting.join(LONG_S)
        assert answers == [False]
    queue.close()
    assert not queue.put(3)
    assert list(queue) == [1]


# --- runs ------------------------------------------------------------------------------------------------------------


def test_a_lossless_run_judges_every_frame_as_the_loop_does(frames: list[Frame]) -> None:
    live, steps = judged(Positioner(is_noise_stated=True), frames)
    loop = Positioner(is_noise_stated=True)
    for step, frame in zip(steps, frames, strict=True):
        expected, found = loop.step(frame).fix, step.fix
        assert isinstance(expected, Fix)
        assert isinstance(found, Fix)
        assert found.T_world_sensor.t_mm.tobytes() == expected.T_world_sensor.t_mm.tobytes()
        assert found.cov.tobytes() == expected.cov.tobytes()
    assert live.rates.dropped == 0
    assert live.rates.frames_per_s > 0


def test_frames_that_come_too_fast_are_dropped_and_the_latest_is_judged(frames: list[Frame]) -> None:
    begun, goes_on, steps = Event(), Event(), list[Step]()

    def watch(body: str, step: Step, rates: Rates) -> None:
        steps.append(step)
        begun.set()
        assert goes_on.wait(LONG_S)

    live = Live({"": Positioner(is_noise_stated=True)}, [watch])
    live.push(frames[0])
    assert begun.wait(LONG_S)
    for frame in frames[1:]:
        assert live.push(frame)  # at once, though nothing is being judged
    live.stop()
    goes_on.set()
    assert live.wait(LONG_S)
    indices = [step.frame.index for step in steps]
    assert indices[0] == 0
    assert indices[-1] == 39
    assert indices == sorted(indices)
    assert len(steps) <= 5  # one in each queue and in each hand
    assert live.rates.dropped == 40 - len(steps)
    assert not live.push(frames[-1])


def test_what_is_inside_when_a_run_is_stopped_is_still_judged(frames: list[Frame]) -> None:
    steps: list[int] = []
    live = Live(
        {"": Positioner(is_noise_stated=True)}, [lambda body, step, rates: steps.append(step.frame.index)], None, True
    )
    for frame in frames[:9]:
        live.push(frame)
    live.stop()
    assert live.wait(LONG_S)
    assert steps == list(range(9))


def test_a_slow_viewer_holds_nobody_up_and_sees_the_latest(frames: list[Frame]) -> None:
    goes_on, seen = Event(), list[tuple[int, int]]()

    class Slow:
        def show(self, step: Step, rates: Rates) -> None:
            assert goes_on.wait(LONG_S)
            assert not np.shares_memory(step.map.xyz_mm, positioner.map.xyz_mm)
            seen.append((step.frame.index, rates.dropped))

    def watch(body: str, step: Step, rates: Rates) -> None:
        if step.frame.index == 39:
            goes_on.set()  # not before everything has been judged

    positioner = Positioner(is_noise_stated=True)
    live = Live({"": positioner}, [watch], {"": Slow()}, is_lossless=True)
    live.follow(Given(frames))
    assert live.wait(LONG_S)
    assert len(seen) <= 3
    assert seen[-1] == (39, 0)


def test_what_goes_wrong_where_results_go_ends_the_run_and_is_told(frames: list[Frame]) -> None:
    def fail(body: str, step: Step, rates: Rates) -> None:
        raise RecordingError("the disk is full.")

    live = Live({"": Positioner()}, [fail], is_lossless=True)
    live.follow(Given(frames))
    with pytest.raises(RecordingError, match="the disk is full"):
        live.wait(LONG_S)
    assert not live.push(frames[0])


def test_what_goes_wrong_in_a_viewer_is_told_when_all_is_judged(frames: list[Frame]) -> None:
    class Broken:
        def show(self, step: Step, rates: Rates) -> None:
            raise RuntimeError("the browser is gone")

    steps: list[Step] = []
    live = Live({"": Positioner()}, [lambda body, step, rates: steps.append(step)], {"": Broken()}, is_lossless=True)
    live.follow(Given(frames))
    with pytest.raises(RuntimeError, match="the browser is gone"):
        live.wait(LONG_S)
    assert len(steps) == len(frames)


def test_what_goes_wrong_in_a_source_is_told() -> None:
    class Broken(Given):
        def __iter__(self) -> Iterator[Frame]:
            raise OSError("no such camera")

    live = Live({"": Positioner()}, is_lossless=True)
    live.follow(Broken([]))
    with pytest.raises(OSError, match="no such camera"):
        list(iter(lambda: live.wait(0.05), True))


def test_each_of_two_bodies_has_a_fix_of_its_own() -> None:
    rng = np.random.default_rng(5)
    cup, table = (scattered(rng, 12, (120.0, 90.0, 40.0)) for _ in range(2))
    view = looking(rng, tilt_rad=0.2)
    maps = {"cup": front_map(cup), "table": front_map(table)}
    bodies = {name: Positioner(map=map, is_map_frozen=True, is_noise_stated=True) for name, map in maps.items()}
    found: dict[str, list[np.ndarray]] = {"cup": [], "table": []}
    live = Live(bodies, [lambda body, step, rates: found[body].append(told(step))], is_lossless=True)
    lift = Pose(np.eye(3), np.array([0.0, 130.0, 0.0]))  # of the table below the cup, and it is carried off
    for k in range(6):
        lift = Pose.exp(np.array([2.0, 0, 0, 0, 0, 0.01])) @ lift
        both = np.concatenate([cup, lift.apply(table)])
        live.push(Frame(k, 50_000_000 * k, None, seen_points(both, view, rng)))
    live.stop()
    assert live.wait(LONG_S)
    for name, expected in (("cup", view), ("table", lift.inverse() @ view)):
        assert len(found[name]) == 6
        last = expected.t_mm if name == "table" else view.t_mm
        assert np.linalg.norm(found[name][-1] - last) < 0.5
    assert np.linalg.norm(found["table"][0] - found["table"][-1]) > 5


def told(step: Step) -> np.ndarray:
    assert isinstance(step.fix, Fix), step.fix
    return step.fix.T_world_sensor.t_mm


# --- states ----------------------------------------------------------------------------------------------------------


def status_after(frames: Sequence[Frame]) -> tuple[str, str]:
    live, _ = judged(Positioner(is_noise_stated=True), frames)
    status = live.status("")
    return status.light, status.sentence


def test_the_light_says_what_became_of_the_newest_frame(frames: list[Frame]) -> None:
    live, _ = judged(Positioner(is_noise_stated=True), frames)
    status = live.status("")
    assert (status.light, status.sentence, status.points, status.matched) == ("green", "Positioned.", 20, 20)
    gone = Unusable(Reason.unreadable_image, "Left camera 0 is gone: is it plugged in?")
    assert status_after([*frames, replace(frames[-1], index=40, content=gone)]) == ("red", gone.detail)
    back = replace(frames[-1], index=41, timestamp_ns=frames[-1].timestamp_ns + 1)
    lost = replace(frames[-1], index=40, content=gone)
    assert status_after([*frames, lost, back]) == ("green", "Positioned.")


def test_silence_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live({"": Positioner()})
    assert live.status("").sentence == "No frame has come yet."
    live._judged_s.append(live._judged_s[-1] - 3.2)
    assert live.status("").light == "red"
    assert live.status("").sentence == "No frame for 3 s: is a camera unplugged, or its trigger off?"
    live.stop()
    assert live.wait(LONG_S)


@pytest.mark.parametrize("shift_px", [0.0, 0.35, 40.0])
def test_rising_epipolar_residuals_are_told_and_pass(world: np.ndarray, shift_px: float) -> None:
    rng = np.random.default_rng(2)
    view = Pose(np.eye(3), np.array([-50.0, 0.0, -470.0]))

    def seen(k: int, shift_px: float) -> Frame:
        dots = seen_dots(view.inverse().apply(world), rng, 0.1, PARALLEL)
        right = replace(dots.right, uv_px=dots.right.uv_px + [0.0, shift_px])
        return Frame(k, 50_000_000 * k, PARALLEL, StereoDots(dots.left, right))

    positioner, watch = Positioner(), _Epipolar()
    warnings = [watch.follow(positioner.step(seen(k, shift_px if 60 <= k < 90 else 0.0))) for k in range(150)]
    assert not any(warnings[:60])
    assert ("times as far from their epipolar lines" in warnings[89]) == (shift_px > 0)
    assert not any(warnings[140:])


# --- frames from the user's own program ------------------------------------------------------------------------------


def test_pushed_dots_and_points_are_judged_as_frames_are(world: np.ndarray, frames: list[Frame]) -> None:
    positioner, loop = Positioner(is_noise_stated=True), Positioner(is_noise_stated=True)
    for frame in frames[:5]:
        step = positioner.push_points(frame.content, frame.timestamp_ns)
        assert told(step).tobytes() == told(loop.step(frame)).tobytes()
        assert step.frame.index == frame.index
    rng = np.random.default_rng(2)
    positioner = Positioner(rig=PARALLEL)
    view = Pose(np.eye(3), np.array([-50.0, 0.0, -470.0]))
    for k in range(3):
        dots = seen_dots(view.inverse().apply(world), rng, 0.1, PARALLEL)
        step = positioner.push(dots.left, dots.right, 50_000_000 * k)
    assert np.linalg.norm(told(step)) < 0.5
    with pytest.raises(TypeError, match="Push two images or the dots of both"):
        positioner.push(dots.left, np.zeros((1024, 1280), dtype=np.uint8), 1_000_000_000)


def test_images_of_another_size_or_without_a_rig_are_refused_and_the_run_goes_on() -> None:
    image = np.full((1024, 1280), 90, dtype=np.uint8)
    step = Positioner().push(image, image, 0)
    assert isinstance(step.fix, NoFix)
    assert (step.fix.why, step.fix.detail) == (Reason.no_calibration, "Images came without a rig.")
    positioner = Positioner(rig=PARALLEL)
    step = positioner.push(image, image[:, :1000], 0)
    assert isinstance(step.fix, NoFix)
    assert step.fix.why is Reason.unreadable_image
    assert step.fix.detail == "The right image is 1000 x 1024 pixels, its calibration is for 1280 x 1024."
    step = positioner.push(image, image, 1)
    assert isinstance(step.fix, NoFix)
    assert step.fix.why is Reason.too_few_points


def test_dots_that_are_not_finite_are_refused(world: np.ndarray) -> None:
    dots = seen_dots(world + [50.0, 0.0, 470.0], np.random.default_rng(0), 0.1, PARALLEL)
    uv = dots.right.uv_px.copy()
    uv[3, 1] = np.nan
    step = Positioner(rig=PARALLEL).push(dots.left, replace(dots.right, uv_px=uv), 0)
    assert isinstance(step.fix, NoFix)
    assert (step.fix.why, step.fix.detail) == (
        Reason.bad_points,
        "1 of 20 right dots are not finite, the first is dot 3.",
    )


@pytest.mark.parametrize("factor", [0.0, -1.0])
def test_dots_without_a_covariance_are_refused(world: np.ndarray, factor: float) -> None:
    dots = seen_dots(world + [50.0, 0.0, 470.0], np.random.default_rng(0), 0.1, PARALLEL)
    cov = dots.left.cov_px2.copy()
    cov[[2, 5]] *= factor
    step = Positioner(rig=PARALLEL, is_noise_stated=True).push(replace(dots.left, cov_px2=cov), dots.right, 0)
    assert isinstance(step.fix, NoFix)
    assert step.fix.why is Reason.bad_points
    assert "2 of 20 left dots have a covariance that is singular or negative, the first is dot 2." in step.fix.detail


def test_dots_found_ahead_are_the_dots_of_the_step() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(100, 110, (1024, 1280)).astype(np.uint8)
    image[500:512, 600:612] = 20
    frame = Frame(0, 0, PARALLEL, StereoImages(image, image))
    positioner = Positioner()
    found = positioner.find_dots(frame)
    assert isinstance(found, Found)
    step = positioner.step(frame, found)
    assert step.dots is found.dots
    assert step.timings_ms["detect"] == found.detect_ms
    assert step.frame.content is frame.content


# --- an hour ---------------------------------------------------------------------------------------------------------


def test_memory_is_flat_in_a_long_run(tmp_path: Path) -> None:
    """Five times as many frames, and no more memory; without the checks of every shape, which cost too much here."""
    program = Path(__file__).parent / "long_run.py"
    command = [sys.executable, program, tmp_path / "out", "5000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    at = {int(frame): float(megabytes) for frame, megabytes in (line.split() for line in done.stdout.splitlines())}
    assert at[5000] - at[1000] < 4.0, at
    assert len((tmp_path / "out" / "frames.csv").read_text().splitlines()) == 5001
