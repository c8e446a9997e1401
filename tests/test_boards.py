"""Boards are found in rendered images, and every point is told by the right column and row."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from board_views import RIG, poses
from trifix import boards
from trifix.boards import Board, find_views
from trifix.calibration import BoardView, Sighting
from trifix.errors import CalibrationError, ConfigError
from trifix.files.images import ImagePairs
from trifix.geometry.camera import Camera
from trifix.geometry.pose import Pose
from trifix.records import GreyOrColour, StereoImages
from trifix.sources.board_images import BoardRenderer, Pattern, charuco, chessboard, dot_grid

CHESSBOARD = (chessboard(8, 5, 18.0), Board("chessboard", 18.0, 8, 5), (63.0, 36.0))
CHARUCO = (charuco(7, 5, 20.0, 15.0, "DICT_4X4_50"), Board("charuco", 20.0, 7, 5, 15.0), (60.0, 40.0))
GRID = (dot_grid(8, 6, 16.0, 8.0), Board("dots", 16.0, 8, 6), (56.0, 40.0))
RINGS = ((2, 4), (2, 1), (6, 4))
RINGED = (dot_grid(16, 12, 16.0, 8.0, RINGS), Board("dots", 16.0, has_rings=True), (70.0, 50.0))


def pairs_of(images: list[StereoImages], change: Callable[[GreyOrColour], GreyOrColour] = lambda x: x) -> ImagePairs:
    return ImagePairs(
        np.arange(len(images)) * 10**9,
        True,
        lambda k: change(images[k].left),
        lambda k: change(images[k].right),
        lambda k: (Path(f"left/{k}.png"), Path(f"right/{k}.png")),
    )


def rendered(
    pattern: Pattern, middle_mm: tuple[float, float], count: int = 2, far_mm: float = 300.0
) -> tuple[list[StereoImages], list[Pose]]:
    rng = np.random.default_rng(1)
    T = poses(count, rng, middle_mm, tilt_rad=0.35, far_mm=far_mm)
    renderer = BoardRenderer(RIG, pattern)
    return [renderer.render(each, rng) for each in T], T


def misses_px(
    sighting: Sighting | None, camera: Camera, T_camera_board: Pose, xy_mm: Callable[[np.ndarray], np.ndarray]
) -> float:
    """Largest distance between points found and those points of the board projected."""
    assert sighting is not None
    true = camera.project(T_camera_board.apply(np.c_[xy_mm(sighting.cell), np.zeros(len(sighting.cell))]))
    return float(np.linalg.norm(true - sighting.uv_px, axis=1).max())


@pytest.mark.parametrize(("made", "limit_px"), [(CHESSBOARD, 0.3), (CHARUCO, 0.5), (GRID, 0.1)])
@pytest.mark.parametrize("bits", [8, 16])
def test_every_point_is_told_by_its_place(
    made: tuple[Pattern, Board, tuple[float, float]], limit_px: float, bits: int
) -> None:
    pattern, board, middle_mm = made
    images, T = rendered(pattern, middle_mm)
    deeper: Callable[[GreyOrColour], GreyOrColour] = (
        (lambda x: x) if bits == 8 else (lambda x: x.astype(np.uint16) * 16)
    )
    found = find_views(pairs_of(images, deeper), board)
    assert found.left_size_px == (320, 240)
    assert [view.name for view in found.views] == ["0 (0.png)", "1 (1.png)"]
    for view, pose in zip(found.views, T, strict=True):
        for sighting, camera, T_camera_board in (
            (view.left, RIG.left, pose),
            (view.right, RIG.right, RIG.T_right_left @ pose),
        ):
            assert misses_px(sighting, camera, T_camera_board, lambda cell: cell * board.pitch_mm) < limit_px


def test_rings_tell_every_dot_of_a_grid_that_reaches_beyond_the_images() -> None:
    pattern, board, middle_mm = RINGED
    images, T = rendered(pattern, middle_mm, 3)

    # counted from the ring at the corner; columns towards the one below which rows lie to the right
    def places(cell: np.ndarray) -> np.ndarray:
        return np.asarray((np.array(RINGS[0]) + np.stack([cell[:, 1], -cell[:, 0]], axis=1)) * 16.0)

    for view, pose in zip(find_views(pairs_of(images), board).views, T, strict=True):
        assert view.left is not None
        assert 60 < len(view.left.cell) < 16 * 12
        assert misses_px(view.left, RIG.left, pose, places) < 0.1
        assert misses_px(view.right, RIG.right, RIG.T_right_left @ pose, places) < 0.1


def test_a_part_of_a_grid_without_rings_could_be_any_part() -> None:
    images, _ = rendered(dot_grid(16, 12, 16.0, 8.0), (70.0, 50.0), 2)
    with pytest.raises(CalibrationError, match="found no board in 2 image pairs; expected a grid of 16 x 12 dots, all"):
        find_views(pairs_of(images), Board("dots", 16.0, 16, 12))


def test_both_images_count_alike_where_turning_makes_no_difference() -> None:
    pattern, board, middle_mm = chessboard(7, 5, 20.0), Board("chessboard", 20.0, 7, 5), (60.0, 40.0)
    rng = np.random.default_rng(3)
    quarter = Pose.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    upright = poses(1, rng, (0.0, 0.0), tilt_rad=0.2)[0] @ quarter
    T = upright @ Pose(np.eye(3), -np.array([*middle_mm, 0.0]))
    view: BoardView = find_views(pairs_of([BoardRenderer(RIG, pattern).render(T, rng)]), board).views[0]
    assert view.left is not None
    assert view.right is not None
    along = [sighting.uv_px[6] - sighting.uv_px[0] for sighting in (view.left, view.right)]
    assert along[0] @ along[1] > 0.9 * np.linalg.norm(along[0]) * np.linalg.norm(along[1])


def test_colour_makes_the_order_of_a_chessboard_unique() -> None:
    pattern, board, middle_mm = CHESSBOARD
    images, _ = rendered(pattern, middle_mm, 1)
    turned = [StereoImages(*(np.ascontiguousarray(x[::-1, ::-1]) for x in (images[0].left, images[0].right)))]
    upright, upside_down = (find_views(pairs_of(each), board).views[0].left for each in (images, turned))
    assert upright is not None
    assert upside_down is not None
    assert np.abs([319, 239] - upside_down.uv_px - upright.uv_px).max() < 0.2


def test_what_cannot_be_read_is_told_and_passed_over() -> None:
    pattern, board, middle_mm = GRID
    images, _ = rendered(pattern, middle_mm, 2)
    pairs = pairs_of(images)
    broken = ImagePairs(
        pairs.timestamp_ns, True, lambda k: "left/0.png is torn." if k == 0 else pairs.left(k), pairs.right, pairs.files
    )
    found = find_views(broken, board)
    assert found.unreadable == ("left/0.png is torn.",)
    assert [view.name for view in found.views] == ["1 (1.png)"]


def test_images_of_two_sizes_are_refused() -> None:
    pattern, board, middle_mm = GRID
    images, _ = rendered(pattern, middle_mm, 1)
    smaller = StereoImages(images[0].left, cv2.resize(images[0].right, (160, 120)))
    with pytest.raises(
        CalibrationError, match=r"right/1.png: this right image is 160 x 120 pixels, those before it are"
    ):
        find_views(pairs_of([images[0], smaller]), board)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("chessboard", 0.0, 9, 6), "the pitch of the board is 0 mm"),
        (("chessboard", 25.0, 2, 6), "a board of 2 x 6 points is too small, expected at least 3 x 3."),
        (("charuco", 25.0, 9, 6, 30.0), "the markers are 30 mm and the squares 25 mm wide"),
        (("charuco", 25.0, 9, 6, 18.0, "DICT_9X9"), "there is no dictionary DICT_9X9, expected one of DICT_4X4_100"),
    ],
)
def test_impossible_boards_are_refused(arguments: tuple[object, ...], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        Board(*arguments)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("board", [Board("dots", 10.0, 7, 5), Board("dots", 10.0, has_rings=True)])
def test_an_image_without_dots_shows_no_grid(board: Board) -> None:
    assert not boards._find(np.full((80, 90), 200, np.uint8), board).ways
