"""Noise yields a fix no more often than promised."""

from collections.abc import Callable

import numpy as np
import pytest

from constellations import frame_of, looking, points_of, scattered, seen_dots, seen_points, sensor_covariances
from trifix.config import Config
from trifix.positioner import Positioner
from trifix.records import Fix, ReferenceMap, SensorPoints, StereoDots
from trifix.stages.verify import VerifyOptions

BOX_MM = (150.0, 120.0, 60.0)
SHEET_MM = (150.0, 120.0, 0.0)

Chance = Callable[[np.random.Generator, np.ndarray], SensorPoints | StereoDots]
"""What a frame shows that has nothing to do with the targets of the map, which are given, too."""


def random_points(rng: np.random.Generator, world: np.ndarray) -> SensorPoints:
    """Points that are nothing at all, in the space that the map fills."""
    return seen_points((rng.random((int(rng.integers(4, 16)), 3)) - 0.5) * BOX_MM, looking(rng), rng)


def three_agree(rng: np.random.Generator, world: np.ndarray) -> SensorPoints:
    """Three neighbours as in the map, and the rest where targets may be but are not: the three prove nothing."""
    three = np.argsort(np.linalg.norm(world - world[int(rng.integers(len(world)))], axis=1))[:3]
    return seen_points(np.vstack([world[three], (rng.random((9, 3)) - 0.5) * BOX_MM]), looking(rng), rng)


def foreign_solid(rng: np.random.Generator, world: np.ndarray) -> SensorPoints:
    """Another object."""
    return seen_points(scattered(rng, int(rng.integers(6, 20)), BOX_MM), looking(rng), rng)


def foreign_sheet(rng: np.random.Generator, world: np.ndarray) -> SensorPoints:
    """Another sheet: lying in a plane is no evidence."""
    return seen_points(scattered(rng, int(rng.integers(6, 20)), SHEET_MM), looking(rng), rng)


def noisy_sheet(rng: np.random.Generator, world: np.ndarray) -> SensorPoints:
    """Another sheet, seen ten times worse."""
    xyz = looking(rng).inverse().apply(scattered(rng, 14, SHEET_MM))
    cov = 100 * sensor_covariances(xyz)
    return points_of(xyz + rng.normal(0, 0.3, xyz.shape), cov)


def foreign_dots(rng: np.random.Generator, world: np.ndarray) -> StereoDots:
    """Another object as dots, false pairs among them."""
    return seen_dots(looking(rng).inverse().apply(scattered(rng, 15, BOX_MM)), rng)


CASES = [
    (random_points, BOX_MM, 40, 1000),
    (random_points, BOX_MM, 200, 200),
    (foreign_solid, BOX_MM, 40, 500),
    (foreign_sheet, SHEET_MM, 40, 500),
    (noisy_sheet, SHEET_MM, 40, 100),
    (foreign_dots, BOX_MM, 60, 100),
]
THREE = [(three_agree, BOX_MM, 40, 150), (three_agree, BOX_MM, 200, 50)]


def ids(cases: list[tuple[Chance, tuple[float, float, float], int, int]]) -> list[str]:
    return [f"{noise.__name__}-{targets}" for noise, _, targets, _ in cases]


def fixes(config: Config, noise: Chance, size_mm: tuple[float, float, float], targets: int, trials: int) -> int:
    """How many of so many frames of noise are positioned; the map is drawn anew now and then."""
    rng = np.random.default_rng(7)
    count = 0
    positioner = None
    for k in range(trials):
        if positioner is None or k % 50 == 0:
            world = scattered(rng, targets, size_mm, 5.0)
            map = ReferenceMap.given(world, np.tile(0.05**2 * np.eye(3), (targets, 1, 1)))
            positioner = Positioner(config, map, is_map_frozen=True, is_noise_stated=True)
        if isinstance(positioner.step(frame_of(k, noise(rng, world))).fix, Fix):
            count += 1
            positioner = None  # a fix leaves traces: the next trial begins anew
    return count


@pytest.mark.parametrize(("noise", "size_mm", "targets", "trials"), [*CASES, *THREE], ids=ids([*CASES, *THREE]))
def test_noise_is_never_positioned(noise, size_mm, targets, trials):
    assert fixes(Config(), noise, size_mm, targets, trials) == 0


@pytest.mark.parametrize(("noise", "size_mm", "targets", "trials"), CASES, ids=ids(CASES))
def test_noise_is_positioned_no_more_often_than_allowed(noise, size_mm, targets, trials):
    """With nothing but the probability of chance to stop it."""
    alone = VerifyOptions(
        max_p_chance=0.05, min_rival_odds=1.0, max_rival_share=1.0, max_sigma_mm=1e6, max_sigma_deg=90.0
    )
    assert fixes(Config(verify=alone), noise, size_mm, targets, trials) <= 0.05 * trials


@pytest.mark.parametrize("noise", [random_points, three_agree, foreign_solid])
def test_noise_is_refused_also_where_the_sensor_is_expected(noise):
    """True frames first, so that the motion is known and the map has grown; then a foreign object is held up."""
    rng = np.random.default_rng(8)
    world = scattered(rng, 20)
    for _ in range(6):
        positioner = Positioner(is_noise_stated=True)
        T = looking(rng)
        true = [positioner.step(frame_of(k, seen_points(world, T, rng))).fix for k in range(5)]
        assert all(isinstance(fix, Fix) for fix in true)
        for k in range(5, 20):
            assert not isinstance(positioner.step(frame_of(k, noise(rng, world))).fix, Fix)
