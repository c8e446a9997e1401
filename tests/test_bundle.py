"""Adjusted recordings: nearer to the truth, in the same world, honest, and never fewer frames than before."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from constellations import nees
from trifix import bundle
from trifix.bundle import Adjusted, Constraints, NotAdjusted, adjust_steps
from trifix.config import BundleOptions, Config
from trifix.errors import MapError
from trifix.geometry.alignment import align
from trifix.geometry.pose import Pose
from trifix.positioner import Positioner
from trifix.records import (
    Fix,
    Frame,
    KnownLength,
    NoFix,
    PositionedReason,
    ReferenceMap,
    SensorPoints,
    SingleDots,
    Step,
    StereoDots,
    TargetState,
)
from trifix.sources.simulation import Simulation, simulate_frames
from trifix.stages.triangulate import triangulate

FRAMES = 70


@dataclass(frozen=True)
class Run:
    """A simulated recording, its steps before, and what came of adjusting them."""

    simulation: Simulation
    before: list[Step]
    after: Sequence[Step]
    told: Adjusted

    def identity(self) -> dict[int, int]:
        """True target of each id of the map, by its place; the trusted ones that are some."""
        map, first = self.after[-1].map, first_of(self.after)
        xyz = self.simulation.truth.frames.T_map_sensor[first].apply(map.xyz_mm)
        true = self.simulation.truth.targets.xyz_mm
        distance = np.linalg.norm(xyz[:, None] - true[None], axis=2)
        return {
            int(map.id[row]): int(distance[row].argmin())
            for row in np.flatnonzero(map.state == TargetState.trusted)
            if distance[row].min() < 2.0
        }


def positioned(simulation: Simulation, level: str) -> list[Step]:
    positioner = Positioner(is_noise_stated=level == "points")
    frames = [unstated(frame) for frame in simulation.frames]
    steps = [step.remembered() for step in positioner.run(frames)]
    return list(positioner.revise(steps))


def unstated(frame: Frame) -> Frame:
    """Dots as a file without sigma_px gives them."""
    if not isinstance(frame.content, StereoDots):
        return frame
    left, right = (
        replace(dots, cov_px2=np.tile(np.eye(2) * 0.3**2, (len(dots), 1, 1)))
        for dots in (frame.content.left, frame.content.right)
    )
    return replace(frame, content=StereoDots(left, right))


def first_of(steps: Sequence[Step]) -> int:
    return next(
        k for k, s in enumerate(steps) if isinstance(s.fix, Fix) and s.fix.reason is PositionedReason.defines_world
    )


@pytest.fixture(scope="module", params=["dots", "points"])
def run(request: pytest.FixtureRequest) -> Run:
    level = request.param
    simulation = simulate_frames("statue", 101, level, FRAMES)
    before = positioned(simulation, level)
    after, told = adjust_steps(before, is_noise_stated=level == "points")
    assert isinstance(told, Adjusted)
    return Run(simulation, before, after, told)


@pytest.fixture(scope="module")
def dots() -> Run:
    simulation = simulate_frames("statue", 102, "dots", FRAMES)
    before = positioned(simulation, "dots")
    after, told = adjust_steps(before)
    assert isinstance(told, Adjusted)
    return Run(simulation, before, after, told)


def fixes(steps: Sequence[Step]) -> dict[int, Fix]:
    return {k: step.fix for k, step in enumerate(steps) if isinstance(step.fix, Fix)}


def position_error(run: Run, steps: Sequence[Step]) -> float:
    """Root mean square after alignment (mm)."""
    found = fixes(steps)
    a = np.array([run.simulation.truth.frames.T_map_sensor[k].t_mm for k in found])
    b = np.array([fix.T_world_sensor.t_mm for fix in found.values()])
    return float(np.sqrt(((align(b, a).apply(b) - a) ** 2).sum(axis=1).mean()))


# --- what comes out --------------------------------------------------------------------------------------------------


def test_poses_come_nearer_to_the_truth(run: Run) -> None:
    before, after = position_error(run, run.before), position_error(run, run.after)
    sigma = run.simulation.truth.frames.sigma_position_mm[list(fixes(run.after))]
    expected = float(np.sqrt(np.nanmean(sigma**2)))
    if run.told.unit == "px":
        assert after < 1.02 * before  # in so short a run, most of the error is the frames' own
        assert 0.7 < after / expected < 1.25
    else:  # dots of one camera are lost in points
        assert after < 1.05 * before
        assert 0.7 < after / expected < 1.6


def test_no_frame_gains_or_loses_its_fix(run: Run) -> None:
    assert len(run.after) == len(run.before)
    for old, new in zip(run.before, run.after, strict=True):
        assert type(new.fix) is type(old.fix)
        assert new.frame.index == old.frame.index
        assert new.events == old.events
        assert new.timings_ms == old.timings_ms
        if isinstance(old.fix, NoFix) and isinstance(new.fix, NoFix):
            assert new.fix.why is old.fix.why
        if isinstance(old.fix, Fix) and isinstance(new.fix, Fix):
            assert new.fix.point.tolist() == old.fix.point.tolist()
            assert new.fix.p_chance == old.fix.p_chance or np.isnan(old.fix.p_chance)


def test_the_first_frame_stays_the_world(run: Run) -> None:
    fix = fixes(run.after)[first_of(run.after)]
    assert fix.T_world_sensor.t_mm.tolist() == [0, 0, 0]
    assert fix.T_world_sensor.R.tolist() == np.eye(3).tolist()
    assert not fix.cov.any()


def test_all_steps_have_the_adjusted_map(run: Run) -> None:
    map = run.after[-1].map
    assert all(step.map is map for step in run.after)
    assert map.id.tolist() == run.before[-1].map.id.tolist()
    assert map.state.tolist() == run.before[-1].map.state.tolist()
    assert np.abs(map.xyz_mm - run.before[-1].map.xyz_mm)[map.alive].max() > 1e-3


def test_dots_of_one_camera_are_moved_by_the_normals_that_all_frames_give(dots: Run) -> None:
    """The images of true centres, by the frames that show them to one camera alone: before and after."""
    off: dict[str, list[float]] = {"before": [], "after": []}
    identity, truth = dots.identity(), dots.simulation.truth
    rig = dots.simulation.scene.rig
    for old, new in zip(dots.before, dots.after, strict=True):
        if not isinstance(new.fix, Fix) or old.centres is None or new.centres is None:
            continue
        one, T = new.fix.single, truth.frames.T_map_sensor[new.frame.index].inverse()
        for camera, dot, target in zip(one.camera, one.dot, new.map.id[one.target], strict=True):
            if camera == 0 and int(target) in identity:
                place = rig.left.project(T.apply(truth.targets.xyz_mm[identity[int(target)]][None]))[0]
                for name, centres in (("before", old.centres), ("after", new.centres)):
                    off[name].append(float(np.sum((centres.left.uv_px[dot] - place) ** 2)))
    assert len(off["after"]) > 50
    assert np.mean(off["after"]) < np.mean(off["before"])


def test_the_map_knows_what_its_targets_have_in_common(run: Run) -> None:
    map = run.after[-1].map
    assert map.joint_mm2 is not None
    k = len(map)
    blocks = map.joint_mm2.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)]
    np.testing.assert_allclose(blocks, map.cov_mm2, rtol=1e-9, atol=1e-12)
    assert np.linalg.eigvalsh(map.joint_mm2)[0] > -1e-9


def test_normalised_errors_follow_their_covariance(run: Run) -> None:
    first = first_of(run.after)
    T_true = run.simulation.truth.frames.T_map_sensor
    of_pose = [
        nees(fix.T_world_sensor, fix.cov, T_true[first].inverse() @ T_true[k]) / 6
        for k, fix in fixes(run.after).items()
        if k != first
    ]
    assert 0.3 < np.mean(of_pose) < 2.0  # one first frame, whose error all share
    map, identity = run.after[-1].map, run.identity()
    rows = np.array([row for row in range(len(map)) if int(map.id[row]) in identity])
    true = run.simulation.truth.targets.xyz_mm[[identity[int(i)] for i in map.id[rows]]]
    off = T_true[first].inverse().apply(true) - map.xyz_mm[rows]
    of_target = np.einsum("ni,nij,nj->n", off, np.linalg.inv(map.cov_mm2[rows]), off) / 3
    assert 0.2 < of_target.mean() < 2.5


def test_residuals_are_those_of_the_adjusted_poses(run: Run) -> None:
    for step in run.after:
        if isinstance(step.fix, Fix) and step.points is not None:
            fix = step.fix
            off = step.map.xyz_mm[fix.target] - fix.T_world_sensor.apply(step.points.xyz_mm[fix.point])
            np.testing.assert_allclose(fix.residual_mm, np.linalg.norm(off, axis=1), atol=1e-9)


def test_the_summary_tells_of_smaller_residuals(run: Run) -> None:
    told = run.told
    assert told.rms_after < 1.01 * told.rms_before  # weighed by their size alone
    assert told.frames == len(fixes(run.before))
    assert told.frames_kept == 0
    assert told.observations > 5 * told.frames
    if told.unit == "px":
        assert 0.1 < told.rms_after < 0.25
        assert 0.33 < told.noise_scale < 0.67  # of 0.3 px, where dots seen straight on have 0.1
        assert 0.5 < told.noise_growth < 1.4
    else:
        assert 0.9 < told.noise_scale < 1.1


@pytest.mark.parametrize("run", ["points"], indirect=True)
@pytest.mark.parametrize(("factor", "believed"), [(5.0, 0.2), (1.2, 1.0)])
def test_a_stated_noise_holds_unless_the_residuals_contradict_it(run: Run, factor: float, believed: float) -> None:
    """Stated five times too large, by too few frames for the positioner to have noticed."""
    vague = [
        replace(
            step,
            frame=replace(
                step.frame, content=replace(step.frame.content, cov_mm2=step.frame.content.cov_mm2 * factor**2)
            ),
            noise_scale=1.0,
        )
        for step in run.before
        if isinstance(step.frame.content, SensorPoints)
    ]
    after, _ = adjust_steps(vague, is_noise_stated=True)
    ids, rows, others = np.intersect1d(after[-1].map.id, run.after[-1].map.id, return_indices=True)
    sigma, as_it_is = (
        np.sqrt(np.median(np.trace(map.cov_mm2[at], axis1=1, axis2=2)))
        for map, at in ((after[-1].map, rows), (run.after[-1].map, others))
    )
    assert len(ids) > 20
    assert 0.85 < sigma / (factor * believed * as_it_is) < 1.15


def test_adjusting_again_gives_the_same_bits(run: Run) -> None:
    again, _ = adjust_steps(run.before, is_noise_stated=run.told.unit == "mm")
    for one, other in zip(run.after, again, strict=True):
        if isinstance(one.fix, Fix) and isinstance(other.fix, Fix):
            assert (one.fix.T_world_sensor.t_mm == other.fix.T_world_sensor.t_mm).all()
            assert (one.fix.cov == other.fix.cov).all()
    assert (run.after[-1].map.xyz_mm == again[-1].map.xyz_mm).all()


def test_dots_of_one_camera_are_found_and_rightly(dots: Run) -> None:
    label, identity = dots.simulation.truth.label, dots.identity()
    right = wrong = 0
    for step, old in zip(dots.after, dots.before, strict=True):
        if not isinstance(step.fix, Fix) or not isinstance(old.fix, Fix) or step.dots is None:
            continue
        one = step.fix.single
        assert len(one) >= len(old.fix.single)
        for camera, dot, target, px in zip(one.camera, one.dot, one.target, one.residual_px, strict=True):
            seen = (step.dots.left, step.dots.right)[camera]
            true = identity.get(int(step.map.id[target]))
            right, wrong = right + (label[seen.row[dot]] == true), wrong + (label[seen.row[dot]] != true)
            assert px < 3.0
        pairs = list(zip(one.camera.tolist(), one.dot.tolist(), strict=True))
        assert len(set(pairs)) == len(pairs)
    assert right > 150
    assert dots.told.dots_found >= 0
    assert wrong == 0


# --- what is known beforehand ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def true_places(dots: Run) -> ReferenceMap:
    """Six targets of the map where they truly are, by their ids in the map."""
    identity = dict(sorted(dots.identity().items())[::3][:6])
    xyz = dots.simulation.truth.targets.xyz_mm[list(identity.values())]
    return ReferenceMap.given(xyz, np.tile(np.eye(3) * 0.02**2, (len(xyz), 1, 1)), id=np.array(list(identity)))


def test_with_control_targets_the_world_is_theirs(dots: Run, true_places: ReferenceMap) -> None:
    steps, told = adjust_steps(dots.before, constraints=Constraints(control=true_places))
    assert isinstance(told, Adjusted)
    T_true = dots.simulation.truth.frames.T_map_sensor
    found = fixes(steps)
    off = [np.linalg.norm(fix.T_world_sensor.t_mm - T_true[k].t_mm) for k, fix in found.items()]
    assert np.sqrt(np.mean(np.square(off))) < 0.5
    assert all(fix.reason is not PositionedReason.defines_world for fix in found.values())
    of_pose = [nees(fix.T_world_sensor, fix.cov, T_true[k]) / 6 for k, fix in found.items()]
    assert 0.5 < np.mean(of_pose) < 1.8
    moved = dots.before[-1].map.view @ T_true[first_of(dots.before)].R.T
    np.testing.assert_allclose(steps[-1].map.view, moved, atol=3e-3)


def test_control_targets_in_other_units_are_refused_in_a_sentence(dots: Run, true_places: ReferenceMap) -> None:
    in_metres = replace(true_places, xyz_mm=true_places.xyz_mm / 1000, cov_mm2=true_places.cov_mm2 * 0)
    steps, told = adjust_steps(dots.before, constraints=Constraints(control=in_metres))
    assert steps is dots.before
    assert isinstance(told, NotAdjusted)
    assert "The control targets do not" in told.why


def test_a_target_that_is_not_in_the_map_is_named(dots: Run, true_places: ReferenceMap) -> None:
    strange = replace(true_places, id=true_places.id + 1000)
    with pytest.raises(MapError, match=r"control: target \d+ is not in the map"):
        adjust_steps(dots.before, constraints=Constraints(control=strange))
    bar = KnownLength(0, 4711, 100.0, 0.1, "bars.csv, line 2")
    with pytest.raises(MapError, match=r"bars.csv, line 2: target 4711 is not in the map: name targets by the id"):
        adjust_steps(dots.before, constraints=Constraints(lengths=[bar]))


def test_a_scale_bar_sets_the_scale_of_a_refined_rig(dots: Run) -> None:
    map = dots.after[-1].map
    a, b = sorted(dots.identity())[0], sorted(dots.identity())[-1]
    rows = [int(np.flatnonzero(map.id == each)[0]) for each in (a, b)]
    length = float(np.linalg.norm(map.xyz_mm[rows[0]] - map.xyz_mm[rows[1]]))
    bar = KnownLength(a, b, 1.002 * length, 0.01)
    config = Config(adjust=BundleOptions(refines_rig=True))
    steps, told = adjust_steps(dots.before, config, Constraints(lengths=[bar]))
    assert isinstance(told, Adjusted)
    xyz = steps[-1].map.xyz_mm[rows]
    assert np.linalg.norm(xyz[0] - xyz[1]) / length == pytest.approx(1.002, abs=2e-4)
    before, after = dots.before[0].frame.rig, steps[0].frame.rig
    assert before is not None
    assert after is not None
    assert after.baseline_mm / before.baseline_mm == pytest.approx(1.002, abs=1e-3)


def test_a_refined_rig_goes_with_every_frame_and_tells_how_far_it_moved(dots: Run) -> None:
    steps, told = adjust_steps(dots.before, Config(adjust=BundleOptions(refines_rig=True)))
    assert isinstance(told, Adjusted)
    assert len({id(step.frame.rig) for step in steps}) == 1
    assert steps[0].frame.rig is not dots.before[0].frame.rig
    assert 0.3 < told.rig_change_sigmas < 2.5  # the rig given is the true one
    assert told.rig_change.keys() == told.rig_sigma.keys()
    assert {"left_fu_px", "right_k1", "x_rad"} <= set(told.rig_change)
    assert all(sigma > 0 for sigma in told.rig_sigma.values())


@pytest.mark.parametrize("sigma_mm", [0.0, 0.05])
def test_a_given_map_is_the_world(sigma_mm: float) -> None:
    simulation = simulate_frames("statue", 103, "dots", 25)
    truth = simulation.truth
    rng = np.random.default_rng(1)
    xyz = truth.targets.xyz_mm + sigma_mm * rng.normal(size=truth.targets.xyz_mm.shape)
    cov = np.tile(np.eye(3) * sigma_mm**2, (len(xyz), 1, 1))
    given = ReferenceMap.given(xyz, cov, view=truth.targets.normal)
    positioner = Positioner(map=given, is_map_frozen=True, is_noise_stated=True)
    before = list(positioner.revise([step.remembered() for step in positioner.run(simulation.frames)]))
    steps, told = adjust_steps(before, constraints=Constraints(given), is_noise_stated=True)
    assert isinstance(told, Adjusted)
    assert given.xyz_mm.tolist() == xyz.tolist()
    if sigma_mm == 0:
        assert (steps[-1].map.xyz_mm == xyz).all()
        assert not steps[-1].map.cov_mm2.any()
    found = fixes(steps)
    of_pose = [nees(fix.T_world_sensor, fix.cov, truth.frames.T_map_sensor[k]) / 6 for k, fix in found.items()]
    assert len(found) > 10
    assert 0.5 < np.mean(of_pose) < 1.7


# --- where it cannot be done -----------------------------------------------------------------------------------------


def test_too_many_targets_are_refused_in_a_sentence(dots: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "MOST_TARGETS", 5)
    steps, told = adjust_steps(dots.before)
    assert steps is dots.before
    assert isinstance(told, NotAdjusted)
    assert "targets are too many to adjust together, the limit is 5" in told.why


def test_nothing_positioned_is_nothing_to_adjust(dots: Run) -> None:
    refused = [step for step in dots.before if isinstance(step.fix, NoFix)]
    for steps in ([], refused):
        same, told = adjust_steps(steps)
        assert same is steps
        assert isinstance(told, NotAdjusted)
        assert "no frame is positioned" in told.why


def test_one_frame_alone_is_not_adjusted(dots: Run) -> None:
    one = dots.before[: first_of(dots.before) + 1]
    steps, told = adjust_steps(one)
    assert len(steps) == len(one)
    assert isinstance(told, Adjusted | NotAdjusted)
    assert fixes(steps)[len(one) - 1].T_world_sensor.t_mm.tolist() == [0, 0, 0]


def test_without_the_frame_that_defines_the_world_nothing_is_adjusted(dots: Run) -> None:
    rest = dots.before[first_of(dots.before) + 1 :]
    steps, told = adjust_steps(rest)
    assert steps is rest
    assert told == NotAdjusted("No frame defines the world, so nothing can be adjusted in its coordinates.")


def test_the_options_may_leave_it_out(dots: Run) -> None:
    steps, told = adjust_steps(dots.before, Config(adjust=BundleOptions(adjusts=False)))
    assert steps is dots.before
    assert isinstance(told, NotAdjusted)


def test_whoever_watches_may_end_it(dots: Run) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adjust_steps(dots.before, watch=stop)


def test_a_frame_that_the_adjustment_leaves_out_keeps_a_pose(dots: Run) -> None:
    """Its points are taken from it but for two: they cannot hold a pose by themselves."""
    k = max(fixes(dots.before))
    step = dots.before[k]
    fix = fixes(dots.before)[k]
    few = replace(
        fix,
        point=fix.point[:2],
        target=fix.target[:2],
        residual_mm=fix.residual_mm[:2],
        reason=PositionedReason.few_points,
        single=SingleDots.none(),
    )
    assert step.centres is not None
    assert step.matches is not None
    assert step.points is not None
    rows = [side[step.points.match[few.point]] for side in (step.matches.left, step.matches.right)]
    away = StereoDots(
        *(
            replace(dots_, uv_px=np.where(np.isin(np.arange(len(dots_)), own)[:, None], dots_.uv_px, -9999.0))
            for dots_, own in zip((step.centres.left, step.centres.right), rows, strict=True)
        )
    )
    steps = [*dots.before[:k], replace(step, fix=few, centres=away), *dots.before[k + 1 :]]
    after, told = adjust_steps(steps)
    assert isinstance(told, Adjusted)
    kept = fixes(after)[k]
    assert np.linalg.norm(kept.T_world_sensor.t_mm - fix.T_world_sensor.t_mm) < 0.1
    assert (kept.cov == fix.cov).all()


def test_targets_that_are_not_trusted_have_no_say_where_others_hold_the_pose(dots: Run) -> None:
    """A false target, seen in two frames from where it cannot be, leaves all poses as they are."""
    map, row = dots.before[-1].map, 2  # without some others, the first frame would show too few
    state = map.state.copy()
    state[row] = TargetState.provisional
    moved = replace(map, state=state)
    doubted, outcome = adjust_steps([replace(step, map=moved) for step in dots.before])
    assert isinstance(outcome, Adjusted)
    assert np.linalg.norm(doubted[-1].map.xyz_mm[row] - dots.after[-1].map.xyz_mm[row]) < 0.2
    told, best = np.trace(doubted[-1].map.cov_mm2[row]), np.trace(dots.after[-1].map.cov_mm2[row])
    assert best < told < 9 * best  # nothing is known better by having no say
    for pose, other in zip(fixes(doubted).values(), fixes(dots.after).values(), strict=True):
        assert isinstance(pose.T_world_sensor, Pose)
        assert pose.T_world_sensor.distance_mm(other.T_world_sensor) < 0.7


def test_dots_that_no_frame_identified_are_found_by_the_adjusted_map(dots: Run) -> None:
    """All that frames said of single dots is forgotten; the map finds most of it again, and nothing false."""

    def forgetful(step: Step) -> Step:
        return replace(step, fix=replace(step.fix, single=SingleDots.none())) if isinstance(step.fix, Fix) else step

    steps, told = adjust_steps([forgetful(step) for step in dots.before])
    assert isinstance(told, Adjusted)
    before = sum(len(fix.single) for fix in fixes(dots.before).values())
    assert 0.9 * before < told.dots_found < 1.3 * before
    for k, fix in fixes(steps).items():
        known = fixes(dots.after)[k].single
        said = dict(
            zip(zip(known.camera.tolist(), known.dot.tolist(), strict=True), known.target.tolist(), strict=True)
        )
        for camera, dot, target in zip(fix.single.camera, fix.single.dot, fix.single.target, strict=True):
            assert said.get((int(camera), int(dot)), target) == target


def test_dots_are_found_alike_however_the_control_targets_turn_the_world(dots: Run) -> None:
    map = dots.before[-1].map
    own = map.rows(np.flatnonzero(map.state == TargetState.trusted)[::2])
    own = replace(own, cov_mm2=np.tile(np.eye(3) * 0.05**2, (len(own), 1, 1)))
    steps = [
        replace(step, fix=replace(step.fix, single=SingleDots.none())) if isinstance(step.fix, Fix) else step
        for step in dots.before
    ]
    found = []
    for turn in (np.zeros(3), np.array([0.0, np.pi, 0.0]), np.array([np.pi / 2, 0.0, 0.0])):
        T = Pose.exp(np.concatenate([[10.0, 20.0, 30.0], turn]))
        _, told = adjust_steps(steps, constraints=Constraints(control=replace(own, xyz_mm=T.apply(own.xyz_mm))))
        assert isinstance(told, Adjusted)
        found.append(told.dots_found)
    assert found[0] > 0
    assert found[1:] == [found[0]] * 2


def test_of_a_large_map_only_what_was_seen_is_adjusted_and_nothing_grows_with_its_square(dots: Run) -> None:
    map = dots.before[-1].map
    rows = np.concatenate([np.arange(len(map)), np.zeros(bundle.MOST_TARGETS, dtype=np.int64)])
    large = map.rows(rows)
    large.id[len(map) :] = 10_000 + np.arange(bundle.MOST_TARGETS)
    large.state[len(map) :] = TargetState.removed
    steps, told = adjust_steps([replace(step, map=large) for step in dots.before])
    assert isinstance(told, Adjusted)
    assert steps[-1].map.joint_mm2 is None
    np.testing.assert_array_equal(steps[-1].map.xyz_mm[: len(map)], dots.after[-1].map.xyz_mm)


def test_points_are_those_of_the_dots_where_they_were_moved(dots: Run) -> None:
    moved = 0
    for old, new in zip(dots.before, dots.after, strict=True):
        if not isinstance(new.fix, Fix) or new.centres is None or new.matches is None or new.points is None:
            continue
        assert new.frame.rig is not None
        anew = triangulate(new.centres, new.matches, new.frame.rig)
        assert np.array_equal(anew.match, new.points.match)
        np.testing.assert_allclose(new.points.xyz_mm, anew.xyz_mm, atol=1e-6)
        assert old.points is not None
        moved += not np.array_equal(new.points.xyz_mm, old.points.xyz_mm)
    assert moved > 10
