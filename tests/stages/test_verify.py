"""Verification: what is true is believed, what is chance is not, and what cannot be told apart is said to be so."""

import copy
from collections.abc import Sequence
from math import sqrt

import numpy as np
import pytest

from constellations import (
    chi2_limits,
    firm_triple,
    fixed,
    front_map,
    indexed,
    looking,
    nees,
    noise,
    points_of,
    saying,
    scattered,
    seen_points,
    sensor_covariances,
    some_points,
)
from trifix.errors import ConfigError
from trifix.geometry.pose import Pose
from trifix.records import (
    Fix,
    Identification,
    NoFix,
    Reason,
    ReferenceMap,
    SensorPoints,
    StereoMatches,
    TargetState,
)
from trifix.stages.orient import orient
from trifix.stages.verify import Evidence, Solution, VerifyOptions, _agreement, verify


def judged(
    points: SensorPoints,
    map: ReferenceMap,
    identification: Identification,
    matches: StereoMatches | None = None,
    earlier: Sequence[Identification] = (),
    options: VerifyOptions = VerifyOptions(),
) -> Fix | NoFix:
    orientations = orient(points, map, identification)
    return verify(
        Evidence.of(points, matches), map, indexed(map), identification, orientations, earlier, options=options
    )


def same(*rows: int) -> list[tuple[int, int]]:
    return [(row, row) for row in rows]


def random_triples(rng: np.random.Generator, n: int, k: int, count: int) -> list[list[tuple[int, int]]]:
    return [
        list(zip(rng.permutation(n)[:3].tolist(), rng.permutation(k)[:3].tolist(), strict=True)) for _ in range(count)
    ]


# --- what is true ----------------------------------------------------------------------------------------------------


def test_the_true_pose_is_found_among_false_hypotheses():
    rng = np.random.default_rng(1)
    for _ in range(10):
        world = scattered(rng, 15)
        T = looking(rng)
        points, map = seen_points(world, T, rng), front_map(world, 0.05)
        fix = fixed(judged(points, map, saying(*random_triples(rng, 15, 15, 40), same(*firm_triple(world)))))
        np.testing.assert_array_equal(fix.point, fix.target)
        assert len(fix.point) >= 14
        assert 0 < fix.p_chance < 1e-9
        assert (fix.T_world_sensor.inverse() @ T).angle_rad() < 0.005
        assert fix.T_world_sensor.distance_mm(T) < 1.0


def test_the_residuals_are_those_of_the_pose():
    rng = np.random.default_rng(2)
    world = scattered(rng, 12)
    points, map = seen_points(world, looking(rng), rng), front_map(world)
    fix = fixed(judged(points, map, saying(same(*firm_triple(world)))))
    distance = np.linalg.norm(map.xyz_mm[fix.target] - fix.T_world_sensor.apply(points.xyz_mm[fix.point]), axis=1)
    np.testing.assert_allclose(fix.residual_mm, distance, atol=1e-9)
    assert fix.rms_mm == pytest.approx(float(np.sqrt(np.mean(distance**2))))
    assert 0.02 < fix.rms_mm < 0.2


@pytest.mark.parametrize("map_sigma_mm", [0.0, 0.08])
def test_errors_of_the_pose_follow_its_covariance(map_sigma_mm: float):
    """Chi-square of six degrees of freedom, in the mean and in both tails: the map's uncertainty is in it."""
    rng = np.random.default_rng(3)
    trials = 200
    errors = np.empty(trials)
    for k in range(trials):
        world = scattered(rng, 12)
        T = looking(rng)
        map = front_map(world, map_sigma_mm)
        if map_sigma_mm:
            map.xyz_mm[:] += noise(rng, map.cov_mm2)
        fix = fixed(judged(seen_points(world, T, rng), map, saying(same(*firm_triple(world)))))
        errors[k] = nees(fix.T_world_sensor, fix.cov, T)
    low, high = chi2_limits(6 * trials)
    assert low < errors.sum() < high
    below, above = chi2_limits(6, 0.05)
    for share in (np.mean(errors < below), np.mean(errors > above)):
        assert abs(share - 0.05) < 4 * sqrt(0.05 * 0.95 / trials)


def test_false_points_are_left_out():
    rng = np.random.default_rng(4)
    world = scattered(rng, 14)
    T = looking(rng)
    clutter = scattered(rng, 20, apart_mm=1.0)
    clutter = clutter[np.linalg.norm(clutter[:, None] - world, axis=2).min(axis=1) > 4]
    points = seen_points(np.vstack([world, clutter]), T, rng)
    fix = fixed(judged(points, front_map(world), saying(same(*firm_triple(world)))))
    np.testing.assert_array_equal(fix.point, fix.target)
    assert len(fix.point) >= 13


def test_targets_that_are_gone_are_not_matched():
    rng = np.random.default_rng(5)
    world = scattered(rng, 16)
    map = front_map(world)
    firm = firm_triple(world)
    gone = [row for row in range(16) if row not in firm][:2]
    map.state[gone] = [TargetState.quarantined, TargetState.removed]
    fix = fixed(judged(seen_points(world, looking(rng), rng), map, saying(same(*firm))))
    assert not set(fix.target.tolist()) & set(gone)
    assert len(fix.target) >= 13


def test_each_point_and_each_target_is_matched_once():
    rng = np.random.default_rng(6)
    world = scattered(rng, 12)
    T = looking(rng)
    xyz = T.inverse().apply(np.vstack([world, world + rng.normal(0, 0.05, world.shape)]))  # every target twice
    cov = sensor_covariances(xyz)
    fix = fixed(judged(points_of(xyz + noise(rng, cov), cov), front_map(world), saying(same(*firm_triple(world)))))
    assert len(set(fix.target.tolist())) == len(fix.target)
    assert len(set(fix.point.tolist())) == len(fix.point)


def test_of_two_points_that_share_a_dot_one_is_matched():
    rng = np.random.default_rng(7)
    world = scattered(rng, 12)
    points = seen_points(world, looking(rng), rng)
    n = len(points)
    firm = firm_triple(world)
    a, b = [row for row in range(n) if row not in firm][:2]
    right = np.arange(n)
    right[b] = right[a]
    matches = StereoMatches(np.arange(n), right, np.zeros(n), np.full(n, 0.1))
    points = SensorPoints(points.xyz_mm, points.cov_mm2, np.arange(n), points.label, points.row)
    fix = fixed(judged(points, front_map(world), saying(same(*firm)), matches))
    assert len({a, b} & set(fix.point.tolist())) == 1
    assert len(fix.point) >= 10


# --- what is not -----------------------------------------------------------------------------------------------------


def test_pure_noise_is_refused():
    rng = np.random.default_rng(8)
    for _ in range(25):
        n = int(rng.integers(4, 20))
        map = front_map(scattered(rng, 25))
        points = seen_points(scattered(rng, n), looking(rng), rng)
        answer = judged(points, map, saying(*random_triples(rng, n, 25, 100)))
        assert isinstance(answer, NoFix)
        assert answer.why in (Reason.not_proven, Reason.no_candidate)
        assert answer.rivals == ()
        if answer.why is Reason.not_proven:
            assert 1e-9 < answer.p_chance <= 1
            assert answer.matched >= 3


def test_three_points_prove_nothing():
    """They made the hypothesis, so they agree with it in any case."""
    rng = np.random.default_rng(9)
    world = scattered(rng, 3)
    answer = judged(seen_points(world, looking(rng), rng), front_map(world), saying(same(0, 1, 2)))
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.not_proven


def test_every_hypothesis_tried_costs_its_share_of_the_proof():
    rng = np.random.default_rng(10)
    world = scattered(rng, 12)
    points, map = seen_points(world, looking(rng), rng), front_map(world)
    right = saying(same(*firm_triple(world)))
    false = saying(*random_triples(rng, 12, 12, 1000))
    few, many = (fixed(judged(points, map, right, earlier=[false] * n)) for n in (1, 5))
    assert many.p_chance / few.p_chance == pytest.approx(5, rel=0.01)


def test_the_required_proof_is_an_option():
    rng = np.random.default_rng(11)
    world = scattered(rng, 12)
    points, map = seen_points(world, looking(rng), rng), front_map(world)
    p = fixed(judged(points, map, saying(same(*firm_triple(world))))).p_chance
    answer = judged(points, map, saying(same(*firm_triple(world))), options=VerifyOptions(max_p_chance=1e-4 * p))
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.not_proven
    assert 1e-4 * p < answer.p_chance <= p
    assert "of 12 points agree" in answer.detail


@pytest.mark.parametrize(
    ("count", "single", "p_chance", "detail"),
    [
        (0, 0, 1.0, "No point agrees with the map."),
        (0, 2, 1.0, "Only 2 dots of a single camera agree with the map."),
        (3, 0, 1.0, "3 of 9 points agree with the map to 0.50 mm, as by chance they may."),
        (
            5,
            1,
            1e-3,
            "5 of 9 points and 1 dot of a single camera agree with the map to 0.50 mm; by chance so in up to ",
        ),
    ],
)
def test_what_proves_nothing_is_said_in_words(count, single, p_chance, detail):
    mm, dots = np.full(count, 0.5), np.arange(4) - 4 + single
    solution = Solution(Pose.identity(), np.eye(6), np.arange(9), dots, np.arange(count), mm, mm, 0.0, 0.0, p_chance)
    assert _agreement(solution, 9).startswith(detail)


def test_without_hypotheses_there_is_no_candidate():
    rng = np.random.default_rng(12)
    world = scattered(rng, 12)
    none = Identification(np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.int64))
    answer = judged(seen_points(world, looking(rng), rng), front_map(world), none)
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.no_candidate


def test_hypotheses_on_one_line_are_no_candidates():
    rng = np.random.default_rng(13)
    world = np.vstack([np.outer(np.arange(4.0), [20.0, 4.0, 2.0]), scattered(rng, 8) + [0, 100, 0]])
    answer = judged(seen_points(world, looking(rng), rng), front_map(world), saying(same(0, 1, 2), same(1, 2, 3)))
    assert isinstance(answer, NoFix)
    assert answer.why in (Reason.no_candidate, Reason.not_proven)


# --- what could be something else ------------------------------------------------------------------------------------


def grid(side: int, pitch_mm: float = 12.0) -> np.ndarray:
    u, v = np.meshgrid(np.arange(side) - (side - 1) / 2, np.arange(side) - (side - 1) / 2)
    return np.c_[u.ravel(), v.ravel(), np.zeros(side**2)] * pitch_mm


def test_a_part_of_a_regular_grid_is_ambiguous():
    """A window of 4 × 4 cells fits in several places; each is offered as a rival."""
    rng = np.random.default_rng(14)
    world, side = grid(7), 7
    T = looking(rng)
    window = np.array([side * row + column for row in range(1, 5) for column in range(1, 5)])
    points = some_points(seen_points(world, T, rng), window)
    shifted = [[(p, int(window[p]) + side * dr + dc) for p in (0, 3, 12)] for dr in (-1, 0, 1) for dc in (-1, 0, 1)]
    answer = judged(points, front_map(world, 0.02), saying(*shifted))
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.ambiguous
    assert len(answer.rivals) >= 5
    assert [rival.log_odds for rival in answer.rivals] == sorted((r.log_odds for r in answer.rivals), reverse=True)
    apart = [answer.rivals[0].T_world_sensor.distance_mm(rival.T_world_sensor) for rival in answer.rivals[1:]]
    assert min(apart) > 8


def test_a_whole_regular_grid_is_ambiguous():
    """Turned by a quarter it is the same; shifted by a cell, most of it: so are more poses than were suggested."""
    rng = np.random.default_rng(15)
    world, side = grid(6), 6
    points = seen_points(world, looking(rng), rng)
    corner, right, below = 7, 10, 25
    turned = [(corner, right), (right, side * 4 + 4), (below, corner)]
    answer = judged(points, front_map(world, 0.02), saying(same(corner, right, below), turned))
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.ambiguous
    assert sum(rival.matched >= 35 for rival in answer.rivals) == 4
    assert len(answer.rivals) > 4


def test_two_halves_that_are_copies_are_ambiguous():
    rng = np.random.default_rng(16)
    half = scattered(rng, 12)
    points = seen_points(half, looking(rng), rng)
    map = front_map(np.vstack([half, half + [400.0, 0, 0]]), 0.02)
    firm = firm_triple(half)
    answer = judged(points, map, saying(same(*firm), [(p, p + 12) for p in firm]))
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.ambiguous
    apart = answer.rivals[0].T_world_sensor.inverse() @ answer.rivals[1].T_world_sensor
    assert np.linalg.norm(apart.t_mm) == pytest.approx(400.0, abs=1.0)


def test_the_same_pose_twice_is_no_rival_of_itself():
    rng = np.random.default_rng(17)
    world = scattered(rng, 15)
    fixed(
        judged(
            seen_points(world, looking(rng), rng),
            front_map(world, 0.05),
            saying(same(*firm_triple(world)), same(1, 2, 3), same(4, 6, 7), same(8, 10, 11), same(12, 13, 14)),
        )
    )


def test_a_mirrored_constellation_is_refused():
    rng = np.random.default_rng(18)
    for _ in range(20):
        world = scattered(rng, 14)
        points = seen_points(world * [1, 1, -1], looking(rng), rng)
        map = front_map(world)
        answer = judged(points, map, saying(*(same(*rng.permutation(14)[:3].tolist()) for _ in range(60))))
        assert isinstance(answer, NoFix)
        assert answer.why in (Reason.not_proven, Reason.no_candidate)


@pytest.mark.parametrize("off", [2, 4])
def test_a_mirrored_constellation_is_refused_though_most_of_it_lies_in_the_mirror(off):
    rng = np.random.default_rng(19)
    for _ in range(10):
        world = scattered(rng, 8 + off, (150.0, 120.0, 0.0))
        world[:off, 2] = rng.choice([-20.0, 20.0], off)
        points = seen_points(world * [1, 1, -1], looking(rng), rng)
        rows = [off + row for row in firm_triple(world[off:])]
        answer = judged(points, front_map(world), saying(same(*rows)))
        assert isinstance(answer, NoFix)
        assert "mirror" in answer.detail


def flat(rng: np.random.Generator, n: int) -> np.ndarray:
    return scattered(rng, n, (150, 120, 0))


def test_a_planar_constellation_is_not_seen_from_behind():
    """Its mirror image is a proper rotation: only the side from which targets are seen tells."""
    rng = np.random.default_rng(19)
    world = flat(rng, 14)
    points = seen_points(world * [-1, 1, 1], looking(rng), rng)
    hypotheses = saying(same(*firm_triple(world)), same(1, 6, 11), same(2, 7, 13))
    answer = judged(points, front_map(world), hypotheses)
    assert isinstance(answer, NoFix)
    assert answer.why is Reason.no_candidate
    blind = ReferenceMap.given(world)  # nobody knows from where these targets are seen
    T = fixed(judged(points, blind, hypotheses)).T_world_sensor
    assert T.t_mm[2] > 0  # behind


def test_a_pose_that_is_held_loosely_is_refused():
    rng = np.random.default_rng(20)
    world = scattered(rng, 12)
    points, map = seen_points(world, looking(rng), rng), front_map(world)
    for options in (VerifyOptions(max_sigma_mm=1e-4), VerifyOptions(max_sigma_deg=1e-4)):
        answer = judged(points, map, saying(same(*firm_triple(world))), options=options)
        assert isinstance(answer, NoFix)
        assert answer.why is Reason.weak_geometry
        assert answer.p_chance < 1e-9


def test_the_fix_does_not_hang_on_the_order_of_the_hypotheses():
    rng = np.random.default_rng(21)
    world = scattered(rng, 15)
    points, map = seen_points(world, looking(rng), rng), front_map(world, 0.05)
    triples = [*random_triples(rng, 15, 15, 30), same(*firm_triple(world))]
    first = fixed(judged(points, map, saying(*triples)))
    last = fixed(judged(points, map, saying(*triples[::-1])))
    np.testing.assert_allclose(last.T_world_sensor.t_mm, first.T_world_sensor.t_mm, atol=1e-9)
    np.testing.assert_array_equal(last.point, first.point)


def test_the_pose_of_the_hypothesis_need_not_be_good():
    """Three points close together hold a pose loosely; the others sharpen it."""
    rng = np.random.default_rng(22)
    for _ in range(10):
        world = scattered(rng, 20)
        near = np.argsort(np.linalg.norm(world - world[0], axis=1))[:6]
        near = near[firm_triple(world[near])]
        T = looking(rng)
        fix = fixed(judged(seen_points(world, T, rng), front_map(world), saying(same(*near.tolist()))))
        assert len(fix.point) >= 18
        assert nees(fix.T_world_sensor, fix.cov, T) < 30


def test_nothing_is_written_into_what_was_given():
    rng = np.random.default_rng(23)
    world = scattered(rng, 12)
    points, map = seen_points(world, looking(rng), rng), front_map(world)
    hypotheses = saying(same(*firm_triple(world)), same(1, 2, 3))
    orientations = orient(points, map, hypotheses)
    records = (points, map, hypotheses, orientations)
    before = copy.deepcopy(records)
    fixed(verify(Evidence.of(points), map, indexed(map), hypotheses, orientations))
    for record, copied in zip(records, before, strict=True):
        for name in record.__slots__:
            np.testing.assert_array_equal(getattr(record, name), getattr(copied, name))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"max_p_chance": 0.0}, "verify.max_p_chance is 0.0"),
        ({"max_p_chance": 1.0}, "verify.max_p_chance is 1.0"),
        ({"gate_sigmas": 0.0}, "verify.gate_sigmas"),
    ],
)
def test_impossible_options_are_refused(values, text):
    with pytest.raises(ConfigError, match=text):
        VerifyOptions(**values)
