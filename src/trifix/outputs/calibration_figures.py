"""Figures of a calibration: where the board was seen, and what is left of each point and view. Draws arrays only."""

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trifix.calibration import Calibration
from trifix.geometry.camera import Camera
from trifix.outputs.figures import BAD, FAINT, GOOD, GRID, INK, PATH, STYLE, svg_of

_MOST_POINTS = 3000  # of one image; more cannot be told apart on a page
_CELL_ARROW = 0.4  # length of an arrow of the usual deviation of a point of the board, in cells
_ARROW = 0.03  # length of an arrow of the usual residual, in widths of the image


def coverage_figure(calibration: Calibration) -> str:
    """Where in both images the board was found; SVG."""
    at = calibration.residuals
    is_out = calibration.is_left_out[at.view]
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure, both = _both_images(calibration)
        for camera, axes in enumerate(both):
            for is_meant, colour, label in ((~is_out, GOOD, "point"), (is_out, BAD, "of a view left out")):
                uv = at.uv_px[_some((at.camera == camera) & is_meant)]
                if len(uv):
                    axes.plot(*uv.T, ".", color=colour, ms=3, label=label)
        _legend(figure, both)
        return svg_of(figure)


def residual_figure(calibration: Calibration) -> str:
    """What is left of each point that had a say, as arrows; SVG."""
    at = calibration.residuals
    has_say = ~calibration.is_left_out[at.view]
    usual_px = max(float(np.median(np.linalg.norm(at.error_px[has_say], axis=1))), 1e-9)
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure, both = _both_images(calibration)
        for camera, (axes, of) in enumerate(zip(both, (calibration.rig.left, calibration.rig.right), strict=True)):
            rows = _some((at.camera == camera) & has_say)
            times = _ARROW * of.width_px / usual_px
            axes.quiver(
                *at.uv_px[rows].T, *(times * at.error_px[rows]).T,
                color=GOOD, angles="xy", scale_units="xy", scale=1, width=0.0015, headwidth=4,
            )  # fmt: skip
            axes.set_title(f"{('Left', 'Right')[camera]}, {times:.0f} times as long")
        return svg_of(figure)


def view_figure(calibration: Calibration) -> str:
    """Rms residual of each view, left and right, and all residuals about zero; SVG."""
    at, rms = calibration.residuals, calibration.view_rms_px
    has_say = ~calibration.is_left_out[at.view]
    number = np.arange(len(rms))
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11, 3.6), layout="constrained")
        views, cloud = figure.subplots(1, 2, width_ratios=[2.2, 1])
        for camera, (name, shade) in enumerate((("left", 1.0), ("right", 0.5))):
            for is_out, colour in ((False, GOOD), (True, BAD)):
                rows = np.flatnonzero(calibration.is_left_out == is_out)
                label = f"{name}{', left out' if is_out else ''}" if len(rows) else None
                place = number[rows] + (camera - 0.5) * 0.4
                height = np.nan_to_num(rms[rows, camera])
                views.bar(place, height, 0.4, color=colour, alpha=shade, label=label, linewidth=0)
        views.axhline(calibration.rms_px, color=INK, linewidth=0.8)
        views.set(title="Residual of each view, rms (px); the line is all of them", xlabel="view")
        views.grid(axis="x", visible=False)
        views.legend(ncols=4, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0, labelcolor=INK)
        rows = _some(has_say)
        cloud.plot(*at.error_px[rows].T, ".", color=GOOD, ms=2)
        angle = np.linspace(0, 2 * np.pi, 100)
        cloud.plot(*(calibration.rms_px * np.array([np.cos(angle), np.sin(angle)])), color=INK, linewidth=0.8)
        cloud.set(title="All residuals (px) and their rms", xlabel="u", ylabel="v", aspect="equal")
        return svg_of(figure)


def board_figure(calibration: Calibration) -> str:
    """By how much the board's points are out of place: arrows in its plane, colours out of it; SVG."""
    cell, off_um = calibration.board_cell, 1e3 * calibration.board_mm
    usual_um = max(float(np.median(np.linalg.norm(off_um[:, :2], axis=1))), 1e-9)
    extent = cell.max(axis=0) - cell.min(axis=0) + 1
    height = float(np.clip(7.0 * extent[1] / extent[0], 2.5, 7.0))
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(8.5, height + 0.7), layout="constrained")
        axes = figure.subplots()
        axes.set_axisbelow(True)
        most_um = float(np.abs(off_um[:, 2]).max())
        dots = axes.scatter(
            cell[:, 0], cell[:, 1], c=off_um[:, 2], cmap="RdBu", vmin=-most_um, vmax=most_um, s=60, linewidth=0
        )
        figure.colorbar(dots, ax=axes, label="out of the plane, away from the cameras (µm)")
        arrows = axes.quiver(
            *cell.T, *off_um[:, :2].T,
            color=INK, angles="xy", scale_units="xy", scale=usual_um / _CELL_ARROW, width=0.003, headwidth=4,
        )  # fmt: skip
        told_um = float(f"{2 * usual_um:.1g}")
        axes.quiverkey(arrows, 0.92, 1.03, told_um, f"{told_um:g} µm", labelpos="E")
        axes.set(title="Points found less points meant", xlabel="column", ylabel="row", aspect="equal")
        axes.set(
            xlim=(cell[:, 0].min() - 1.5, cell[:, 0].max() + 1.5), ylim=(cell[:, 1].max() + 1.5, cell[:, 1].min() - 1.5)
        )
        return svg_of(figure)


def _both_images(calibration: Calibration) -> tuple[Figure, tuple[Axes, Axes]]:
    """Empty frames of both images side by side."""
    left, right = calibration.rig.left, calibration.rig.right
    figure = Figure(figsize=(11, 5.3 * left.height_px / left.width_px + 0.7), layout="constrained")
    both = figure.subplots(1, 2)
    for axes, camera, name in zip(both, (left, right), ("Left", "Right"), strict=True):
        _frame(axes, camera)
        axes.set_title(name)
    return figure, (both[0], both[1])


def _frame(axes: Axes, camera: Camera) -> None:
    axes.set(xlim=(-0.5, camera.width_px - 0.5), ylim=(camera.height_px - 0.5, -0.5), aspect="equal")
    axes.spines[:].set_visible(True)
    axes.plot([camera.pu_px], [camera.pv_px], "+", color=PATH, ms=9, label="principal point")
    axes.tick_params(color=GRID, labelcolor=FAINT)


def _legend(figure: Figure, both: tuple[Axes, Axes]) -> None:
    named = dict(zip(*reversed(both[0].get_legend_handles_labels()), strict=True))
    named |= dict(zip(*reversed(both[1].get_legend_handles_labels()), strict=True))
    figure.legend(list(named.values()), list(named), loc="outside lower center", ncols=len(named), labelcolor=INK)


def _some(is_meant: Bool[np.ndarray, "m"]) -> Float[np.ndarray, "k"] | np.ndarray:
    """Rows of those meant, evenly thinned out where there are too many."""
    rows = np.flatnonzero(is_meant)
    return rows[:: -(-len(rows) // _MOST_POINTS) or 1]
