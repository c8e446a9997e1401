"""The plain running average of a target's sightings, beside the Kalman filter."""

import numpy as np
import pytest

from trifix.geometry.pose import Pose
from trifix.records import Fix, ReferenceMap, SensorPoints
from trifix.stages.update import UpdateOptions, update

MEAN = UpdateOptions(method="mean")
WORLD = np.array([[0.0, 0, 500], [60, 0, 500], [0, 70, 520]])


def sight(map: ReferenceMap, offset_mm: float, sigma_mm: float, options: UpdateOptions) -> ReferenceMap:
    """The map after all targets were seen from the origin, off by so much along x, from a pose that is exact."""
    xyz = WORLD + np.array([offset_mm, 0, 0])
    points = SensorPoints(xyz, np.tile(sigma_mm**2 * np.eye(3), (3, 1, 1)), *[np.arange(3)] * 3)
    fix = Fix(Pose.identity(), np.zeros((6, 6)), np.arange(3), np.arange(3), np.zeros(3), 1e-20)
    return update(map, points, None, fix, 0, None, 3, options)[0]


def test_the_mean_counts_every_sighting_alike_whatever_its_covariance():
    map = ReferenceMap.given(WORLD, np.tile(0.3**2 * np.eye(3), (3, 1, 1)), sightings=np.full(3, 1))
    for offset_mm, sigma_mm in ((3.0, 0.01), (6.0, 5.0), (-1.0, 0.2)):
        map = sight(map, offset_mm, sigma_mm, MEAN)
    np.testing.assert_allclose(map.xyz_mm, WORLD + np.array([(0 + 3 + 6 - 1) / 4, 0, 0]), atol=1e-12)
    variance = (0.3**2 + 0.01**2 + 5.0**2 + 0.2**2) / 16
    np.testing.assert_allclose(map.cov_mm2, np.tile(variance * np.eye(3), (3, 1, 1)), atol=1e-12)


def test_mean_and_kalman_agree_on_sightings_of_equal_covariance():
    start = ReferenceMap.given(WORLD, np.tile(0.2**2 * np.eye(3), (3, 1, 1)), sightings=np.full(3, 1))
    mean = kalman = start
    for offset_mm in (0.4, -0.3, 0.1):
        mean, kalman = sight(mean, offset_mm, 0.2, MEAN), sight(kalman, offset_mm, 0.2, UpdateOptions())
    np.testing.assert_allclose(mean.xyz_mm, kalman.xyz_mm, atol=1e-9)
    np.testing.assert_allclose(mean.cov_mm2, kalman.cov_mm2, atol=1e-9)


def test_a_position_that_was_given_counts_as_one_sighting():
    map = sight(ReferenceMap.given(WORLD), 2.0, 0.1, MEAN)
    np.testing.assert_allclose(map.xyz_mm, WORLD + np.array([1.0, 0, 0]), atol=1e-12)
    assert map.sightings == pytest.approx(1)
