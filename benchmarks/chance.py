"""Does p_chance say what it promises?

Run: python benchmarks/chance.py --out out/chance --frames 1000000 --jobs 2

Weak frames, of three to six points, with ghosts among them, and one frame in five foreign, against maps of 30 to 1000
targets. The threshold is 0.5 and poses may be as loose as they like, so that evidence alone decides. A fix agrees by
chance, and is counted as wrong, if fewer than three of its pairs, or fewer than half, are true. Fixes are counted by
p_chance: of those with 10^-(k+1) < p <= 10^-k no more than 10^-k may be wrong, for k = 1 to 4, as far as there are
10^(k+1) of them. p_chance is an upper bound; how far too cautious it is stands beside it.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cyclopts
import matplotlib as mpl
import numpy as np
import shards
from adversarial import decade, patch, surface, upper_per_million
from made_frames import MOST, Batch, World, measured
from rich.table import Table

from trifix import Config, Fix, Positioner

BINS = 12
"""Decades of p_chance: 0.5 to 0.1 first, 1e-11 and below last."""
JUDGED = range(1, 5)
"""Decades in which the share of wrong fixes is held against the promise."""
FOREIGN = 0.2


def main(out: Path = Path("out/chance"), frames: int = 10_000, seed: int = 1, shard: int = 1000, jobs: int = 1) -> None:
    """Runs the frames and writes chance.json and chance.png.

    Parameters
    ----------
    out: folder of the run, which goes on if it has begun.
    frames: frames in all.
    seed: of all random numbers.
    shard: frames on one map; the unit in which a run goes on.
    jobs: processes.
    """
    summary = measure(out, frames, seed, shard, jobs)
    shards.console().print(table(summary))
    raise SystemExit(0 if summary["is_kept"] else 1)


def measure(out: Path, frames: int, seed: int, shard: int, jobs: int) -> dict[str, object]:
    """The numbers of a run, also written into its folder with the figure."""
    config = Config()
    verify = replace(config.verify, max_p_chance=0.5, max_sigma_mm=1e9, max_sigma_deg=1e9)
    todo = shards.tasks(["weak"], frames, shard, seed, replace(config, verify=verify))
    summary = summarised(shards.run(out / "chance.jsonl", todo, judged, told, jobs))
    (out / "chance.json").write_text(json.dumps(summary, indent=1) + "\n")
    draw(summary, out / "chance.png")
    return summary


def judged(task: shards.Task) -> dict[str, object]:
    """Fixes of one shard by decade of p_chance: their number, those that are wrong, and the sum of p_chance."""
    world, batch = weak(task.rng(), task.frames)
    positioner = Positioner(task.config, map=world.map, is_map_frozen=True)
    fixes, wrong, promised = np.zeros(BINS, dtype=int), np.zeros(BINS, dtype=int), np.zeros(BINS)
    for k, frame in enumerate(batch.frames()):
        fix = positioner.step(frame).fix
        if isinstance(fix, Fix):
            row = min(decade(fix.p_chance), BINS - 1)
            fixes[row] += 1
            promised[row] += fix.p_chance
            wrong[row] += batch.true_pairs(k, fix) < max(3, len(fix.point) / 2)
    return {"frames": len(batch), "fixes": fixes.tolist(), "wrong": wrong.tolist(), "promised": promised.tolist()}


def weak(rng: np.random.Generator, f: int) -> tuple[World, Batch]:
    """Frames of three to six points, up to two of which are ghosts; some show another object."""
    world, other = surface(rng), surface(rng)
    count = rng.integers(3, 7, f)
    true = count - rng.integers(0, 3, f)
    part = (rng.random(f) < FOREIGN).astype(int)
    own, label = patch(rng, world, count, true)
    away, _ = patch(rng, other, count, count)
    is_foreign = (part == 1)[:, None]
    xyz = np.where(is_foreign[..., None], away, own)
    return world, measured(rng, xyz, np.where(is_foreign, np.full((f, MOST), -1), label), count, part)


def told(done: Mapping[str, dict]) -> str:
    """How a run stands."""
    return "{} fixes, {} wrong".format(*(sum(sum(r[name]) for r in done.values()) for name in ("fixes", "wrong")))


def summarised(results: Mapping[str, dict]) -> dict[str, object]:
    """The sums over all shards, and whether the promise was kept."""
    frames = sum(result["frames"] for result in results.values())
    fixes, wrong, promised = (
        np.sum([result[name] for result in results.values()], axis=0) for name in ("fixes", "wrong", "promised")
    )
    rows, is_kept = [], True
    for k in range(BINS):
        n, w = int(fixes[k]), int(wrong[k])
        share = w / n if n else None
        is_judged = k in JUDGED and n >= 10 ** (k + 1)
        is_kept &= not (is_judged and share is not None and share > 10.0**-k)
        rows.append(
            {
                "p_at_most": 10.0**-k,
                "fixes": n,
                "wrong": w,
                "wrong_share": share,
                "wrong_share_at_most": upper_per_million(w, n) / 1e6 if n else None,
                "promised": float(promised[k]) / n if n else None,
                "is_judged": is_judged,
            }
        )
    return {"frames": frames, "is_kept": bool(is_kept), "decades": rows}


def wrong_of_promised(summary: dict) -> float:
    """Wrong fixes by those that p_chance promised at most; it should not exceed one."""
    wrong = sum(row["wrong"] for row in summary["decades"])
    promised = sum(row["fixes"] * row["promised"] for row in summary["decades"] if row["fixes"])
    return wrong / promised if promised else 0.0


def table(summary: dict) -> Table:
    """The promise and what came of it."""
    names = ("p_chance up to", "fixes", "wrong", "share", "95 %", "allowed", "promised", "cautious", "verdict")
    shown = Table(*names)
    for k, row in enumerate(summary["decades"]):
        n = row["fixes"]
        verdict = "[dim]too few" if k in JUDGED else ""
        if row["is_judged"]:
            verdict = "[green]kept" if row["wrong_share"] <= row["p_at_most"] else "[bold red]broken"
        shown.add_row(
            f"1e-{k}",
            f"{n}",
            f"{row['wrong']}",
            f"{row['wrong_share']:.1e}" if n else "–",
            f"{row['wrong_share_at_most']:.1e}" if n else "–",
            f"{row['p_at_most']:.0e}",
            f"{row['promised']:.1e}" if n else "–",
            cautious(row),
            verdict,
        )
    return shown


def cautious(row: dict) -> str:
    """How many times more wrong fixes were promised than came."""
    if not row["fixes"]:
        return "–"
    sign, share = ("", row["wrong_share"]) if row["wrong"] else (">", row["wrong_share_at_most"])
    return f"{sign}{row['promised'] / share:.2g}"


def draw(summary: dict, file: Path) -> None:
    """The reliability diagram: the share of wrong fixes against the mean p_chance, with what it may be at most."""
    mpl.use("agg")
    from matplotlib import pyplot as plt

    rows = [row for row in summary["decades"][:-1] if row["fixes"]]
    figure, axes = plt.subplots(figsize=(5.5, 4.5), layout="constrained")
    axes.plot([1e-11, 1], [1e-11, 1], color="0.6", lw=1, label="as promised")
    promised = np.array([row["promised"] for row in rows])
    share = np.array([row["wrong_share"] for row in rows])
    at_most = np.array([row["wrong_share_at_most"] for row in rows])
    axes.plot(promised[share > 0], share[share > 0], "o", label="wrong, share of the fixes")
    axes.plot(promised, at_most, "v", mfc="none", color="C0", label="95 % at most")
    axes.set(xscale="log", yscale="log", xlabel="p_chance, mean of its decade", ylabel="share of wrong fixes")
    axes.legend(fontsize=8)
    figure.savefig(file, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    cyclopts.run(main)
