"""Frames made to mislead: is a fix ever wrong?

Run: python benchmarks/adversarial.py --out out/adversarial --frames 1000000 --jobs 2

Seven kinds of frames, at the level of points, each against maps of 30 to 1000 targets, judged by the whole step and
from nothing: no frame follows another in time. A run that was killed goes on; the same seed gives the same numbers.

- foreign: another object of the same make. Any fix is wrong.
- decoy: four to six points are congruent within noise to targets of another place of the map, at most 40 % of the
  frame; the others are of its own place, or foreign. In the second case nothing but the decoy is known: six points made
  to agree, at the rim of a map, are what a frame shows that has just left it, and no bound on chance can tell them
  apart. Such fixes are counted by themselves, as misled.
- mirrored: what a mirror shows of the object, flat ones among them. Any fix is wrong.
- grid: targets 0.05 to 3 mm off a square grid that reaches beyond the map, so that shifts nearly fit.
- scaled: the sensor's scale is off by 0.1 to 10 %.
- moved: some targets are 2 to 20 mm from where the map has them, each by itself or all together; most are in place.
- ghosts: points at random in the sensor's view. Any fix is wrong.

A fix is wrong if it is off by more than 3 mm or 0.5 degrees and by more than 5 sigma from the pose that the frame's
true labels give against the same map; where these are too nearly on a line, if one of its pairs is false. For the curve
of the threshold against right and wrong fixes, frames whose best candidate was not proven are judged a second time with
the threshold at (almost) one: that tells its pose, or that it would be refused for another reason at any threshold.

The power of the test: how often would the best candidate be wrong if residuals alone decided, with at least three
points and at most 0.6 mm (rms)? This is asked of the program's own candidates, in all frames: a lower bound of what
search for the smallest residual would do. Below 1000 per million the frames would mislead nobody.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import starmap
from pathlib import Path

import cyclopts
import matplotlib as mpl
import numpy as np
import shards
from made_frames import (
    MOST,
    Batch,
    World,
    in_sensor,
    looking_at,
    made_grid,
    made_world,
    measured,
    near_targets,
    seen,
    strays,
)
from rich.table import Table

from trifix import Config, Fix, NoFix, Positioner
from trifix.config import with_overrides
from trifix.records import Reason

RESIDUAL_MM, RESIDUAL_POINTS = 0.6, 3
POWER_PER_MILLION = 1000.0
DECADES = 41
"""p_chance is counted by decades, 1 to 0.1 first, 1e-40 and below last."""
OPEN = 1 - 1e-9
"""A threshold of p_chance that lets every candidate pass which is any better than chance."""
_TOLD_WRONG = 20  # wrong fixes of a shard that are noted one by one

Maker = Callable[[np.random.Generator, int], tuple[World, Batch]]


def main(
    out: Path = Path("out/adversarial"),
    frames: int = 2000,
    kinds: tuple[str, ...] = (),
    seed: int = 1,
    shard: int = 1000,
    jobs: int = 1,
    option: tuple[str, ...] = (),
) -> None:
    """Runs the frames and writes adversarial.json and adversarial.png.

    Parameters
    ----------
    out: folder of the run, which goes on if it has begun.
    frames: frames of each kind.
    kinds: only these kinds.
    seed: of all random numbers.
    shard: frames on one map; the unit in which a run goes on.
    jobs: processes.
    option: options of the program, such as verify.max_p_chance=1e-6.
    """
    config = with_overrides(Config(), dict(each.split("=", 1) for each in option))
    summary = measure(out, frames, kinds or tuple(KINDS), seed, shard, jobs, config)
    shards.console().print(table(summary))
    is_good = summary["wrong"] == 0 and summary["residual_alone_wrong_per_million"] >= POWER_PER_MILLION
    raise SystemExit(0 if is_good else 1)


def measure(
    out: Path, frames: int, kinds: tuple[str, ...], seed: int, shard: int, jobs: int, config: Config
) -> dict[str, object]:
    """The numbers of a run, also written into its folder with the figure."""
    for kind in kinds:
        if kind not in KINDS:
            raise SystemExit(f"{kind} is no kind of frame; expected some of {', '.join(KINDS)}.")
    results = shards.run(
        out / "adversarial.jsonl", shards.tasks(kinds, frames, shard, seed, config), judged, told, jobs
    )
    summary = summarised(results, config)
    (out / "adversarial.json").write_text(json.dumps(summary, indent=1) + "\n")
    draw(summary, out / "adversarial.png")
    return summary


def judged(task: shards.Task) -> dict[str, object]:
    """Counts of one shard."""
    rng = task.rng()
    world, batch = KINDS[task.kind](rng, task.frames)
    positioner = Positioner(task.config, map=world.map, is_map_frozen=True)
    open_config = replace(task.config, verify=replace(task.config.verify, max_p_chance=OPEN))
    lenient = Positioner(open_config, map=world.map, is_map_frozen=True)
    reasons, parts = Counter[str](), Counter[str]()
    right, wrong = np.zeros(DECADES, dtype=int), np.zeros(DECADES, dtype=int)
    fixes = {True: 0, False: 0}
    by_residual = {True: 0, False: 0}
    told_wrong = []
    misled = 0
    for k, frame in enumerate(batch.frames()):
        part = PARTS[task.kind][batch.part[k]]
        parts[f"{part}:frames"] += 1
        fix = positioner.step(frame).fix
        match fix:
            case Fix():
                is_right = is_fix_right(batch, k, fix, world)
                parts[f"{part}:{'right' if is_right else 'wrong'}"] += 1
                if not is_right and part == UNDECIDABLE:
                    misled += 1
                    continue
                fixes[is_right] += 1
                (right if is_right else wrong)[decade(fix.p_chance)] += 1
                matched, rms_mm = len(fix.point), fix.rms_mm
                if not is_right and len(told_wrong) < _TOLD_WRONG:
                    told_wrong.append(
                        {
                            "frame": k,
                            "part": part,
                            "points": int(batch.count[k]),
                            "matched": matched,
                            "true_pairs": batch.true_pairs(k, fix),
                            "p_chance": fix.p_chance,
                        }
                    )
            case NoFix():
                reasons[fix.why.name] += 1
                matched, rms_mm = fix.matched, fix.residual_mm
                loose = fix
                has_pose = len(batch.labelled(k)) >= 3
                if fix.why is Reason.not_proven and (has_pose or fix.p_chance <= 0.1):
                    loose = lenient.step(frame).fix
                is_right = is_candidate_right(batch, k, loose, world) if has_pose else False
                is_fix_at_some_threshold = isinstance(loose, Fix) or loose.why is Reason.not_proven
                if fix.why is Reason.not_proven and is_fix_at_some_threshold and is_right is not None:
                    (right if is_right else wrong)[decade(loose.p_chance)] += 1
        if is_right is not None and matched >= RESIDUAL_POINTS and rms_mm <= RESIDUAL_MM:
            by_residual[is_right] += 1
    return {
        "frames": len(batch),
        "right": fixes[True],
        "wrong": fixes[False],
        "misled": misled,
        "reasons": dict(reasons),
        "parts": dict(parts),
        "right_by_decade": right.tolist(),
        "wrong_by_decade": wrong.tolist(),
        "residual_right": by_residual[True],
        "residual_wrong": by_residual[False],
        "wrong_ones": told_wrong,
    }


def is_fix_right(batch: Batch, k: int, fix: Fix, world: World) -> bool:
    """Whether a fix is right by the pose of the true labels, or by its pairs where these lie on a line."""
    are_pairs_true = batch.true_pairs(k, fix) == len(fix.point)
    if are_pairs_true and len(fix.point) == len(batch.labelled(k)):
        return True  # it is that pose
    if not batch.is_positionable(k, world.map):
        return are_pairs_true
    return batch.is_right(k, fix.T_world_sensor, world.map)


def is_candidate_right(batch: Batch, k: int, fix: Fix | NoFix, world: World) -> bool | None:
    """The same of the best candidate of a frame; None where it does not tell its pose."""
    match fix:
        case Fix():
            return is_fix_right(batch, k, fix, world)
        case NoFix(weak=Fix() as weak):
            return is_fix_right(batch, k, weak, world)
        case NoFix(rivals=(best, *_)) if batch.is_positionable(k, world.map):
            return batch.is_right(k, best.T_world_sensor, world.map)
    return None


def decade(p_chance: float) -> int:
    """k for 10^-(k+1) < p ≤ 10^-k."""
    return min(int(-math.log10(max(p_chance, 1e-300))), DECADES - 1)


def foreign(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """Another object of the same make."""
    world, other, count = surface(rng), surface(rng), counts(rng, f)
    xyz, _ = patch(rng, other, count, count)
    return world, measured(rng, xyz, np.full((f, MOST), -1), count, none(f))


def decoy(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """A few points as of another place of the map, among points of the own place or of a foreign object."""
    world, other = surface(rng, 80), surface(rng)
    part = rng.integers(2, size=f)  # the others are foreign, or of the own place
    few = rng.integers(4, 7, f)
    count = rng.integers(np.ceil(2.5 * few).astype(int), MOST + 1)
    n = len(world.map)
    centre, elsewhere = rng.integers(n, size=f), rng.integers(n, size=(f, 4))
    apart = np.linalg.norm(world.xyz_mm[elsewhere] - world.xyz_mm[centre][:, None], axis=2)
    elsewhere = elsewhere[np.arange(f), apart.argmax(axis=1)]
    own, label = patch(rng, world, count, count - few, centre)
    away, _ = patch(rng, other, count, count)
    xyz = np.where((part == 1)[:, None, None], own, away)
    label = np.where((part == 1)[:, None], label, -1)
    false = seen(rng, world, near_targets(rng, world, elsewhere, few, 6), elsewhere)
    angle = rng.uniform(0, 2 * np.pi, f)
    false += (rng.uniform(20.0, 90.0, f) * np.stack([np.cos(angle), np.sin(angle), 0 * angle])).T[:, None]
    # the decoys take the last of the frame's places
    first = (count - few)[:, None]
    column = np.arange(MOST)
    is_false = (column >= first) & (column < count[:, None])
    taken = np.take_along_axis(false, np.clip(column - first, 0, 5)[..., None], axis=1)
    return world, measured(rng, np.where(is_false[..., None], taken, xyz), np.where(is_false, -1, label), count, part)


def mirrored(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """What a mirror shows of the object; a third of the objects is flat."""
    is_flat = rng.random() < 1 / 3
    world, count = surface(rng, relief=0.0 if is_flat else None), counts(rng, f)
    xyz, _ = patch(rng, world, count, with_strays(rng, count))
    xyz[..., 0] *= -1
    return world, measured(rng, xyz, np.full((f, MOST), -1), count, np.full(f, int(is_flat)))


def grid(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """Windows of a grid that reaches beyond the map."""
    jitter_mm = float(np.exp(rng.uniform(np.log(0.05), np.log(3.0))))
    world = made_grid(rng, targets(rng), rng.uniform(20.0, 40.0), jitter_mm, sigma(rng))
    count = counts(rng, f)
    centre = rng.integers(len(world.xyz_mm), size=f)
    xyz, label = patch(rng, world, count, with_strays(rng, count), centre)
    label = np.where(label < len(world.map), label, -1)
    known = (label >= 0).sum(axis=1)
    return world, measured(rng, xyz, label, count, np.where(known == 0, 0, np.where(known < count, 1, 2)))


def scaled(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """The right constellation in a wrong size."""
    world, count = surface(rng), counts(rng, f)
    true = with_strays(rng, count)
    xyz, label = patch(rng, world, count, true)
    part = rng.integers(2, size=f)  # too small, too large
    off = np.exp(rng.uniform(np.log(0.001), np.log(0.1), f))
    factor = np.where(part == 1, 1 + off, 1 - off)[:, None, None]
    middle = middles(xyz, true)
    return world, measured(rng, middle + factor * (xyz - middle), label, count, part)


def moved(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """Some targets are no longer where they were; they count as new ones. Most of the frame's are."""
    world, count = surface(rng), counts(rng, f)
    true = with_strays(rng, count)
    xyz, label = patch(rng, world, count, true)
    part = rng.integers(2, size=f)  # each by itself, all together
    share = np.where(part == 1, rng.uniform(0.15, 0.45, f), rng.uniform(0.1, 0.6, f))
    number = np.maximum((share * true).astype(int), 1)
    # those that moved together are neighbours: the farthest along some direction
    column = np.arange(MOST)
    direction = rng.normal(size=(f, 1, 3))
    along = np.where(part[:, None] == 1, (xyz * direction).sum(axis=2), rng.random((f, MOST)))
    along = np.where(column < true[:, None], along, -np.inf)
    is_moved = np.argsort(np.argsort(-along, axis=1), axis=1) < number[:, None]
    step = rng.normal(size=(f, MOST, 3))
    step = np.where(part[:, None, None] == 1, step[:, :1], step)
    length = rng.uniform(2.0, 20.0, (f, MOST, 1))
    length = np.where(part[:, None, None] == 1, length[:, :1], length)
    step *= length / np.linalg.norm(step, axis=2, keepdims=True)
    return world, measured(
        rng, np.where(is_moved[..., None], xyz + step, xyz), np.where(is_moved, -1, label), count, part
    )


def ghosts(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """Points at random in the sensor's view."""
    world, count = surface(rng), counts(rng, f)
    depth = rng.uniform(400.0, 560.0, (f, MOST, 1))
    xyz = np.concatenate([rng.uniform(-0.25, 0.25, (f, MOST, 2)) * depth, depth], axis=2)
    return world, measured(rng, xyz, np.full((f, MOST), -1), count, none(f))


KINDS: dict[str, Maker] = {
    "foreign": foreign,
    "decoy": decoy,
    "mirrored": mirrored,
    "grid": grid,
    "scaled": scaled,
    "moved": moved,
    "ghosts": ghosts,
}
PARTS = {
    "foreign": ("foreign",),
    "decoy": ("rest foreign", "rest of its own place"),
    "mirrored": ("curved", "flat"),
    "grid": ("beyond the map", "at its edge", "within"),
    "scaled": ("too small", "too large"),
    "moved": ("each by itself", "all together"),
    "ghosts": ("ghosts",),
}
"""Varieties of each kind, in the order of ``Batch.part``."""

UNDECIDABLE = "rest foreign"
"""The variety in which the frame shows nothing of the map but what was made to agree with it."""


def surface(rng: np.random.Generator, least: int = 30, relief: float | None = None) -> World:
    """A curved object with a map of it; one in six is flat, unless told."""
    if relief is None:
        relief = 0.0 if rng.random() < 1 / 6 else rng.uniform(0.01, 0.06)
    return made_world(rng, targets(rng, least), rng.uniform(20.0, 40.0), sigma(rng), relief)


def targets(rng: np.random.Generator, least: int = 30) -> int:
    """Targets of a map, small maps as often as large ones."""
    return int(np.exp(rng.uniform(np.log(least), np.log(1000))))


def sigma(rng: np.random.Generator) -> float:
    """How well a map is known (mm)."""
    return float(rng.uniform(0.005, 0.05))


def counts(rng: np.random.Generator, f: int) -> np.ndarray:
    """Points of each frame."""
    return rng.integers(4, MOST + 1, f)


def with_strays(rng: np.random.Generator, count: np.ndarray) -> np.ndarray:
    """How many of them are targets: all, or down to seven of ten."""
    return np.maximum(np.round(count * rng.uniform(0.7, 1.05, len(count))).astype(int).clip(max=count), 3)


def none(f: int) -> np.ndarray:
    """For kinds of a single variety."""
    return np.zeros(f, dtype=int)


def patch(
    rng: np.random.Generator,
    world: World,
    count: np.ndarray,
    true: np.ndarray,
    centre: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """``true`` neighbouring targets in sensor coordinates and their rows, strays behind them."""
    if centre is None:
        centre = rng.integers(len(world.map), size=len(count))
    rows = near_targets(rng, world, centre, true)
    R, t_mm = looking_at(rng, world.xyz_mm[centre], world.normal[centre])
    xyz = in_sensor(R, t_mm, world.xyz_mm[rows])
    return np.where((rows >= 0)[..., None], xyz, strays(rng, xyz, rows >= 0)), rows


def middles(xyz_mm: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Centres (f, 1, 3) of the first few points of each frame."""
    is_first = np.arange(xyz_mm.shape[1]) < number[:, None]
    return ((xyz_mm * is_first[..., None]).sum(axis=1) / number[:, None])[:, None]


def told(done: Mapping[str, dict]) -> str:
    """How a run stands."""
    wrong = sum(result["wrong"] for result in done.values())
    return (
        f"{sum(result['right'] for result in done.values())} right, [{'bold red' if wrong else 'green'}]{wrong} wrong"
    )


def summarised(results: Mapping[str, dict], config: Config) -> dict[str, object]:
    """The sums over all shards, by kind and in all."""
    kinds: dict[str, dict] = {}
    for key, result in results.items():
        kind = kinds.setdefault(
            key.split("/")[0],
            {"frames": 0, "right": 0, "wrong": 0, "misled": 0, "residual_right": 0, "residual_wrong": 0},
        )
        for name in ("frames", "right", "wrong", "misled", "residual_right", "residual_wrong"):
            kind[name] += result[name]
        for name in ("reasons", "parts"):
            kind[name] = dict(Counter(kind.get(name, {})) + Counter(result[name]))
        for name in ("right_by_decade", "wrong_by_decade"):
            kind[name] = np.add(kind.get(name, 0), result[name]).tolist()
        if result["wrong_ones"]:
            kind.setdefault("wrong_ones", {})[key] = result["wrong_ones"]
    frames, wrong = (sum(kind[name] for kind in kinds.values()) for name in ("frames", "wrong"))
    return {
        "frames": frames,
        "right": sum(kind["right"] for kind in kinds.values()),
        "wrong": wrong,
        "misled": sum(kind["misled"] for kind in kinds.values()),
        "wrong_per_million_at_most": upper_per_million(wrong, frames),
        "residual_alone_wrong_per_million": 1e6 * sum(kind["residual_wrong"] for kind in kinds.values()) / frames,
        "max_p_chance": config.verify.max_p_chance,
        "kinds": kinds,
    }


def upper_per_million(events: int, trials: int) -> float:
    """Upper end of the one-sided 95 % interval of a rate, per million (Clopper and Pearson 1934)."""
    from scipy.special import betaincinv

    return 1e6 if events == trials else 1e6 * float(betaincinv(events + 1, trials - events, 0.95))


def table(summary: dict) -> Table:
    """A run at a glance."""
    shown = Table("kind", "frames", "right", "wrong", "wrong by residual alone\nper million", "refused")
    for name, kind in summary["kinds"].items():
        reasons = sorted(kind["reasons"].items(), key=lambda each: -each[1])
        shown.add_row(
            name,
            f"{kind['frames']}",
            f"{kind['right']}",
            f"[{'bold red' if kind['wrong'] else 'green'}]{kind['wrong']}",
            f"{1e6 * kind['residual_wrong'] / kind['frames']:.0f}",
            ", ".join(starmap("{} {}".format, reasons)),
        )
        for part in PARTS[name] if len(PARTS[name]) > 1 else ():
            of = [kind["parts"].get(f"{part}:{what}", 0) for what in ("frames", "right", "wrong")]
            shown.add_row(f"  [dim]{part}", *(f"[dim]{each}" for each in of))
    shown.add_section()
    shown.add_row(
        "all",
        f"{summary['frames']}",
        f"{summary['right']}",
        f"{summary['wrong']}",
        f"{summary['residual_alone_wrong_per_million']:.0f}",
        f"wrong at most {summary['wrong_per_million_at_most']:.1f} per million (95 %); misled {summary['misled']}",
    )
    return shown


def draw(summary: dict, file: Path) -> None:
    """The threshold of p_chance against wrong and right fixes."""
    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    threshold = 10.0 ** -np.arange(DECADES)
    for name, kind in summary["kinds"].items():
        # accepted at a threshold of 10^-k: all whose decade is k or beyond
        wrong, true = (np.cumsum(kind[each][::-1])[::-1] for each in ("wrong_by_decade", "right_by_decade"))
        left.plot(threshold, np.where(wrong > 0, 1e6 * wrong / kind["frames"], np.nan), "o-", ms=3, label=name)
        if true[0]:
            right.plot(threshold, true / kind["frames"], "o-", ms=3, label=name)
    floor = 1e6 / max(min(kind["frames"] for kind in summary["kinds"].values()), 1)
    left.axhline(floor, color="0.7", lw=1, ls=":")
    left.set(xscale="log", yscale="log", xlabel="threshold of p_chance", ylabel="wrong candidates per million frames")
    right.set(xscale="log", xlabel="threshold of p_chance", ylabel="right candidates, of all frames")
    for axes in (left, right):
        axes.axvline(summary["max_p_chance"], color="k", lw=1)
        axes.set_xlim(2.0, threshold[-1])
        if axes.lines:
            axes.legend(fontsize=8)
    figure.savefig(file, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    cyclopts.run(main)
