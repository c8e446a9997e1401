"""What the terminal says during a live run and after any. Knows Status and Summary, and neither Steps nor files."""

import math
from collections.abc import Mapping
from pathlib import Path

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trifix.live import Status
from trifix.outputs.summary import Summary
from trifix.records import Reason


def summary_table(summary: Summary, report: Path) -> Group:
    """A run at a glance, for ``rich`` to print."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(justify="right")
    table.add_column()
    share = f"{100 * summary.positioned / summary.frames:.1f} %" if summary.frames else ""
    table.add_row("positioned", Text(str(summary.positioned), "bold green"), f"of {summary.frames} frames  {share}")
    if summary.dropped:
        table.add_row("dropped", Text(str(summary.dropped), "yellow"), Text("came too fast to be judged", "dim"))
    for name, count in summary.reasons.items():
        is_refusal = name in Reason.__members__
        words = Reason[name].value if is_refusal else "positioned"
        table.add_row(name.replace("_", " "), Text(str(count), "yellow" if is_refusal else ""), Text(words, "dim"))
    provisional = summary.targets["provisional"]
    table.add_row("targets", str(summary.targets["trusted"]), f"and {provisional} provisional" if provisional else "")
    for unit, residuals in (("mm", summary.residual_mm), ("px", summary.residual_px)):
        if residuals.rms is not None:
            table.add_row("residual, rms", f"{residuals.rms:.3f}", f"{unit}  worst frame {residuals.worst:.3f}")
    table.add_row("noise", f"{summary.noise_scale:.2f}", "times what was stated or assumed")
    if (a := summary.adjustment) is not None:
        what = f"{a.unit} of {a.observations} {'dots' if a.unit == 'px' else 'points'}, {a.rms_before:.3f} before"
        table.add_row("adjusted, rms", f"{a.rms_after:.3f}", f"{what}  {a.seconds:.1f} s")
        if a.rig_change_sigmas is not None:
            table.add_row("rig, moved by", f"{a.rig_change_sigmas:.1f}", "standard deviations, rms of its parameters")
    if summary.not_adjusted:
        table.add_row("not adjusted", "", Text(summary.not_adjusted, "yellow"))
    if total := summary.timings.get("total"):
        table.add_row("time a frame", f"{total.median_ms:.1f}", f"ms  99 % below {total.p99_ms:.1f}")
    table.add_row("in all", f"{summary.seconds:.1f}", f"s  {summary.frames_per_s:.1f} frames/s")
    warning = [Text(), Text(summary.rig, "bold yellow")] if summary.rig else []
    advice = Table.grid(padding=(0, 2))
    for tip in summary.advice:
        advice.add_row(Text("→", "bold"), Text(tip.sentence))
    told: list[RenderableType] = [Text(), advice] if summary.advice else []
    return Group(table, *warning, *told, Text(), Text.assemble("report  ", (str(report), "bold")))


def live_lines(statuses: Mapping[str, Status]) -> Group:
    """How a live run goes, two lines a body, for ``rich`` to print again and again."""
    lines = []
    for body, status in statuses.items():
        rates, colour = status.rates, {"green": "green", "amber": "yellow", "red": "red"}[status.light]
        latency = f"{rates.latency_ms:.0f} ms" if math.isfinite(rates.latency_ms) else "–"
        numbers = (
            f"{rates.frames_per_s:5.1f} frames/s   latency {latency}   dropped {rates.dropped}   "
            f"points {status.points}   matched {status.matched}"
        )
        name = f"{body}   " if len(statuses) > 1 else ""
        lines.append(Text.assemble(("● ", f"bold {colour}"), name, numbers))
        lines.append(Text(f"  {status.sentence}", colour))
    return Group(*lines)
