"""Rendered boards show what they should where they should."""

import numpy as np
import pytest

from board_views import RIG, poses
from trifix.sources.board_images import BoardRenderer, charuco, chessboard, dot_grid
from trifix.stages.detect import detect


def test_dots_are_drawn_where_they_are_projected() -> None:
    rng = np.random.default_rng(1)
    T = poses(1, rng, (36.0, 27.0), tilt_rad=0.0)[0]  # seen straight on by the left camera: without eccentricity
    images = BoardRenderer(RIG, dot_grid(5, 4, 18.0, 9.0)).render(T, rng)
    cell = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    true = RIG.left.project(T.apply(np.c_[cell * 18.0, np.zeros(20)]))
    found = detect(images.left).uv_px
    distance = np.linalg.norm(true[:, None] - found[None], axis=2).min(axis=1)
    assert 0.002 < np.sqrt(np.mean(distance**2)) < 0.03


def test_noise_is_as_asked() -> None:
    rng = np.random.default_rng(2)
    T = poses(1, rng, (36.0, 27.0))[0]
    pattern = chessboard(5, 4, 18.0)
    noisy, clean = (BoardRenderer(RIG, pattern, noise).render(T, rng).left for noise in (3.0, 0.0))
    assert np.std(noisy.astype(float) - clean) == pytest.approx(3.0, rel=0.05)


def test_a_chessboard_and_the_squares_between_markers_are_the_same() -> None:
    xy = np.stack(np.meshgrid(np.arange(-19, 60, 20.0), np.arange(-19, 40, 20.0)), axis=-1).reshape(-1, 2)
    marked, plain = charuco(3, 2, 20.0, 14.0, "DICT_4X4_50")(xy), chessboard(3, 2, 20.0)(xy)
    assert np.array_equal(marked, plain)  # one millimetre inside the corners of squares, clear of markers
