"""What came of an acceptance test, for people: a page, its figure as files, every length as a row of CSV.

Measures nothing.
"""

from pathlib import Path

from trifix.experiments.acceptance import BAR_SIGMA_MM, Acceptance
from trifix.experiments.figures import for_page, lengths_figure, png_of, svg_of
from trifix.files.tables import write_atomically, write_table
from trifix.outputs.page import environment
from trifix.outputs.summary import versions
from trifix.sources.scenes import LINES_MM


def acceptance_rows(found: Acceptance) -> list[tuple[str, str]]:
    """What came of it, in a few lines."""
    limit, seeds = found.limit, {each.seed for each in found.lengths}
    verdict = "met" if found.is_met else f"not met: {found.exceeding} lengths beyond, {found.missing} not measured"
    return [
        ("artefact", f"simulated; {len(found.lengths)} test lengths in {len(LINES_MM)} directions"),
        ("recordings", f"{len(seeds)} of {found.frames} frames, with {found.bars} scale bars"),
        ("permitted", f"{limit.constant_mm:g} mm + {limit.slope_mm_m:g} mm/m"),
        ("largest error", f"{found.largest_mm:.4f} mm"),
        ("error over predicted sigma", f"{found.normalised_rms:.2f} (rms)"),
        ("limit", verdict),
    ]


def write_acceptance(found: Acceptance, out: Path, command: str) -> Path:
    """Writes ``acceptance.html``, ``lengths.csv`` and the figure as SVG and PNG; returns the page's path."""
    svg, figure = "", lengths_figure(found)
    svg = svg_of(figure)
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "lengths.svg", svg)
    (out / "lengths.png").write_bytes(png_of(figure))
    write_table(
        out / "lengths.csv",
        {
            "seed": [str(each.seed) for each in found.lengths],
            "line": [str(each.line) for each in found.lengths],
            "length_mm": [f"{each.length_mm:.6f}" for each in found.lengths],
            "error_mm": [f"{each.error_mm:.6f}" for each in found.lengths],
            "sigma_mm": [f"{each.sigma_mm:.6f}" for each in found.lengths],
        },
    )
    lines = []
    for number, (a, b) in enumerate(LINES_MM, start=1):
        own = [each for each in found.lengths if each.line == number]
        away = [round(v - u) for u, v in zip(a, b, strict=True)]
        lines.append((number, away, own))
    page = (
        environment("trifix.experiments")
        .get_template("acceptance.html.jinja")
        .render(
            rows=acceptance_rows(found),
            lines=lines,
            figure=for_page(svg),
            found=found,
            bar_sigma_mm=BAR_SIGMA_MM,
            command=command,
            versions=versions(),
        )
    )
    write_atomically(out / "acceptance.html", page)
    return out / "acceptance.html"
