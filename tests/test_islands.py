"""Frames that nothing connects to the map: islands, their joining, and the second look at a whole recording."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from constellations import frame_of, front_map, looking, scattered, seen_points
from trifix.config import Config, to_toml, with_overrides
from trifix.evaluation import compare_poses
from trifix.geometry.pose import Pose
from trifix.outputs.results import ResultsWriter
from trifix.positioner import Positioner
from trifix.records import Fix, Frame, NoFix, PositionedReason, Reason, Step


@pytest.fixture(scope="module")
def strip() -> np.ndarray:
    """Targets along a strip that is wider than the sensor sees."""
    return scattered(np.random.default_rng(3), 45, (500.0, 120.0, 50.0), apart_mm=15.0)


def visit(strip: np.ndarray, *places_mm: float, seed: int = 0, each: int = 6) -> Iterator[tuple[Frame, Pose]]:
    """Frames that see what lies within 100 mm of some places along the strip, with their true poses.

    There is a pause before each place, in which the sensor may have been carried anywhere.
    """
    rng = np.random.default_rng(seed)
    k = 0
    for place in places_mm:
        k += 100
        for _ in range(each):
            there = Pose(np.eye(3), np.array([place, 0.0, 0.0])) @ looking(rng, tilt_rad=0.2)
            near = strip[np.abs(strip[:, 0] - place) < 100]
            yield frame_of(k, seen_points(near, there, rng), rig=None), there
            k += 1


def run(frames: list[tuple[Frame, Pose]], config: Config | None = None) -> tuple[Positioner, list[Step]]:
    positioner = Positioner(config, is_noise_stated=True)
    return positioner, list(positioner.run(frame for frame, _ in frames))


def events(steps: list[Step]) -> list[str]:
    return [event.event for step in steps for event in step.events]


def worst_error_mm(steps: list[Step], frames: list[tuple[Frame, Pose]]) -> float:
    found = [
        (step.fix.T_world_sensor, truth)
        for step, (_, truth) in zip(steps, frames, strict=True)
        if isinstance(step.fix, Fix)
    ]
    return float(compare_poses([a for a, _ in found], [b for _, b in found]).error_mm.max())


def test_what_is_seen_apart_is_an_island_until_a_frame_connects_it(strip: np.ndarray) -> None:
    frames = list(visit(strip, -160.0, 160.0, -60.0, 20.0, 90.0, 160.0))
    positioner, steps = run(frames)
    on_island = [k for k, step in enumerate(steps) if isinstance(step.fix, NoFix) and step.elsewhere is not None]
    assert on_island[0] == 6, "the first frame of the second place"
    assert {steps[k].fix.why for k in on_island[1:6]} == {Reason.other_island}  # type: ignore[union-attr]
    assert "island_founded" in events(steps[6:7])
    assert "island_joined" in events(steps[7:])
    assert all(isinstance(step.fix, Fix) for step in steps[-6:]), "the second place again, now part of the world"
    assert worst_error_mm(steps, frames) < 1.0
    assert len(positioner.map.id) == len(np.unique(positioner.map.id))


def test_a_second_look_places_what_was_on_an_island(strip: np.ndarray) -> None:
    frames = list(visit(strip, -160.0, 160.0, -60.0, 20.0, 90.0, 160.0))
    positioner, steps = run(frames)
    revised = list(positioner.revise([step.remembered() for step in steps]))
    assert all(isinstance(step.fix, Fix) for step in revised)
    assert [step.frame.index for step in revised] == [frame.index for frame, _ in frames]
    assert worst_error_mm(revised, frames) < 1.0
    first = revised[0].fix
    assert isinstance(first, Fix)
    assert first.reason is PositionedReason.defines_world
    assert np.array_equal(first.T_world_sensor.t_mm, np.zeros(3))
    assert events(revised) == events(steps)


def test_an_island_that_nothing_connects_stays_one(strip: np.ndarray) -> None:
    frames = list(visit(strip, -160.0, 160.0))
    positioner, steps = run(frames)
    revised = list(positioner.revise([step.remembered() for step in steps]))
    for step in revised[7:]:
        assert isinstance(step.fix, NoFix)
        assert step.fix.why is Reason.other_island
        assert step.elsewhere is not None
        assert len(step.elsewhere.fix.point) > 3
    there = [
        (step.elsewhere.fix.T_world_sensor, truth)
        for step, (_, truth) in zip(steps, frames, strict=True)
        if step.elsewhere
    ]
    assert compare_poses([a for a, _ in there], [b for _, b in there]).error_mm.max() < 1.0


def test_the_island_of_most_frames_is_the_world_of_a_recording(strip: np.ndarray) -> None:
    frames = [*list(visit(strip, -160.0, 160.0, each=3))[:4], *visit(strip, 160.0, 160.0, seed=1)]
    frames = [(frame_of(k, frame.content, rig=None), truth) for k, (frame, truth) in enumerate(frames)]  # type: ignore[arg-type]
    positioner, steps = run(frames)
    assert isinstance(steps[0].fix, Fix), "online the world is where it began"
    revised = list(positioner.revise([step.remembered() for step in steps]))
    assert not any(isinstance(step.fix, Fix) for step in revised[:3])
    assert all(isinstance(step.fix, Fix) for step in revised[4:])


def test_without_islands_what_is_apart_is_lost(strip: np.ndarray) -> None:
    frames = list(visit(strip, -160.0, 160.0))
    _, steps = run(frames, with_overrides(Config(), {"islands.max_islands": "0"}))
    assert events(steps) == []
    assert all(step.elsewhere is None for step in steps)


def test_the_second_look_is_the_same_every_time(strip: np.ndarray) -> None:
    frames = list(visit(strip, -160.0, 160.0, 0.0))
    poses = []
    for _ in range(2):
        positioner, steps = run(frames)
        revised = positioner.revise([step.remembered() for step in steps])
        poses.append([step.fix.T_world_sensor.t_mm.tobytes() for step in revised if isinstance(step.fix, Fix)])
    assert poses[0] == poses[1]


def test_results_of_the_first_passage_stand_until_the_second_is_whole(strip: np.ndarray, tmp_path: Path) -> None:
    frames = list(visit(strip, -160.0, 160.0, -60.0, 20.0, 90.0, 160.0))
    positioner, steps = run(frames)
    out = tmp_path / "out"

    def positioned() -> int:
        return (out / "frames.csv").read_text().count(",positioned,")

    with ResultsWriter(out, "strip", "points", to_toml(Config()), is_online=False) as results:
        for step in steps:
            results.write(step)
        results.start_over()
        first = positioned()
        assert 0 < first < len(steps)
        assert (out / "islands" / "1" / "poses.csv").exists()
        for step in positioner.revise([step.remembered() for step in steps]):
            results.write(step)
        assert positioned() == first
        summary = results.finish()
    assert positioned() == len(steps) == summary.positioned
    assert len((out / "trajectory.tum").read_text().splitlines()) == len(steps)
    assert not (out / "islands").exists(), "all have joined"
    assert not (out / ".revised").exists()


def test_an_island_that_stays_has_a_folder_with_its_map(strip: np.ndarray, tmp_path: Path) -> None:
    positioner, steps = run(list(visit(strip, -160.0, 160.0)))
    out = tmp_path / "out"
    with ResultsWriter(out, "strip", "points", to_toml(Config()), is_online=False) as results:
        for step in steps:
            results.write(step)
        results.start_over()
        for step in positioner.revise([step.remembered() for step in steps]):
            results.write(step)
        results.finish()
    island = out / "islands" / "1"
    assert sorted(path.name for path in island.iterdir()) == ["map.csv", "poses.csv", "trajectory.tum"]
    assert len((island / "trajectory.tum").read_text().splitlines()) == 6


def test_a_frozen_map_has_no_islands(strip: np.ndarray) -> None:
    known = strip[strip[:, 0] < 0]
    frames = list(visit(strip, -160.0, 160.0, -20.0, 160.0))
    positioner = Positioner(map=front_map(known), is_map_frozen=True, is_noise_stated=True)
    steps = list(positioner.run(frame for frame, _ in frames))
    revised = list(positioner.revise([step.remembered() for step in steps]))
    assert events(steps) == []
    assert len(positioner.map) == len(known)
    for step in revised[6:12]:
        assert isinstance(step.fix, NoFix)
        assert step.fix.why in (Reason.no_candidate, Reason.not_proven)
