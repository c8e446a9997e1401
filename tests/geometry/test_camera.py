import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import CAMERAS, CONVERGENT, FISHEYE, LAW, PINHOLE, RADTAN4, RADTAN5, points_before

from trifix.geometry.camera import Camera, distort, distort_jacobian

EACH = pytest.mark.parametrize("camera", list(CAMERAS.values()), ids=list(CAMERAS))
SLOPES = st.one_of(
    st.sampled_from([(0.0, 0.0), (1e-12, 0.0), (1e-9, -1e-9), (1e-6, 1e-7), (0.5, 0.0), (0.0, -0.5)]),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)


def central_differences(function, x: np.ndarray, step: float) -> np.ndarray:
    columns = []
    for k in range(x.shape[1]):
        e = np.zeros(x.shape[1])
        e[k] = step
        columns.append((function(x + e) - function(x - e)) / (2 * step))
    return np.stack(columns, axis=2)


@EACH
@LAW
@given(slope=SLOPES, depth_mm=st.sampled_from([1e-3, 300.0, 1e5]))
def test_unproject_undoes_project(camera: Camera, slope: tuple[float, float], depth_mm: float) -> None:
    xy = np.array([slope])
    uv = camera.project(np.c_[xy, 1.0] * depth_mm)
    np.testing.assert_allclose(camera.unproject(uv), xy, atol=1e-11)


@EACH
@LAW
@given(slope=SLOPES)
def test_distortion_jacobian_against_central_differences(camera: Camera, slope: tuple[float, float]) -> None:
    xy = np.array([slope])
    numeric = central_differences(lambda p: distort(camera.model, camera.coefficients, p), xy, 1e-5)
    np.testing.assert_allclose(distort_jacobian(camera.model, camera.coefficients, xy), numeric, atol=1e-8)


@EACH
def test_projection_jacobian_against_central_differences(camera: Camera) -> None:
    xyz = np.r_[points_before(np.random.default_rng(1), 50), [[0.0, 0.0, 400.0]]]
    numeric = central_differences(camera.project, xyz, 1e-3)
    np.testing.assert_allclose(camera.project_jacobian(xyz), numeric, atol=1e-6)


@EACH
def test_unprojection_jacobian_against_central_differences(camera: Camera) -> None:
    xyz = np.r_[points_before(np.random.default_rng(2), 50), [[0.0, 0.0, 400.0]]]
    uv = camera.project(xyz)
    numeric = central_differences(camera.unproject, uv, 1e-2)
    np.testing.assert_allclose(camera.unproject_jacobian(camera.unproject(uv)), numeric, atol=1e-9)


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN4, RADTAN5], ids=["none", "radtan4", "radtan5"])
def test_projection_is_opencvs(camera: Camera) -> None:
    xyz = points_before(np.random.default_rng(3), 200)
    expected, _ = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.K, np.array(camera.coefficients or [0.0] * 4))
    np.testing.assert_allclose(camera.project(xyz), expected.reshape(-1, 2), atol=1e-9)


def test_equidistant_projection_is_opencvs_fisheye() -> None:
    rng = np.random.default_rng(4)
    z = rng.uniform(100.0, 800.0, 200)
    xyz = np.c_[rng.uniform(-2.0, 2.0, (200, 2)) * z[:, None], z]
    expected, _ = cv2.fisheye.projectPoints(
        xyz.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), FISHEYE.K, np.array(FISHEYE.coefficients)
    )
    np.testing.assert_allclose(FISHEYE.project(xyz), expected.reshape(-1, 2), atol=1e-9)


def test_equidistant_unprojection_reaches_wide_angles() -> None:
    angle = np.linspace(0.0, 1.5, 40)
    xy = np.tan(angle)[:, None] * [np.cos(0.7), np.sin(0.7)]
    back = FISHEYE.unproject(FISHEYE.project(np.c_[xy, np.ones(40)]))
    np.testing.assert_allclose(np.arctan(np.linalg.norm(back, axis=1)), angle, atol=1e-9)


@pytest.mark.parametrize("camera", [RADTAN4, RADTAN5], ids=["radtan4", "radtan5"])
def test_unprojection_is_opencvs(camera: Camera) -> None:
    uv = np.random.default_rng(5).uniform([0, 0], [1280, 1024], (100, 2))
    ours = camera.unproject(uv)
    # OpenCV stops after five iterations: our own round trip below is the sharper test
    theirs = cv2.undistortPoints(uv.reshape(-1, 1, 2), camera.K, np.array(camera.coefficients)).reshape(-1, 2)
    np.testing.assert_allclose(ours * 900.0, theirs * 900.0, atol=0.05)
    np.testing.assert_allclose(camera.project(np.c_[ours, np.ones(100)]), uv, atol=1e-9)


def test_pixels_that_no_ray_reaches_are_nan() -> None:
    barrel = Camera(500.0, 500.0, 320.0, 240.0, 640, 480, "radtan", (-0.4, 0.0, 0.0, 0.0))
    # x (1 − 0.4 x²) has its greatest value 0.6086 at x = 0.913
    uv = np.array([[320.0 + 500 * 0.60, 240.0], [320.0 + 500 * 0.62, 240.0], [1e5, 1e5]])
    xy = barrel.unproject(uv)
    assert np.isfinite(xy[0]).all()
    assert abs(xy[0, 0]) < 0.913
    assert np.isnan(xy[1:]).all()


def test_points_beside_or_behind_the_camera_have_no_pixel() -> None:
    uv = PINHOLE.project(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(uv[:2]).all()
    np.testing.assert_allclose(uv[2], [633.5, 511.0])


def test_sees_is_the_image_with_half_a_pixel_around_it() -> None:
    def at(u: float, v: float) -> np.ndarray:
        return np.array([[(u - 633.5) / 900.0, (v - 511.0) / 905.0, 1.0]]) * 500.0

    assert PINHOLE.sees(at(-0.49, -0.49))[0]
    assert not PINHOLE.sees(at(-0.51, 5.0))[0]
    assert PINHOLE.sees(at(1279.49, 1023.49))[0]
    assert not PINHOLE.sees(at(5.0, 1023.51))[0]
    assert not PINHOLE.sees(at(5.0, 5.0), margin_px=10.0)[0]
    assert not PINHOLE.sees(np.array([[0.0, 0.0, -500.0]]))[0]


def test_points_folded_back_by_the_distortion_are_not_seen() -> None:
    barrel = Camera(500.0, 500.0, 320.0, 240.0, 640, 480, "radtan", (-0.4, 0.0, 0.0, 0.0))
    xyz = np.array([[0.3, 0.0, 1.0], [1.5, 0.0, 1.0], [1.7, 0.0, 1.0]]) * 300.0
    assert np.abs(barrel.project(xyz) - [320.0, 240.0]).max() < 320  # all three land on the image
    assert barrel.sees(xyz).tolist() == [True, False, False]


def test_rig_knows_its_baseline_and_right_centre() -> None:
    assert abs(CONVERGENT.baseline_mm - np.linalg.norm(CONVERGENT.T_right_left.t_mm)) < 1e-12
    in_right = CONVERGENT.T_right_left.apply(CONVERGENT.right_centre_mm[None])
    np.testing.assert_allclose(in_right, 0.0, atol=1e-12)
