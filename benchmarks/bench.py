"""The benchmarks in short, against a committed baseline: make bench.

Run: python benchmarks/bench.py [--accept]

Each metric has a value, a unit, a direction and a tolerance, the share of the value by which it may be worse. What is
measured is counted, or is a ratio of times taken side by side in the same run: no wall clock is compared with one of
another day. Metrics of peers that are not installed are passed over. ``--accept`` makes what was measured the baseline,
but for what has no tolerance at all: that is a promise.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import adversarial
import chance
import cold_start
import cyclopts
import shards
from rich.table import Table

from trifix import Config

BASELINE = Path(__file__).with_name("baseline.json")
KINDS_WITH_FIXES = ("decoy", "grid", "scaled", "moved")


def main(accept: bool = False, frames: int = 100, queries: int = 60) -> None:
    """Measures, compares, and exits with 1 if something is worse than its tolerance allows.

    Parameters
    ----------
    accept: make what was measured the baseline, promises excepted.
    frames: of each kind of misleading frame; ten times as many weak ones.
    queries: cold starts for each map.
    """
    cold_start.one_core()
    measured = measure(frames, queries)
    baseline = json.loads(BASELINE.read_text())
    table, is_good = compared(measured, baseline)
    shards.console().print(table)
    if accept:
        for name, value in measured.items():
            if baseline[name]["tolerance"] > 0:
                baseline[name]["value"] = float(f"{value:.3g}")
        BASELINE.write_text(json.dumps(baseline, indent=2) + "\n")
    raise SystemExit(0 if is_good or accept else 1)


def measure(frames: int, queries: int, sizes: tuple[int, ...] = (50, 118, 1000)) -> dict[str, float]:
    """Every metric's value now."""
    with TemporaryDirectory() as folder:
        misled = adversarial.measure(Path(folder), frames, tuple(adversarial.KINDS), 1, 25, 1, Config())
        weak = chance.measure(Path(folder), 10 * frames, 1, 50, 1)
    cold = cold_start.measure(sizes, queries, 5.0, 1, ("Open3D", "KISS-Matcher"), Config())
    kinds = [misled["kinds"][kind] for kind in KINDS_WITH_FIXES]
    values = {
        "adversarial.wrong": misled["wrong"],
        "adversarial.misled": misled["misled"] / misled["kinds"]["decoy"]["frames"],
        "adversarial.right": sum(kind["right"] for kind in kinds) / sum(kind["frames"] for kind in kinds),
        "adversarial.wrong_by_residual_alone": misled["residual_alone_wrong_per_million"],
        "chance.wrong_of_promised": chance.wrong_of_promised(weak),
    }
    for row in cold["rows"]:
        if row["method"] == "trifix":
            values[f"cold_start.{row['targets']}.success"] = row["success"]
            values[f"cold_start.{row['targets']}.wrong"] = row["wrong"]
    for ratio in cold["ratios"]:
        if ratio["ours"] == "trifix":
            name = ratio["than"].replace(" ", "_")
            values[f"cold_start.{ratio['targets']}.times_faster_than_{name}"] = ratio["median"]
    return values


def compared(measured: dict[str, float], baseline: dict[str, dict]) -> tuple[Table, bool]:
    """What was measured beside the baseline, and whether all is within its tolerance."""
    table, is_good = Table("metric", "unit", "better", "baseline", "may be", "now", ""), True
    for name, metric in baseline.items():
        value, slack = metric["value"], metric["tolerance"] * abs(metric["value"])
        is_lower_better = metric["direction"] == "lower"
        limit = value + slack if is_lower_better else value - slack
        if name in measured:
            now = measured[name]
            is_within = now <= limit if is_lower_better else now >= limit
            is_good &= is_within
            verdict = "[green]good" if is_within else "[bold red]worse"
        else:
            now, verdict = None, "[dim]not measured"
        shown = (f"{each:.3g}" if each is not None else "–" for each in (value, limit, now))
        table.add_row(name, metric["unit"], metric["direction"], *shown, verdict)
    return table, is_good


if __name__ == "__main__":
    cyclopts.run(main)
