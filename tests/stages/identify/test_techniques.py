"""What every technique owes: the right pose on a clean scatter, on a sequence, and peace on hopeless ones."""

from typing import get_args

import numpy as np
import pytest
from scatters import Scatter, around_sphere, looking_at, map_of, over_plane, plane, points_at, seen, sphere

from trifix.config import Config, with_overrides
from trifix.geometry.pose import Pose
from trifix.positioner import Positioner
from trifix.records import Fix, ReferenceMap, SensorPoints
from trifix.stages.identify import Identifier, IdentifyOptions, identifier
from trifix.stages.identify.congruence import Technique

TECHNIQUES = get_args(Technique)
SCENES = {"sphere": sphere, "plane": plane}
PAPER = {
    "verify.method": "residual",
    "identify.max_sigmas": "0",
    "identify.tolerance_mm": "0.5",
    "identify.portion": "1000000",
    "update.max_misses": "0",
}


def knowing(technique: Technique, map: ReferenceMap, options: IdentifyOptions | None = None) -> Identifier:
    made = identifier(options or IdentifyOptions(technique=technique))
    made.learn(map, np.zeros(0, dtype=np.int64))
    return made


def correct(technique: Identifier, points: SensorPoints, map: ReferenceMap, target: np.ndarray, T: Pose) -> int:
    """Hypotheses all of whose pairs are true."""
    return sum(
        int((target[each.point] == each.target).all(axis=1).sum()) for each in technique.identify(points, map, T)
    )


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("technique", TECHNIQUES)
def test_every_technique_finds_true_pairs_on_a_clean_scatter(technique: Technique, scene: str) -> None:
    rng = np.random.default_rng(11)
    scatter: Scatter = SCENES[scene](40, rng)
    T = looking_at(np.zeros(3), np.array([30.0, -80, 500]), roll_rad=0.5)
    points, target = seen(scatter, T, 1e-4, rng)
    map = map_of(scatter)
    made = knowing(technique, map)
    assert isinstance(made, Identifier)
    assert correct(made, points, map, target, T) >= 1


@pytest.mark.parametrize("verification", ["probability", "residual"])
@pytest.mark.parametrize("scene", ["sphere", "plane"])
@pytest.mark.parametrize("technique", TECHNIQUES)
def test_every_technique_follows_a_sensor_and_never_errs(technique: Technique, scene: str, verification: str) -> None:
    rng = np.random.default_rng(5)
    frames = (
        around_sphere(sphere(90, rng), 15, 0.04, rng) if scene == "sphere" else over_plane(plane(70, rng), 15, 6.0, rng)
    )
    settings = {"identify.technique": technique} | (PAPER if verification == "residual" else {})
    positioner = Positioner(with_overrides(Config(), settings), is_noise_stated=True)
    T_world_first = frames[0][1]
    positioned = 0
    for step, (_, T) in zip(positioner.run(frame for frame, _ in frames), frames, strict=True):
        if isinstance(step.fix, Fix):
            positioned += 1
            assert (T_world_first.inverse() @ T).distance_mm(step.fix.T_world_sensor) < 1.0
    # outer triangles of a noisy plane are what the noise makes of them
    assert positioned >= (5 if technique == "delaunay" and scene == "plane" else 15)


@pytest.mark.parametrize("technique", TECHNIQUES)
@pytest.mark.parametrize("count", [1, 2])
def test_a_map_of_fewer_than_three_targets_yields_no_candidates(technique: Technique, count: int) -> None:
    rng = np.random.default_rng(1)
    points = points_at(rng.uniform(300, 400, size=(6, 3)), 0.1, rng)
    map = ReferenceMap.given(points.xyz_mm[:count])
    made = knowing(technique, map)
    assert sum(len(each) for each in made.identify(points, map, Pose.identity())) == 0
    assert len(made.triangles()) == 0


@pytest.mark.parametrize("technique", TECHNIQUES)
def test_an_empty_map_and_frames_of_few_points_are_endured(technique: Technique) -> None:
    rng = np.random.default_rng(1)
    points = points_at(rng.uniform(300, 400, size=(5, 3)), 0.1, rng)
    few = SensorPoints(points.xyz_mm[:2], points.cov_mm2[:2], points.match[:2], points.label[:2], points.row[:2])
    map = ReferenceMap.given(points.xyz_mm)
    assert sum(len(each) for each in knowing(technique, map).identify(few, map, Pose.identity())) == 0
    empty = ReferenceMap.empty()
    made = knowing(technique, empty)
    assert sum(len(each) for each in made.identify(points, empty, Pose.identity())) == 0
    assert made.size == 0


@pytest.mark.parametrize("technique", TECHNIQUES)
@pytest.mark.parametrize("flatness", ["plane", "line", "grid", "one place"])
def test_degenerate_scatters_do_no_harm(technique: Technique, flatness: str) -> None:
    rng = np.random.default_rng(4)
    xyz = np.zeros((16, 3))
    if flatness == "grid":
        xyz[:, :2] = 40.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)
    elif flatness != "one place":
        axes = 2 if flatness == "plane" else 1
        xyz[:, :axes] = rng.uniform(-200, 200, size=(16, axes))
    T = looking_at(np.zeros(3), np.array([50.0, 60, 400]))
    points = points_at(T.inverse().apply(xyz), 0.0, rng)
    map = ReferenceMap.given(xyz)
    made = knowing(technique, map, IdentifyOptions(technique=technique, max_sigmas=0.0, tolerance_mm=0.1))
    for each in made.identify(points, map, T):
        assert each.point.shape == each.target.shape
        assert each.point.max(initial=0) < 16


@pytest.mark.parametrize("technique", ["minimal", "delaunay", "frequency"])
def test_about_two_triangles_form_per_target(technique: Technique) -> None:
    rng = np.random.default_rng(7)
    positioner = Positioner(with_overrides(Config(), {"identify.technique": technique}), is_noise_stated=True)
    for _ in positioner.run(frame for frame, _ in around_sphere(sphere(100, rng), 100, 0.065, rng)):
        pass
    made = knowing(technique, positioner.map) if technique != "frequency" else positioner.identifier
    per_target = made.size / int(positioner.map.alive.sum())
    assert positioner.map.alive.sum() > 60
    assert 1.6 < per_target < 3.0
    assert made.size == len(made.triangles()) == len(np.unique(np.sort(made.triangles(), axis=1), axis=0))


def test_size_counts_all_distances_and_all_triangles() -> None:
    map = ReferenceMap.given(np.random.default_rng(1).uniform(0, 100, size=(20, 3)))
    assert knowing("distances", map).size == 20 * 19 // 2
    assert knowing("triangles", map).size == knowing("hashing", map).size == 20 * 19 * 18 // 6
    assert knowing("icp", map).size == 0


def test_all_triangles_of_a_large_map_are_those_of_neighbourhoods() -> None:
    xyz = np.random.default_rng(1).uniform(0, 1000, size=(61, 3))
    triangles = knowing("triangles", ReferenceMap.given(xyz)).triangles()
    assert 61 * 100 < len(triangles) < 61 * 60 * 59 // 6
    assert np.array_equal(triangles, knowing("hashing", ReferenceMap.given(xyz)).triangles())


def test_hashing_finds_what_comparing_all_triangles_finds() -> None:
    rng = np.random.default_rng(8)
    scatter = sphere(50, rng)
    T = looking_at(np.zeros(3), np.array([100.0, 50, 450]))
    points, _ = seen(scatter, T, 0.3, rng)
    map = map_of(scatter)
    found = []
    for technique in ("triangles", "hashing"):
        made = knowing(technique, map, IdentifyOptions(technique=technique, portion=10**6))
        (each,) = made.identify(points, map)
        found.append({tuple(sorted(zip(p, q, strict=True))) for p, q in zip(each.point, each.target, strict=True)})
        assert len(found[-1]) == len(each)
    assert found[0] == found[1]
    assert len(found[0]) > 10


def test_closest_points_has_no_candidate_without_a_last_pose() -> None:
    rng = np.random.default_rng(2)
    scatter = sphere(60, rng)
    T = looking_at(np.zeros(3), np.array([0.0, 450, 0]))
    points, target = seen(scatter, T, 0.01, rng)
    map = map_of(scatter)
    made = knowing("icp", map)
    assert list(made.identify(points, map)) == []
    moved = T @ Pose.exp(np.array([4.0, -3.0, 2.0, 0.01, -0.01, 0.03]))
    assert correct(made, points, map, target, moved) == 10


def test_distances_resolve_the_contradictions_of_strangers_in_the_frame() -> None:
    rng = np.random.default_rng(6)
    scatter = sphere(60, rng)
    T = looking_at(np.zeros(3), np.array([0.0, 450, 0]))
    points, target = seen(scatter, T, 0.02, rng)
    known = target[: len(target) - 4]  # four points are not in the map
    map = ReferenceMap.given(np.delete(scatter.xyz_mm, target[-4:], axis=0))
    row_in_map = np.full(60, -1)
    row_in_map[np.setdiff1d(np.arange(60), target[-4:])] = np.arange(56)
    (found,) = knowing("distances", map).identify(points, map)
    assert len(known) >= 5
    assert len(found) >= 4
    assert (row_in_map[target[found.point]] == found.target).all()
    assert found.comparisons == len(points) * (len(points) - 1) // 2 * (56 * 55 // 2)


def test_the_command_line_offers_every_technique() -> None:
    from trifix import cli

    assert get_args(cli.Technique) == TECHNIQUES
