"""Coded markers and coloured dots: what they are labelled, and where they are."""

from typing import Literal

import cv2
import numpy as np
import pytest

from trifix.errors import ConfigError
from trifix.records import Dots
from trifix.stages.detect import DetectOptions, detect
from trifix.stages.label import add_codes, add_hues

NONE = Dots.of(np.zeros((0, 2)))


def homography(rng: np.random.Generator, width_px: float, centre: np.ndarray) -> np.ndarray:
    """Pixels of the unit square, tilted by up to 40 degrees and turned at will; its middle is at ``centre``."""
    tilt = cv2.Rodrigues(np.array([*rng.uniform(-0.7, 0.7, 2), 0.0]))[0]
    R = tilt @ cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-3, 3)]))[0]
    K = np.array([[800.0, 0, centre[0]], [0, 800.0, centre[1]], [0, 0, 1]])
    return K @ np.c_[R[:, :2], [0, 0, 800.0 / width_px]] @ np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])


def with_marker(rng: np.random.Generator, code: int, H: np.ndarray, dictionary: str = "DICT_4X4_50") -> np.ndarray:
    """A grey image of one marker, with its white margin, blur and noise."""
    codes, cell, fine = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), 20, 4
    n = codes.markerSize + 2
    paper = np.full(((n + 2) * cell,) * 2, 255, np.uint8)
    paper[cell:-cell, cell:-cell] = cv2.aruco.generateImageMarker(codes, code, n * cell)
    to_unit = np.diag([1 / n, 1 / n, 1]) @ [[1 / cell, 0, 0.5 / cell - 1], [0, 1 / cell, 0.5 / cell - 1], [0, 0, 1]]
    to_fine = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1]])
    image = cv2.warpPerspective(
        paper, to_fine @ H @ to_unit, (240 * fine, 200 * fine), flags=cv2.INTER_AREA, borderValue=200
    )
    image = cv2.resize(
        cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7 * fine), (240, 200), interpolation=cv2.INTER_AREA
    )
    return np.clip(0.7 * image + 30 + rng.normal(0, 2.0, image.shape), 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_APRILTAG_36h11"])
def test_a_marker_is_a_dot_at_its_centre_labelled_by_its_code(dictionary: str):
    rng = np.random.default_rng(1)
    chi2, errors_px = 0.0, []
    for code in range(12):
        centre = [120.0, 100.0] + rng.uniform(-3, 3, 2)
        dots = add_codes(NONE, with_marker(rng, code, homography(rng, 60.0, centre), dictionary), dictionary)
        assert dots.label.tolist() == [code]
        assert np.isnan(dots.ellipse).all()
        error = dots.uv_px[0] - centre
        errors_px.append(error)
        chi2 += float(error @ np.linalg.solve(dots.cov_px2[0], error))
    assert 0.005 < np.sqrt(np.mean(np.square(errors_px))) < 0.06
    assert 0.1 < chi2 / 24 < 2.0  # the corners' error is a round number


def test_the_centre_is_the_projective_one_and_not_the_mean_of_the_corners():
    rng = np.random.default_rng(2)
    tilt = cv2.Rodrigues(np.array([0.9, 0.0, 0.0]))[0]
    K = np.array([[300.0, 0, 120], [0, 300.0, 100], [0, 0, 1]])
    H = K @ np.c_[tilt[:, :2], [0, 0, 2.8]] @ np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    corners = np.c_[[[0, 0], [1, 0], [1, 1], [0, 1]], np.ones(4)] @ H.T
    mean = (corners[:, :2] / corners[:, 2:]).mean(axis=0)
    assert np.linalg.norm(mean - [120.0, 100.0]) > 1.0
    dots = add_codes(NONE, with_marker(rng, 7, H), "DICT_4X4_50")
    np.testing.assert_allclose(dots.uv_px, [[120.0, 100.0]], atol=0.15)


def test_round_dots_within_a_marker_are_parts_of_it_and_others_stay():
    rng = np.random.default_rng(3)
    image = with_marker(rng, 5, homography(rng, 60.0, np.array([120.0, 100.0])))
    dots = add_codes(Dots.of(np.array([[118.0, 103.0], [20.0, 30.0]])), image, "DICT_4X4_50")
    np.testing.assert_array_equal(dots.label, [-1, 5])
    np.testing.assert_array_equal(dots.uv_px[0], [20.0, 30.0])
    np.testing.assert_array_equal(dots.row, [0, 1])


def test_markers_are_found_in_colour_and_in_sixteen_bits():
    rng = np.random.default_rng(4)
    image = with_marker(rng, 9, homography(rng, 60.0, np.array([120.0, 100.0])))
    one = add_codes(NONE, image, "DICT_4X4_50").uv_px
    for other in (cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), 16 * image.astype(np.uint16)):
        np.testing.assert_allclose(add_codes(NONE, other, "DICT_4X4_50").uv_px, one, atol=0.05)


def test_an_image_without_markers_keeps_its_dots():
    dots = Dots.of(np.array([[20.0, 30.0]]))
    assert add_codes(dots, np.full((100, 120), 90, np.uint8), "DICT_4X4_50") is dots


@pytest.mark.parametrize("depth", ["uint8", "uint16"])
def test_coloured_dots_are_labelled_by_the_nearest_hue(depth: Literal["uint8", "uint16"]):
    image = np.full((120, 320, 3), 230, np.uint8)
    colours = [(40, 40, 200), (50, 180, 40), (200, 60, 50), (90, 90, 90), (40, 160, 170)]  # red green blue grey yellow
    for k, colour in enumerate(colours):
        cv2.circle(image, (40 + 60 * k, 60), 12, colour, -1, cv2.LINE_AA)
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    if depth == "uint16":
        image = 200 * image.astype(np.uint16)
    dots = detect(image, DetectOptions(polarity="dark"))
    dots = add_hues(dots, image, DetectOptions(hues="0, 120 240").hues_deg)
    by_place = dots.label[np.argsort(dots.uv_px[:, 0])]
    np.testing.assert_array_equal(by_place, [0, 1, 2, -1, -1])


def test_hues_say_nothing_of_grey_images_and_leave_codes_alone():
    image = np.full((60, 60, 3), (40, 40, 200), np.uint8)
    dots = Dots.of(np.array([[30.0, 30.0]]), diameter_px=np.array([10.0]))
    hues = np.array([0.0, 120.0])
    assert add_hues(dots, image[:, :, 0], hues) is dots
    coded = Dots(dots.uv_px, dots.cov_px2, dots.ellipse, np.array([17]), dots.row)
    np.testing.assert_array_equal(add_hues(coded, image, hues).label, [17])
    np.testing.assert_array_equal(add_hues(dots, image, hues).label, [0])


def test_black_dots_and_those_without_a_core_have_no_hue():
    image = np.full((60, 60, 3), 200, np.uint8)
    cv2.circle(image, (30, 30), 10, (0, 0, 0), -1)
    dots = Dots.of(np.array([[30.0, 30.0]]), diameter_px=np.array([10.0]))
    hues = np.array([0.0, 120.0])
    np.testing.assert_array_equal(add_hues(dots, image, hues).label, [-1])
    narrow = Dots(np.array([[20.5, 20.5]]), dots.cov_px2, np.array([[1.8, 0.6, 0.0]]), dots.label, dots.row)
    image[15:25, 15:25] = (40, 40, 200)
    np.testing.assert_array_equal(add_hues(narrow, image, hues).label, [-1])


@pytest.mark.parametrize("hues", ["red", "0 360", "nan"])
def test_impossible_hues_are_refused(hues: str):
    with pytest.raises(ConfigError, match="different angles in degrees"):
        DetectOptions(hues=hues)
