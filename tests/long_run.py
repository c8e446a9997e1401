"""A run of many frames, which prints how much memory it holds (MB) after every thousand."""

import sys
from pathlib import Path

import numpy as np

from constellations import looking, scattered, seen_points
from trifix import Frame, Live, Positioner, Report, ResultsWriter, Step
from trifix.geometry.pose import Pose
from trifix.live import Rates
from trifix.outputs.history import Thinned

PAGE_MB = 4096 / 1e6


def main(out: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    world, start = scattered(rng, 12), looking(rng)
    clip = []
    for k in range(200):
        a = 2 * np.pi * k / 200
        clip.append(
            seen_points(world, start @ Pose.exp(np.array([20 * np.sin(a), 0, 0, 0, 0.1 * np.sin(2 * a), 0])), rng)
        )
    Thinned.most = 500  # what is remembered of single frames is full before memory is compared
    report = Report()
    with ResultsWriter(out, "long", "points", "", is_online=True) as results:

        def watch(body: str, step: Step, rates: Rates) -> None:
            results.write(step, rates.dropped)
            report.show(step)
            if (step.frame.index + 1) % 1000 == 0:
                held = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_MB
                print(step.frame.index + 1, held, flush=True)

        live = Live({"": Positioner(is_noise_stated=True)}, [watch], is_lossless=True)
        for k in range(count):
            live.push(Frame(k, 50_000_000 * k, None, clip[k % len(clip)]))
        live.stop()
        live.wait()
        results.finish()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
