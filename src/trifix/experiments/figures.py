"""The experiment's figures, after those of the paper (Khoury 2006): parts in, drawings out. Writes no file.

Drawn in the colours of a light page; ``for_page`` lets an SVG take those of the page it stands on.
"""

import io
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from trifix.experiments.acceptance import Acceptance
from trifix.experiments.measuring import Part, growth, slope
from trifix.outputs import figures
from trifix.records import ReferenceMap
from trifix.stages.identify.congruence import IdentifyOptions
from trifix.stages.identify.delaunay import DelaunayTriangles
from trifix.stages.identify.minimal import MinimalTriangles

_PAGE, _INK, _FAINT, _GRID = "#fefefe", "#1b1f24", "#66707c", "#dde1e6"
_GOOD, _BAD, _PATH, _SOFT = "#0072b2", "#d55e00", "#0b5c36", "#cfe3f1"
_VARIABLES = {
    _PAGE: "card", _INK: "ink", _FAINT: "faint", _GRID: "grid", _GOOD: "good", _BAD: "bad", _PATH: "path",
    _SOFT: "soft",
}  # fmt: skip
# Colours that can be told apart by most eyes on light and dark pages (Okabe and Ito 2008).
_LINES = {
    "frequency": ("#0072b1", "-"),
    "minimal": ("#009e73", "-"),
    "delaunay": ("#d55e01", "-"),
    "triangles": ("#cc79a7", "--"),
    "hashing": ("#9a7fd1", ":"),
    "distances": ("#e69f00", "--"),
    "icp": ("#8a929b", ":"),
}
_STYLE = figures.style_of(_INK, _FAINT, _GRID) | {
    "figure.facecolor": _PAGE,
    "axes.facecolor": _PAGE,
    "legend.labelcolor": _INK,
}
_LIGHT = np.array([0.5, 0.35, 0.8]) / np.linalg.norm([0.5, 0.35, 0.8])
_MOST_BEHIND = 0.15  # a point this far behind the middle, in units of the scatter's radius, is drawn as behind


def svg_of(figure: Figure) -> str:
    """The figure as SVG."""
    text = io.StringIO()
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        FigureCanvasSVG(figure)
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return text.getvalue()


def png_of(figure: Figure) -> bytes:
    """The figure as PNG."""
    data = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(data, format="png", dpi=110, metadata={"Software": None})
    return data.getvalue()


def for_page(svg: str) -> str:
    """An SVG as part of a page: in its colours, in its font."""
    return figures.for_page(svg, _VARIABLES)


# --- acceptance ------------------------------------------------------------------------------------------------------


def lengths_figure(found: Acceptance) -> Figure:
    """Error of each test length against the length, with the band that is permitted and twice the predicted sigma."""
    length, error, sigma = (
        np.array([getattr(each, name) for each in found.lengths]) for name in ("length_mm", "error_mm", "sigma_mm")
    )
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 4.4), layout="constrained")
        axes = figure.subplots()
        ends = np.array([0.0, 1.04 * length.max(initial=1.0)])
        limit = np.array([found.limit.at(end) for end in ends])
        axes.fill_between(ends, -limit, limit, color=_SOFT, linewidth=0, label="permitted")
        axes.axhline(0, color=_GRID, linewidth=0.8)
        axes.errorbar(
            length, error, 2 * sigma, fmt="none", ecolor=_FAINT, elinewidth=0.7, alpha=0.6, label="± 2 predicted sigma"
        )
        is_over = np.abs(error) > found.limit.constant_mm + found.limit.slope_mm_m * length / 1000
        axes.plot(length[~is_over], error[~is_over], "o", ms=4, mfc=_GOOD, mec="none", label="within")
        if is_over.any():
            axes.plot(length[is_over], error[is_over], "D", ms=5, mfc=_BAD, mec="none", label="beyond")
        axes.set(xlim=ends, xlabel="true length (mm)", ylabel="measured less true (mm)")
        axes.grid(axis="x", visible=False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        return figure


# --- 4-2 -------------------------------------------------------------------------------------------------------------


def accepted_figure(parts: Sequence[Part], paper: dict[tuple[str, str], float]) -> Figure:
    """Frames positioned by each technique, one panel a scene; the paper's shares (%) as diamonds."""
    scenes = list(dict.fromkeys(part.scene for part in parts))
    techniques = list(dict.fromkeys(part.technique for part in parts))
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 0.34 * len(techniques) + 1.5), layout="constrained")
        panels = figure.subplots(1, len(scenes), sharex=True, sharey=True, squeeze=False)[0]
        for axes, scene in zip(panels, scenes, strict=True):
            for part in parts:
                if part.scene == scene:
                    _draw_accepted(axes, part, techniques.index(part.technique))
            marks = [
                (share, techniques.index(technique))
                for (where, technique), share in paper.items()
                if where == scene and technique in techniques
            ]
            if marks:
                axes.plot(*zip(*marks, strict=True), "D", ms=6, mfc=_PAGE, mec=_INK, mew=1.2, label="the paper")
            axes.set(title=scene, xlim=(0, 100), ylim=(len(techniques) - 0.5, -0.5))
            axes.set_yticks(range(len(techniques)), techniques)
            axes.tick_params(axis="y", length=0, labelcolor=_INK)
            axes.grid(axis="y", visible=False)
        figure.supxlabel("share of all frames (%)", fontsize=9.5, color=_FAINT)
        entries = {
            label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(entries.values(), entries.keys(), loc="outside upper right", ncols=len(entries))
        return figure


def _draw_accepted(axes: Axes, part: Part, row: int) -> None:
    """Positioned, then failed although a growing map could reach the frame, then out of reach."""
    wrong = len(part.misidentified)
    impossible = min(part.frames - part.reachable, part.frames - part.positioned)
    failed = part.frames - part.positioned - impossible
    shares = 100 / part.frames * np.array([part.positioned - wrong, wrong, failed, impossible])
    looks = (("positioned", _GOOD), ("positioned wrongly", _BAD), ("failed", _SOFT), ("out of reach of any", _GRID))
    left = 0.0
    for share, (label, colour) in zip(shares.tolist(), looks, strict=True):
        axes.barh(row, share, 0.68, left, color=colour, label=label)
        left += share


# --- 4-1 -------------------------------------------------------------------------------------------------------------


def growth_figure(parts: Sequence[Part]) -> Figure:
    """Triangles or distances against the number of targets in the list, and the same up to 100."""
    by_scene: dict[str, list[Part]] = {}
    for part in parts:
        by_scene.setdefault(part.scene, []).append(part)
    largest = max(by_scene, key=lambda scene: max(part.targets[-1] for part in by_scene[scene]))
    shown = list(dict.fromkeys([next(iter(by_scene)), largest]))
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 6.6), layout="constrained")
        panels = figure.subplots(2, len(shown), sharex="col", squeeze=False)
        for (above, below), scene in zip(panels.T, shown, strict=True):
            most = 10
            for part in by_scene[scene]:
                count, size = growth(part.targets, part.sizes)
                if not size.any():
                    continue
                most = max(most, int(count.max()))
                colour, line = _LINES[part.technique]
                steepness = slope(part.targets, part.sizes)
                grows_evenly = steepness is not None and size.max() < 10 * count.max()
                above.plot(count, size, line, color=colour, linewidth=1.8, label=part.technique)
                below.plot(
                    count,
                    size,
                    line,
                    color=colour,
                    linewidth=1.8,
                    label=f"{part.technique}: {steepness:.2f} per target" if grows_evenly else "_",
                )
            above.set(title=f"{scene}: triangles or distances in the list", yscale="log")
            below.set(title="the same, close up", ylim=(0, max(100, 2.6 * most)), xlabel="targets in the list")
            below.set_xlim(0, 1.04 * most)
            below.xaxis.set_major_locator(MaxNLocator(8, integer=True))
            if below.get_legend_handles_labels()[0]:
                below.legend(loc="upper left", frameon=True, facecolor=_PAGE, framealpha=0.9, edgecolor="none")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
        return figure


# --- 3-1 to 3-3 ------------------------------------------------------------------------------------------------------


def triangles_figure(part: Part, counted: Part | None) -> Figure:
    """The triangles of one scatter, the targets of ``part``: Delaunay, minimal and, where ``counted``, frequency.

    What was seen in one or two frames only is false, mostly, and far from all others; it is left out.
    """
    is_shown = np.array(part.sightings, dtype=np.int64) >= 3
    xyz = np.array(part.map_mm).reshape(-1, 3)[is_shown]
    scatter, all_rows = ReferenceMap.given(xyz), np.arange(len(xyz))
    panels: list[tuple[str, Int[np.ndarray, "t 3"]]] = []
    for title, technique in (
        ("3-1  Delaunay", DelaunayTriangles(IdentifyOptions())),
        ("3-2  minimal", MinimalTriangles(IdentifyOptions())),
    ):
        technique.learn(scatter, all_rows)
        panels.append((title, technique.triangles()))
    if counted is not None:
        triangles = np.array(counted.triangles, dtype=np.int64).reshape(-1, 3)
        row = np.cumsum(is_shown) - 1
        panels.append(("3-3  frequency", row[triangles[is_shown[triangles].all(axis=1)]]))
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 11 / len(panels) + 0.5), layout="constrained")
        for axes, (title, triangles) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            _draw_surface(axes, xyz, triangles)
            axes.set_title(f"{title}: {len(triangles)} triangles, {len(xyz)} targets")
        for axes in figure.axes:
            handles, labels = axes.get_legend_handles_labels()
            if handles:
                figure.legend(handles, labels, loc="outside lower center")
                break
        return figure


def _draw_surface(axes: Axes, xyz_mm: Float[np.ndarray, "k 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
    """Triangles as opaque faces, the nearer before the farther, seen from a little above and to the side."""
    axes.set(aspect="equal")
    axes.axis("off")
    if not len(xyz_mm):
        return
    towards, right, up = _view(xyz_mm)
    centred = xyz_mm - xyz_mm.mean(axis=0)
    depth, flat = centred @ towards, np.stack([centred @ right, centred @ up], axis=1)
    is_behind = depth < -_MOST_BEHIND * np.abs(centred).max()
    axes.plot(*flat[is_behind].T, "o", ms=2.5, color=_FAINT, linestyle="")
    if len(triangles):
        nearest_last = triangles[np.argsort(depth[triangles].mean(axis=1), kind="stable")]
        a, b, c = (centred[nearest_last[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        light = np.abs(normal @ (np.stack([right, up, towards], axis=1) @ _LIGHT))[:, None]
        tint = np.array(mpl.colors.to_rgb("#9cc7e3")) * (0.55 + 0.45 * light)
        faces = np.concatenate([tint, np.full((len(tint), 1), 0.82)], axis=1)
        axes.add_collection(PolyCollection(flat[nearest_last], facecolors=faces, edgecolors="#12415f", linewidths=0.7))
    is_alone = np.ones(len(xyz_mm), dtype=np.bool_)
    is_alone[np.unique(triangles)] = False
    axes.plot(*flat[~is_behind & ~is_alone].T, "o", ms=3.6, mfc=_INK, mec="none", linestyle="")
    if is_alone.any():
        axes.plot(*flat[is_alone].T, "o", ms=6, mfc="none", mec=_BAD, mew=1.8, linestyle="", label="in no triangle")
    axes.autoscale_view()


def _view(xyz_mm: Float[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors towards the viewer, to his right and upwards."""
    if _is_flat(xyz_mm):
        return np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    azimuth, elevation = np.radians(20), np.radians(12)
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return towards, right, np.cross(towards, right)


def _is_flat(xyz_mm: Float[np.ndarray, "k 3"]) -> bool:
    """Whether the targets lie flat, seen from +z; else they stand upright (z), seen from +x."""
    width, depth, height = np.ptp(xyz_mm, axis=0)
    return bool(height < 0.5 * min(width, depth))


# --- 4-3 to 4-6 ------------------------------------------------------------------------------------------------------


def path_figure(part: Part) -> Figure:
    """Targets and the path of the sensor, from the front and from above, in coordinates of the object."""
    true, found = np.array(part.true_mm).reshape(-1, 3), np.array(part.map_mm).reshape(-1, 3)
    path, frame = np.array(part.path_mm).reshape(-1, 3), np.array(part.path_frame, dtype=np.int64)
    is_wrong = np.isin(frame, part.misidentified)
    # from above, what is nearer to someone in front is lower in the picture
    across, upwards, away = (0, 1, 2) if _is_flat(true) else (1, 2, 0)
    names = "xyz"
    shown = np.concatenate([true, path[~is_wrong]])
    low, high = shown.min(axis=0) - 25, shown.max(axis=0) + 25
    size = high - low
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        tallest = max(size[upwards], size[away]) / size[across]
        figure = Figure(figsize=(11, float(np.clip(4.55 * tallest, 2.2, 6.5)) + 1.35), layout="constrained")
        for axes, row, title in zip(
            figure.subplots(1, 2), (upwards, away), ("from the front", "from above"), strict=True
        ):
            axes.plot(*_broken(path[~is_wrong][:, [across, row]], frame[~is_wrong]), color=_PATH, linewidth=0.9,
                      alpha=0.8, label="path of the sensor")  # fmt: skip
            if is_wrong.any():
                axes.plot(*path[is_wrong][:, [across, row]].T, "x", ms=4, color=_BAD, label="positioned wrongly")
            axes.plot(*found[:, [across, row]].T, "o", ms=4, mfc=_GOOD, mec="none", label="target in the list")
            axes.plot(*true[:, [across, row]].T, "o", ms=7, mfc="none", mec=_INK, mew=0.8, label="true target")
            axes.set(
                title=title, xlabel=f"{names[across]} (mm)", ylabel=f"{names[row]} (mm)", aspect="equal", anchor="N"
            )
            axes.set_xlim(low[across], high[across])
            axes.set_ylim(low[row], high[row])
            if row == away:
                axes.invert_yaxis()
        entries, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(entries, labels, loc="outside lower center", ncols=len(labels))
        return figure


def _broken(xy_mm: Float[np.ndarray, "n 2"], frame: Int[np.ndarray, "n"]) -> Float[np.ndarray, "2 m"]:
    """The path with a gap wherever frames are missing."""
    gaps = np.flatnonzero(np.diff(frame) > 1) + 1
    return np.asarray(np.insert(xy_mm, gaps, np.nan, axis=0).T)
