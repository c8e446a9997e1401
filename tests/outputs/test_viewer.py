"""The viewer in a real browser: what it says, that it follows, and that it asks nobody outside."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from finished_runs import FRAMES, write_run
from made_steps import steps

pytest.importorskip("viser", reason="the extra viewer is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from trifix.errors import ViewerError  # noqa: E402
from trifix.geometry.pose import Pose  # noqa: E402
from trifix.outputs.finished import FinishedRun  # noqa: E402
from trifix.outputs.viewer import RunViewer, Viewer, open_run, who_can_see  # noqa: E402
from trifix.records import Fix, Step, TargetState  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
IMAGES = "img[src^='blob:']"
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed: apt-get install chromium")


@pytest.fixture(scope="module")
def browser() -> "Iterator[playwright.Browser]":
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@dataclass
class Visit:
    """A page, and what it asked for and complained of."""

    page: "playwright.Page"
    hosts: set[str | None] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)

    def note(self, url: str) -> None:
        if not url.startswith(("data:", "blob:")):  # these are part of the page
            self.hosts.add(urlsplit(url).hostname)

    def says(self, words: str) -> None:
        """Waits until the status says so."""
        playwright.expect(self.page.get_by_role("status")).to_contain_text(re.compile(words), timeout=20_000)

    def shows(self, words: str | re.Pattern[str]) -> None:
        """Waits until it stands somewhere on the page."""
        playwright.expect(self.page.locator("body")).to_contain_text(words, timeout=20_000)

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button).click()


def visit(browser: "playwright.Browser", url: str) -> Visit:
    visit = Visit(browser.new_page(viewport={"width": 1400, "height": 900}, device_scale_factor=0.4))
    visit.page.on("request", lambda request: visit.note(request.url))
    visit.page.on("websocket", lambda socket: visit.note(socket.url))
    visit.page.on("pageerror", lambda fault: visit.faults.append(str(fault)))
    visit.page.goto(url)
    visit.page.get_by_role("status").wait_for()
    return visit


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Step]]:
    folder = tmp_path_factory.mktemp("viewed")
    return folder, write_run(folder)


@pytest.fixture(scope="module")
def run(folder: tuple[Path, list[Step]]) -> Iterator[RunViewer]:
    viewer, _ = open_run(folder[0] / "results", port=0)
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def visited(browser: "playwright.Browser", run: RunViewer) -> Iterator[Visit]:
    visited = visit(browser, run.url)
    yield visited
    visited.page.close()
    assert not visited.faults


@pytest.fixture
def seen(visited: Visit, run: RunViewer) -> Visit:
    """The page of the finished run, at its first frame."""
    run.go(0)
    visited.says(r"frame 0\b")
    return visited


class Rates:
    frames_per_s, latency_ms, dropped = 24.6, 37.2, 3


@needs_browser
def test_a_live_view_follows_a_replay(browser: "playwright.Browser") -> None:
    viewer = Viewer(port=0)
    live = visit(browser, viewer.url)
    try:
        live.says(r"Waiting.*No frame has come in yet\.")
        for step in steps(31):
            viewer.show(step, Rates())
            if step.frame.index == 12:
                live.says(r"Positioned.*frame 12\b")
        live.says(r"Refused.*frame 30\b.*Fewer than three points")
        playwright.expect(live.page.locator(".tf-advice")).to_contain_text("Only two targets")
        for words in ("24.6", "3 dropped", "37.2", "the last 31"):
            live.shows(words)
        assert live.page.locator(".tf-strip rect[height='44.0']").count() == 2, "frames 13 and 30 were refused"
    finally:
        viewer.close()
        live.page.close()
    assert live.hosts == {"127.0.0.1"}
    assert not live.faults


@needs_browser
def test_the_page_says_what_became_of_the_frame_and_asks_nobody_outside(seen: Visit) -> None:
    seen.says(r"Positioned.*frame 0 .*The first frame: its sensor coordinates are the world's\.")
    for words in (
        "trifix · plate",
        "Points",
        "Matched",
        "Residual, rms",
        "Chance",
        "Frames/s",
        "Latency",
        "86 trusted",
    ):
        seen.shows(words)
    assert seen.page.locator("canvas").count() >= 1
    playwright.expect(seen.page.locator(IMAGES)).to_have_count(2)
    assert seen.hosts == {"127.0.0.1"}


@needs_browser
def test_the_timeline_moves_and_jumps_to_refused_frames(seen: Visit) -> None:
    line = seen.page.locator("line.now")
    slider = seen.page.get_by_role("slider").first
    slider.focus()
    slider.press("ArrowRight")
    seen.says(r"frame 1\b")
    playwright.expect(line).to_have_attribute("x1", "1.5")
    seen.press("refused ▶")
    seen.says(r"Refused.*frame 13\b.*Several poses explain the frame about equally well\.")
    playwright.expect(line).to_have_attribute("x1", "13.5")
    seen.press("refused ▶")
    seen.says(r"Refused.*frame 30\b.*Fewer than three points were seen by both cameras\.")
    playwright.expect(seen.page.locator(".tf-advice")).to_contain_text(re.compile(r"near \(.*\) mm"))
    seen.press("◀ refused")
    seen.says(r"frame 13\b")


@needs_browser
def test_jumps_go_to_the_reason_chosen(seen: Visit) -> None:
    seen.page.get_by_label("Jump to").first.click()
    seen.page.get_by_role("option", name="unreadable image (1)").click()
    seen.press("refused ▶")
    seen.says(r"frame 40\b.*An image of this frame cannot be read\.")
    playwright.expect(seen.page.locator(IMAGES)).to_have_count(0)


@needs_browser
def test_it_plays_and_stops_at_the_end(seen: Visit, run: RunViewer) -> None:
    run.go(FRAMES - 3)
    seen.says(rf"frame {FRAMES - 3}\b")
    seen.press("play / pause")
    seen.says(rf"frame {FRAMES - 1}\b")


@needs_browser
def test_a_target_chosen_by_number_shows_its_sightings(seen: Visit, folder: tuple[Path, list[Step]]) -> None:
    fix, map = folder[1][1].fix, folder[1][1].map
    assert isinstance(fix, Fix)
    target = int(map.id[fix.target[0]])
    seen.page.get_by_label("Number").fill(str(target))
    seen.page.get_by_label("Number").press("Enter")
    seen.shows(f"Target {target}, trusted, at (")
    seen.shows(f"{len(FinishedRun(folder[0] / 'results').sightings(target).frame)} sightings, frames ")
    assert seen.page.locator("tr", has_text="left and right").count() >= 3


@needs_browser
def test_a_target_clicked_in_the_scene_shows_its_sightings(seen: Visit, run: RunViewer) -> None:
    page = seen.page
    page.wait_for_timeout(1500)  # until the scene stands
    page.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())")
    (client,) = run._page._server.get_clients().values()
    targets, camera = run._run.targets, client.camera
    in_view = (targets.xyz_mm / 1000 - camera.position) @ rotation(camera.wxyz)
    focal_px = camera.image_height / 2 / np.tan(camera.fov / 2)
    uv = in_view[:, :2] / in_view[:, 2:] * focal_px + [camera.image_width / 2, camera.image_height / 2]
    apart_px = (np.linalg.norm(uv[:, None] - uv[None], axis=2) + 1e6 * np.eye(len(uv))).min(axis=1)
    is_free = (uv > 30).all(axis=1) & (uv < [camera.image_width - 30, camera.image_height * 0.6]).all(axis=1)
    best = int(np.argmax(np.where(is_free & (targets.state == TargetState.trusted), apart_px, -1)))
    canvas = page.locator("canvas").first.bounding_box()
    assert canvas is not None
    page.mouse.click(canvas["x"] + uv[best, 0], canvas["y"] + uv[best, 1])
    seen.shows(f"Target {targets.id[best]}, trusted")


def rotation(wxyz: np.ndarray) -> np.ndarray:
    return Pose.from_quaternion(wxyz[[1, 2, 3, 0]], np.zeros(3)).R


@needs_browser
def test_it_turns_dark_when_told(seen: Visit) -> None:
    seen.page.locator("html[data-mantine-color-scheme=light]").wait_for()
    seen.page.get_by_role("checkbox", name="Dark").click()
    seen.page.locator("html[data-mantine-color-scheme=dark]").wait_for()


def test_nobody_need_watch(folder: tuple[Path, list[Step]]) -> None:
    viewer = Viewer(port=0)
    for step in folder[1]:
        viewer.show(step)
    viewer.close()


def test_a_port_that_is_taken_is_named() -> None:
    viewer = Viewer(port=0)
    port = urlsplit(viewer.url).port
    assert port is not None
    try:
        with pytest.raises(ViewerError, match=rf"Port {port} of 127\.0\.0\.1 is taken; .* --port"):
            Viewer(port=port)
    finally:
        viewer.close()


def test_an_address_of_another_machine_or_no_port_is_refused() -> None:
    with pytest.raises(ViewerError, match=r"Cannot listen on 192\.0\.2\.1, port 8080 \(.*\); name others"):
        Viewer(host="192.0.2.1")
    with pytest.raises(ViewerError, match="There is no port 70000, expected 1 to 65535"):
        Viewer(port=70000)


def test_listening_to_the_network_is_told_for_what_it_is() -> None:
    assert who_can_see("127.0.0.1") == who_can_see("localhost") == who_can_see("::1") == ""
    assert "everybody who can reach this machine over the network sees the images" in who_can_see("0.0.0.0")


def test_no_tunnel_to_the_world_is_ever_opened() -> None:
    viewer = Viewer(port=0)
    assert viewer._page._server.request_share_url() is None
    viewer.close()


def test_without_the_extra_one_sentence_says_how_to_get_it(folder: tuple[Path, list[Step]]) -> None:
    code = "import sys; sys.modules['viser'] = None; from trifix.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "view", str(folder[0] / "results")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr == 'trifix: The viewer needs an extra: pip install "trifix[viewer]".\n'
