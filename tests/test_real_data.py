"""Real recordings against their truth, by the limits of their READMEs: no wrong pose, and most frames positioned."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest

from trifix.evaluation import compare_poses
from trifix.files.maps import read_map
from trifix.files.recordings import read_recording
from trifix.files.truth import read_truth
from trifix.positioner import Positioner
from trifix.records import Fix, NoFix, Reason, Step

CLUSTERS = ["01_04", "05_08", "09_12", "13_16", "17_20", "21_24", "25_28", "29_32", "41_44"]
SUBSETS = ["dice_plate/subset", "chess_subset/seed_1", "chess_subset/seed_2", "chess_subset/seed_3"]


def steps_of(folder: Path, recording: str, frames: int | None = None, is_map_given: bool = False) -> list[Step]:
    """The first frames of a recording, positioned as they come; a given map stays as it is."""
    source = read_recording(folder / recording)
    positioner = Positioner(
        map=read_map(folder / "map_given.csv") if is_map_given else None,
        is_map_frozen=is_map_given,
        is_noise_stated=source.is_noise_stated,
    )
    return list(positioner.run(islice(source, frames)))


def share_positioned(steps: list[Step]) -> float:
    return sum(isinstance(step.fix, Fix) for step in steps) / len(steps)


def wrong_frames(steps: list[Step], truth: Path, is_map_given: bool, wrong_mm: float, wrong_deg: float) -> list[int]:
    """Frames whose pose is off: against the given map as it is, else after one alignment."""
    frames = read_truth(truth).frames
    true = dict(zip(frames.index.tolist(), frames.T_map_sensor, strict=True))
    fixes = [(step.frame.index, step.fix) for step in steps if isinstance(step.fix, Fix)]
    errors = compare_poses(
        [fix.T_world_sensor for _, fix in fixes],
        [true[k] for k, _ in fixes],
        is_map_given=is_map_given,
        wrong_mm=wrong_mm,
        wrong_deg=wrong_deg,
    )
    return [k for (k, _), is_wrong in zip(fixes, errors.is_wrong, strict=True) if is_wrong]


Folder = Callable[[str], Path]


@pytest.fixture
def folder(data: Path) -> Folder:
    def find(name: str) -> Path:
        found = data / name
        if not found.is_dir():
            pytest.skip(f"no {name} among the real recordings in {data}")
        return found

    return find


@pytest.mark.parametrize(
    ("recording", "frames", "least"),
    [("recording", 6, 0.7), ("recording_dots", 12, 0.9), ("recording_points", 12, 0.9)],
)
def test_dots_in_heavy_clutter(folder: Folder, recording: str, frames: int, least: float):
    boofcv = folder("boofcv_dots")
    steps = steps_of(boofcv, recording, frames)
    assert wrong_frames(steps, boofcv / "truth", False, 10.0, 1.5) == []
    assert share_positioned(steps) >= least


@pytest.mark.parametrize("is_map_given", [False, True], ids=["from nothing", "with the map"])
@pytest.mark.parametrize("recording", ["recording_dots", "recording_points"])
def test_a_regular_plate_is_never_taken_for_itself_shifted_by_a_cell(
    folder: Folder, recording: str, is_map_given: bool
):
    plate = folder("dice_plate")
    steps = steps_of(plate, recording, None, is_map_given)
    assert wrong_frames(steps, plate / "truth", is_map_given, 1.0, 0.3) == []
    assert {step.fix.why for step in steps if isinstance(step.fix, NoFix)} <= {Reason.ambiguous}


@pytest.mark.parametrize("is_map_given", [False, True], ids=["from nothing", "with the map"])
@pytest.mark.parametrize("recording", ["recording_dots", "recording_points"])
@pytest.mark.parametrize("name", SUBSETS)
def test_irregular_parts_of_regular_patterns_are_told_apart(
    folder: Folder, name: str, recording: str, is_map_given: bool
):
    pattern = folder(name)
    wrong_mm, wrong_deg = (1.0, 0.3) if name.startswith("dice") else (15.0, 3.0)
    steps = steps_of(pattern, recording, None, is_map_given)
    assert wrong_frames(steps, pattern / "truth", is_map_given, wrong_mm, wrong_deg) == []
    assert share_positioned(steps) >= 0.9


@pytest.mark.parametrize("cluster", CLUSTERS)
def test_four_markers_among_fifty_are_found_rightly_or_not_at_all(folder: Folder, cluster: str):
    """Half a turn of a cluster upon itself is some ten degrees and millimetres off, if not far more."""
    markers = folder(f"optotrak_clusters/clusters/markers_{cluster}")
    steps = steps_of(markers, "recording_points", None, is_map_given=True)
    assert wrong_frames(steps, markers / "truth", True, 5.0, 3.0) == []
