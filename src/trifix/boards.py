"""Find calibration boards in images: chessboards and ChArUco boards by OpenCV, grids of dots by trifix's own detection.

Every point found is told by its column and row on the board, the same in all images. Knows no camera.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from trifix.calibration import LEAST_POINTS, BoardView, Sighting
from trifix.errors import CalibrationError, ConfigError
from trifix.files.images import ImagePairs
from trifix.records import Dots, GreyOrColour
from trifix.stages.detect import detect

Target = Literal["chessboard", "charuco", "dots"]

_ALIKE = 1.5  # factor between the diameters of dots of one grid
_CLEAR = 0.4  # of a square around a chessboard's corner: nothing else, also where the board is seen obliquely
_SEEDS = 5  # dots near the middle from which a lattice is tried to grow
_NEAR = 0.3  # of the shorter step of the lattice: how far from its expected place a dot may be
_IS_RING = 0.5  # brightness of a dot's core between that of its body (0) and of what surrounds it (1)


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board whose points form a square lattice."""

    target: Target
    """What marks the points."""
    pitch_mm: float
    """Distance between neighbouring points: side of a square, or pitch of the dots (mm)."""
    columns: int = 0
    """Points in a row: inner corners, or dots; of no consequence with rings."""
    rows: int = 0
    """Points in a column."""
    marker_mm: float = 0.0
    """Side of a ChArUco marker (mm)."""
    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the ChArUco markers' dictionary."""
    has_rings: bool = False
    """Whether three of the dots are rings: one at a corner, one in its row and one in its column."""

    def __post_init__(self) -> None:
        if not 0 < self.pitch_mm < np.inf:
            raise ConfigError(
                f"the pitch of the board is {self.pitch_mm:g} mm, expected a positive length; the side of a square "
                f"(--square-mm) or the distance between dots (--pitch-mm)."
            )
        if not self.has_rings and min(self.columns, self.rows) < 3:
            raise ConfigError(f"a board of {self.columns} x {self.rows} points is too small, expected at least 3 x 3.")
        if self.target == "charuco":
            if not 0 < self.marker_mm < self.pitch_mm:
                raise ConfigError(
                    f"the markers are {self.marker_mm:g} mm and the squares {self.pitch_mm:g} mm wide, expected "
                    f"markers that fit into the squares (--marker-mm, --square-mm)."
                )
            if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
                known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
                raise ConfigError(f"there is no dictionary {self.dictionary}, expected one of {', '.join(known)}.")

    def __str__(self) -> str:
        extent = f"of {self.columns} x {self.rows}"
        match self.target:
            case "chessboard":
                return f"a chessboard {extent} inner corners, all of them in the image"
            case "charuco":
                return f"a ChArUco board {extent} inner corners with markers of {self.dictionary}"
            case "dots" if self.has_rings:
                return (
                    "a grid of dots of which three in the image are rings: a corner, one in its row, one in its column"
                )
            case "dots":
                return f"a grid {extent} dots, all of them in the image"
            case never:
                assert_never(never)


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What was found of a board in a recording."""

    views: tuple[BoardView, ...]
    """The pairs of which at least one image shows the board."""
    looked: int
    """Pairs looked at."""
    unreadable: tuple[str, ...]
    """Why images could not be read; their pairs are not among the views."""
    left_size_px: tuple[int, int]
    """Width and height of the left images."""
    right_size_px: tuple[int, int]
    """The same of the right ones."""


def find_views(
    pairs: ImagePairs, board: Board, every: int = 1, progress: Callable[[int, int], None] = lambda done, of: None
) -> Search:
    """The board in every n-th pair of a recording.

    Raises:
        CalibrationError: no pair shows the board, or images of one camera differ in size.
    """
    looked = range(0, len(pairs.timestamp_ns), every)
    sizes: dict[str, tuple[int, int]] = {}
    unreadable, names, found = [], [], []
    for done, k in enumerate(looked):
        progress(done, len(looked))
        images = pairs.left(k), pairs.right(k)
        if isinstance(images[0], str) or isinstance(images[1], str):
            unreadable += [each for each in images if isinstance(each, str)]
            continue
        for side, image, file in zip(("left", "right"), images, pairs.files(k), strict=True):
            assert not isinstance(image, str)
            size = (image.shape[1], image.shape[0])
            if sizes.setdefault(side, size) != size:
                raise CalibrationError(
                    f"{file}: this {side} image is {size[0]} x {size[1]} pixels, those before it are "
                    f"{sizes[side][0]} x {sizes[side][1]}; expected images of one size from each camera."
                )
        files = pairs.files(k)
        names.append(f"{k}" if files == pairs.files(looked[0]) and k else f"{k} ({files[0].name})")
        found.append((_find(images[0], board), _find(images[1], board)))
    progress(len(looked), len(looked))
    views = _views(names, found)
    if not views:
        raise CalibrationError(
            f"found no board in {len(looked)} image pairs"
            + (f", of which {len(unreadable)} images could not be read" if unreadable else "")
            + f"; expected {board}."
        )
    return Search(tuple(views), len(looked), tuple(unreadable), sizes["left"], sizes["right"])


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """A board in one image."""

    ways: Sequence[Sighting]
    """Ways to count its columns and rows, where turning it makes no difference; none where it was not found."""
    legs: tuple[int, int] | None = None
    """Where it has rings: how many columns and rows they are apart."""


def _views(names: Sequence[str], found: Sequence[tuple[_Found, _Found]]) -> list[BoardView]:
    """What was found, counted alike in both images of a pair; without boards whose rings differ from the others'."""
    legs = Counter(each.legs for pair in found for each in pair if each.ways)
    usual = legs.most_common(1)[0][0] if legs else None
    views = []
    for name, pair in zip(names, found, strict=True):
        left_ways, right_ways = (each.ways if each.legs == usual else () for each in pair)
        left = _most_along(np.array([1.0, 0.0]), left_ways)
        right = _most_along(np.array([1.0, 0.0]) if left is None else _direction(left), right_ways)
        if left is not None or right is not None:
            views.append(BoardView(name, left, right))
    return views


def _most_along(direction: Float[np.ndarray, "2"], ways: Sequence[Sighting]) -> Sighting | None:
    """The way to count in which the columns follow one another in a direction."""
    return max(ways, key=lambda way: float(direction @ _direction(way)), default=None)


def _direction(sighting: Sighting) -> Float[np.ndarray, "2"]:
    """Unit vector in the image along which the columns count up."""
    step = _steps(sighting)[0]
    return np.asarray(step / np.linalg.norm(step))


def _steps(sighting: Sighting) -> Float[np.ndarray, "2 2"]:
    """Mean step in the image (px) of a column and of a row."""
    cell = sighting.cell - sighting.cell.mean(axis=0)
    return np.asarray(np.linalg.lstsq(cell, sighting.uv_px - sighting.uv_px.mean(axis=0), rcond=None)[0])


def _find(image: GreyOrColour, board: Board) -> _Found:
    match board.target:
        case "chessboard":
            return _Found(_find_chessboard(_grey8(image), board))
        case "charuco":
            return _Found(_find_charuco(_grey8(image), board))
        case "dots":
            grey = _grey8(image)
            return _find_rings(grey, detect(image)) if board.has_rings else _Found(_find_grid(detect(image), board))
        case never:
            assert_never(never)


def _grey8(image: GreyOrColour) -> UInt8[np.ndarray, "h w"]:
    """The image as OpenCV's finders want it."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    if grey.dtype == np.uint16:  # of which cameras use but a part
        grey = cv2.convertScaleAbs(grey, alpha=255 / max(int(grey.max()), 1))
    return np.ascontiguousarray(grey)


def _find_chessboard(grey: UInt8[np.ndarray, "h w"], board: Board) -> list[Sighting]:
    """Inner corners by OpenCV's sector-based finder (Duda & Frese 2018); all or none."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    is_found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not is_found:
        return []
    turns = _turns(np.asarray(corners, dtype=float).reshape(board.rows, board.columns, 2))
    dark_first = [grid for grid in turns if _is_first_dark(grey, grid)]
    return [_refined(grey, _of_grid(grid), _CLEAR) for grid in dark_first or turns]


def _is_first_dark(grey: UInt8[np.ndarray, "h w"], grid: Float[np.ndarray, "r c 2"]) -> bool:
    """Whether the square right below the first corner is one of the dark ones."""
    middle = (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]) / 4
    u, v = np.moveaxis(middle.astype(np.float32), -1, 0)
    values = np.asarray(cv2.remap(grey, u, v, cv2.INTER_LINEAR), dtype=float)
    is_first = np.indices(values.shape).sum(axis=0) % 2 == 0
    return bool(values[is_first].mean() < values[~is_first].mean())


def _turns(grid: Float[np.ndarray, "r c 2"]) -> list[Float[np.ndarray, "r c 2"]]:
    """The same points counted from each corner that leaves columns and rows as many as they are; never mirrored."""
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]
    return [np.rot90(grid, k) for k in range(4) if np.rot90(grid, k).shape == grid.shape]


def _of_grid(grid: Float[np.ndarray, "r c 2"]) -> Sighting:
    row, column = np.indices(grid.shape[:2])
    cell = np.stack([column.ravel(), row.ravel()], axis=1)
    return Sighting(cell, np.ascontiguousarray(grid.reshape(-1, 2)), np.zeros(len(cell)))


def _find_charuco(grey: UInt8[np.ndarray, "h w"], board: Board) -> list[Sighting]:
    """Corners between markers that were read, by OpenCV; a part of the board is enough."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    printed = cv2.aruco.CharucoBoard((board.columns + 1, board.rows + 1), board.pitch_mm, board.marker_mm, dictionary)
    corners, ids, *_ = cv2.aruco.CharucoDetector(printed).detectBoard(grey)
    if ids is None or len(ids) < LEAST_POINTS:
        return []
    row, column = np.divmod(np.ravel(ids).astype(np.int64), board.columns)
    cell = np.stack([column, row], axis=1)
    if min(len(np.unique(column)), len(np.unique(row))) < 2:  # on a line
        return []
    clear = (1 - board.marker_mm / board.pitch_mm) / 2  # what is left between a corner and the markers
    return [_refined(grey, Sighting(cell, np.asarray(corners, dtype=float).reshape(-1, 2), np.zeros(len(cell))), clear)]


def _refined(grey: UInt8[np.ndarray, "h w"], sighting: Sighting, clear: float) -> Sighting:
    """The corners again, from as much around them as shows nothing else: ``clear``, a fraction of a square."""
    along, down = _steps(sighting)
    width_px = abs(along[0] * down[1] - along[1] * down[0]) / max(np.linalg.norm(along), np.linalg.norm(down))
    reach = max(2, int(clear * width_px))
    corners = np.ascontiguousarray(sighting.uv_px[:, None], dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    found = cv2.cornerSubPix(grey, corners, (reach, reach), (-1, -1), stop)
    return replace(sighting, uv_px=np.asarray(found, dtype=float).reshape(-1, 2))


def _find_grid(dots: Dots, board: Board) -> list[Sighting]:
    """All dots of a grid without marks; all or none, as a part of it could be any part."""
    dots = _of_one_size(dots)
    row, cell = _lattice(dots.uv_px)
    if len(row) != board.columns * board.rows:
        return []
    cell = cell - cell.min(axis=0)
    columns, rows = (cell.max(axis=0) + 1).tolist()
    if {columns, rows} != {board.columns, board.rows}:
        return []
    at = np.zeros((rows, columns), dtype=np.int64)
    at[cell[:, 1], cell[:, 0]] = row
    turns = _turns(dots.uv_px[at if columns == board.columns else np.rot90(at)])
    radius = float(np.median(dots.ellipse[row, 0]))
    return [replace(turned, radius_px=np.full(len(row), radius)) for turned in map(_of_grid, turns)]


def _find_rings(grey: UInt8[np.ndarray, "h w"], dots: Dots) -> _Found:
    """All dots of a grid, counted from the ring that shares its row with one other and its column with the third."""
    dots = _of_one_size(dots)
    row, cell = _lattice(dots.uv_px)
    rings = cell[_are_rings(grey, dots)[row]]
    if len(rings) != 3:
        return _Found(())
    for k in range(3):
        one, other = np.delete(rings, k, axis=0) - rings[k]
        if np.count_nonzero(one) == np.count_nonzero(other) == 1 and one @ other == 0:
            if one[0] * other[1] - one[1] * other[0] < 0:  # rows count up to the right of where columns do
                one, other = other, one
            axes = np.stack([np.sign(one), np.sign(other)])
            counted = (cell - rings[k]) @ axes.T
            legs = (int(np.abs(one).sum()), int(np.abs(other).sum()))
            return _Found([Sighting(counted, dots.uv_px[row], dots.ellipse[row, 0])], legs)
    return _Found(())


def _of_one_size(dots: Dots) -> Dots:
    """The dots about as large as most of what dots cover; specks are many, but cover little."""
    order = np.argsort(dots.diameter_px)
    area = np.cumsum(dots.diameter_px[order] ** 2)
    if not len(order):
        return dots
    usual = dots.diameter_px[order[np.searchsorted(area, area[-1] / 2)]]
    kept = (dots.diameter_px < _ALIKE * usual) & (dots.diameter_px > usual / _ALIKE)
    return Dots(dots.uv_px[kept], dots.cov_px2[kept], dots.ellipse[kept], dots.label[kept], dots.row[kept])


def _are_rings(grey: UInt8[np.ndarray, "h w"], dots: Dots) -> Bool[np.ndarray, "n"]:
    """Which dots have a core like what surrounds them."""
    core, body, around = (_along_ellipses(grey, dots, scale) for scale in (0.1, 0.7, 1.3))
    contrast = around - body
    return np.asarray(np.abs(core - body) > _IS_RING * np.abs(contrast))


def _along_ellipses(grey: UInt8[np.ndarray, "h w"], dots: Dots, scale: float) -> Float[np.ndarray, "n"]:
    """Mean grey value on each dot's ellipse, shrunk or widened."""
    if not len(dots):
        return np.zeros(0)
    phi = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    a, b, theta = (dots.ellipse.T * [[scale], [scale], [1.0]])[:, :, None]
    u = dots.uv_px[:, :1] + a * np.cos(phi) * np.cos(theta) - b * np.sin(phi) * np.sin(theta)
    v = dots.uv_px[:, 1:] + a * np.cos(phi) * np.sin(theta) + b * np.sin(phi) * np.cos(theta)
    values = cv2.remap(
        grey, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(values.reshape(len(dots), -1).mean(axis=1))


def _lattice(uv_px: Float[np.ndarray, "n 2"]) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m 2"]]:
    """Rows of the dots that form a lattice, and the cell of each; the largest that grows out of the middle.

    Cells count up along two short steps, the second to the right of the first as the image shows them.
    """
    best: dict[int, tuple[int, int]] = {}
    if not len(uv_px):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64)
    for seed in np.argsort(np.linalg.norm(uv_px - np.median(uv_px, axis=0), axis=1))[:_SEEDS].tolist():
        grown = _grow(uv_px, seed)
        best = grown if len(grown) > len(best) else best
    row = np.array(sorted(best), dtype=np.int64)
    return row, np.array([best[k] for k in row.tolist()], dtype=np.int64).reshape(-1, 2)


def _grow(uv_px: Float[np.ndarray, "n 2"], seed: int) -> dict[int, tuple[int, int]]:
    """The cell of each dot that steps from neighbour to neighbour lead to, the steps changing with the perspective."""
    offset = np.delete(uv_px, seed, axis=0) - uv_px[seed]
    offset = offset[np.argsort(np.linalg.norm(offset, axis=1))]
    if len(offset) < 2:
        return {}
    first = offset[0]
    cross = first[0] * offset[:, 1] - first[1] * offset[:, 0]
    aside = np.flatnonzero(np.abs(cross) > 0.5 * np.linalg.norm(first) * np.linalg.norm(offset, axis=1))
    if not len(aside):
        return {}
    second = offset[aside[0]] * np.sign(cross[aside[0]])
    cell_of = {seed: (0, 0)}
    steps = {seed: (first, second)}
    taken = {(0, 0)}
    waiting = [seed]
    while waiting:
        k = waiting.pop(0)
        reach = _NEAR * min(np.linalg.norm(step) for step in steps[k])
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            cell = (cell_of[k][0] + sign * (axis == 0), cell_of[k][1] + sign * (axis == 1))
            distance = np.linalg.norm(uv_px - uv_px[k] - sign * steps[k][axis], axis=1)
            nearest = int(distance.argmin())
            if cell in taken or nearest in cell_of or distance[nearest] > reach:
                continue
            own = sign * (uv_px[nearest] - uv_px[k])
            cell_of[nearest] = cell
            steps[nearest] = (own, steps[k][1]) if axis == 0 else (steps[k][0], own)
            taken.add(cell)
            waiting.append(nearest)
    return cell_of
