"""A rig that does not belong to the images is told in one sentence with numbers, and a right one never is."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from constellations import PARALLEL, RIG, looking, scattered, seen_dots
from trifix.config import Config, to_toml
from trifix.files.recordings import read_recording
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose, exp_rotation
from trifix.outputs.report import Report
from trifix.outputs.results import ResultsWriter
from trifix.positioner import Positioner
from trifix.records import Dots, Frame, StereoDots
from trifix.rigcheck import diagnosis, wrong_size
from trifix.sources.simulation import simulate_frames
from trifix.stages.match import MatchOptions

Frames = list[tuple[StereoDots, StereoRig]]


def seen(rig: StereoRig, frames: int = 6, ghosts: int = 8, seed: int = 1, sigma_px: float = 0.15) -> Frames:
    """Twenty targets and some ghosts in every frame, in no order."""
    rng = np.random.default_rng(seed)
    xyz = scattered(rng, 20)
    out = []
    for _ in range(frames):
        dots = seen_dots(looking(rng).inverse().apply(xyz), rng, sigma_px, rig)
        sides = []
        for one, camera in ((dots.left, rig.left), (dots.right, rig.right)):
            more = rng.uniform(0, 1, (ghosts, 2)) * [camera.width_px, camera.height_px]
            sides.append(Dots.of(rng.permutation(np.concatenate([one.uv_px, more])), sigma_px))
        out.append((StereoDots(*sides), rig))
    return out


def with_rig(frames: Frames, change: Callable[[StereoRig], StereoRig]) -> Frames:
    return [(dots, change(rig)) for dots, rig in frames]


def turned(*px: float) -> Callable[[StereoRig], StereoRig]:
    """The right camera of the rig turned by so many pixels about its axes."""

    def turn(rig: StereoRig) -> StereoRig:
        T = rig.T_right_left
        return replace(rig, T_right_left=Pose(exp_rotation(np.array(px) / rig.right.fu_px) @ T.R, T.t_mm))

    return turn


def numbers(sentence: str) -> list[float]:
    return [float(each) for each in re.findall(r"-?[0-9]+[.]?[0-9]*(?=[ ,°)])", sentence)]


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
@pytest.mark.parametrize("ghosts", [0, 20])
def test_a_right_rig_is_not_doubted(rig: StereoRig, ghosts: int):
    for frames in (1, 4, 16):
        assert diagnosis(seen(rig, frames, ghosts)) == ""


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
def test_exchanged_cameras_are_told(rig: StereoRig):
    frames = [(StereoDots(dots.right, dots.left), rig) for dots, rig in seen(rig)]
    sentence = diagnosis(frames)
    assert "with left and right exchanged" in sentence
    assert sentence.endswith("are the cameras swapped?")
    share, px = numbers(sentence.split("exchanged, ")[1])
    assert 60 < share < 80  # 20 of 28 dots
    assert 0.12 < px < 0.18


@pytest.mark.parametrize("rig", [RIG, PARALLEL], ids=["convergent", "parallel"])
def test_a_reversed_baseline_is_told(rig: StereoRig):
    frames = with_rig(seen(rig), lambda r: replace(r, T_right_left=Pose(r.T_right_left.R, -r.T_right_left.t_mm)))
    reversed_ = "with the baseline reversed" if rig is RIG else "with left and right exchanged"  # the same if parallel
    assert reversed_ in diagnosis(frames)


def test_an_inverted_transform_is_told():
    frames = with_rig(seen(RIG), lambda r: replace(r, T_right_left=r.T_right_left.inverse()))
    assert "with the transform between the cameras inverted" in diagnosis(frames)


@pytest.mark.parametrize(
    ("rig", "px"),
    [(RIG, (3.0, 0.0, 0.0)), (PARALLEL, (-40.0, 0.0, 0.0)), (RIG, (0.0, 0.0, 25.0))],
    ids=["tilted", "tilted far", "rolled"],
)
def test_a_turned_camera_is_told_and_how_it_turned(rig: StereoRig, px: tuple[float, float, float]):
    sentence = diagnosis(with_rig(seen(rig), turned(*px)))
    assert sentence.endswith("has a camera moved since it was calibrated?")
    found = numbers(sentence.split("turned by ")[1])[:3]
    true = np.degrees(-np.array(px) / rig.right.fu_px)
    np.testing.assert_allclose(found[::2], true[::2], atol=0.15)
    assert abs(found[1]) < 0.5  # a turn within the plane of the rays hardly shows
    assert 0.1 < numbers(sentence.rsplit("partner, ")[-1])[0] < 0.25


def test_distortion_of_images_that_have_none_is_told():
    def distorting(camera: Camera) -> Camera:
        return replace(camera, model="radtan", coefficients=(-0.3, 0.1, 0.0, 0.0))

    frames = with_rig(seen(PARALLEL), lambda r: replace(r, left=distorting(r.left), right=distorting(r.right)))
    assert "without the lenses' distortion" in diagnosis(frames)


def test_the_distortion_of_another_lens_is_told():
    """Wide images, in which the distortion of both lenses is 0.25 and neither camera knows of it."""

    def lens(camera: Camera, k1: float) -> Camera:
        return replace(camera, fu_px=700.0, fv_px=700.0, model="radtan", coefficients=(k1, 0.0, 0.0, 0.0))

    def both(rig: StereoRig, k1: float) -> StereoRig:
        return replace(rig, left=lens(rig.left, k1), right=lens(rig.right, k1))

    rng = np.random.default_rng(3)
    true, frames = both(PARALLEL, 0.25), []
    for _ in range(10):
        z = rng.uniform(300, 700, 25)
        xyz = np.c_[rng.uniform([-0.5, -0.6], [0.8, 0.6], (25, 2)) * z[:, None], z]
        frames.append((seen_dots(xyz, rng, 0.15, true), both(PARALLEL, 0.02)))
    sentence = diagnosis(frames)
    assert "is the distortion that of another lens" in sentence
    np.testing.assert_allclose(numbers(sentence.split("k1 changed by ")[1])[:1], 0.23, atol=0.08)


def test_dots_that_have_nothing_to_do_with_one_another_are_told():
    first, others = seen(PARALLEL, ghosts=0), seen(PARALLEL, ghosts=0, seed=2)
    frames = [(StereoDots(a.left, b.right), rig) for (a, rig), (b, _) in zip(first, others, strict=True)]
    sentence = diagnosis(frames)
    assert "hardly a dot" in sentence
    assert "the rig that of other images" in sentence


def test_depth_limits_without_the_object_are_told():
    assert "match.min_depth_mm" in diagnosis(seen(PARALLEL), MatchOptions(max_depth_mm=300.0))


def test_a_wrong_length_of_the_baseline_shows_in_the_targets_diameter_alone():
    rng = np.random.default_rng(5)
    frames: Frames = []
    for dots, rig in seen(PARALLEL, ghosts=0):
        # 6 mm wide where they are; their depth is 470 mm, give or take a tenth
        px = 6.0 * rig.left.fu_px / 470 * rng.uniform(0.95, 1.05, len(dots.left))
        sides = (replace(one, ellipse=np.c_[px / 2, px / 2, 0 * px]) for one in (dots.left, dots.right))
        frames.append((StereoDots(*sides), rig))
    long = with_rig(frames, lambda r: replace(r, T_right_left=Pose(r.T_right_left.R, 1.5 * r.T_right_left.t_mm)))
    given = MatchOptions(target_diameter_mm=6.0)
    assert diagnosis(long) == ""
    assert wrong_size(long, MatchOptions()) == ""
    assert wrong_size(frames, given) == ""
    assert "is the rig's baseline stated 1.5 times too long?" in wrong_size(long, given)
    short = with_rig(frames, lambda r: replace(r, T_right_left=Pose(r.T_right_left.R, 0.5 * r.T_right_left.t_mm)))
    assert "is the rig's baseline stated 2 times too short?" in wrong_size(short, given)


@pytest.mark.parametrize("scene", ["statue", "grid", "clutter", "sparse"])
def test_the_rigs_of_scenes_are_not_doubted(scene: str):
    frames = [(f.content, f.rig) for f in simulate_frames(scene, 3, "dots", 12).frames]
    some = [(dots, rig) for dots, rig in frames if isinstance(dots, StereoDots) and rig is not None and len(dots.left)]
    for n in (3, 12):
        assert diagnosis(some[:n]) == ""


@pytest.mark.parametrize("name", ["boofcv_dots", "dice_plate", "dice_plate/subset", "chess_subset/seed_1"])
def test_the_rigs_of_real_recordings_are_not_doubted(data: Path, name: str):
    folder = data / name / "recording_dots"
    if not folder.is_dir():
        pytest.skip(f"no {name} among the real recordings in {data}")
    frames = [(f.content, f.rig) for f in read_recording(folder)]
    some = [(dots, rig) for dots, rig in frames if isinstance(dots, StereoDots) and rig is not None]
    for n in (3, 12):
        assert diagnosis(some[:n]) == ""


def test_what_is_wrong_stands_in_summary_and_report(tmp_path: Path):
    swapped = [
        Frame(k, 50_000_000 * k, rig, StereoDots(dots.right, dots.left)) for k, (dots, rig) in enumerate(seen(RIG, 6))
    ]
    report = Report()
    with ResultsWriter(tmp_path, "swapped", "dots", to_toml(Config()), is_online=True) as results:
        for step in Positioner().run(swapped):
            results.write(step)
            report.show(step)
            assert bool(results.doubt) == (step.frame.index >= 3)
        summary = results.finish()
    report.write(tmp_path / "report.html", summary)
    assert "are the cameras swapped?" in summary.rig
    assert json.loads((tmp_path / "summary.json").read_text())["rig"] == summary.rig
    assert "are the cameras swapped?" in (tmp_path / "report.html").read_text()
