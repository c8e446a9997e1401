from itertools import combinations

import numpy as np
import pytest
from test_colours import EYES, luminance, oklab

from trifix.geometry.pose import Pose, exp_rotation
from trifix.outputs import scene3d
from trifix.outputs.scene3d import (
    COLOUR,
    PLACE,
    Path,
    default_magnification,
    ellipsoids,
    facing_wxyz,
    quaternions_wxyz,
    residual_colours,
    worst_shown_mm,
)

GROUNDS = {"light": np.full(3, 255), "dark": np.full(3, 20)}


def linear(rgb: tuple[int, int, int] | np.ndarray) -> np.ndarray:
    return (np.asarray(rgb) / 255) ** 2.2


@pytest.mark.parametrize("eyes", EYES)
def test_states_of_targets_and_the_place_that_is_wanted_look_different_to_all_eyes(eyes: str) -> None:
    seen = [oklab(EYES[eyes] @ linear(rgb)) for rgb in (*COLOUR.values(), PLACE)]
    assert min(float(np.linalg.norm(a - b)) for a, b in combinations(seen, 2)) > 7


@pytest.mark.parametrize("ground", GROUNDS)
def test_colours_stand_out_from_light_and_from_dark_ground(ground: str) -> None:
    for rgb in (*COLOUR.values(), PLACE):
        low, high = sorted((luminance(linear(rgb)), luminance(linear(GROUNDS[ground]))))
        assert (high + 0.05) / (low + 0.05) > 3


def rotation(wxyz: np.ndarray) -> np.ndarray:
    return Pose.from_quaternion(wxyz[[1, 2, 3, 0]], np.zeros(3)).R


def test_an_ellipsoid_has_the_axes_of_its_covariance() -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(50, 3, 3))
    cov = A @ np.swapaxes(A, 1, 2)
    wxyz, sigma = ellipsoids(cov)
    rebuilt = [R @ np.diag(s**2) @ R.T for R, s in zip(map(rotation, wxyz), sigma, strict=True)]
    np.testing.assert_allclose(rebuilt, cov, atol=1e-10)


def test_quaternions_are_those_of_the_pose() -> None:
    rng = np.random.default_rng(4)
    R = np.array([exp_rotation(phi) for phi in rng.normal(size=(40, 3)) * 2] + [np.diag([1.0, -1.0, -1.0]), np.eye(3)])
    for wxyz, each in zip(quaternions_wxyz(R), R, strict=True):
        np.testing.assert_allclose(rotation(wxyz), each, atol=1e-12)


def test_targets_face_the_direction_from_which_they_were_seen() -> None:
    view = np.array([[0.0, 0.0, -1.0], [0.6, -0.8, 0.0], [1.0, 0.0, 0.0], [np.nan] * 3])
    z = [rotation(wxyz)[:, 2] for wxyz in facing_wxyz(view)]
    np.testing.assert_allclose(z, [*view[:3], [0.0, 0.0, -1.0]], atol=1e-12)


@pytest.mark.parametrize("name", ["disc", "ring", "cross", "ball"])
def test_meshes_look_outwards_and_have_about_the_radius_one(name: str) -> None:
    vertices, faces = getattr(scene3d, name)()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6  # positive only if faces look outwards
    assert {"disc": 0.61, "ring": 0.33, "cross": 0.43, "ball": 3.93}[name] == pytest.approx(volume, abs=0.03)
    assert 0.95 < np.linalg.norm(vertices, axis=1).max() < 1.2


def test_colours_go_from_blue_to_orange_and_are_grey_where_nothing_is_known() -> None:
    rgb = residual_colours(np.array([0.0, 0.5, 1.0, 9.0, np.nan]), 1.0).astype(int)
    assert (np.diff(rgb[:3, 2]) < 0).all()
    assert (rgb[2] == rgb[3]).all()
    assert np.ptp(rgb[4]) < 30


def test_the_scale_of_residuals_is_round_and_holds_most_of_them() -> None:
    assert worst_shown_mm(np.array([0.01, 0.02, np.nan, 0.031])) == pytest.approx(0.05)
    assert worst_shown_mm(np.array([np.nan])) == 1.0
    assert worst_shown_mm(np.zeros(3)) == 1.0


def test_the_magnification_makes_a_typical_ellipsoid_well_seen() -> None:
    cov = np.tile(np.eye(3) * 0.01**2, (5, 1, 1))
    assert 0.02 * 400 < default_magnification(cov, 400.0) * 0.01 < 0.07 * 400
    assert default_magnification(np.zeros((5, 3, 3)), 400.0) == 1.0


def test_the_path_has_gaps_where_frames_were_refused() -> None:
    path = Path()
    for k in range(6):
        if k == 3:
            path.break_off()
        else:
            path.add(np.array([float(k), 0.0, 0.0]), 0.1 * k)
    lines, of_lines, points, _ = path.segments()
    assert lines[:, :, 0].tolist() == [[0, 1], [1, 2], [4, 5]]
    np.testing.assert_allclose(of_lines, [0.1, 0.2, 0.5])
    assert points[:, 0].tolist() == [0, 1, 2, 4, 5]


def test_a_long_path_stays_bounded_and_keeps_its_ends_and_gaps() -> None:
    path = Path(most=100)
    for k in range(10_000):
        if k == 5000:
            path.break_off()
        else:
            path.add(np.array([float(k), 0.0, 0.0]), 0.0)
    lines, _, points, _ = path.segments()
    assert 40 < len(path) <= 101
    assert points[0, 0] == 0.0
    assert points[-1, 0] > 9700
    assert not ((lines[:, 0, 0] < 5000) & (lines[:, 1, 0] > 5000)).any()
    assert np.diff(points[:, 0]).max() < 400


def test_a_path_of_gaps_alone_stays_bounded() -> None:
    path = Path(most=100)
    for k in range(5000):
        path.add(np.array([float(k), 0.0, 0.0]), 0.0)
        path.break_off()
    lines, _, points, _ = path.segments()
    assert not len(lines)
    assert len(path) <= 101
    assert points[-1, 0] == 4999.0
