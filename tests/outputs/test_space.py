"""The picture in three dimensions: what is handed to it, and what a browser makes of it."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_steps import pose, rig, steps
from test_report import reported

from trifix.outputs import page as page_templates
from trifix.outputs.course import Course, object_axes
from trifix.outputs.space import space_of
from trifix.records import ReferenceMap, Step, TargetState

TARGETS = ReferenceMap.given(
    np.random.default_rng(4).uniform(-200, 200, (30, 3)) + [0, 0, 700], np.tile(np.eye(3) * 0.01, (30, 1, 1))
)


def course(is_found: np.ndarray) -> Course:
    n = len(is_found)
    poses = [pose(k) for k in range(n)]
    hidden = np.where(is_found, 1.0, np.nan)
    return Course(
        frame=np.arange(n),
        outcome=["positioned" if each else "no_candidate" for each in is_found],
        points=np.full(n, 8),
        matched=np.full(n, 7),
        residual_mm=hidden * np.linspace(0, 0.3, n),
        position_mm=np.array([T.t_mm for T in poses]) * hidden[:, None],
        down=np.array([T.R[:, 1] for T in poses]) * hidden[:, None],
        forward=np.array([T.R[:, 2] for T in poses]) * hidden[:, None],
    )


def handed_over(is_found: np.ndarray) -> dict[str, dict[str, list[float]]]:
    space = space_of(course(is_found), TARGETS, rig(), [np.array([3, 5, 99])] * len(is_found))
    assert space is not None
    found: dict[str, dict[str, list[float]]] = json.loads(space.json)
    return found


def test_a_short_path_is_whole_and_broken_where_frames_were_refused():
    is_found = np.ones(40, dtype=bool)
    is_found[[10, 11, 30]] = False
    path = handed_over(is_found)["path"]
    assert path["frame"] == np.flatnonzero(is_found).tolist()
    assert np.array(path["frame"])[np.array(path["gap"]) == 1].tolist() == [12, 31]
    assert path["targets"][0] == [3, 5]


def test_a_long_path_is_thinned_out_and_keeps_both_ends_of_every_long_gap():
    is_found = np.ones(20_000, dtype=bool)
    is_found[5001:5100] = is_found[7:9] = False
    path = handed_over(is_found)["path"]
    assert {0, 5000, 5100, 19_999} <= set(path["frame"])
    assert np.array(path["frame"])[np.array(path["gap"]) == 1].tolist() == [5100]
    assert 1000 < len(path["frame"]) < 1600


@pytest.mark.parametrize("found", [0, 1, 2])
def test_few_poses_are_drawn_as_they_are(found: int):
    is_found = np.zeros(5, dtype=bool)
    is_found[2 : 2 + found] = True
    assert handed_over(is_found)["path"]["frame"] == [2, 3][:found]


def test_a_run_without_targets_and_poses_has_no_space():
    assert (
        space_of(course(np.zeros(3, dtype=bool)), ReferenceMap.empty(), None, [np.zeros(0, dtype=np.int64)] * 3) is None
    )


def test_flat_targets_are_seen_along_their_normal_whatever_the_first_pose():
    rng = np.random.default_rng(1)
    flat = np.c_[rng.uniform(-300, 300, (40, 2)), rng.normal(0, 0.5, 40)]
    tilt = pose(17)
    shown = course(np.ones(60, dtype=bool))
    right, down, away = object_axes(shown, ReferenceMap.given(tilt.apply(flat)))
    assert abs(away @ tilt.R[:, 2]) > 0.9999
    assert away @ shown.forward.mean(axis=0) > 0
    assert down @ shown.down.mean(axis=0) > 0.5
    assert np.abs(np.stack([right, down, away]) @ np.stack([right, down, away]).T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(np.stack([right, down, away])) > 0


def test_other_targets_are_seen_as_the_first_pose_looks_with_down_where_it_was_on_average():
    shown = course(np.ones(60, dtype=bool))
    right, down, away = object_axes(shown, TARGETS)
    mean = shown.down.mean(axis=0)
    assert abs(down @ mean / np.linalg.norm(mean) - 1) < 1e-9
    assert away @ shown.forward[0] > 0.8
    assert abs(right @ shown.forward[0]) < 1e-9


def test_what_draws_it_is_small():
    assert (Path(page_templates.__file__).parent / "space.js").stat().st_size < 25_000


# --- in a browser ----------------------------------------------------------------------------------------------------

PIXELS = """canvas => {
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let drawn = 0, sum = 0;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3]) drawn++;
    sum = (sum * 31 + data[i] + 7 * data[i + 3]) % 1e9;
  }
  return [drawn, sum];
}"""


@pytest.fixture(scope="module")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("space") / "report.html"
    made: list[Step] = list(steps(62))
    assert {int(state) for state in made[-1].map.state} == {
        TargetState.provisional, TargetState.trusted, TargetState.quarantined,
    }  # fmt: skip
    reported(made, path)
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("no chromium is installed: apt-get install chromium")
    arguments = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
                 "--disable-sync", "--no-first-run"]  # fmt: skip
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=arguments)
        yield started
        started.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_turns_and_explains_it_and_asks_nothing_of_the_network(browser, page_path: Path, scheme: str):
    context = browser.new_context(color_scheme=scheme, viewport={"width": 1000, "height": 800})
    context.set_default_timeout(120_000)
    page = context.new_page()
    asked: list[str] = []
    faults: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(page_path.as_uri())
    canvas = page.locator(".space canvas")

    def changed(last: list[int]) -> list[int]:
        for _ in range(200):
            now: list[int] = canvas.evaluate(PIXELS)
            if now != last:
                return now
            page.wait_for_timeout(50)
        raise AssertionError("the picture stays as it is")

    drawn = changed([0, 0])
    assert drawn[0] > 3000
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y + 30)
    page.mouse.up()
    dragged = changed(drawn)
    canvas.press("ArrowLeft")
    turned = changed(dragged)
    canvas.press("+")
    zoomed = changed(turned)
    page.locator(".space input").press("End")
    chosen = changed(zoomed)
    assert "frame 61" in page.locator(".space output").inner_text()
    page.locator(".space select").select_option("10000")
    changed(chosen)
    page.locator(".space button[value=front]").click()
    tip = page.locator(".space .tip")
    for column in range(int(box["width"]) // 8):
        page.mouse.move(box["x"] + 8 * column, y)
        if tip.is_visible():
            break
    assert tip.inner_text().split()[0] in ("target", "frame")
    page.emulate_media(media="print")
    assert not canvas.is_visible()
    assert page.locator("figure svg").last.is_visible()
    assert asked == [page_path.as_uri()]
    assert faults == []
    context.close()


def test_without_scripts_there_is_no_empty_frame(browser, page_path: Path):
    page = browser.new_context(java_script_enabled=False).new_page()
    page.goto(page_path.as_uri())
    assert not page.locator(".space").is_visible()
    page.close()
