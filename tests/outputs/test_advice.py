"""Advice: the sentence names what is lacking, the place is where both cameras see and nothing is yet."""

from dataclasses import replace

import numpy as np
import pytest
from made_steps import rig, step, targets

from trifix.geometry.pose import Pose
from trifix.outputs.advice import advice_for, advice_for_run, advice_on, room_in_view
from trifix.records import Fix, NoFix, PositionedReason, Reason, ReferenceMap

HERE = Pose.exp(np.array([40.0, -30.0, 10.0, 0.05, 0.1, -0.2]))
LINE_MM = np.stack([np.linspace(-150, 150, 7), np.linspace(-30, 30, 7), np.full(7, 700.0)], axis=1)


def seen_by_both(place_mm: np.ndarray, pose: Pose) -> bool:
    sensor, at = rig(), pose.inverse().apply(place_mm[None])
    return bool(sensor.left.sees(at, 20.0)[0] and sensor.right.sees(sensor.T_right_left.apply(at), 20.0)[0])


def test_the_place_is_seen_by_both_cameras_at_the_distance_of_the_targets() -> None:
    place = room_in_view(HERE, rig(), HERE.apply(LINE_MM[2:4]))
    assert place is not None
    assert seen_by_both(place, HERE)
    assert HERE.inverse().apply(place[None])[0, 2] == pytest.approx(700.0, abs=1.0)


def test_the_place_is_far_from_the_line_of_the_targets_and_from_each_of_them() -> None:
    place = room_in_view(HERE, rig(), HERE.apply(LINE_MM))
    assert place is not None
    at = HERE.inverse().apply(place[None])[0]
    along = np.array([300.0, 60.0]) / np.hypot(300.0, 60.0)
    off_line = abs(at[0] * -along[1] + at[1] * along[0])
    assert 100.0 < off_line < 300.0


def test_the_place_is_rather_in_the_middle_where_all_is_free() -> None:
    corner = HERE.apply(np.array([[230.0, 170.0, 700.0]]))
    place = room_in_view(HERE, rig(), corner)
    assert place is not None
    uv = rig().left.project(HERE.inverse().apply(place[None]))[0]
    assert np.abs(uv - [320, 240]).max() < 130.0


def test_without_a_rig_a_cone_is_searched() -> None:
    place = room_in_view(HERE, None, HERE.apply(LINE_MM))
    assert place is not None
    at = HERE.inverse().apply(place[None])[0]
    assert np.abs(at[:2] / at[2]).max() < 0.36


def test_no_place_is_made_up_where_no_distance_is_known() -> None:
    assert room_in_view(HERE, rig(), np.zeros((0, 3))) is None
    assert room_in_view(Pose.identity(), rig(), np.array([[0.0, 0.0, -500.0]])) is None


def test_a_frame_of_two_targets_is_told_to_get_one_more_and_where() -> None:
    rng = np.random.default_rng(1)
    world = targets(60, rng)
    seen = replace(step(7, "dots", rng, world), fix=NoFix(Reason.too_few_points))
    assert seen.points is not None
    few = replace(seen, points=replace(seen.points, xyz_mm=seen.points.xyz_mm[:2], cov_mm2=seen.points.cov_mm2[:2],
        match=seen.points.match[:2], label=seen.points.label[:2], row=seen.points.row[:2]))  # fmt: skip
    advice = advice_for(few, HERE)
    assert advice is not None
    assert advice.place_mm is not None
    assert seen_by_both(advice.place_mm, HERE)
    x, y, z = (f"{round(float(each))}".replace("-", "−") for each in advice.place_mm)
    expected = f"Only two targets in view of both cameras: stick one more near ({x}, {y}, {z}) mm."
    assert advice.sentence == expected
    lost = advice_for(few, None)
    assert lost is not None
    assert lost.sentence == "Only two targets in view of both cameras: stick one more."
    assert lost.place_mm is None


def test_a_firm_fix_needs_no_advice_and_one_of_few_points_does() -> None:
    rng = np.random.default_rng(1)
    world = targets(60, rng)
    firm = step(7, "dots", rng, world)
    assert isinstance(firm.fix, Fix)
    assert advice_for(firm) is None
    fix = firm.fix
    held = replace(fix, point=fix.point[:2], target=fix.target[:2], residual_mm=fix.residual_mm[:2])
    few = replace(firm, fix=replace(held, reason=PositionedReason.few_points))
    advice = advice_for(few)
    assert advice is not None
    assert advice.sentence.startswith("Two targets hold this pose")
    assert "stick one more near" in advice.sentence


def test_a_weak_frame_is_advised_from_its_own_pose() -> None:
    rng = np.random.default_rng(1)
    firm = step(7, "dots", rng, targets(60, rng))
    assert isinstance(firm.fix, Fix)
    advice = advice_for(replace(firm, fix=NoFix(Reason.weak_geometry, weak=firm.fix)), None)
    assert advice is not None
    assert advice.place_mm is not None
    assert "off" in advice.sentence


@pytest.mark.parametrize("reason", Reason)
def test_every_refusal_has_one_sentence_of_advice(reason: Reason) -> None:
    advice = advice_on(reason, points=0)
    assert advice is not None
    assert advice.sentence.endswith((".", "?"))
    assert len(advice.sentence) < 120


def test_a_run_is_told_where_most_of_its_poor_frames_looked() -> None:
    world = ReferenceMap.given(np.array([[x, y, 600.0] for x in (0.0, 200.0, 400.0, 2000.0) for y in (-50.0, 50.0)]))
    at = [*np.linspace(0, 400, 40), *np.full(30, 2000.0)]
    reason = [""] * 40 + [Reason.too_few_points.name, ""] * 15
    poses = [None if why else Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x, why in zip(at, reason, strict=True)]
    points = np.array([2 if why else 5 for why in reason])
    (advice,) = advice_for_run(reason, points, poses, world)
    assert advice.place_mm is not None
    np.testing.assert_allclose(advice.place_mm, [2000.0, 0.0, 600.0], atol=30.0)
    assert advice.sentence.startswith("21 % of the frames saw fewer than three targets, most of them around (")
    assert advice.sentence.endswith("add one target there.")


def test_a_run_without_poor_frames_is_left_in_peace() -> None:
    poses = [Pose.identity()] * 30
    assert advice_for_run([""] * 30, np.full(30, 9), poses, targets(9, np.random.default_rng(0))) == []
    assert advice_for_run([], np.zeros(0, dtype=np.int64), [], ReferenceMap.empty()) == []


def test_the_most_frequent_trouble_comes_first() -> None:
    reason = ["ambiguous"] * 4 + ["too_few_points"] * 9 + [""] * 20
    advice = advice_for_run(reason, np.full(33, 1), [None] * 33, ReferenceMap.empty())
    assert [each.sentence.split("%")[0] for each in advice] == ["27 ", "12 "]
    assert all(each.place_mm is None for each in advice)
