"""What a calibration came to, for programs and for people: YAML, JSON, one self-contained page, a table.

Computes nothing of the calibration itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from trifix.boards import Board, Search
from trifix.calibration import OUTLIER, PARAMETERS, Calibration, parameters_of
from trifix.files.calibrations import write_rig
from trifix.files.tables import write_atomically
from trifix.geometry.camera import Camera
from trifix.geometry.pose import log_rotation
from trifix.outputs.calibration_figures import board_figure, coverage_figure, residual_figure, view_figure
from trifix.outputs.page import environment
from trifix.outputs.summary import versions

_CELLS = (8, 6)  # into which an image is divided to say how much of it the board was seen in
_FEW_VIEWS, _LITTLE_COVERAGE, _LITTLE_TILT_DEG = 10, 0.5, 20.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter and how uncertain it is."""

    value: float
    """The value."""
    sigma: float
    """Its standard deviation."""


@dataclass(frozen=True, slots=True)
class BoardPoint:
    """By how much a point of the board is out of place, in board coordinates: x along columns, y along rows."""

    column: int
    """Its column."""
    row: int
    """Its row."""
    x_um: float
    """Along the columns' count (µm)."""
    y_um: float
    """Along the rows' count (µm)."""
    z_um: float
    """Out of the board, away from who looks at it (µm)."""


@dataclass(frozen=True, slots=True)
class ViewResidual:
    """What the calibration leaves of one pair of images."""

    view: str
    """The pair: its number, and the name of the left image."""
    left_px: float | None
    """Rms residual in the left image (px); None where it does not show the board."""
    right_px: float | None
    """The same of the right one."""
    is_left_out: bool
    """Whether it had no say, as its residuals stand out."""


@dataclass(frozen=True, slots=True)
class CalibrationSummary:
    """A calibration in numbers."""

    recording: str
    """Name of the recording."""
    board: str
    """What was looked for."""
    pairs: int
    """Pairs of images looked at."""
    views: int
    """Pairs that show the board in one image at least."""
    both: int
    """Pairs that show it in both."""
    left_out: tuple[str, ...]
    """Views that had no say, as their residuals stand out."""
    unreadable: tuple[str, ...]
    """Why images could not be read."""
    points: int
    """Points found, in both images together, without the views left out."""
    rms_px: float
    """Rms distance of points found and projected (px)."""
    image_sigma_px: float
    """Of these, what each image does by itself: standard deviation per coordinate (px)."""
    board_sigma_mm: float
    """And what all images have in common: by how much points of the board are out of place, per coordinate (mm)."""
    scale_sigma: float
    """Standard deviation of the board's size, relative; part of the covariance."""
    board_points: tuple[BoardPoint, ...]
    """By how much its points are out of place; empty where that was not sought."""
    epipolar_rms_px: float
    """Rms distance of points from one another's epipolar lines (px)."""
    coverage: tuple[float, float]
    """Share of the left and of the right image in which the board was seen."""
    tilt_deg: float
    """Largest angle between the board in two views (degrees)."""
    baseline_mm: Estimate
    """Distance of the cameras (mm)."""
    left: Mapping[str, Estimate]
    """Intrinsics (px) and distortion coefficients of the left camera."""
    right: Mapping[str, Estimate]
    """The same of the right one."""
    T_right_left: Mapping[str, Estimate]
    """Translation (mm), and the rotation vector (rad); sigma of δ in T_right_left · exp(δ)."""
    parameters: tuple[str, ...]
    """What the rows of the covariance are."""
    covariance: list[list[float]]
    """Covariance of the parameters."""
    by_view: tuple[ViewResidual, ...]
    """What is left of each view."""
    advice: tuple[str, ...]
    """What would make the calibration better."""
    versions: Mapping[str, str]
    """Versions of what computed it."""


def summarise(calibration: Calibration, search: Search, board: Board, recording: str) -> CalibrationSummary:
    """The calibration in numbers."""
    rig, sigma, T = calibration.rig, calibration.sigma.tolist(), calibration.rig.T_right_left
    is_out = calibration.is_left_out
    coverage = (_coverage(calibration, 0), _coverage(calibration, 1))
    motion = np.r_[T.t_mm, log_rotation(T.R)].tolist()
    rms = [[None if np.isnan(x) else x for x in row] for row in calibration.view_rms_px.tolist()]
    has_say = ~is_out[calibration.residuals.view]
    return CalibrationSummary(
        recording=recording,
        board=str(board),
        pairs=search.looked,
        views=len(calibration.views),
        both=sum(view.is_pair for view in calibration.views),
        left_out=tuple(view.name for view, out in zip(calibration.views, is_out, strict=True) if out),
        unreadable=search.unreadable,
        points=int(has_say.sum()),
        rms_px=calibration.rms_px,
        image_sigma_px=calibration.image_sigma_px,
        board_sigma_mm=calibration.board_sigma_mm,
        scale_sigma=calibration.scale_sigma,
        board_points=tuple(
            BoardPoint(*cell, *place)
            for cell, place in zip(calibration.board_cell.tolist(), (1e3 * calibration.board_mm).tolist(), strict=True)
            if calibration.is_board_sought
        ),
        epipolar_rms_px=calibration.epipolar_rms_px,
        coverage=coverage,
        tilt_deg=float(np.degrees(calibration.tilt_rad)),
        baseline_mm=Estimate(rig.baseline_mm, calibration.baseline_sigma_mm),
        left=_estimates(rig.left, sigma[:8]),
        right=_estimates(rig.right, sigma[8:16]),
        T_right_left={
            name: Estimate(*pair)
            for name, *pair in zip(("x_mm", "y_mm", "z_mm", "rx", "ry", "rz"), motion, sigma[16:], strict=True)
        },
        parameters=PARAMETERS,
        covariance=calibration.cov.tolist(),
        by_view=tuple(
            ViewResidual(view.name, left, right, bool(out))
            for view, (left, right), out in zip(calibration.views, rms, is_out, strict=True)
        ),
        advice=_advice(int((~is_out).sum()), coverage, float(np.degrees(calibration.tilt_rad))),
        versions=versions(),
    )


def _estimates(camera: Camera, sigma: Sequence[float]) -> dict[str, Estimate]:
    coefficients = ("k1", "k2", "p1", "p2") if camera.model == "radtan" else ("k1", "k2", "k3", "k4")
    names = ("fu", "fv", "pu", "pv", *coefficients)
    values = parameters_of(camera).tolist()
    return {name: Estimate(*pair) for name, *pair in zip(names, values, sigma, strict=True)}


def _coverage(calibration: Calibration, camera: int) -> float:
    """Share of an image's cells in which a point was found."""
    at = calibration.residuals
    of = (calibration.rig.left, calibration.rig.right)[camera]
    uv = at.uv_px[(at.camera == camera) & ~calibration.is_left_out[at.view]]
    cell = ((uv + 0.5) / [of.width_px, of.height_px] * _CELLS).astype(int).clip(0, np.array(_CELLS) - 1)
    return len(np.unique(cell, axis=0)) / (_CELLS[0] * _CELLS[1])


def _advice(views: int, coverage: tuple[float, float], tilt_deg: float) -> tuple[str, ...]:
    found = []
    if views < _FEW_VIEWS:
        found.append(f"There are {views} views; {_FEW_VIEWS} to 20 average out more.")
    for side, share in zip(("left", "right"), coverage, strict=True):
        if share < _LITTLE_COVERAGE:
            found.append(
                f"The board was seen in {100 * share:.0f} % of the {side} image only; distortion is unknown elsewhere."
            )
    if tilt_deg < _LITTLE_TILT_DEG:
        found.append(
            f"The board was tilted by {tilt_deg:.0f}° between views at most; 20° to 45° hold the focal lengths better."
        )
    return tuple(found)


def write_calibration(calibration: Calibration, summary: CalibrationSummary, out: Path) -> None:
    """Writes ``calibration.yaml`` for recordings, ``calibration.json`` and ``calibration.html``."""
    out.mkdir(parents=True, exist_ok=True)
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2).decode()
    write_atomically(out / "calibration.json", text + "\n")
    page = environment().get_template("calibration.html.jinja")
    figures = {
        "coverage": coverage_figure(calibration),
        "residuals": residual_figure(calibration),
        "views": view_figure(calibration),
        "board": board_figure(calibration) if calibration.is_board_sought else "",
    }
    written = datetime.now().astimezone()
    html = page.render(c=summary, figures=figures, written=written, outlier=OUTLIER, rows=estimate_rows(summary))
    write_atomically(out / "calibration.html", html)
    write_rig(calibration.rig, out / "calibration.yaml")


def estimate_rows(summary: CalibrationSummary) -> list[tuple[str, str, str, str, str]]:
    """Name, left value ± sigma, right value ± sigma of the cameras' parameters, as text."""
    names = {"fu": "px", "fv": "px", "pu": "px", "pv": "px"}
    return [
        (f"{name} ({names[name]})" if name in names else name, *_plus_minus(left), *_plus_minus(summary.right[name]))
        for name, left in summary.left.items()
    ]


def _plus_minus(estimate: Estimate) -> tuple[str, str]:
    """Value and sigma with the decimals that the sigma's second digit leaves."""
    if not estimate.sigma > 0:
        return f"{estimate.value:.6g}", "0"
    decimals = max(0, 1 - int(np.floor(np.log10(estimate.sigma))))
    return f"{estimate.value:.{decimals}f}", f"{estimate.sigma:.{decimals}f}"


def calibration_table(summary: CalibrationSummary, out: Path) -> Group:
    """A calibration at a glance, for ``rich`` to print."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(justify="right")
    table.add_column()
    table.add_row("views", Text(str(summary.views), "bold green"), f"of {summary.pairs} pairs  {summary.both} in both")
    for each in summary.by_view:
        if each.is_left_out:
            worst = max(x for x in (each.left_px, each.right_px) if x is not None)
            table.add_row("left out", Text(f"{worst:.3f}", "yellow"), f"px  view {each.view}")
    table.add_row("residual, rms", f"{summary.rms_px:.3f}", f"px  of {summary.points} points")
    table.add_row("of each image", f"{summary.image_sigma_px:.3f}", "px per coordinate")
    sought = ", which the calibration knows" if summary.board_points else ""
    table.add_row("of the board", f"{summary.board_sigma_mm:.4f}", f"mm per coordinate: points out of place{sought}")
    table.add_row("epipolar, rms", f"{summary.epipolar_rms_px:.3f}", "px")
    table.add_row("baseline", *_in_line(summary.baseline_mm, "mm"))
    for side, camera in (("left", summary.left), ("right", summary.right)):
        for name in ("fu", "fv", "pu", "pv"):
            table.add_row(f"{side} {name}", *_in_line(camera[name], "px"))
    shares = " and ".join(f"{100 * share:.0f}" for share in summary.coverage)
    table.add_row("coverage", shares, "% of the left and right image")
    table.add_row("tilt", f"{summary.tilt_deg:.0f}", "° between views at most")
    advice = [Text(each, "yellow") for each in summary.advice]
    places = [
        Text.assemble(f"{name:12}", (str(out / file), "bold"))
        for name, file in (("calibration", "calibration.yaml"), ("report", "calibration.html"))
    ]
    return Group(table, Text(), *advice, *([Text()] if advice else []), *places)


def _in_line(estimate: Estimate, unit: str) -> tuple[str, str]:
    value, sigma = _plus_minus(estimate)
    return value, f"± {sigma} {unit}"


def record_of(summary: CalibrationSummary, out: Path) -> dict[str, object]:
    """What programs read: the summary, and where the files are."""
    return {**asdict(summary), "calibration": out / "calibration.yaml", "page": out / "calibration.html"}
