"""The loop: what it refuses and why, and whole simulated recordings against their truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from constellations import (
    MAP_COLUMNS,
    PARALLEL,
    RIG,
    fixed,
    frame_of,
    front_map,
    looking,
    points_of,
    scattered,
    seen_dots,
    seen_points,
    sensor_covariances,
    some_dots,
    some_points,
)
from trifix.config import Config
from trifix.errors import MapError
from trifix.evaluation import compare_poses
from trifix.files.recordings import read_recording
from trifix.geometry.pose import Pose
from trifix.positioner import Positioner
from trifix.records import (
    Fix,
    Frame,
    NoFix,
    PositionedReason,
    Reason,
    ReferenceMap,
    Step,
    StereoDots,
    TargetState,
    Unusable,
)
from trifix.sources.simulation import Simulation, simulate, simulate_frames
from trifix.stages.verify import VerifyOptions


def refused(step: Step, why: Reason) -> NoFix:
    assert isinstance(step.fix, NoFix)
    assert step.fix.why is why
    assert len(step.added) == 0
    return step.fix


@pytest.fixture(scope="module")
def world() -> np.ndarray:
    return scattered(np.random.default_rng(0), 20)


# --- refusals --------------------------------------------------------------------------------------------------------


def test_thousands_of_points_are_refused_at_once(world: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    there = looking(rng)
    crowd = points_of(rng.uniform(-200.0, 200.0, (2500, 3)) + [0, 0, 500.0], np.tile(np.eye(3) * 0.01, (2500, 1, 1)))
    positioner = Positioner(is_noise_stated=True)
    steps = list(positioner.run(frame_of(k, c) for k, c in enumerate([crowd, seen_points(world, there, rng), crowd])))
    assert "2500 points" in refused(steps[0], Reason.out_of_time).detail
    assert fixed(steps[1].fix).reason is PositionedReason.defines_world
    refused(steps[2], Reason.out_of_time)


IMPOSSIBLE = {
    "not finite": (np.nan, 1.0),
    "farther off": (1e8, 1.0),
    "zero": (1.0, 0.0),
    "flat": (1.0, np.diag([1.0, 1.0, 0.0])),
    "negative along two axes": (1.0, np.diag([-1.0, -1.0, 1.0])),
    "one-sided": (1.0, np.triu(np.ones((3, 3))) + 2 * np.eye(3)),
    "endless": (1.0, 1e300),
    "next to nothing": (1.0, 1e-300),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_points_are_refused_and_the_run_goes_on(world, case):
    rng = np.random.default_rng(1)
    factor, times = IMPOSSIBLE[case]
    good = seen_points(world, looking(rng), rng)
    bad = replace(good, xyz_mm=good.xyz_mm.copy(), cov_mm2=good.cov_mm2 * times)
    bad.xyz_mm[3] *= factor
    for map in (None, front_map(world)):
        positioner = Positioner(map=map, is_noise_stated=True)
        detail = refused(positioner.step(frame_of(0, bad)), Reason.bad_points).detail
        assert ("row 3" if factor != 1.0 else "20 of 20") in detail
        fixed(positioner.step(frame_of(1, good)).fix)


def test_points_far_beyond_the_map_are_no_candidates(world):
    rng = np.random.default_rng(1)
    good = seen_points(world, looking(rng), rng)
    far = replace(good, xyz_mm=good.xyz_mm * 1000.0)
    refused(Positioner(map=front_map(world), is_map_frozen=True).step(frame_of(0, far)), Reason.no_candidate)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["xyz_mm", "cov_mm2"])
def test_a_map_with_a_target_nowhere_is_refused(world, field, value):
    map = front_map(world)
    getattr(map, field)[4] = value
    with pytest.raises(MapError, match=r"Target 4 .* not finite"):
        Positioner(map=map)
    map.state[4] = TargetState.removed
    Positioner(map=map)


def test_a_map_with_a_negative_variance_is_refused(world):
    map = front_map(world, 0.1)
    map.cov_mm2[7, 0, 0] = -1.0
    with pytest.raises(MapError, match="covariance of target 7"):
        Positioner(map=map)


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("level", ["dots", "points"])
def test_fewer_than_three_points_are_too_few(world, count, level):
    rng = np.random.default_rng(1)
    T = looking(rng)
    rows = np.arange(count)
    dots = seen_dots(T.inverse().apply(world), rng)
    few = StereoDots(some_dots(dots.left, rows), some_dots(dots.right, rows))
    content = few if level == "dots" else some_points(seen_points(world, T, rng), rows)
    for map in (None, front_map(world)):
        refused(Positioner(map=map, is_noise_stated=True).step(frame_of(0, content)), Reason.too_few_points)


def test_how_few_points_there_are_is_said_in_words(world):
    rng = np.random.default_rng(1)
    T = looking(rng)
    dots = seen_dots(T.inverse().apply(world), rng)
    positioner = Positioner(map=front_map(world), is_noise_stated=True)
    fixed(positioner.step(frame_of(0, dots)).fix)
    none, one = some_dots(dots.right, np.zeros(0, dtype=np.int64)), some_dots(dots.left, np.arange(1))
    answer = refused(positioner.step(frame_of(1, StereoDots(one, none))), Reason.too_few_points)
    assert (answer.matched, answer.detail) == (0, "No point.")
    far = some_points(seen_points(world + [0.0, 0.0, 400.0], T, rng), np.arange(1))
    answer = refused(positioner.step(frame_of(2, far)), Reason.too_few_points)
    assert (answer.matched, answer.detail) == (0, "One point.")


def test_dots_in_one_image_only_are_too_few_points(world):
    rng = np.random.default_rng(2)
    dots = seen_dots(looking(rng).inverse().apply(world), rng)
    none = some_dots(dots.right, np.zeros(0, dtype=np.int64))
    step = Positioner().step(frame_of(0, StereoDots(dots.left, none)))
    refused(step, Reason.too_few_points)
    assert step.points is not None
    assert len(step.points) == 0


def test_a_frame_older_than_the_one_before_is_refused_and_changes_nothing(world):
    rng = np.random.default_rng(3)
    positioner = Positioner(is_noise_stated=True)
    frames = [frame_of(k, seen_points(world, looking(rng), rng)) for k in range(4)]
    for frame in frames[:3]:
        fixed(positioner.step(frame).fix)
    before = positioner.map.copy()
    late = replace(frames[3], timestamp_ns=frames[0].timestamp_ns)
    step = positioner.step(late)
    assert str(frames[0].timestamp_ns) in refused(step, Reason.time_reversed).detail
    assert step.frame.index == 3
    for name in MAP_COLUMNS:
        np.testing.assert_array_equal(getattr(positioner.map, name), getattr(before, name))
    fixed(positioner.step(frames[3]).fix)  # the same frame in its time


def test_the_same_time_twice_is_no_reversal(world):
    rng = np.random.default_rng(4)
    positioner = Positioner(is_noise_stated=True)
    for _ in range(3):
        fixed(positioner.step(replace(frame_of(1, seen_points(world, looking(rng), rng)), timestamp_ns=5)).fix)


@pytest.mark.parametrize("reason", [Reason.unreadable_image, Reason.no_calibration, Reason.bad_points])
def test_what_cannot_be_used_passes_through_with_its_reason(world, reason):
    rng = np.random.default_rng(5)
    positioner = Positioner(is_noise_stated=True)
    fixed(positioner.step(frame_of(0, seen_points(world, looking(rng), rng))).fix)
    step = positioner.step(Frame(1, 50_000_000, None, Unusable(reason, "left/0001.png ends early.")))
    assert refused(step, reason).detail == "left/0001.png ends early."
    assert step.points is None
    assert step.dots is None
    fixed(positioner.step(frame_of(2, seen_points(world, looking(rng), rng))).fix)


def test_an_unusable_first_frame_does_not_define_the_world(world):
    rng = np.random.default_rng(6)
    positioner = Positioner(is_noise_stated=True)
    refused(positioner.step(Frame(0, 0, None, Unusable(Reason.unreadable_image, ""))), Reason.unreadable_image)
    fix = fixed(positioner.step(frame_of(1, seen_points(world, looking(rng), rng))).fix)
    assert fix.reason is PositionedReason.defines_world


def test_a_frame_that_resembles_nothing_has_no_candidate(world):
    """Points farther apart than any two targets."""
    rng = np.random.default_rng(7)
    xyz = scattered(rng, 6, (4000, 4000, 500), 900.0) + [0, 0, 3000]
    step = Positioner(map=front_map(world), is_noise_stated=True).step(
        frame_of(0, points_of(xyz, sensor_covariances(xyz)))
    )
    refused(step, Reason.no_candidate)


def test_a_pose_that_is_not_proven_is_refused(world):
    rng = np.random.default_rng(8)
    strict = Config(verify=VerifyOptions(max_p_chance=1e-300))
    step = Positioner(strict, front_map(world), is_noise_stated=True).step(
        frame_of(0, seen_points(world[:16], looking(rng), rng))
    )
    answer = refused(step, Reason.not_proven)
    assert 1e-300 < answer.p_chance < 1e-9
    assert answer.matched >= 15


def test_points_on_one_line_do_not_define_the_world(world):
    rng = np.random.default_rng(9)
    line = np.outer(np.arange(5.0), [20.0, 4.0, 2.0]) + [-20, 0, 450]
    positioner = Positioner(is_noise_stated=True)
    refused(positioner.step(frame_of(0, points_of(line, sensor_covariances(line)))), Reason.weak_geometry)
    assert len(positioner.map) == 0
    fixed(positioner.step(frame_of(1, seen_points(world, looking(rng), rng))).fix)


# --- the world and the map -------------------------------------------------------------------------------------------


def test_the_first_frame_defines_the_world(world):
    rng = np.random.default_rng(10)
    positioner = Positioner(is_noise_stated=True)
    points = seen_points(world, looking(rng), rng)
    step = positioner.step(frame_of(0, points))
    fix = fixed(step.fix)
    assert fix.reason is PositionedReason.defines_world
    assert np.isnan(fix.p_chance)
    np.testing.assert_array_equal(fix.T_world_sensor.R, np.eye(3))
    np.testing.assert_array_equal(fix.T_world_sensor.t_mm, 0)
    np.testing.assert_array_equal(fix.cov, 0)
    np.testing.assert_array_equal(step.map.xyz_mm[fix.target], points.xyz_mm[fix.point])
    np.testing.assert_array_equal(np.sort(step.added), np.arange(len(points)))
    assert fixed(positioner.step(frame_of(1, seen_points(world, looking(rng), rng))).fix).reason is None


def test_a_growing_map_carries_the_sensor_to_targets_it_never_started_from():
    """A long strip, of which each frame sees a part: poses stay right and the map becomes the strip."""
    rng = np.random.default_rng(11)
    strip = scattered(rng, 60, (900, 120, 60))
    positioner = Positioner(is_noise_stated=True)
    T_first = None
    for k, x in enumerate(np.linspace(-370, 370, 38)):
        T = Pose(np.eye(3), np.array([x, 0, 0])) @ looking(rng, 0.2)
        near = np.abs(strip[:, 0] - x) < 90
        fix = fixed(positioner.step(frame_of(k, seen_points(strip[near], T, rng))).fix)
        T_first = T_first or T
        error = (T_first @ fix.T_world_sensor).inverse() @ T
        assert np.linalg.norm(error.t_mm) < 3
        assert np.degrees(error.angle_rad()) < 0.5
    alive = positioner.map.alive
    seen = np.abs(strip[:, 0]) < 460
    distance = np.linalg.norm(T_first.apply(positioner.map.xyz_mm[alive])[:, None] - strip, axis=2)
    assert alive.sum() == pytest.approx(seen.sum(), abs=2)
    assert np.all(distance.min(axis=1) < 3)
    assert len(np.unique(positioner.map.id)) == len(positioner.map)


@pytest.mark.parametrize("level", ["dots", "points"])
def test_a_frozen_map_stays_as_it_is(world, level):
    rng = np.random.default_rng(12)
    map = front_map(world[:14], 0.05)
    before = map.copy()
    positioner = Positioner(map=map, is_map_frozen=True, is_noise_stated=True)
    for k in range(8):
        T = looking(rng)
        seen = seen_dots(T.inverse().apply(world), rng) if level == "dots" else seen_points(world, T, rng)
        step = positioner.step(frame_of(k, seen))
        fix = fixed(step.fix)
        assert fix.reason is None
        assert (fix.T_world_sensor.inverse() @ T).angle_rad() < 0.005
        assert fix.T_world_sensor.distance_mm(T) < 1.5
        assert len(step.added) == 0
    for name in MAP_COLUMNS:
        np.testing.assert_array_equal(getattr(positioner.map, name), getattr(before, name))


@pytest.mark.parametrize("level", ["dots", "points"])
def test_a_given_map_may_grow(world, level):
    rng = np.random.default_rng(13)
    given = front_map(world[:12], 0.05)
    positioner = Positioner(map=given.copy(), is_noise_stated=True)
    for k in range(8):
        T = looking(rng)
        seen = seen_dots(T.inverse().apply(world), rng) if level == "dots" else seen_points(world, T, rng)
        fix = fixed(positioner.step(frame_of(k, seen)).fix)
        assert fix.T_world_sensor.distance_mm(T) < 1.5  # in the coordinates of the given map
    map = positioner.map
    np.testing.assert_array_equal(map.id[:12], given.id)
    assert np.linalg.norm(map.xyz_mm[:12] - world[:12], axis=1).max() < 0.3
    trusted = map.xyz_mm[map.state == TargetState.trusted]
    distance = np.linalg.norm(trusted[:, None] - world, axis=2)
    assert distance.min(axis=0).max() < 0.5  # all twenty are there
    assert (map.id[12:] >= 12).all()


def test_ids_of_new_targets_follow_those_given(world):
    rng = np.random.default_rng(14)
    given = ReferenceMap.given(world[:12], np.tile(0.0025 * np.eye(3), (12, 1, 1)), id=np.arange(12) * 10 + 1000)
    positioner = Positioner(map=given, is_noise_stated=True)
    for k in range(3):
        fixed(positioner.step(frame_of(k, seen_points(world, looking(rng), rng))).fix)
    assert positioner.map.id.min() == 1000
    assert (positioner.map.id[12:] > 1110).all()


def test_every_frame_may_have_a_rig_of_its_own(world):
    rng = np.random.default_rng(15)
    positioner = Positioner(map=front_map(world), is_map_frozen=True, is_noise_stated=True)
    for k in range(6):
        rig = (RIG, PARALLEL)[k % 2]
        T = looking(rng)
        fix = fixed(positioner.step(frame_of(k, seen_dots(T.inverse().apply(world), rng, 0.1, rig), rig)).fix)
        assert fix.T_world_sensor.distance_mm(T) < 2


def test_a_step_tells_all_that_was_found(world):
    rng = np.random.default_rng(16)
    positioner = Positioner(map=front_map(world), is_noise_stated=True)
    step = positioner.step(frame_of(3, seen_dots(looking(rng).inverse().apply(world), rng)))
    fix = fixed(step.fix)
    assert step.frame.index == 3
    assert len(step.dots.left) == len(step.dots.right) == 20
    assert len(step.matches) >= 20
    assert len(step.points) == len(step.matches)
    pair = step.points.match[fix.point]
    np.testing.assert_array_equal(step.matches.left[pair], step.matches.right[pair])  # true pairs
    np.testing.assert_array_equal(step.matches.left[pair], fix.target)
    assert {"match", "triangulate", "identify", "orient", "verify", "update"} <= step.timings_ms.keys()
    assert step.map is positioner.map


# --- whole recordings ------------------------------------------------------------------------------------------------


def positioned(simulation: Simulation, steps: Sequence[Step]) -> list[tuple[Pose, Pose]]:
    """Estimated and true pose of each positioned frame."""
    return [
        (step.fix.T_world_sensor, true)
        for step, true in zip(steps, simulation.truth.frames.T_map_sensor, strict=True)
        if isinstance(step.fix, Fix)
    ]


@pytest.mark.parametrize(
    ("scene", "level", "frames", "least"),
    [
        ("demo", "images", 4, 1.0),
        ("demo", "dots", 25, 0.95),
        ("demo", "points", 25, 0.95),
        ("statue", "dots", 40, 0.75),
        ("head", "points", 40, 0.75),
        ("sphere", "dots", 40, 0.75),
        ("steps", "points", 30, 0.75),
        ("mirror", "dots", 30, 0.9),
        ("clutter", "dots", 30, 0.9),
        ("clutter", "points", 30, 0.9),
        ("kidnap", "points", 60, 0.7),
        ("grid", "points", 15, 0.0),
    ],
)
def test_simulated_recordings_are_positioned_and_never_wrongly(scene, level, frames, least):
    """Of the frames that a map growing frame by frame can reach."""
    simulation = simulate_frames(scene, 1, level, frames)
    steps = list(Positioner(is_noise_stated=level != "images").run(simulation.frames))
    estimated, true = zip(*positioned(simulation, steps), strict=True)
    errors = compare_poses(estimated, true)
    assert not errors.is_wrong.any()
    assert len(estimated) >= least * simulation.truth.frames.reachable_online.sum()


@pytest.mark.parametrize("level", ["dots", "points"])
def test_with_the_true_map_poses_are_right_without_alignment(level):
    simulation = simulate_frames("demo", 2, level, 25)
    targets = simulation.scene.targets
    map = ReferenceMap.given(targets.xyz_mm, view=targets.normal)
    steps = list(Positioner(map=map, is_map_frozen=True, is_noise_stated=True).run(simulation.frames))
    estimated, true = zip(*positioned(simulation, steps), strict=True)
    assert len(estimated) >= 24
    assert not compare_poses(estimated, true, is_map_given=True, wrong_mm=2.0, wrong_deg=0.3).is_wrong.any()


@pytest.mark.parametrize(("level", "frames"), [("images", 2), ("dots", 12), ("points", 12)])
def test_two_runs_are_the_same_to_the_last_bit(level, frames):
    recording = simulate_frames("demo", 5, level, frames).frames
    first, second = (list(Positioner().run(recording)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        a, b = fixed(one.fix), fixed(other.fix)
        assert a.T_world_sensor.R.tobytes() == b.T_world_sensor.R.tobytes()
        assert a.T_world_sensor.t_mm.tobytes() == b.T_world_sensor.t_mm.tobytes()
        assert a.cov.tobytes() == b.cov.tobytes()
        np.testing.assert_array_equal(a.point, b.point)
        np.testing.assert_array_equal(a.target, b.target)
        for name in MAP_COLUMNS:
            assert getattr(one.map, name).tobytes() == getattr(other.map, name).tobytes()


def test_a_near_regular_grid_is_positioned_throughout(tmp_path: Path) -> None:
    """Among its many hypotheses are some that lose every pair as they are worked out (frame 268)."""
    simulate("grid", tmp_path / "grid", "dots", 7, 500)
    recording = read_recording(tmp_path / "grid" / "recording")
    steps = list(Positioner().run(recording.frame(k) for k in range(275)))
    assert all(isinstance(step.fix, Fix) for step in steps)


@pytest.mark.parametrize(("stated_px", "at_least"), [(0.01, 34), (0.1, 34), (1.0, 30), (None, 34)])
def test_a_wrongly_stated_noise_is_found_out(stated_px, at_least):
    """The statue's dots have 0.1 px, more where they are seen slantwise; 36 of its first 60 frames are found."""
    frames = []
    for frame in simulate_frames("statue", 1, "dots", 60).frames:
        assert isinstance(frame.content, StereoDots)
        cov = (stated_px or 0.3) ** 2 * np.eye(2)
        sides = (frame.content.left, frame.content.right)
        dots = StereoDots(*(replace(side, cov_px2=np.tile(cov, (len(side), 1, 1))) for side in sides))
        frames.append(replace(frame, content=dots))
    positioner = Positioner(is_noise_stated=stated_px is not None)
    steps = list(positioner.run(frames))
    assert at_least <= sum(isinstance(step.fix, Fix) for step in steps) <= 40
    found_px = (stated_px or 0.3) * positioner.noise.scale
    assert 0.09 < found_px < 0.14


def test_a_frame_numbered_backwards_is_refused_and_the_run_goes_on(world: np.ndarray) -> None:
    rng = np.random.default_rng(6)
    there = looking(rng)
    frames = [replace(frame_of(k, seen_points(world, there, rng)), index=index) for k, index in enumerate((7, 3, 8))]
    steps = list(Positioner(is_noise_stated=True).run(frames))
    assert refused(steps[1], Reason.time_reversed).detail == "It is frame 3, after frame 7."
    fixed(steps[2].fix)


def test_a_map_with_a_target_twice_is_refused() -> None:
    world = scattered(np.random.default_rng(3), 8)
    with pytest.raises(MapError, match="Target 0 of the map given shares its place with another"):
        Positioner(map=ReferenceMap.given(np.vstack([world, world[:1]])), is_map_frozen=True)
    with pytest.raises(MapError, match="Target 5 of the map given shares its identity with another"):
        Positioner(map=ReferenceMap.given(world, id=np.array([5, 1, 2, 3, 4, 5, 6, 7])), is_map_frozen=True)


def test_points_as_vague_as_they_lie_apart_define_no_world(world: np.ndarray) -> None:
    points = seen_points(world, looking(np.random.default_rng(4)), np.random.default_rng(4))
    vague = replace(points, cov_mm2=points.cov_mm2 * 1e8)
    step = Positioner(is_noise_stated=True).step(frame_of(0, vague))
    assert "are known to" in refused(step, Reason.weak_geometry).detail


def test_dots_of_a_single_camera_hold_the_pose_as_well():
    """On the true map, errors are those that the noise of all dots leaves, not of those that both cameras saw."""
    simulation = simulate_frames("head-front", 3, "dots", 60)
    truth = simulation.truth
    given = ReferenceMap.given(truth.targets.xyz_mm, view=truth.targets.normal, id=truth.targets.id)
    positioner = Positioner(map=given, is_map_frozen=True, is_noise_stated=True)
    ratio, single = [], 0
    for k, step in enumerate(positioner.run(simulation.frames)):
        if isinstance(step.fix, Fix) and np.isfinite(truth.frames.sigma_position_mm[k]):
            error = step.fix.T_world_sensor.inverse() @ truth.frames.T_map_sensor[k]
            ratio.append(np.linalg.norm(error.t_mm) / truth.frames.sigma_position_mm[k])
            single += len(step.fix.single)
            assert not set(step.fix.single.target) & set(step.fix.target)
    assert len(ratio) > 30
    assert single > len(ratio)
    assert 0.8 < np.sqrt(np.mean(np.square(ratio))) < 1.2
