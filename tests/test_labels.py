"""Labels say where to look first; a wrong one costs time and makes no pose."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from constellations import PARALLEL, points_of
from trifix.config import Config
from trifix.evaluation import compare_poses
from trifix.files.recordings import read_recording
from trifix.files.truth import TrueFrames, read_truth
from trifix.labels import TargetLabels, by_label, contradict
from trifix.positioner import Positioner
from trifix.records import (
    Fix,
    Frame,
    Identification,
    NoFix,
    Reason,
    ReferenceMap,
    SensorPoints,
    StereoDots,
    StereoImages,
)
from trifix.sources.simulation import simulate_frames
from trifix.stages.detect import DetectOptions
from trifix.stages.verify import VerifyOptions


def labelled(frames: Sequence[Frame], truth: np.ndarray, classes: int, wrong: float, seed: int = 1) -> list[Frame]:
    """The same frames; each target has one of some labels, and a share of its dots or points bears another."""
    rng = np.random.default_rng(seed)
    label_of = rng.integers(0, classes, truth.max() + 1)

    def label(row: np.ndarray) -> np.ndarray:
        target = truth[row]
        own = np.where(target >= 0, label_of[target], rng.integers(0, classes, len(row)))
        other = (own + rng.integers(1, classes, len(row))) % classes
        return np.where(rng.random(len(row)) < wrong, other, own)

    out = []
    for frame in frames:
        content = frame.content
        if isinstance(content, SensorPoints):
            content = replace(content, label=label(content.row))
        elif isinstance(content, StereoDots):
            left, right = (replace(one, label=label(one.row)) for one in (content.left, content.right))
            content = StereoDots(left, right)
        out.append(replace(frame, content=content))
    return out


def positioned(frames: Sequence[Frame], true: TrueFrames, config: Config | None = None) -> tuple[int, int]:
    """How many frames have a pose, and how many a wrong one: against the pose of the first."""
    T_true = dict(zip(true.index.tolist(), true.T_map_sensor, strict=True))
    steps = [step.remembered() for step in Positioner(config, is_noise_stated=True).run(frames)]
    assert {each.fix.why for each in steps if isinstance(each.fix, NoFix)} <= {
        Reason.too_few_points,
        Reason.ambiguous,
        Reason.not_proven,
        Reason.no_candidate,
        Reason.other_island,
    }
    fixes = [(T_true[each.frame.index], each.fix.T_world_sensor) for each in steps if isinstance(each.fix, Fix)]
    errors = compare_poses([T for _, T in fixes], [T for T, _ in fixes])
    return len(fixes), int(errors.is_wrong.sum())


def test_codes_and_hues_are_read_where_the_options_ask_for_them():
    image = np.full((PARALLEL.left.height_px, PARALLEL.left.width_px, 3), 220, np.uint8)
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100), 77, 70)
    image[40:110, 30:100] = marker[:, :, None]
    cv2.circle(image, (180, 140), 12, (40, 40, 200), -1, cv2.LINE_AA)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    options = DetectOptions(polarity="dark", codes="DICT_5X5_100", hues="120 0")
    step = Positioner(Config(detect=options)).step(Frame(0, 0, PARALLEL, StereoImages(image, image)))
    assert step.dots is not None
    for dots in (step.dots.left, step.dots.right):
        assert sorted(dots.label.tolist()) == [1, 77]
        np.testing.assert_allclose(dots.uv_px[dots.label == 77], [[64.5, 74.5]], atol=0.1)
        np.testing.assert_allclose(dots.uv_px[dots.label == 1], [[180.0, 140.0]], atol=0.1)


def test_only_known_labels_contradict():
    np.testing.assert_array_equal(
        contradict(np.array([1, 1, -1, 2]), np.array([1, 2, 2, -1])), [False, True, False, False]
    )


def test_a_targets_label_is_that_of_most_of_its_sightings():
    labels, map = TargetLabels(), ReferenceMap.given(np.zeros((3, 3)), id=np.array([4, 40, 9]))
    points = points_of(np.zeros((2, 3)), np.zeros((2, 3, 3)))
    for first, second in ((7, -1), (3, 5), (7, -1), (7, 5), (3, -1)):
        seen = replace(points, label=np.array([first, second]))
        labels.learn(map, seen, np.array([0, 1]), np.array([1, 2]))
    np.testing.assert_array_equal(labels.of(map), [-1, 7, 5])
    np.testing.assert_array_equal(labels.of(ReferenceMap.given(np.zeros((1, 3)), id=np.array([1000]))), [-1])


def test_hypotheses_that_labels_contradict_come_last_and_none_is_lost():
    points = replace(points_of(np.zeros((4, 3)), np.zeros((4, 3, 3))), label=np.array([0, 1, 2, -1]))
    point = np.array([[0, 1, 2], [0, 1, 2], [1, 2, 3], [0, 1, 3]])
    target = np.array([[0, 1, 3], [0, 1, 2], [1, 3, 0], [3, 1, 0]])
    given = Identification(point, target, comparisons=99, expected_by_chance=0.25, max_sigmas=3.0)
    first, last = by_label(given, points, np.array([0, 1, 2, 9]))
    np.testing.assert_array_equal(first.target, [[0, 1, 2]])
    np.testing.assert_array_equal(last.target, [[0, 1, 3], [1, 3, 0], [3, 1, 0]])
    assert (first.comparisons + last.comparisons, first.expected_by_chance + last.expected_by_chance) == (99, 0.25)
    assert [each.max_sigmas for each in (first, last)] == [3.0, 3.0]
    for known in (np.full(4, -1), np.full(4, 9)):
        assert [*by_label(given, points, known)] == [given]


@pytest.mark.parametrize("level", ["points", "dots"])
@pytest.mark.parametrize("label_error", [1.0, 0.01])
def test_a_third_of_all_labels_wrong_makes_no_wrong_pose_and_costs_none(level: str, label_error: float):
    simulation = simulate_frames("kidnap", 2, "points" if level == "points" else "dots", 40)
    frames, truth = simulation.frames, simulation.truth
    without = positioned(frames, truth.frames)
    config = Config(verify=VerifyOptions(label_error=label_error))
    for wrong in (0.0, 1 / 3, 1.0):
        number, of_wrong = positioned(labelled(frames, truth.label, 5, wrong), truth.frames, config)
        assert of_wrong == 0
        assert abs(number - without[0]) <= 1


@pytest.mark.parametrize("level", ["points", "dots"])
def test_labels_tell_the_places_of_a_regular_plate_apart_if_their_error_is_stated(data: Path, level: str):
    plate = data / "dice_plate"
    if not plate.is_dir():
        pytest.skip(f"no dice_plate among the real recordings in {data}")
    frames = list(read_recording(plate / f"recording_{level}"))
    truth = read_truth(plate / "truth")
    rows = np.loadtxt(plate / "truth" / f"labels_{level}.csv", delimiter=",", skiprows=1, dtype=int)
    label = np.full(rows[:, 0].max() + 1, -1)
    label[rows[:, 0]] = rows[:, 2]
    stated = Config(verify=VerifyOptions(label_error=0.01))
    assert positioned(labelled(frames, label, 3, 0.0), truth.frames) == (1, 0)  # the first
    assert positioned(labelled(frames, label, 3, 0.0), truth.frames, stated) == (7, 0)
    # labels that err far more often than stated are not believed
    number, wrong = positioned(labelled(frames, label, 3, 1.0), truth.frames, stated)
    assert (number, wrong) == (1, 0)
