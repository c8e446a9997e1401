"""Lengths and places known by other means: read as they stand, each bad row refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest

from trifix.errors import MapError
from trifix.files.constraints import read_control, read_scale_bars

BARS = "target_a,target_b,length_mm,sigma_mm\n"
PLACES = "1,0,0,0\n2,100,0,0\n3,0,100,0\n"


def file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "known.csv"
    path.write_text(text)
    return path


def test_scale_bars_are_read_with_the_line_they_stand_in(tmp_path: Path) -> None:
    bars = read_scale_bars(file(tmp_path, BARS + "3,17,500.25,0.02\n# a comment\n17,4,250,0.01\n"))
    assert [(bar.target_a, bar.target_b, bar.length_mm, bar.sigma_mm) for bar in bars] == [
        (3, 17, 500.25, 0.02),
        (17, 4, 250.0, 0.01),
    ]
    assert bars[1].source.endswith("known.csv, line 4")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("", "found no scale bar, expected a line for each: target_a,target_b,length_mm,sigma_mm."),
        ("3,17,0,0.02\n", "line 2, column 'length_mm': found 0.0, expected a positive number of millimetres."),
        ("3,17,-5,0.02\n", "line 2, column 'length_mm': found -5.0, expected a positive number"),
        ("3,17,500,0\n", "line 2, column 'sigma_mm': found 0.0, expected a positive number"),
        ("3,3,500,0.02\n", "line 2, column 'target_b': found 3, expected another target than target_a."),
        ("3,17,500,0.02\n17,3,501,0.02\n", "line 3: the targets 3 and 17 already stand in line 2, expected them once."),
        ("3,17,nan,0.02\n", "line 2, column 'length_mm': found 'nan', expected a finite number."),
        ("three,17,500,0.02\n", "line 2, column 'target_a': found 'three', expected an integer."),
        ("3,17,500\n", "line 2: found 3 cells, expected 4"),
    ],
)
def test_a_bad_scale_bar_is_refused(rows: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(MapError) as refusal:
        read_scale_bars(file(tmp_path, BARS + rows))
    assert words in str(refusal.value)


def test_control_targets_may_be_exact_or_have_an_error(tmp_path: Path) -> None:
    exact = read_control(file(tmp_path, "id,x_mm,y_mm,z_mm\n" + PLACES))
    assert exact.id.tolist() == [1, 2, 3]
    assert not exact.cov_mm2.any()
    rows = "1,0,0,0,0.1\n2,100,0,0,\n3,0,100,0,0.2\n"
    with_sigma = read_control(file(tmp_path, "id,x_mm,y_mm,z_mm,sigma_mm\n" + rows))
    np.testing.assert_allclose(with_sigma.cov_mm2, np.array([0.01, 0.0, 0.04])[:, None, None] * np.eye(3))
    rows = "1,0,0,0,4,0,0,9,0,16\n2,100,0,0,,,,,,\n3,0,100,0,1,0,0,1,0,1\n"
    with_cov = read_control(file(tmp_path, "id,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz\n" + rows))
    np.testing.assert_allclose(with_cov.cov_mm2[0], np.diag([4.0, 9.0, 16.0]))
    assert not with_cov.cov_mm2[1].any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("id,x_mm,y_mm,z_mm\n1,0,0,0\n2,1,0,0\n", "found 2 control targets, expected at least three."),
        ("id,x_mm,y_mm,z_mm\n" + PLACES + "2,5,5,5\n", "line 5: id 2 already stands in line 3, expected it once."),
        ("id,x_mm,y_mm\n1,0,0\n", "column 'z_mm' is missing"),
        ("id,x_mm,y_mm,z_mm,sigma_mm\n1,0,0,0,-1\n2,9,0,0,1\n3,0,9,0,1\n", "line 2, column 'sigma_mm': found -1.0"),
        (
            "id,x_mm,y_mm,z_mm,sigma_mm,xx,xy,xz,yy,yz,zz\n1,0,0,0,1,1,0,0,1,0,1\n2,9,0,0,,,,,,,\n3,0,9,0,,,,,,,\n",
            "line 2, column 'sigma_mm': found 1.0, expected it or a covariance, not both.",
        ),
        (
            "id,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz\n1,0,0,0,-1,0,0,1,0,1\n2,9,0,0,,,,,,\n3,0,9,0,,,,,,\n",
            "line 2: xx ... zz is no covariance",
        ),
    ],
)
def test_bad_control_targets_are_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(MapError) as refusal:
        read_control(file(tmp_path, text))
    assert words in str(refusal.value)
