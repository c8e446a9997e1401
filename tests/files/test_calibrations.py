"""A Kalibr camchain is read in millimetres, or refused with the key, what was found and what was expected."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trifix.errors import CalibrationError
from trifix.files.calibrations import read_rig, write_rig
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose

CAMCHAIN = """\
cam0:
  camera_model: pinhole
  intrinsics: [800.0, 801.0, 320.5, 240.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.05, 1e-05, 0]
  resolution: [640, 480]
  rostopic: /left
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 0.0, -1.0, 0.001]
  - [0.0, 1.0, 0.0, 0.002]
  - [0, 0, 0, 1]
  camera_model: pinhole
  intrinsics: [810.0, 811.0, 330.5, 250.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [800, 600]
"""


def changed(old: str, new: str) -> str:
    assert old in CAMCHAIN
    return CAMCHAIN.replace(old, new, 1)


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str], StereoRig]:
    def read_text(text: str) -> StereoRig:
        path = tmp_path / "calibration.yaml"
        path.write_text(text)
        return read_rig(path)

    return read_text


def test_metres_become_millimetres_and_cameras_keep_their_side(read: Callable[[str], StereoRig]) -> None:
    rig = read(CAMCHAIN)
    assert rig.left == Camera(800.0, 801.0, 320.5, 240.5, 640, 480, "radtan", (0.1, -0.05, 1e-5, 0.0))
    assert rig.right == Camera(810.0, 811.0, 330.5, 250.5, 800, 600)
    np.testing.assert_allclose(rig.T_right_left.t_mm, [-120, 1, 2], atol=1e-12)
    np.testing.assert_allclose(rig.T_right_left.apply(np.array([[0, 0, 1000.0]])), [[-120, -999, 2]], atol=1e-9)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("none", ()),
        ("radtan", (-0.28, 0.07, 2e-4, 1.8e-5)),
        ("radtan", (-0.28, 0.07, 2e-4, 1.8e-5, 3e-7)),
        ("equidistant", (0.1, -0.01, 1e-3, -1e-12)),
    ],
)
def test_a_rig_survives_being_written(tmp_path: Path, model: str, coefficients: tuple[float, ...]) -> None:
    left = Camera(800.1, 801.2, 320.3, 240.4, 640, 480, model, coefficients)  # type: ignore[arg-type]
    right = Camera(1 / 3 * 2000, 700.0, 300.0, 200.0, 600, 400)
    rig = StereoRig(left, right, Pose.exp(np.array([-119.9, 1.25, 3e-4, 0.1, -0.2, 0.3])))
    write_rig(rig, tmp_path / "rig.yaml")
    again = read_rig(tmp_path / "rig.yaml")
    assert (again.left, again.right) == (left, right)
    np.testing.assert_allclose(again.T_right_left.R, rig.T_right_left.R, atol=1e-14)
    np.testing.assert_allclose(again.T_right_left.t_mm, rig.T_right_left.t_mm, atol=1e-12)


def test_a_rotation_printed_with_few_digits_is_made_orthonormal(read: Callable[[str], StereoRig]) -> None:
    R = Pose.exp(np.array([0, 0, 0, 0.3, -0.2, 0.1])).R
    rows = "".join(f"  - [{', '.join(f'{x:.5f}' for x in row)}, -0.1]\n" for row in R)
    rig = read(
        re.sub(r"(?m)^  - \[.*\n", "", CAMCHAIN).replace("T_cn_cnm1:\n", f"T_cn_cnm1:\n{rows}  - [0, 0, 0, 1]\n")
    )
    np.testing.assert_allclose(rig.T_right_left.R.T @ rig.T_right_left.R, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rig.T_right_left.R, R, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (changed("pinhole", "omni"), r"cam0\.camera_model: found 'omni', expected pinhole"),
        (changed("radtan", "radtann"), r"cam0\.distortion_model: found 'radtann'.*the nearest is radtan"),
        (changed("model: none", "model: equi"), r"cam1\.distortion_model: found 'equi'.*the nearest is equidistant"),
        (changed(", 1e-05, 0]", "]"), r"cam0\.distortion_coeffs: found 2 numbers, expected 4 or 5"),
        (changed("coeffs: []", "coeffs: [0.1]"), r"cam1\.distortion_coeffs: found 1 numbers, expected 0"),
        (changed("  distortion_coeffs: [0.1, -0.05, 1e-05, 0]\n", ""), r"key 'cam0\.distortion_coeffs' is missing"),
        (changed("801.0, ", ""), r"cam0\.intrinsics: found 3 numbers, expected 4"),
        (changed("[800.0", "[-800.0"), r"cam0\.intrinsics: found focal lengths fu = -800, fv = 801 px, expected pos"),
        (changed("801.0", "0"), r"fv = 0 px, expected positive"),
        (changed("801.0", ".nan"), r"cam0\.intrinsics: found nan, expected finite numbers"),
        (changed("801.0", "abc"), r"cam0\.intrinsics: found 'abc', expected finite numbers"),
        (changed("801.0", "8" * 400), r"cam0\.intrinsics: found 8{57}\.\.\., expected finite numbers"),
        (changed("801.0", "true"), r"cam0\.intrinsics: found True, expected finite numbers"),
        (changed("[640, 480]", "[640.5, 480]"), r"cam0\.resolution: found \[640\.5, 480\], expected width and height"),
        (changed("[640, 480]", "[0, 480]"), r"cam0\.resolution: found \[0, 480\]"),
        (changed("[640, 480]", "640x480"), r"cam0\.resolution: found '640x480', expected a list"),
        (changed("  resolution: [640, 480]\n", ""), r"key 'cam0\.resolution' is missing"),
        (
            changed("[1.0, 0.0, 0.0", "[1.01, 0.0, 0.0"),
            r"cam1\.T_cn_cnm1: .*off from orthonormal by 0\.02, expected at",
        ),
        (changed("[1.0, 0.0, 0.0", "[-1.0, 0.0, 0.0"), r"T_cn_cnm1: .*is mirrored \(determinant -1\.000\)"),
        (changed("[0, 0, 0, 1]", "[0, 0, 0, 2]"), r"T_cn_cnm1: the last row is \[0\.0, 0\.0, 0\.0, 2\.0\], expected"),
        (changed("  - [0, 0, 0, 1]\n", ""), r"T_cn_cnm1: found 3 rows, expected 4"),
        (changed("0.0, -1.0, 0.001", "0.0, -1.0"), r"T_cn_cnm1, row 1: found 3 numbers, expected 4"),
        (
            changed("-0.12", "0").replace("0.001]", "0]").replace("0.002]", "0]"),
            r"T_cn_cnm1: the baseline is zero, expected two cameras that stand apart",
        ),
        (CAMCHAIN.split("cam1:")[0], r"key 'cam1' is missing, found cam0; expected a Kalibr camchain"),
        (changed("T_cn_cnm1", "T_cam_imu"), r"key 'cam1\.T_cn_cnm1' is missing"),
        ("cam0: [", r"calibration\.yaml is not YAML: .*line"),
        ("cam0: 2020-13-45", r"calibration\.yaml is not YAML: month must be in 1\.\.12"),
        ("just text", r"the file holds 'just text', expected keys and values"),
        ("", r"the file holds None, expected keys and values"),
        ("cam0: 1\ncam1: 2\n", r"cam0 holds 1, expected keys and values"),
    ],
)
def test_an_impossible_calibration_is_refused_with_its_key(
    read: Callable[[str], StereoRig], text: str, message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        read(text)


def test_a_missing_calibration_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"rig\.yaml does not exist"):
        read_rig(tmp_path / "rig.yaml")
