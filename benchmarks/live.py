"""A live run of 1280 x 1024 stereo with 30 targets: frames per second, and time from push to pose.

Run: python benchmarks/live.py

Compared with the barest loop that could be part of it, in turns in the same run: decode both images, adaptiveThreshold,
findContours. Each frame is had as JPEG, as many cameras send it, or decoded already; the frames go to and fro, so that
the sensor moves by a hand's speed for as long as the run lasts. What is compared at full speed leaves out no frame and
writes all results; the latency is measured at 60 frames/s, where frames that come too fast are left out.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import cv2
import cyclopts
import numpy as np
from detection import box_of, contours, coverage
from rich.console import Console
from rich.table import Table

from trifix import Camera, Fix, Frame, Live, Pose, Positioner, ResultsWriter, Step, StereoImages, StereoRig
from trifix.kernels import detection, index, joint, mapping, matching, positioning, stereo, tending
from trifix.live import Rates

WIDTH, HEIGHT = 1280, 1024
BLUR_PX, NOISE = 0.8, 2.0
GOAL_RATIO, GOAL_MS, GOAL_FPS = 2.5, 25.0, 60.0

Pair = tuple[np.ndarray, np.ndarray]


class Clip:
    """A source of frames: a clip that goes to and fro, at a pace or as fast as it is taken."""

    def __init__(self, pairs: Sequence[Pair], rig: StereoRig, frames: int, decode: bool, pace_s: float = 0.0) -> None:
        self.dropped = 0
        self.pushed_s: dict[int, float] = {}
        self._pairs, self._rig, self._frames, self._decode, self._pace_s = pairs, rig, frames, decode, pace_s

    def __iter__(self) -> Iterator[Frame]:
        start = time.monotonic()
        for k in range(self._frames):
            time.sleep(max(0.0, start + k * self._pace_s - time.monotonic()))
            left, right = to_and_fro(self._pairs, k)
            if self._decode:
                left, right = decoded(left), decoded(right)
            self.pushed_s[k] = time.perf_counter()
            yield Frame(k, round(k * 1e9 / 60), self._rig, StereoImages(left, right))

    def close(self) -> None: ...


def main(frames: int = 300, rounds: int = 3, targets: int = 30, clip: int = 60) -> None:
    """Measures and prints.

    Parameters
    ----------
    frames: of each measurement.
    rounds: of measurements in turns; the median counts.
    targets: in view of both cameras.
    clip: frames that are drawn.
    """
    for module in (detection, index, joint, mapping, matching, positioning, stereo, tending):
        module.warm_up()
    rig, pairs = drawn(targets, clip)
    coded = [tuple(cv2.imencode(".jpg", each, [cv2.IMWRITE_JPEG_QUALITY, 92])[1] for each in pair) for pair in pairs]
    table = Table(f"{targets} targets, 1280 x 1024 x 2", "bare", "trifix", "ratio")
    for name, clip_of, decode in (("JPEG", coded, True), ("decoded already", pairs, False)):
        bare, ours = [], []
        for _ in range(rounds):
            bare.append(1e3 * bare_s(clip_of, frames, decode))
            ours.append(1e3 * live_s(Clip(clip_of, rig, frames, decode)))
        ratio = median(a / b for a, b in zip(ours, bare, strict=True))
        table.add_row(f"{name}: ms a frame", *(f"{median(each):.1f}" for each in (bare, ours)), f"{ratio:.2f}")
        table.add_row(f"{name}: frames/s", *(f"{1e3 / median(each):.0f}" for each in (bare, ours)), "")
    Console().print(table)
    table = Table("at 60 frames/s", "judged/s", "dropped", "latency: median, ms", "99 %, ms", "positioned")
    for name, clip_of, decode in (("JPEG", coded, True), ("decoded already", pairs, False)):
        table.add_row(name, *paced(Clip(clip_of, rig, frames, decode, 1 / GOAL_FPS)))
    table.add_row("Positioner.push, one at a time", *pushed(pairs, rig, frames))
    Console().print(table)
    Console().print(f"wanted: ratio at most {GOAL_RATIO}, median latency below {GOAL_MS:g} ms, {GOAL_FPS:g} frames/s")


def bare_s(pairs: Sequence[Pair], frames: int, decode: bool) -> float:
    """Seconds a frame of the bare loop."""
    start = time.perf_counter()
    for k in range(frames):
        for image in to_and_fro(pairs, k):
            contours(decoded(image) if decode else image)
    return (time.perf_counter() - start) / frames


def live_s(clip: Clip) -> float:
    """Seconds a frame of a live run that leaves out none, once it has begun."""
    judged: list[float] = []
    with TemporaryDirectory() as out, ResultsWriter(Path(out), "live", "images", "", is_online=True) as results:

        def watch(body: str, step: Step, rates: Rates) -> None:
            results.write(step, rates.dropped)
            judged.append(time.perf_counter())

        run(clip, watch, is_lossless=True)
    return (judged[-1] - judged[0]) / (len(judged) - 1)


def paced(clip: Clip) -> tuple[str, ...]:
    """What comes of frames at a camera's pace."""
    steps, latency_ms = list[bool](), list[float]()

    def watch(body: str, step: Step, rates: Rates) -> None:
        latency_ms.append(1e3 * (time.perf_counter() - clip.pushed_s[step.frame.index]))
        steps.append(isinstance(step.fix, Fix))

    live = run(clip, watch, is_lossless=False)
    return figures(latency_ms, live.rates.frames_per_s, live.rates.dropped, steps)


def pushed(pairs: Sequence[Pair], rig: StereoRig, frames: int) -> tuple[str, ...]:
    """What comes of frames that the user's own program pushes and waits for."""
    positioner, latency_ms, steps = Positioner(rig=rig), [], []
    for k in range(frames):
        start = time.perf_counter()
        step = positioner.push(*to_and_fro(pairs, k), round(k * 1e9 / 60))
        latency_ms.append(1e3 * (time.perf_counter() - start))
        steps.append(isinstance(step.fix, Fix))
    return figures(latency_ms, 1e3 / float(np.mean(latency_ms)), 0, steps)


def figures(latency_ms: Sequence[float], frames_per_s: float, dropped: int, steps: list[bool]) -> tuple[str, ...]:
    middle, most = np.percentile(latency_ms, [50, 99])
    return f"{frames_per_s:.1f}", f"{dropped}", f"{middle:.1f}", f"{most:.1f}", f"{sum(steps)} of {len(steps)}"


def run(clip: Clip, watch: Callable[[str, Step, Rates], None], is_lossless: bool) -> Live:
    live = Live({"": Positioner()}, [watch], is_lossless=is_lossless)
    live.follow(clip)
    live.wait()
    return live


def to_and_fro(pairs: Sequence[Pair], k: int) -> Pair:
    n = len(pairs) - 1
    return pairs[n - abs(n - k % (2 * n))]


def decoded(image: np.ndarray) -> np.ndarray:
    return cv2.imdecode(image, cv2.IMREAD_GRAYSCALE)


def drawn(targets: int, frames: int) -> tuple[StereoRig, list[Pair]]:
    """Images of a bumpy plate with dark dots, all in view, before which a hand carries the sensor."""
    rng = np.random.default_rng(3)
    camera = Camera(1400.0, 1400.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
    rig = StereoRig(camera, camera, Pose(np.eye(3), np.array([-80.0, 0.0, 0.0])))
    xyz = scattered(rng, targets)
    pairs = []
    for k in range(frames):
        a = k / 60
        motion = Pose.exp(np.array([0, 0, 0, 0.05 * np.sin(3 * a), 0.06 * np.sin(2 * a), 0.2 * np.sin(a)]))
        T_world_sensor = motion @ Pose(np.eye(3), np.array([25 * np.sin(2 * a), 20 * np.sin(3 * a), 10 * np.sin(a)]))
        seen = T_world_sensor.inverse().apply(xyz)
        in_right = rig.T_right_left.apply(seen)
        left, right = (image(rng, camera.project(each), 1400 * 3.5 / each[:, 2]) for each in (seen, in_right))
        pairs.append((left, right))
    return rig, pairs


def scattered(rng: np.random.Generator, targets: int) -> np.ndarray:
    """Places on the plate, none near another."""
    xy = np.zeros((0, 2))
    while len(xy) < targets:
        one = rng.uniform((-150, -150), (190, 150))
        if np.linalg.norm(xy - one, axis=1).min(initial=np.inf) > 28:
            xy = np.vstack([xy, one])
    return np.c_[xy, 650 + 30 * np.sin(xy[:, 0] / 60) * np.cos(xy[:, 1] / 50)]


def image(rng: np.random.Generator, uv: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    covered = np.zeros((HEIGHT, WIDTH))
    for (u, v), radius in zip(uv, radius_px, strict=True):
        box = box_of(u, v, radius, BLUR_PX, covered.shape)
        covered[box] += coverage(u, v, radius, 0.9 * radius, 0.3, BLUR_PX, box)
    grey = 180 - 150 * covered + NOISE * rng.standard_normal(covered.shape)
    return np.rint(grey).clip(0, 255).astype(np.uint8)


if __name__ == "__main__":
    cyclopts.run(main)
