"""How many frames of the simulated scenes are positioned, of those that can be, and how well.

Run: python benchmarks/scenes.py WORK --seeds 101 102 --frames 500
     python benchmarks/scenes.py WORK --outliers --seeds 101

Every scene at each level is gone through online, and its second passage makes the offline result. What is done stands
as a line in WORK/scenes.jsonl or WORK/outliers.jsonl: after an interrupt, the same command goes on where it was. After
a change of the program, name another folder. Where a cell holds two figures, they are online and offline.

With ``--outliers``, the map is given and frozen, a fifth of its targets 2 to 20 mm from where they are, and as many
points again as a frame has are ghosts. A frame can be solved if it shows four targets in their places, not on one line.
"""

import json
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import cyclopts
import numpy as np

from trifix import kernels
from trifix.config import Config, to_toml
from trifix.evaluation import LINE_RMS_MM, compare_poses, evaluate
from trifix.files.recordings import read_recording
from trifix.geometry.alignment import spread_off_line_mm
from trifix.outputs.results import ResultsWriter
from trifix.positioner import Positioner
from trifix.records import Fix, Frame, ReferenceMap, SensorPoints, Step
from trifix.sources.simulation import SCENES, Simulation, simulate, simulate_frames

Level = Literal["points", "dots"]
Line = dict[str, Any]
"""What came out of a part, as it stands in the file."""


MANY = cyclopts.Parameter(consume_multiple=True)


@dataclass(frozen=True)
class Part:
    """One recording to be made and positioned."""

    scene: str
    level: Level
    seed: int
    frames: int


def main(
    work: Path,
    /,
    *,
    seeds: Annotated[tuple[int, ...], MANY] = (101,),
    frames: int = 500,
    scenes: Annotated[tuple[str, ...], MANY] = (),
    levels: Annotated[tuple[Level, ...], MANY] = ("points", "dots"),
    outliers: bool = False,
) -> None:
    """Go through what is not done yet, and print the table of all that was asked for.

    Args:
        work: Folder that keeps what is done.
        seeds: Of the recordings; their figures are added up.
        frames: Frames of each recording, or as many as the scene has.
        scenes: Names of scenes; without any, all.
        levels: Points, dots, or both.
        outliers: Half of all points ghosts and a fifth of the map moved, at the level of points.
    """
    for name in scenes or SCENES:
        if name not in SCENES:
            sys.exit(f"There is no scene {name!r}; known are {', '.join(SCENES)}.")
    _warm_up()
    parts = [
        Part(scene, level, seed, min(frames, SCENES[scene].frames))
        for scene in scenes or SCENES
        for level in (("points",) if outliers else levels)
        for seed in seeds
    ]
    work.mkdir(parents=True, exist_ok=True)
    if outliers:
        print(outlier_table(_done(parts, work / "outliers.jsonl", outlier_part)))
    else:
        print(scene_table(_done(parts, work / "scenes.jsonl", lambda part: scene_part(part, work / "now"))))


def _warm_up() -> None:
    """Compiles everything, or the first frames would wait for it."""
    import pkgutil
    from importlib import import_module

    for module in pkgutil.iter_modules(kernels.__path__):
        import_module(f"{kernels.__name__}.{module.name}").warm_up()


def _done(parts: Sequence[Part], file: Path, do: Callable[[Part], Line]) -> list[Line]:
    """A line for each part, from the file or done now and added to it."""
    text = file.read_text() if file.exists() else ""
    whole = text[: text.rfind("\n") + 1]  # a line that was cut short is done again
    file.write_text(whole)
    lines = [json.loads(line) for line in whole.splitlines()]
    known = {tuple(line[each.name] for each in fields(Part)): line for line in lines}
    results = []
    for k, part in enumerate(parts, start=1):
        key = astuple(part)
        if key not in known:
            print(f"{k} of {len(parts)}: {part}", file=sys.stderr, flush=True)
            known[key] = asdict(part) | do(part)
            with file.open("a") as stream:
                stream.write(json.dumps(known[key]) + "\n")
        results.append(known[key])
    return results


# --- the scenes ------------------------------------------------------------------------------------------------------


def scene_part(part: Part, folder: Path) -> Line:
    """One recording made, positioned online and offline, and compared with its truth."""
    shutil.rmtree(folder, ignore_errors=True)
    simulate(part.scene, folder, part.level, part.seed, part.frames)
    recording = read_recording(folder / "recording")
    positioner, judged = Positioner(), list[Step]()

    def passage(name: str, steps: Iterable[Step]) -> Line:
        ms = []
        with ResultsWriter(folder / name, part.scene, part.level, to_toml(Config()), name == "online") as results:
            for step in steps:
                results.write(step)
                ms.append(sum(step.timings_ms.values()))
                if name == "online":
                    judged.append(step.remembered())
            results.finish()
        found = evaluate(folder / name, folder / "truth").to_dict()
        return {"evaluation": found, "frames_per_s": 1e3 / float(np.median(ms))}

    line = {
        "online": passage("online", positioner.run(recording)),
        "offline": passage("offline", positioner.revise(judged)),
    }
    shutil.rmtree(folder)
    return line


def scene_table(lines: Sequence[Line]) -> str:
    """A row for each scene and level."""
    rows = [
        "scene|level|online4|online3|offline of reachable|few points|misidentified|drifted|duplicates|NEES/dof|frames/s"
    ]
    for scene, level in dict.fromkeys((line["scene"], line["level"]) for line in lines):
        own = [line for line in lines if (line["scene"], line["level"]) == (scene, level)]
        online, offline = ([line[passage]["evaluation"] for line in own] for passage in ("online", "offline"))
        both = partial(_both, online, offline)

        cells = [
            scene,
            level,
            _share(online, "of_online4"),
            _share(online, "of_online3"),
            _share(offline, "of_reachable_offline"),
            both(lambda found: _share(found, "of_few")),
            both(lambda found: sum(len(each["misidentified"]) for each in found)),
            both(lambda found: sum(each["drifted"] for each in found)),
            both(lambda found: sum(each["duplicates"] for each in found)),
            both(_nees),
            f"{np.median([line['online']['frames_per_s'] for line in own]):.0f}",
        ]
        rows.append("|".join(cells))
    return _markdown(rows)


def _both(online: Sequence[Line], offline: Sequence[Line], figure: Callable[[Sequence[Line]], object]) -> str:
    return f"{figure(online)} · {figure(offline)}"


def _share(found: Sequence[Line], name: str) -> str:
    return _percent(sum(each[name]["count"] for each in found), sum(each[name]["of"] for each in found))


def _percent(count: int, of: int) -> str:
    return f"{count}/{of}" + (f" {100 * count / of:.1f} %" if of else "")


def _nees(found: Sequence[Line]) -> str:
    """The mean over the poses of all recordings."""
    known = [each["consistency"] for each in found if each["consistency"]["poses"]]
    poses = sum(each["poses"] for each in known)
    return f"{sum(each['mean'] * each['poses'] for each in known) / poses:.2f}" if poses else "–"


def _markdown(rows: Sequence[str]) -> str:
    head, *body = rows
    return "\n".join(f"|{row}|" for row in (head, "|".join(["---"] * len(head.split("|"))), *body))


# --- outliers --------------------------------------------------------------------------------------------------------


def outlier_part(part: Part) -> Line:
    """One recording among ghosts, positioned on a map that is wrong in places."""
    simulation = simulate_frames(part.scene, part.seed, "points", part.frames)
    rng = np.random.default_rng([part.seed, 1])
    map, is_moved = spoilt_map(simulation, rng)
    frames = [haunted(frame, simulation, rng) for frame in simulation.frames]
    positioner = Positioner(map=map, is_map_frozen=True, is_noise_stated=True)
    steps = [step.remembered() for step in positioner.run(frames)]
    fixes = {step.frame.index: step.fix.T_world_sensor for step in steps if isinstance(step.fix, Fix)}
    truth = simulation.truth
    errors = compare_poses(list(fixes.values()), [truth.frames.T_map_sensor[k] for k in fixes], is_map_given=True)
    solvable = [k for k, seen in enumerate(truth.seen_both) if _can_be_solved(truth.targets.xyz_mm[seen & ~is_moved])]
    return {
        "solvable": len(solvable),
        "positioned": len(set(solvable) & set(fixes)),
        "wrong": int(errors.is_wrong.sum()),
        "frames_per_s": 1e3 / float(np.median([sum(step.timings_ms.values()) for step in steps])),
    }


def spoilt_map(simulation: Simulation, rng: np.random.Generator) -> tuple[ReferenceMap, np.ndarray]:
    """The true targets, a fifth of them elsewhere, and which these are."""
    targets = simulation.truth.targets
    is_moved = np.zeros(len(targets), dtype=bool)
    is_moved[rng.permutation(len(targets))[: len(targets) // 5]] = True
    way = rng.standard_normal((len(targets), 3))
    way *= rng.uniform(2.0, 20.0, (len(targets), 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    return ReferenceMap.given(targets.xyz_mm + way * is_moved[:, None], view=targets.normal, id=targets.id), is_moved


def haunted(frame: Frame, simulation: Simulation, rng: np.random.Generator) -> Frame:
    """The frame with as many ghosts as it has points, anywhere in the left camera's view and in range."""
    points, scene = frame.content, simulation.scene
    assert isinstance(points, SensorPoints)
    n, camera = len(points), scene.rig.left
    slope = camera.unproject(rng.uniform(0, 1, (n, 2)) * [camera.width_px, camera.height_px] - 0.5)
    ghosts = np.c_[slope, np.ones(n)] * rng.uniform(*scene.sensing.depth_mm, (n, 1))
    order = rng.permutation(2 * n)
    none = np.full(2 * n, -1)
    content = SensorPoints(
        xyz_mm=np.concatenate([points.xyz_mm, ghosts])[order],
        cov_mm2=np.tile(points.cov_mm2, (2, 1, 1))[order],
        match=none,
        label=none,
        row=np.arange(2 * n),
    )
    return replace(frame, content=content)


def _can_be_solved(xyz_mm: np.ndarray) -> bool:
    return len(xyz_mm) >= 4 and spread_off_line_mm(xyz_mm) >= LINE_RMS_MM


def outlier_table(lines: Sequence[Line]) -> str:
    """A row for each scene."""
    rows = ["scene|positioned of solvable|wrong|frames/s"]
    for scene in dict.fromkeys(line["scene"] for line in lines):
        own = [line for line in lines if line["scene"] == scene]
        positioned, solvable, wrong = (sum(line[name] for line in own) for name in ("positioned", "solvable", "wrong"))
        fps = np.median([line["frames_per_s"] for line in own])
        rows.append(f"{scene}|{_percent(positioned, solvable)}|{wrong}|{fps:.0f}")
    return _markdown(rows)


if __name__ == "__main__":
    cyclopts.run(main)
