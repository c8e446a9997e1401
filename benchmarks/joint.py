"""What the joint covariance costs a frame, and how much of it is the arithmetic.

Run: python benchmarks/joint.py --targets 118 900

A sensor goes there and back along a strip of targets and sees 25 of them at a time. Told are milliseconds:
a pose settled, and a map that has learnt; the median and the 99th percentile over the frames.
"""

from time import perf_counter
from typing import Annotated

import cyclopts
import numpy as np

from trifix.geometry.pose import Pose
from trifix.joint import JointMap
from trifix.kernels import joint as kernels
from trifix.records import Fix, ReferenceMap, SensorPoints

SEEN = 25
APART_MM = 12.0
SIGMA_MM = 0.05


def main(*, targets: Annotated[tuple[int, ...], cyclopts.Parameter(consume_multiple=True)] = (118, 900)) -> None:
    """Print a line for each number of targets."""
    kernels.warm_up()
    for n in targets:
        settling, learning, held = walk(n, np.random.default_rng(n))
        told = ", ".join(
            f"{name} {np.median(ms):.2f} ms (99 %: {np.quantile(ms, 0.99):.2f})"
            for name, ms in (("settle", settling), ("learn", learning))
        )
        print(f"{n} targets: {told}; covariance of {held} unknowns")


def walk(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int]:
    """Milliseconds of each frame for a settled pose and for a lesson, and how many rows the covariance has."""
    xyz = np.stack([APART_MM * np.arange(n), rng.uniform(-100, 100, n), rng.uniform(430, 470, n)], axis=1)
    joint = JointMap(100)
    map = ReferenceMap.given(np.zeros((0, 3)))
    settling, learning = [], []
    way = np.arange(0, n - SEEN, 2)
    for first in [*way, *way[::-1]]:
        rows = np.arange(first, first + SEEN)
        T = Pose(np.eye(3), np.array([APART_MM * first, 0.0, 0.0]))
        seen = T.inverse().apply(xyz[rows]) + SIGMA_MM * rng.normal(size=(SEEN, 3))
        none = np.full(SEEN, -1)
        points = SensorPoints(seen, np.tile(SIGMA_MM**2 * np.eye(3), (SEEN, 1, 1)), none, none, np.arange(SEEN))
        known = np.flatnonzero(rows < len(map))
        if len(map) == 0:
            map = ReferenceMap.given(seen.copy(), points.cov_mm2.copy())
            joint.adopt(map, rows)
            continue
        fix = Fix(T, np.eye(6), known, rows[known], np.zeros(len(known)), 0.0)
        start = perf_counter()
        joint.settle(map, points, fix)
        middle = perf_counter()
        knowledge = joint.learn(map, points, fix)
        new = np.setdiff1d(np.arange(SEEN), known)
        if len(new):
            places = np.vstack([map.xyz_mm, knowledge.T_world_sensor.apply(seen[new])])
            map = ReferenceMap.given(places)
            joint.enter(map, points, new, rows[new], knowledge)
        end = perf_counter()
        settling.append(1e3 * (middle - start))
        learning.append(1e3 * (end - middle))
    return np.array(settling), np.array(learning), joint.unknowns


if __name__ == "__main__":
    cyclopts.run(main)
