"""What came out, for people: one page, its figures as files, its tables as CSV, the paper's numbers beside ours.

Everything shown is worked out from the parts; nothing is measured here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table
from rich.text import Text

from trifix.config import paper_options, to_toml
from trifix.experiments.figures import (
    accepted_figure,
    for_page,
    growth_figure,
    path_figure,
    png_of,
    svg_of,
    triangles_figure,
)
from trifix.experiments.measuring import Part, growth, slope
from trifix.files.tables import write_atomically, write_table
from trifix.outputs.page import environment
from trifix.outputs.summary import versions
from trifix.sources.scenes import SCENES

POSITIONED_IN_PAPER = {
    # exhaustive distances, Delaunay and minimal triangles: 68 % possible frames less the failures, as the paper counts
    ("statue", "frequency"): 57.0,
    ("statue", "distances"): 52.0,
    ("statue", "minimal"): 50.0,
    ("statue", "delaunay"): 48.0,
    ("plane", "frequency"): 94.0,
    ("sphere", "frequency"): 71.0,
    ("head", "frequency"): 58.0,
    ("head-front", "frequency"): 67.0,
}
"""Share of all frames that the paper positioned (%), by scene and technique."""
_IMPOSSIBLE_IN_PAPER = 32.0  # of the statue's frames (%)
_FAILED_IN_PAPER = {"frequency": 11.0, "distances": 16.0, "minimal": 18.0, "delaunay": 20.0}  # on top of these
_SLOPE_IN_PAPER = 2.0  # triangles per target, of the three triangle techniques on the statue
_TRIANGLE_TECHNIQUES = ("frequency", "minimal", "delaunay")
_FIGURE_OF = {"plane": "4-3", "sphere": "4-4", "head": "4-5", "head-front": "4-6"}


@dataclass(frozen=True, slots=True)
class Claim:
    """A number of the paper beside ours."""

    what: str
    """The quantity."""
    paper: float
    """The paper's."""
    ours: float | None
    """Ours; None if it could not be measured."""
    unit: str
    """Its unit."""


def claims(parts: Sequence[Part]) -> list[Claim]:
    """The paper's numbers that the parts can be compared with."""
    found = []
    statue = {part.technique: part for part in parts if part.scene == "statue"}
    if statue:
        some = next(iter(statue.values()))
        share = 100 * (some.frames - some.reachable) / some.frames
        found.append(Claim("statue: frames that no technique can position", _IMPOSSIBLE_IN_PAPER, share, "% of all"))
    for technique, failed in _FAILED_IN_PAPER.items():
        if technique in statue:
            what = f"statue: failures of {technique} on top of these"
            found.append(Claim(what, failed, _failed_percent(statue[technique]), "% of all"))
    for part in parts:
        share = POSITIONED_IN_PAPER.get((part.scene, part.technique), 0.0)
        if share:
            ours = 100 * part.positioned / part.frames
            found.append(Claim(f"{part.scene}: positioned by {part.technique}", share, ours, "% of all"))
    for technique in _TRIANGLE_TECHNIQUES:
        if technique in statue:
            ours_slope = slope(statue[technique].targets, statue[technique].sizes)
            found.append(Claim(f"statue: {technique} triangles per target", _SLOPE_IN_PAPER, ours_slope, "slope"))
    return found


def claims_table(parts: Sequence[Part], page: Path) -> Group:
    """The paper's numbers beside ours, for ``rich`` to print, and where the rest is."""
    table = Table.grid(padding=(0, 3))
    table.add_column()
    table.add_column(justify="right")
    table.add_column(justify="right")
    table.add_column(style="dim")
    table.add_row("", Text("paper", "dim"), Text("here", "dim"), "")
    for each in claims(parts):
        table.add_row(each.what, f"{each.paper:.3g}", "–" if each.ours is None else f"{each.ours:.3g}", each.unit)
    wrong = sum(len(part.misidentified) for part in parts)
    table.add_row("misidentified, all scenes and techniques", "", Text(str(wrong), "red" if wrong else ""), "frames")
    return Group(table, Text(), Text.assemble("page  ", (str(page), "bold")))


def _failed_percent(part: Part) -> float:
    """Frames that some technique could have positioned and this one did not, of all frames (%)."""
    return 100 * (part.reachable - part.positioned_of_reachable) / part.frames


def write_experiment(parts: Sequence[Part], out: Path, command: str) -> Path:
    """Writes ``experiment.html``, ``figures/`` as PNG and SVG, and ``tables/`` as CSV; returns the page's path."""
    drawings = _drawings(parts)
    figures = out / "figures"
    figures.mkdir(exist_ok=True)
    svgs = {}
    for name, figure in drawings.items():
        svgs[name] = svg_of(figure)
        (figures / f"{name}.svg").write_text(svgs[name], encoding="utf-8")
        (figures / f"{name}.png").write_bytes(png_of(figure))
    _write_tables(parts, out / "tables")
    page = out / "experiment.html"
    text = (
        environment("trifix.experiments")
        .get_template("experiment.html.jinja")
        .render(
            scenes=_by_scene(parts),
            summaries={name: SCENES[name].summary for name in _by_scene(parts)},
            claims=claims(parts),
            figures={name: for_page(svg) for name, svg in svgs.items()},
            figure_of=_FIGURE_OF,
            command=command,
            options=to_toml(paper_options()),
            versions=versions(),
            slope=lambda part: slope(part.targets, part.sizes),
            failed=_failed_percent,
        )
    )
    write_atomically(page, text)
    return page


def _by_scene(parts: Sequence[Part]) -> dict[str, list[Part]]:
    scenes: dict[str, list[Part]] = {}
    for part in parts:
        scenes.setdefault(part.scene, []).append(part)
    return scenes


def _drawings(parts: Sequence[Part]) -> dict[str, Figure]:
    """The figures by name, those of the paper that these parts can show."""
    first = _by_scene(parts)[parts[0].scene]
    counted = next((part for part in first if part.technique == "frequency"), None)
    drawings = {
        "accepted": accepted_figure(parts, POSITIONED_IN_PAPER),
        "growth": growth_figure(parts),
        "triangles": triangles_figure(counted or first[0], counted),
    }
    for scene, of_scene in _by_scene(parts).items():
        shown = next((part for part in of_scene if part.technique == "frequency"), of_scene[0])
        drawings[f"path-{scene}"] = path_figure(shown)
    return drawings


def _write_tables(parts: Sequence[Part], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    write_table(
        folder / "paper.csv",
        {
            "quantity": [each.what for each in claims(parts)],
            "paper": [_number(each.paper) for each in claims(parts)],
            "ours": [_number(each.ours) for each in claims(parts)],
            "unit": [each.unit for each in claims(parts)],
        },
    )
    rows = [_row(part) for part in parts]
    write_table(folder / "techniques.csv", {name: [row[name] for row in rows] for name in rows[0]})
    reasons = [(part, reason, count) for part in parts for reason, count in part.refused.items()]
    write_table(
        folder / "refusals.csv",
        {
            "scene": [part.scene for part, _, _ in reasons],
            "technique": [part.technique for part, _, _ in reasons],
            "reason": [reason for _, reason, _ in reasons],
            "frames": [str(count) for _, _, count in reasons],
        },
    )
    sizes = [(part, *at) for part in parts for at in zip(*growth(part.targets, part.sizes), strict=True)]
    write_table(
        folder / "growth.csv",
        {
            "scene": [part.scene for part, _, _ in sizes],
            "technique": [part.technique for part, _, _ in sizes],
            "targets": [str(count) for _, count, _ in sizes],
            "triangles_or_distances": [_number(size) for _, _, size in sizes],
        },
    )


def _row(part: Part) -> dict[str, str]:
    """A part in one line of techniques.csv."""
    counts = {
        "frames": part.frames,
        "positioned": part.positioned,
        "reachable": part.reachable,
        "positioned_of_reachable": part.positioned_of_reachable,
        "sharing": part.sharing,
        "positioned_of_sharing": part.positioned_of_sharing,
        "misidentified": len(part.misidentified),
        "drifted": part.drifted,
        "targets_true": part.targets_true,
        "targets_found": part.targets_found,
        "duplicates": part.duplicates,
        "unknown_targets": part.unknown_targets,
        "targets_in_list": part.targets[-1],
        "triangles_or_distances": part.sizes[-1],
        "targets_without_triangle": part.without_triangle,
    }
    numbers = {
        "slope": slope(part.targets, part.sizes),
        "triangles_kept": part.kept,
        "error_mm_median": part.error_mm.median,
        "error_mm_rms": part.error_mm.rms,
        "error_deg_median": part.error_deg.median,
        "error_deg_rms": part.error_deg.rms,
        "drift_mm_median": part.drift_mm.median,
        "drift_mm_rms": part.drift_mm.rms,
        "drift_mm_max": part.drift_mm.max,
        "target_mm_median": part.target_mm.median,
        "frame_ms_median": part.frame_ms.median,
        "frame_ms_p99": part.frame_ms.p99,
        "comparisons_median": part.comparisons.median,
        "comparisons_p99": part.comparisons.p99,
    }
    return (
        {"scene": part.scene, "technique": part.technique}
        | {name: str(count) for name, count in counts.items()}
        | {name: _number(number) for name, number in numbers.items()}
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
