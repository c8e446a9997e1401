"""`trifix calibrate`: from images on the disk to files that `trifix run` reads."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from cyclopts import CycloptsError

from board_views import RIG, poses
from trifix import cli
from trifix.calibration import parameters_of
from trifix.errors import TrifixError
from trifix.files.calibrations import read_rig
from trifix.sources.board_images import BoardRenderer, Pattern, charuco, chessboard

CHESSBOARD = ("--target", "chessboard", "--columns", "8", "--rows", "5", "--square-mm", "16")
CHARUCO = ("--target", "charuco", "--columns", "7", "--rows", "5", "--square-mm", "20", "--marker-mm", "15")


def record(folder: Path, pattern: Pattern, middle_mm: tuple[float, float], count: int = 8) -> Path:
    """A recording of a board, as a folder each of left and right images."""
    rng = np.random.default_rng(1)
    renderer = BoardRenderer(RIG, pattern)
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    for k, T in enumerate(poses(count, rng, middle_mm)):
        images = renderer.render(T, rng)
        cv2.imwrite(str(folder / "left" / f"{k}.png"), images.left)
        cv2.imwrite(str(folder / "right" / f"{k}.png"), images.right)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("board"), chessboard(8, 5, 16.0), (56.0, 32.0))


def calibrated(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    """What the command answers in JSON."""
    cli.app(["calibrate", *map(str, arguments), "--json"])
    return dict(json.loads(capsys.readouterr().out))


def assert_near_truth(out: Path) -> None:
    """Parameters within four standard deviations, which are small enough to be of use."""
    rig, told = read_rig(out / "calibration.yaml"), json.loads((out / "calibration.json").read_text())
    sigma = np.sqrt(np.diag(told["covariance"]))
    error = np.r_[
        parameters_of(RIG.left) - parameters_of(rig.left),
        parameters_of(RIG.right) - parameters_of(rig.right),
        (rig.T_right_left.inverse() @ RIG.T_right_left).log(),
    ]
    assert 0.5 < np.abs(error / sigma).max() < 4.0
    assert sigma[:2].max() < 2.0
    assert told["baseline_mm"]["value"] == pytest.approx(RIG.baseline_mm, abs=4 * told["baseline_mm"]["sigma"])


def test_a_chessboard_gives_back_the_rig(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = calibrated(capsys, recording, "-o", tmp_path / "out", *CHESSBOARD)
    assert_near_truth(tmp_path / "out")
    assert told["both"] == 8
    assert told["left_out"] == []
    assert 0.01 < float(str(told["rms_px"])) < 0.1
    page = (tmp_path / "out" / "calibration.html").read_text()
    assert page.count("<svg") == 3 + bool(told["board_points"])
    assert "http" not in page.replace("http://www.w3.org", "")


def test_a_charuco_board_gives_back_the_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = record(tmp_path / "board", charuco(7, 5, 20.0, 15.0, "DICT_4X4_50"), (60.0, 40.0))
    calibrated(capsys, recording, "-o", tmp_path / "out", *CHARUCO)
    assert_near_truth(tmp_path / "out")


def test_a_board_that_moved_between_the_exposures_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(recording, tmp_path / "moved")
    image = cv2.imread(str(recording / "right" / "4.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    cv2.imwrite(str(tmp_path / "moved" / "right" / "4.png"), np.roll(image, 6, axis=0))
    cli.app(["calibrate", str(tmp_path / "moved"), "-o", str(tmp_path / "out"), *CHESSBOARD])
    assert "view 4 (4.png)" in capsys.readouterr().out
    assert "view 4 (4.png)" in (tmp_path / "out" / "calibration.html").read_text()
    assert_near_truth(tmp_path / "out")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--target", "chessboard", "--columns", "9"), "--target chessboard needs --square-mm and --rows."),
        (("--target", "charuco", "--square-mm", "9", "--columns", "9", "--rows", "6"), "charuco needs --marker-mm."),
        (("--target", "dots", "--rings"), "--target dots needs --pitch-mm."),
        ((*CHESSBOARD, "--rings"), "--rings says that three dots are rings: it goes with --target dots."),
        ((*CHESSBOARD, "--every", "0"), "--every must be at least 1."),
        ((*CHESSBOARD, "--pitch-sigma", "-0.1"), "--pitch-sigma is -0.1, expected 0 or more."),
    ],
)
def test_what_is_missing_is_a_usage_error(arguments: tuple[str, ...], text: str, tmp_path: Path) -> None:
    with pytest.raises(CycloptsError) as caught:
        cli.app(["calibrate", str(tmp_path), "-o", str(tmp_path / "out"), *arguments])
    assert text in str(caught.value)


def test_another_board_than_was_shown_is_told(recording: Path, tmp_path: Path) -> None:
    other = ("--target", "chessboard", "--columns", "9", "--rows", "6", "--square-mm", "16")
    with pytest.raises(TrifixError, match="found no board in 2 image pairs; expected a chessboard of 9 x 6 inner"):
        cli.app(["calibrate", str(recording), "-o", str(tmp_path / "out"), *other, "--every", "4"])
    assert not (tmp_path / "out").exists()


def test_a_plate_that_fills_the_image_is_calibrated_by_its_rings(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = data / "dice_plate" / "recording"
    told = calibrated(capsys, recording, "-o", tmp_path, "--target", "dots", "--pitch-mm", "3.5", "--rings")
    assert told["both"] == 7
    assert 0.02 < float(str(told["rms_px"])) < 0.04
    assert 0.004 < float(str(told["board_sigma_mm"])) < 0.009
    assert (tmp_path / "calibration.html").read_text().count("<svg") == 4
    rig, given = read_rig(tmp_path / "calibration.yaml"), read_rig(recording / "calibration.yaml")
    assert rig.baseline_mm == pytest.approx(given.baseline_mm, rel=0.003)
