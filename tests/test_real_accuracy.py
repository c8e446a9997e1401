"""Lengths on real recordings: against what is known of them, and against those of the other half of the frames.

Where a normalised error is not near 1, the reason is stated, and tested where it can be. What the covariances cannot
know is the calibration: an error of it is the same in every frame, so no frame contradicts it.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from trifix.files.maps import read_map
from trifix.files.truth import read_truth
from trifix.records import Fix, Frame

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import real

Folder = Callable[[str], Path]
CHESS = [f"chess_subset/seed_{k}" for k in (1, 2, 3)]


@pytest.fixture(scope="module")
def folder(data: Path) -> Folder:
    def find(name: str) -> Path:
        found = data / name
        if not found.is_dir():
            pytest.skip(f"no {name} among the real recordings in {data}")
        return found

    return find


@pytest.fixture(scope="module")
def cards(folder: Folder) -> tuple[real.Layout, real.Layout]:
    return real.boofcv_halves(folder("boofcv_dots"), every=2)


def measured(pattern: Path, frames: Sequence[Frame]) -> real.Layout:
    return real.layout(real.adjusted(frames), read_truth(pattern / "truth"))


def known(pattern: Path) -> real.Layout:
    """The layout as it is given, with the uncertainty that is stated for it."""
    return real.layout_of(read_map(pattern / "map_given.csv"))


@pytest.mark.parametrize("source", ["dots", "images"])
def test_lengths_on_the_plate_are_those_of_its_design(folder: Folder, source: str):
    """The design is known to 5 um in each coordinate, and so are the lengths; trifix's own sigma is 0.5 um.

    The error of 6.5 um is the same in all frames and for both ways of finding dots: that of the printing and of the
    calibration, whose own residuals are 0.45 px (7 um).
    """
    plate = folder("dice_plate")
    frames = real.frames_of(plate / "subset", "dots")[0] if source == "dots" else real.detected_frames(plate)
    found = real.compare(measured(plate / "subset", frames), known(plate / "subset"))
    assert found.targets == 25
    assert 0.004 < found.error_mm < 0.009
    assert found.worst_mm < 0.03
    assert 0.7 < found.normalised < 1.3
    assert found.beyond_two < 0.12
    assert abs(found.shape - 1) < 3 * found.shape_spread


@pytest.mark.parametrize("name", CHESS)
def test_lengths_on_the_chessboard_are_those_of_its_squares(folder: Folder, name: str):
    """Up to one factor, as nobody knows how large a square is: 25 mm were taken for the calibration.

    So the factor is that of calibration and squares together, and 1 to some 10⁻⁴ here. The corners are given to 0.1 mm
    in each coordinate; that is more than they are off (0.07 mm), most of it across the board, which is bent: a smooth
    distortion explains more than half of χ².
    """
    board = folder(name)
    found = real.compare(measured(board, real.frames_of(board, "dots")[0]), known(board), is_scale_free=True)
    assert found.targets == 25
    assert abs(found.scale - 1) < 0.001
    assert 0.05 < found.error_mm < 0.15
    assert found.worst_mm < 0.4
    assert 0.5 < found.normalised < 1.0
    assert found.beyond_two < 0.05
    assert 0.4 < found.shape < 1.0
    assert found.bent < 0.7 * found.shape


@pytest.mark.parametrize("half", [0, 1])
def test_lengths_on_the_cards_are_those_of_the_given_map(
    folder: Folder, cards: tuple[real.Layout, real.Layout], half: int
):
    """Up to one factor: the rigs have their scale from the printed layout, which is good to a percent.

    The map is given to 0.3 mm. Of four frames from about one side, the depths are off by a smooth field of some tenths
    of a millimetre (see the halves, below), more so in the second half; what is left is below what is stated.
    """
    found = real.compare(cards[half], known(folder("boofcv_dots")), is_scale_free=True)
    assert found.targets >= 110
    assert abs(found.scale - 1) < 0.003
    assert 0.1 < found.error_mm < 0.6
    assert 0.5 < found.normalised < 1.6
    assert found.beyond_two < 0.25
    assert 0.1 < found.bent < 0.5


def test_halves_of_the_plates_frames_differ_by_less_than_their_covariances_where_they_are_alike(folder: Folder):
    """Odd and even frames see the same dots at nearly the same pixels, so that errors of the calibration cancel.

    More than half of the residuals is a smooth field over the image, a rig that is not quite that of the images: it
    passes for noise of the dots, and the covariances are too vague. First and second half of the frames are from
    somewhat different poses, where that field is another; there the covariances are right.
    """
    plate = folder("dice_plate") / "subset"
    frames = real.frames_of(plate, "dots")[0]
    share, by_noise = real.smooth_share(real.adjusted(frames))
    assert 0.4 < share < 0.7
    assert by_noise < 0.15
    agreement = {
        how: real.compare(measured(plate, a), measured(plate, b)) for how, (a, b) in real.splits(frames).items()
    }
    assert 0.4 < agreement["odd and even"].normalised < 0.8
    assert 0.7 < agreement["first and second"].normalised < 1.3
    assert abs(agreement["first and second"].shape - 1) < 3 * agreement["first and second"].shape_spread


@pytest.mark.parametrize("name", CHESS)
def test_halves_of_the_chessboards_frames_differ_as_their_covariances_say(folder: Folder, name: str):
    """All places at once agree as predicted (χ² of 69 degrees of freedom within three of its standard deviations).

    Lengths alone are led by a few long-wave errors, above all by the size; they are off by 1.1 to 1.4 sigma, at a
    standard deviation of 0.15 for right covariances. The size of a half depends on how far the board was, which is what
    an error of the focal lengths makes; 25 corners in 13 frames cannot tell it from chance.
    """
    board = folder(name)
    for a, b in real.splits(real.frames_of(board, "dots")[0]).values():
        found = real.compare(measured(board, a), measured(board, b))
        assert found.targets == 25
        assert abs(found.shape - 1) < 3 * found.shape_spread
        assert 0.7 < found.normalised < 1.6


def test_halves_of_the_cards_frames_differ_by_a_smooth_distortion_and_as_predicted_beside_it(
    cards: tuple[real.Layout, real.Layout],
):
    """Each pair of exposures has a rig of its own, which was computed, and one camera saw each half from one side.

    Errors of these rigs and of the lens bend all depths of a half together, by up to 2 mm, and no covariance of dots
    knows that: lengths of the halves differ by about two sigma, by three with twice as many frames. Beside a
    distortion of second degree, which is left free, the places agree as predicted.
    """
    found = real.compare(*cards)
    assert found.targets >= 110
    assert 1.4 < found.normalised < 3.0
    assert found.shape > 2.5
    assert 0.4 < found.bent < 1.2


def test_markers_miss_their_cluster_by_as_much_as_its_shape_is_known(folder: Folder):
    """The README states how well each cluster keeps its shape. The two loosest are left out: of these, only frames that
    fit well are positioned at all, and of one cluster none."""
    data = folder("optotrak_clusters").parent
    for cluster, rigid_mm in real.RIGID_MM.items():
        if cluster in ("21_24", "29_32", "41_44"):
            continue
        placed = [step for step in real.cluster_steps(data, cluster) if isinstance(step.fix, Fix)]
        assert len(placed) >= 27
        assert 0.9 < real.rms_residual_mm(placed) / rigid_mm < 1.35


def test_halves_of_the_clusters_frames_agree_where_they_alternate_and_not_where_time_passes(folder: Folder):
    """Clusters on skin bend slowly: frames a thirtieth of a second apart share that, those of another half do not.

    So normalised errors are below one for alternate frames and above for the first and the second half. Independent
    errors, which covariances speak of, would make both one.
    """
    data = folder("optotrak_clusters").parent
    squared: dict[bool, list[float]] = {True: [], False: []}
    for cluster in ("05_08", "09_12", "13_16", "17_20", "25_28"):
        steps = real.cluster_steps(data, cluster)
        for is_interleaved, found in squared.items():
            found.append(real.cluster_halves(data, cluster, steps, is_interleaved).normalised ** 2)
    assert 0.1 < np.mean(squared[True]) < 0.7
    assert 1.5 < np.mean(squared[False]) < 5.0
