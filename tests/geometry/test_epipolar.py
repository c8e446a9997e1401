import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import CONVERGENT, LAW, RADTAN4, RADTAN5, RIGS, points_before, poses

from trifix.geometry.camera import StereoRig
from trifix.geometry.epipolar import epipolar_lines, essential_matrix, pairs_near_epipolar_lines
from trifix.geometry.pose import Pose

EACH = pytest.mark.parametrize("rig", list(RIGS.values()), ids=list(RIGS))


def slopes(rig: StereoRig, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    in_right = rig.T_right_left.apply(xyz_mm)
    return xyz_mm[:, :2] / xyz_mm[:, 2:], in_right[:, :2] / in_right[:, 2:]


@LAW
@given(T=poses(), seed=st.integers(0, 99))
def test_true_pairs_satisfy_the_essential_matrix_of_any_rig(T: Pose, seed: int) -> None:
    rig = StereoRig(RADTAN5, RADTAN4, T)
    if rig.baseline_mm < 1e-3:
        return
    xyz = points_before(np.random.default_rng(seed), 20)
    in_right = T.apply(xyz) / 500.0
    value = np.einsum("ni,ij,nj->n", in_right, essential_matrix(rig), xyz / 500.0)
    assert np.abs(value).max() < 1e-9


@EACH
def test_true_pairs_lie_on_their_lines(rig: StereoRig) -> None:
    left, right = slopes(rig, points_before(np.random.default_rng(1), 200))
    lines = epipolar_lines(essential_matrix(rig), left)
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1.0, atol=1e-14)
    assert np.abs((lines * np.c_[right, np.ones(200)]).sum(axis=1)).max() < 1e-14


def test_gate_keeps_exactly_the_pairs_within_it() -> None:
    rng = np.random.default_rng(3)
    left, right = slopes(CONVERGENT, points_before(rng, 30))
    right = right + rng.normal(0, 0.002, right.shape)
    E = essential_matrix(CONVERGENT)
    rows = pairs_near_epipolar_lines(E, left, right, 0.003)
    expected = [
        (i, j)
        for i, (a, b, c) in enumerate(epipolar_lines(E, left))
        for j, (x, y) in enumerate(right)
        if abs(a * x + b * y + c) < 0.003
    ]
    assert list(zip(*(r.tolist() for r in rows), strict=True)) == expected
    assert 0 < len(expected) < 900


def test_a_sideways_rig_has_horizontal_lines() -> None:
    lines = epipolar_lines(essential_matrix(RIGS["parallel"]), np.array([[0.1, 0.2], [-0.3, -0.1]]))
    np.testing.assert_allclose(np.abs(lines[:, :2]), [[0, 1], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(-lines[:, 2] / lines[:, 1], [0.2, -0.1], atol=1e-15)
