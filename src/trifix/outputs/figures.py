"""The figures of reports and comparisons, as SVG that takes its colours from the page. Knows no Step and no file."""

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from trifix.outputs.course import Course, object_axes
from trifix.records import ReferenceMap, TargetState

# Drawn in these colours, which occur nowhere else, and then replaced by the page's variables.
INK, FAINT, GRID, GOOD, BAD, PATH = (f"#0102{k:02x}" for k in range(1, 7))
_VARIABLES = {INK: "ink", FAINT: "faint", GRID: "grid", GOOD: "good", BAD: "bad", PATH: "path"}


def style_of(ink: str, faint: str, grid: str) -> dict[str, object]:
    """Settings of matplotlib in which all figures are drawn, in some colours."""
    return {
        "svg.fonttype": "none",  # text stays text
        "svg.hashsalt": "trifix",  # the same figure has the same bytes
        "font.family": "sans-serif",
        "font.size": 9.5,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "axes.titlecolor": ink,
        "text.color": ink,
        "axes.edgecolor": grid,
        "axes.labelcolor": faint,
        "xtick.color": grid,
        "ytick.color": grid,
        "xtick.labelcolor": faint,
        "ytick.labelcolor": faint,
        "grid.color": grid,
        "grid.linewidth": 0.6,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
    }


STYLE = style_of(INK, FAINT, GRID) | {
    "lines.solid_capstyle": "round",
    "path.simplify": False,  # it would drop lone points
}

_MOST_BINS = 600  # more cannot be told apart on a page
_MOST_VERTICES = 2000


def time_figure(course: Course) -> str:
    """Outcome, residual and number of points of every frame, one above the other; SVG."""
    matched = np.where(course.is_positioned, course.matched, np.nan)
    lanes = sorted(set(course.outcome) - {"positioned"}, key=course.outcome.count, reverse=True)
    lane_height = 0.24 * (len(lanes) + 1)
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, lane_height + 3.9), layout="constrained")
        outcome, residual, points = figure.subplots(3, 1, sharex=True, height_ratios=[lane_height, 1.5, 1.5])
        _draw_outcome(outcome, course, ["positioned", *lanes])
        for axes in (residual, points):
            axes.broken_barh(
                _runs(course, ~course.is_positioned), (0, 1), transform=axes.get_xaxis_transform(),
                facecolor=BAD, alpha=0.13, linewidth=0,
            )  # fmt: skip
        _draw_band(residual, course.frame, course.residual_mm, GOOD)
        residual.set(title="Residual of the identified points, rms (mm)", ylim=(0, None))
        _draw_band(points, course.frame, course.points.astype(float), FAINT, "seen")
        _draw_band(points, course.frame, matched, GOOD, "identified")
        points.set(title="Points", ylim=(0, None), xlabel="frame")
        points.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        points.xaxis.set_major_locator(MaxNLocator(10, integer=True))
        points.margins(x=0.01)
        points.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0, labelcolor=INK)
        return svg_of(figure)


def path_figure(course: Course, targets: ReferenceMap) -> str:
    """Targets and the sensor's path from the front and from above, as the paper draws its scenes (4-3 to 4-6); SVG."""
    axes_of_object = object_axes(course, targets)
    course, targets = _turned(course, targets, axes_of_object)
    centre, half = _what_matters(course, targets)
    half[0] = max(half[0], 0.8 * half[1:].max())
    half[1:] = np.maximum(half[1:], 0.4 * half[0])
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 4.9 * half[1:].max() / half[0] + 1.0), layout="constrained")
        front, above = figure.subplots(1, 2)
        for axes, row, title, name in (
            (front, 1, "From the front", "up"),
            (above, 2, "From above", "away"),
        ):
            _draw_targets(axes, targets, row)
            _draw_path(axes, course, row)
            axes.set(title=title, xlabel="right (mm)", ylabel=f"{name} (mm)", aspect="equal", anchor="N")
            axes.set_xlim(centre[0] - half[0], centre[0] + half[0])
            axes.set_ylim(centre[row] - half[row], centre[row] + half[row])
        handles, labels = front.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=max(len(labels), 1), labelcolor=INK)
        return svg_of(figure)


def difference_figure(
    frame: Int[np.ndarray, "n"], mm: Float[np.ndarray, "n"], deg: Float[np.ndarray, "n"], sigmas: Float[np.ndarray, "n"]
) -> str:
    """How far the two poses of each frame are apart, by distance, angle and standard deviations; SVG."""
    rows = ((mm, "Distance (mm)"), (deg, "Angle (degrees)"), (sigmas, "Standard deviations"))
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 4.6), layout="constrained")
        for axes, (value, title) in zip(figure.subplots(len(rows), 1, sharex=True), rows, strict=True):
            _draw_band(axes, frame, value, PATH)
            axes.set(title=title, ylim=(0, None))
            axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.set(xlabel="frame")
        axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
        axes.margins(x=0.01)
        return svg_of(figure)


def _draw_outcome(axes: Axes, course: Course, lanes: Sequence[str]) -> None:
    """One lane an outcome; a bar where consecutive frames have it."""
    outcome = np.array(course.outcome, dtype=object)
    for lane, name in enumerate(lanes):
        colour = GOOD if name == "positioned" else BAD
        axes.broken_barh(_runs(course, outcome == name), (lane - 0.4, 0.8), facecolor=colour, linewidth=0)
    axes.set_yticks(range(len(lanes)), [name.replace("_", " ") for name in lanes])
    axes.set(title="Outcome", ylim=(len(lanes) - 0.4, -0.6))
    axes.tick_params(labelbottom=False, length=0)
    axes.grid(axis="y", visible=False)
    axes.spines[:].set_visible(False)


def _runs(course: Course, is_meant: Bool[np.ndarray, "n"]) -> list[tuple[float, float]]:
    """Start and width of each run of consecutive bins in which some frame is meant."""
    bins = _binned(is_meant.astype(float))
    meant = np.nanmax(bins, axis=1) > 0
    edge = np.flatnonzero(np.diff(np.r_[False, meant, False].astype(int)))
    first, end = edge[::2] * bins.shape[1], np.minimum(edge[1::2] * bins.shape[1], len(is_meant))
    start, stop = course.frame[first] - 0.5, course.frame[end - 1] + 0.5
    return list(zip(start.tolist(), (stop - start).tolist(), strict=True))


def _draw_band(
    axes: Axes, frame: Int[np.ndarray, "n"], value: Float[np.ndarray, "n"], colour: str, label: str = ""
) -> None:
    """A value over time; of many frames, the median of each bin and the range around it."""
    bins = _binned(value)
    known = np.isfinite(bins).any(axis=1)
    low, middle, high = np.full((3, len(bins)), np.nan)
    low[known], high[known] = np.nanmin(bins[known], axis=1), np.nanmax(bins[known], axis=1)
    middle[known] = np.nanmedian(bins[known], axis=1)
    at = frame[:: bins.shape[1]].astype(float)
    if bins.shape[1] > 1:
        axes.fill_between(at, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(*_with_lone_points(at, middle), color=colour, linewidth=1.3, label=label)


def _binned(value: Float[np.ndarray, "n"]) -> Float[np.ndarray, "bins size"]:
    """Consecutive values in at most ``_MOST_BINS`` rows, the last one filled up with NaN."""
    size = -(-len(value) // _MOST_BINS)
    bins = np.full((-(-len(value) // size), size), np.nan)
    bins.flat[: len(value)] = value
    return bins


def _draw_targets(axes: Axes, targets: ReferenceMap, row: int) -> None:
    looks: tuple[tuple[TargetState, str, dict[str, object]], ...] = (
        (TargetState.provisional, "target, provisional", {"marker": "o", "mfc": "none", "mec": FAINT, "ms": 3.5}),
        (TargetState.trusted, "target", {"marker": "o", "mfc": GOOD, "mec": "none", "ms": 4.5}),
        (TargetState.quarantined, "target, quarantined", {"marker": "x", "mfc": "none", "mec": BAD, "ms": 5}),
    )
    for state, label, look in looks:
        xyz = targets.xyz_mm[targets.state == state]
        if len(xyz):
            axes.plot(xyz[:, 0], xyz[:, row], linestyle="", label=label, **look)  # type: ignore[arg-type]


def _draw_path(axes: Axes, course: Course, row: int) -> None:
    """The path, broken where frames were refused, with a dozen of viewing directions."""
    found = np.flatnonzero(course.is_positioned)
    if not len(found):
        return
    xy = course.position_mm[:, [0, row]]
    line = xy[:: -(-len(xy) // _MOST_VERTICES)]
    axes.plot(
        *_with_lone_points(line[:, 0], line[:, 1]),
        color=PATH,
        linewidth=1.6,
        label="path of the sensor, and where it looks",
    )
    some = found[np.unique(np.linspace(0, len(found) - 1, 12).astype(int))]
    axes.quiver(
        *xy[some].T, *course.forward[some][:, [0, row]].T,
        color=PATH, alpha=0.6, angles="xy", scale_units="width", scale=18, width=0.003, headwidth=4,
    )  # fmt: skip
    axes.plot(*xy[found[0]], marker="o", ms=8, mfc="none", mec=PATH, mew=1.8, linestyle="", label="first frame")
    axes.plot(*xy[found[-1]], marker="s", ms=6, mfc=PATH, mec="none", linestyle="", label="last frame")


def _turned(course: Course, targets: ReferenceMap, axes: Float[np.ndarray, "3 3"]) -> tuple[Course, ReferenceMap]:
    """Path and targets in coordinates right, up, away, measured from the middle of the targets."""
    R = axes * [[1.0], [-1.0], [1.0]]
    shown = targets.xyz_mm[targets.state == TargetState.trusted]
    centre = shown.mean(axis=0) if len(shown) else np.zeros(3)
    turned = replace(course, position_mm=(course.position_mm - centre) @ R.T, forward=course.forward @ R.T)
    return turned, replace(targets, xyz_mm=(targets.xyz_mm - centre) @ R.T)


def _what_matters(course: Course, targets: ReferenceMap) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Centre and half extent of the box that holds the path and the trusted targets, if there are any; with a margin.

    A false target far away must not shrink everything else.
    """
    is_shown = targets.state == TargetState.trusted
    if not is_shown.any():
        is_shown = targets.alive
    xyz = np.concatenate([targets.xyz_mm[is_shown], course.position_mm[course.is_positioned]])
    if not len(xyz):
        return np.zeros(3), np.full(3, 10.0)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    return (low + high) / 2, (high - low) * 0.55 + 10.0


def _with_lone_points(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """The same polyline, gaps at NaN, in which a point between two gaps is doubled, so that its round caps show."""
    known = np.isfinite(y)
    is_alone = known & ~np.r_[False, known[:-1]] & ~np.r_[known[1:], False]
    row = np.repeat(np.arange(len(x)), np.where(is_alone, 2, 1))
    is_double = np.r_[False, row[1:] == row[:-1]]
    return x[row] + 1e-3 * is_double, y[row]


def svg_of(figure: Figure) -> str:
    """The figure as an SVG element whose colours are the page's variables, without a style sheet of its own."""
    text = io.StringIO()
    FigureCanvasSVG(figure)
    figure.savefig(text, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return for_page(text.getvalue(), _VARIABLES)


def for_page(svg: str, variables: Mapping[str, str]) -> str:
    """An SVG as part of a page: in its font, and with the page's variables in the place of colours."""
    svg = re.sub(r"^.*?(?=<svg)|<defs>\s*<style.*?</defs>|font-family: [^;]*; ?", "", svg, flags=re.DOTALL)
    for colour, name in variables.items():
        svg = svg.replace(colour, f"var(--{name})")
    return svg
