"""The report's two figures, as SVG that takes its colours from the page. Draws arrays; knows no Step and no file."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from trifix.records import ReferenceMap, TargetState

# Drawn in these colours, which occur nowhere else, and then replaced by the page's variables.
INK, FAINT, GRID, GOOD, BAD, SOFT, PATH = (f"#0102{k:02x}" for k in range(1, 8))
_VARIABLES = {INK: "ink", FAINT: "faint", GRID: "grid", GOOD: "good", BAD: "bad", SOFT: "soft", PATH: "path"}

_STYLE = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "trifix",  # the same figure has the same bytes
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "text.color": INK,
    "axes.edgecolor": GRID,
    "axes.labelcolor": FAINT,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": FAINT,
    "ytick.labelcolor": FAINT,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "path.simplify": False,  # it would drop lone points
}

_MOST_BINS = 600  # more cannot be told apart on a page
_MOST_VERTICES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """What became of n frames, in the order of the recording."""

    frame: Int[np.ndarray, "n"]
    """Number of the frame."""
    outcome: Sequence[str]
    """Name of the reason of each refused frame; "positioned" for the others."""
    points: Int[np.ndarray, "n"]
    """Points seen."""
    matched: Int[np.ndarray, "n"]
    """Points identified."""
    residual_mm: Float[np.ndarray, "n"]
    """Rms residual of the identified points (mm); NaN where refused."""
    position_mm: Float[np.ndarray, "n 3"]
    """Where the sensor was, world coordinates (mm); NaN where refused."""
    forward: Float[np.ndarray, "n 3"]
    """Where it looked, unit vectors in world coordinates; NaN where refused."""

    @property
    def is_positioned(self) -> Bool[np.ndarray, "n"]:
        """Which frames have a pose."""
        return np.asarray(np.isfinite(self.position_mm[:, 0]))


def time_figure(course: Course) -> str:
    """Outcome, residual and number of points of every frame, one above the other; SVG."""
    matched = np.where(course.is_positioned, course.matched, np.nan)
    lanes = sorted(set(course.outcome) - {"positioned"}, key=course.outcome.count, reverse=True)
    lane_height = 0.24 * (len(lanes) + 1)
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
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
        return _svg(figure, "Outcome, residual and points of every frame")


def path_figure(course: Course, targets: ReferenceMap) -> str:
    """Targets and the sensor's path from the front (x, y) and from above (x, z); SVG."""
    centre, half = _what_matters(course, targets)
    half[0] = max(half[0], 0.8 * half[1:].max())
    half[1:] = np.maximum(half[1:], 0.4 * half[0])
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 4.9 * half[1:].max() / half[0] + 1.0), layout="constrained")
        front, above = figure.subplots(1, 2)
        for axes, row, title in ((front, 1, "From the front"), (above, 2, "From above")):
            _draw_targets(axes, targets, row)
            _draw_path(axes, course, row)
            axes.set(title=title, xlabel="x (mm)", ylabel=f"{'xyz'[row]} (mm)", aspect="equal", anchor="N")
            axes.set_xlim(centre[0] - half[0], centre[0] + half[0])
            axes.set_ylim(centre[row] - half[row], centre[row] + half[row])
        front.invert_yaxis()  # y points down
        handles, labels = front.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=max(len(labels), 1), labelcolor=INK)
        return _svg(figure, "Targets and path of the sensor from the front and from above")


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
    """Start and width of each run of consecutive frames that are meant; none too thin to be seen."""
    change = np.flatnonzero(np.diff(np.r_[False, is_meant, False].astype(int)))
    thinnest = (course.frame[-1] - course.frame[0] + 1) / _MOST_BINS
    return [
        (course.frame[start] - 0.5, max(course.frame[end - 1] - course.frame[start] + 1, thinnest))
        for start, end in change.reshape(-1, 2)
    ]


def _draw_band(
    axes: Axes, frame: Int[np.ndarray, "n"], value: Float[np.ndarray, "n"], colour: str, label: str = ""
) -> None:
    """A value over time; of many frames, the median of each bin and the range around it."""
    size = -(-len(frame) // _MOST_BINS)
    padded = np.full(-(-len(frame) // size) * size, np.nan)
    padded[: len(value)] = value
    bins = padded.reshape(-1, size)
    known = np.isfinite(bins).any(axis=1)
    low, middle, high = np.full((3, len(bins)), np.nan)
    low[known], high[known] = np.nanmin(bins[known], axis=1), np.nanmax(bins[known], axis=1)
    middle[known] = np.nanmedian(bins[known], axis=1)
    at = frame[::size].astype(float)
    if size > 1:
        axes.fill_between(at, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(*_with_lone_points(at, middle), color=colour, linewidth=1.3, label=label)


def _draw_targets(axes: Axes, targets: ReferenceMap, row: int) -> None:
    looks: tuple[tuple[TargetState, str, dict[str, object]], ...] = (
        (TargetState.provisional, "target, provisional", {"marker": "o", "mfc": "none", "mec": FAINT, "ms": 3.5}),
        (TargetState.trusted, "target", {"marker": "o", "mfc": GOOD, "mec": "none", "ms": 4.5}),
        (TargetState.quarantined, "target, quarantined", {"marker": "x", "mec": BAD, "ms": 5}),
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


def _what_matters(course: Course, targets: ReferenceMap) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Centre and half extent of the box that holds the trusted targets and the path, with a margin.

    A false point far away must not shrink everything else.
    """
    trusted = targets.xyz_mm[targets.state == TargetState.trusted]
    xyz = np.concatenate([trusted, course.position_mm[course.is_positioned], np.zeros((1, 3))])
    if len(xyz) > 1:
        xyz = xyz[:-1]
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


def _svg(figure: Figure, title: str) -> str:
    """The figure as an SVG element whose colours are the page's variables."""
    text = io.StringIO()
    FigureCanvasSVG(figure)
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None, "Title": title})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    for colour, name in _VARIABLES.items():
        svg = svg.replace(colour, f"var(--{name})")
    return svg
