import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_steps import rig, steps

from trifix.files.recordings import Level
from trifix.outputs.report import Report
from trifix.outputs.samples import SPREAD, WIDTH_PX, Samples, sample
from trifix.outputs.summary import Summary, Tally
from trifix.records import Fix, Frame, NoFix, Reason, ReferenceMap, Step, StereoImages, Unusable


class Page(HTMLParser):
    """What a browser would load and show, and whether every element is closed."""

    VOID = frozenset({"meta", "link", "br", "image", "input"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.words: list[str] = []
        self.tags: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loaded += [value or "" for name, value in attributes if name in ("src", "href", "xlink:href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def reported(made: list[Step], path: Path, level: Level = "dots", name: str = "plate", finished: bool = True) -> str:
    report, tally = Report(), Tally(name, level, "[match]\nmax_depth_mm = 900.0\n", is_online=True)
    for step in made:
        report.show(step)
        tally.add(step, np.full(2, 0.2) if isinstance(step.fix, Fix) else np.zeros(0))
    report.write(path, tally.summary(made[-1].map if made else ReferenceMap.empty(), 2.0, finished))
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module", params=["images", "dots", "points"])
def text(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    return reported(list(steps(62, request.param)), tmp_path_factory.mktemp("report") / "report.html", request.param)


def test_the_page_asks_nothing_of_the_network(text: str):
    page = Page(text)
    assert page.open == []
    assert all(address.startswith(("data:", "#")) for address in page.loaded)
    assert not re.search(r"@import|url\((?!#)", text)
    assert page.tags.count("script") == 2  # the numbers and what draws them; neither has an address
    assert not re.search(r"fetch\(|XMLHttpRequest|WebSocket|import\(", text)


def test_the_page_says_what_came_of_the_run_and_why(text: str):
    words = " ".join(" ".join(Page(text).words).split())
    assert "of 62 frames positioned" in words
    for why in (Reason.ambiguous, Reason.not_proven, Reason.too_few_points):
        assert why.value in words
    assert "match.max_depth_mm 900.0" in words
    assert "did not reach its end" not in words


def test_the_page_says_what_would_help_and_marks_the_places(text: str):
    words = " ".join(" ".join(Page(text).words).split())
    assert "What would help" in words
    assert re.search(r"\d+ % of the frames saw too few known targets to be sure", words)
    numbers = re.search(r'<script type="application/json">(.*?)</script>', text, flags=re.DOTALL)
    assert numbers is not None
    record = json.loads(numbers[1])
    assert len(record["advice"]) >= 1
    assert all(len(each["xyz"]) == 3 for each in record["advice"])
    assert "where something would help" in words


def test_only_a_finished_run_gives_advice():
    tally = Tally("plate", "dots", "", is_online=True)
    made = list(steps(62))
    for step in made:
        tally.add(step, np.zeros(0))
    assert tally.summary(made[-1].map, 2.0, finished=False).advice == ()
    advice = tally.summary(made[-1].map, 2.0, finished=True).advice
    few = next(tip for tip in advice if "too few known targets" in tip.sentence)
    assert few.sentence.startswith(f"{round(100 * 8 / 62)} % of the frames")
    assert few.place_mm is not None
    assert np.abs(few.place_mm).max() < 1000


def test_the_figures_take_their_colours_from_the_theme(text: str):
    figures = re.findall(r"<svg xmlns.*?</svg>", text, flags=re.DOTALL)
    assert len(figures) == 2
    for figure in figures:
        assert "var(--good)" in figure
        assert set(re.findall(r"#[0-9a-f]{6}\b", figure)) <= {"#000000"}  # of strokes without opacity
    assert "prefers-color-scheme: dark" in text


def test_what_the_recording_says_is_text_and_not_markup(tmp_path: Path):
    made = list(steps(2))
    bad = Step(made[0].frame, None, None, None, None, NoFix(Reason.bad_points, "<script>1</script>"), made[0].added,
               made[0].map, 1.0)  # fmt: skip
    text = reported([*made, bad], tmp_path / "report.html", name="<b>plate</b> & co", finished=False)
    assert "<script>1" not in text
    assert "<b>plate" not in text
    words = " ".join(Page(text).words)
    assert "<b>plate</b> & co" in words
    assert "did not reach its end" in words


def refused(step: Step) -> Step:
    unusable = Unusable(Reason.no_calibration, "")
    frame = Frame(step.frame.index, step.frame.timestamp_ns, None, unusable)
    return Step(frame, None, None, None, None, NoFix(Reason.no_calibration), step.added, ReferenceMap.empty(), 1.0)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_run_in_which_nothing_was_found_has_a_page(tmp_path: Path, count: int):
    text = reported([refused(step) for step in steps(count)], tmp_path / "report.html")
    assert "0.0 %" in " ".join(Page(text).words)


def test_a_run_of_one_frame_has_a_page(tmp_path: Path):
    assert "100.0 %" in " ".join(Page(reported(list(steps(1)), tmp_path / "report.html")).words)


def test_a_long_run_has_a_small_page(tmp_path: Path):
    made = list(steps(60))
    text = reported([made[k % 60] for k in range(20_000)], tmp_path / "report.html")
    assert len(text) < 1_500_000


def test_the_frames_shown_are_the_first_the_last_the_worst_and_some_of_each_kind():
    samples, made = Samples(), list(steps(130))
    for step in made:
        samples.show(step)
    chosen = samples.chosen()
    by_frame = {each.frame: each.why_shown for each in chosen}
    assert list(by_frame) == sorted(by_frame)
    assert "first" in by_frame[0]
    assert "last" in by_frame[129]
    rms = {step.frame.index: step.fix.rms_mm for step in made if isinstance(step.fix, Fix)}
    assert "largest residual" in by_frame[max(rms, key=rms.__getitem__)]
    why = {step.frame.index: step.fix.why for step in made if isinstance(step.fix, NoFix)}
    first = {reason: min(k for k in why if why[k] is reason) for reason in set(why.values())}
    assert {k for k, shown in by_frame.items() if "first with this reason" in shown} == set(first.values())
    spread = [k for k, shown in by_frame.items() if {"first", "in between"} & set(shown)]
    assert np.unique(np.diff(spread)).tolist() == [32]


@pytest.mark.parametrize("count", [1, 2, 6, 7, 12, 13, 100, 1000])
def test_few_frames_are_kept_however_long_the_run(count: int):
    samples, made = Samples(), list(steps(30))
    for k in range(count):
        samples.show(made[k % 30])
    assert min(count, SPREAD // 2) <= len(samples._spread) <= SPREAD
    assert len(samples.chosen()) <= min(count, SPREAD + len(Reason) + 2)


def test_every_dot_is_drawn_once_as_what_became_of_it():
    step = next(iter(steps(1)))
    assert isinstance(step.fix, Fix)
    assert step.dots is not None
    assert step.matches is not None
    for picture, dots in zip(sample(step, 0).pictures, (step.dots.left, step.dots.right), strict=True):
        drawn = {kind: len(uv) for kind, uv in picture.dots.items()}
        identified, paired = len(step.fix.point), len(step.matches)
        assert drawn == {
            "identified": identified, "refused": 0, "unidentified": paired - identified, "single": len(dots) - paired,
        }  # fmt: skip
        assert np.abs(picture.dots["identified"] - dots.uv_px[:identified]).max() == 0.0


def test_points_of_a_refused_frame_are_drawn_as_refused_inside_the_canvas():
    step = next(step for step in steps(20, "points") if isinstance(step.fix, NoFix))
    (picture,) = sample(step, 0).pictures
    assert step.points is not None
    uv = picture.dots["refused"]
    assert len(uv) == len(step.points)
    assert ((uv > 0) & (uv < [picture.width_px, picture.height_px])).all()


@pytest.mark.parametrize("shape", [(480, 1280), (480, 1280, 3), (60, 80)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pictures_are_small_and_use_the_whole_range(shape: tuple[int, ...], dtype: type):
    step = next(iter(steps(1, "images")))
    grey = np.zeros(shape, dtype)
    grey[:, : shape[1] // 2] = 255 if dtype is np.uint8 else 900
    frame = Frame(0, 0, rig(), StereoImages(grey, grey))
    shown = Step(frame, step.dots, step.matches, step.points, None, step.fix, step.added, step.map, 1.0)
    picture = sample(shown, 0).pictures[0]
    assert (picture.height_px, picture.width_px) == shape[:2]
    assert picture.jpeg is not None
    small = cv2.imdecode(np.frombuffer(base64.b64decode(picture.jpeg), np.uint8), cv2.IMREAD_UNCHANGED)
    assert small.shape[1] == min(shape[1], WIDTH_PX)
    assert int(small.max()) > 245
    assert int(small.min()) < 10


def test_the_terminal_names_what_matters():
    from rich.console import Console

    from trifix.outputs.terminal import summary_table

    tally = Tally("plate", "dots", "", is_online=False)
    made = list(steps(45))
    for step in made:
        tally.add(step, np.full(4, 0.25))
    summary: Summary = tally.summary(made[-1].map, 3.0, finished=True)
    console = Console(width=160)
    with console.capture() as capture:
        console.print(summary_table(summary, Path("out") / "report.html"))
    said = capture.get()
    for words in (
        f"{summary.positioned}  of 45 frames",
        "ambiguous",
        "0.250  px",
        "15.0 frames/s",
        "report.html",
        "1.10",
        summary.advice[0].sentence.split(":")[0],
    ):
        assert words in said
