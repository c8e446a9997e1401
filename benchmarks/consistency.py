"""Are the covariances of poses honest? Over many recordings of each scene, and one pose of each.

Run: python benchmarks/consistency.py WORK --seeds 40 --frames 60

All poses of a recording share the error of its first frame, so their squared normalised errors are not independent, and
the mean over one recording proves nothing. Here each recording, of a layout, path and noise of its own, gives one: that
of its last pose, T_first⁻¹ T_k against truth, no alignment. The sum over M recordings follows a chi-square law with 6 M
degrees of freedom if the covariances are honest. Where a cell holds two figures, they are online and offline, adjusted
together. *Map* is that of the adjusted targets, by their joint covariance, against T_first⁻¹ of their true places. What
is done stands as a line in WORK/consistency.jsonl: after an interrupt, the same command goes on where it was.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import cyclopts
import numpy as np
from scipy.special import chdtri

from trifix.bundle import adjust_steps
from trifix.positioner import Positioner
from trifix.records import Fix, PositionedReason, Step, TargetState
from trifix.sources.simulation import SCENES, Simulation, simulate_frames

Level = Literal["points", "dots"]
MANY = cyclopts.Parameter(consume_multiple=True)
PASSAGES = ("online", "offline")
NEAR_MM = 8.0  # from its true place, beyond which a target is none


def main(
    work: Path,
    /,
    *,
    seeds: int = 40,
    first_seed: int = 1000,
    frames: int = 60,
    scenes: Annotated[tuple[str, ...], MANY] = (),
    levels: Annotated[tuple[Level, ...], MANY] = ("points", "dots"),
) -> None:
    """Go through what is not done yet, and print the table of all that was asked for.

    Args:
        work: Folder that keeps what is done.
        seeds: Recordings of each scene at each level.
        first_seed: Seed of the first of them.
        frames: Frames of each recording.
        scenes: Names of scenes; without any, all.
        levels: Points, dots, or both.
    """
    work.mkdir(parents=True, exist_ok=True)
    file = work / "consistency.jsonl"
    text = file.read_text() if file.exists() else ""
    file.write_text(text[: text.rfind("\n") + 1])  # a line that was cut short is done again
    done = {(d["scene"], d["level"], d["seed"], d["frames"]): d for d in map(json.loads, file.read_text().splitlines())}
    rows = ["scene|level|recordings|NEES/dof|95 % limits|worst pose|map"]
    for scene in scenes or SCENES:
        for level in levels:
            found = []
            for seed in range(first_seed, first_seed + seeds):
                key = (scene, level, seed, min(frames, SCENES[scene].frames))
                if key not in done:
                    done[key] = dict(zip(("scene", "level", "seed", "frames"), key, strict=True)) | one(*key)
                    with file.open("a") as stream:
                        stream.write(json.dumps(done[key]) + "\n")
                found.append(done[key])
            rows.append(row(scene, level, found))
            print(rows[-1], file=sys.stderr, flush=True)
    head, *body = rows
    print("\n".join(f"|{each}|" for each in (head, "|".join(["---"] * len(head.split("|"))), *body)))


def one(scene: str, level: Level, seed: int, frames: int) -> dict[str, float | None]:
    """The squared normalised error of the last pose of a recording, by each passage; None without a pose."""
    simulation = simulate_frames(scene, seed, level, frames)
    positioner = Positioner(is_noise_stated=True)
    judged = [step.remembered() for step in positioner.run(simulation.frames)]
    adjusted, _ = adjust_steps(list(positioner.revise(judged)), is_noise_stated=True)
    found = dict(zip(PASSAGES, (last_error2(steps, simulation) for steps in (judged, adjusted)), strict=True))
    return found | {"map": map_error2(adjusted, simulation)}


def map_error2(steps: Sequence[Step], simulation: Simulation) -> float | None:
    """eᵀ C⁻¹ e a degree of freedom of all trusted targets, e against their true places; None without an adjustment."""
    map, first = steps[-1].map, first_of(steps)
    if map.joint_mm2 is None or first is None:
        return None
    true_mm = simulation.truth.frames.T_map_sensor[first].inverse().apply(simulation.truth.targets.xyz_mm)
    trusted = np.flatnonzero(map.state == TargetState.trusted)
    distance = np.linalg.norm(map.xyz_mm[trusted][:, None] - true_mm, axis=2)
    is_there = distance.min(axis=1) < NEAR_MM
    rows = trusted[is_there]
    error = (map.xyz_mm[rows] - true_mm[distance.argmin(axis=1)[is_there]]).ravel()
    entries = (3 * rows[:, None] + np.arange(3)).ravel()
    return float(error @ np.linalg.solve(map.joint_mm2[np.ix_(entries, entries)], error)) / len(error)


def first_of(steps: Sequence[Step]) -> int | None:
    """Row of the step that defines the world."""
    fixes = ((row, step.fix) for row, step in enumerate(steps))
    return next((r for r, f in fixes if isinstance(f, Fix) and f.reason is PositionedReason.defines_world), None)


def last_error2(steps: Sequence[Step], simulation: Simulation) -> float | None:
    """δᵀ C⁻¹ δ of the last pose, δ against T_first⁻¹ T_k of the truth."""
    T_true = simulation.truth.frames.T_map_sensor
    poses = [(row, step.fix) for row, step in enumerate(steps) if isinstance(step.fix, Fix)]
    first = first_of(steps)
    if first is None or poses[-1][0] == first:
        return None
    row, fix = poses[-1]
    delta = (fix.T_world_sensor.inverse() @ T_true[first].inverse() @ T_true[row]).log()
    return float(delta @ np.linalg.solve(fix.cov, delta))


def row(scene: str, level: Level, found: list[dict[str, float | None]]) -> str:
    """Mean over the recordings, with the limits that an honest mean keeps in 95 % of cases."""
    values = {name: np.array([each[name] for each in found if each[name] is not None]) for name in PASSAGES}
    M = len(values["online"])
    if M == 0:
        return f"{scene}|{level}|0|–|–|–|–"
    low, high = (float(chdtri(6 * M, p)) / (6 * M) for p in (0.975, 0.025))
    means = " · ".join(
        f"{value.mean() / 6:.2f}" + ("" if low <= value.mean() / 6 <= high else " !") for value in values.values()
    )
    worst = " · ".join(f"{value.max() / 6:.1f}" for value in values.values())
    maps = [each["map"] for each in found if each["map"] is not None]
    of_map = f"{np.mean(maps):.2f}" if maps else "–"
    return f"{scene}|{level}|{M}|{means}|{low:.2f} to {high:.2f}|{worst}|{of_map}"


if __name__ == "__main__":
    cyclopts.run(main)
