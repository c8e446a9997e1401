"""One page on which a run is watched as it goes on, or gone through when it is over; a browser shows it.

Draws what it is given, on threads of its own: who feeds it never waits for it, and what cannot be drawn in time is left
out. The page holds all that it needs; nothing is asked of the network. Needs the extra ``viewer``.
"""

import errno
import io
import ipaddress
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, UInt8

from trifix.errors import ViewerError
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.outputs import panels
from trifix.outputs.advice import advice_for_run
from trifix.outputs.course import object_axes
from trifix.outputs.finished import FinishedRun, Sightings, recording_beside
from trifix.outputs.moments import SHOWN_PX, Moment, drawn, moment_of
from trifix.outputs.scene3d import (
    COLOUR,
    LEFT,
    PLACE,
    RIGHT,
    Mesh,
    Path,
    ball,
    cross,
    default_magnification,
    disc,
    ellipsoids,
    facing_wxyz,
    quaternions_wxyz,
    residual_colours,
    ring,
    worst_shown_mm,
)
from trifix.records import Fix, ReferenceMap, Step, TargetState

try:
    import viser
except ImportError as error:
    raise ViewerError('The viewer needs an extra: pip install "trifix[viewer]".') from error

_UNIT = 1e-3  # the scene is drawn in metres
_PAUSE_S = 0.08  # between two drawings
_LAST_FRAMES = 300  # shown of a live run
_OUTGROWN = 1.25  # the scene by so much what was looked at: look again
_NEARLY_RAD = 0.012  # a click so near a target is meant for it
_PLAY_FRAMES_PER_S = 10.0
_MAGNIFICATIONS = (0.0, *(step * 10.0**power for power in range(5) for step in (1.0, 2.0, 5.0)), 1e5)
_MOVES = {
    "◀ refused": ("jump", -1),
    "◀": ("go", -1),
    "play / pause": ("play", 0),
    "▶": ("go", 1),
    "refused ▶": ("jump", 1),
}
_FREE_WIDTH, _FREE_HEIGHT = 0.72, 0.68  # of half the scene's height: what panels and timeline leave
_FOV_RAD = float(np.radians(40.0))
_SIGHT = {False: (176, 190, 204), True: (70, 88, 106)}
_FLOOR = {False: (222, 226, 231), True: (46, 52, 59)}
"""Of lines, on light ground and on dark."""
_REFUSED = COLOUR[TargetState.quarantined]
_MESHES: dict[TargetState, Callable[[], Mesh]] = {
    TargetState.trusted: disc,
    TargetState.provisional: ring,
    TargetState.quarantined: cross,
}
_NOTHING: Float[np.ndarray, "0 2"] = np.zeros((0, 2))


@runtime_checkable
class Rates(Protocol):
    """How fast frames come and are judged."""

    @property
    def frames_per_s(self) -> float:
        """Frames judged per second."""

    @property
    def latency_ms(self) -> float:
        """From the exposure to the answer (ms)."""

    @property
    def dropped(self) -> int:
        """Frames that were left out so far."""


class Viewer:
    """Shows Steps as they come.

    viewer = Viewer()
    for step in steps:
        viewer.show(step)
    viewer.close()
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080, title: str = "live") -> None:
        """Opens the page; port 0 is any that is free.

        Raises:
            ViewerError: the port is taken, or the address is none of this machine's.
        """
        self._lock = threading.Lock()
        self._latest: tuple[Step, Pose | None, float, float, int] | None = None
        self._last_pose: Pose | None = None
        self._path = Path()
        self._outcomes: deque[tuple[int, bool, float]] = deque(maxlen=_LAST_FRAMES)
        self._arrivals: deque[float] = deque(maxlen=30)
        self._page = _Page(host, port, title)
        self._painter = _Painter(self._paint)
        self._page.timeline("The newest frames")
        self._page.add_view(self._painter.wake)
        self._page.on_watched(self._painter.wake)
        self._painter.start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return self._page.url

    def show(self, step: Step, rates: Rates | None = None) -> None:
        """Take a look at the next frame; returns at once. From any thread."""
        copied = replace(step, map=step.map.copy())
        with self._lock:
            self._arrivals.append(time.monotonic())
            if rates is not None:
                speed = rates.frames_per_s, rates.latency_ms, rates.dropped
            else:
                span = self._arrivals[-1] - self._arrivals[0]
                measured = (len(self._arrivals) - 1) / span if span > 0 else float("nan")
                speed = measured, sum(step.timings_ms.values(), start=0.0), 0
            self._latest = (copied, self._last_pose, *speed)
            if isinstance(step.fix, Fix):
                self._last_pose = step.fix.T_world_sensor
                self._path.add(self._last_pose.t_mm, step.fix.rms_mm)
                self._outcomes.append((step.frame.index, True, step.fix.rms_mm))
            else:
                self._path.break_off()
                self._outcomes.append((step.frame.index, False, float("nan")))
        self._painter.wake()

    def close(self) -> None:
        """Take the page away."""
        self._painter.close()
        self._page.close()

    def _paint(self) -> None:
        """Draw the newest frame, if somebody looks."""
        if not self._page.is_watched:
            return
        with self._lock:
            if self._latest is None:
                return
            step, last_pose, frames_per_s, latency_ms, dropped = self._latest
            lines, of_lines, points, of_points = self._path.segments()
            outcomes = list(self._outcomes)
        frame, is_positioned, residual_mm = (np.array(each) for each in zip(*outcomes, strict=True))
        worst_mm = worst_shown_mm(of_points)
        moment = moment_of(step, last_pose)
        self._page.draw_targets(step.map, worst_mm)
        self._page.draw_path(lines, of_lines, points, of_points, worst_mm)
        self._page.draw(moment, frames_per_s, latency_ms, dropped)
        strip = panels.strip(is_positioned, residual_mm, np.ones(len(frame), dtype=bool), worst_mm)
        words = f'<span>frame <b>{frame[-1]}</b></span><span class="dim">the last {len(frame)}</span>'
        self._page.draw_strip(panels.with_now(strip, len(frame) - 1, words))


class RunViewer:
    """Shows a finished run, frame by frame: a timeline, its refused frames, its targets' sightings."""

    def __init__(self, run: FinishedRun, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Opens the page; port 0 is any that is free.

        Raises:
            ViewerError: the port is taken, or the address is none of this machine's.
        """
        self._run = run
        self._k, self._target = 0, -1
        self._worst_mm = worst_shown_mm(run.course.residual_mm)
        self._choices = panels.reasons_found(run.reason, run.course.is_positioned)
        self._is_playing = threading.Event()
        self._is_closed = threading.Event()
        self._page = _Page(host, port, run.name)
        self._painter = _Painter(self._paint)
        self._filter(next(iter(self._choices)))
        self._add_timeline()
        self._add_target()
        self._page.add_view(self._painter.wake)
        self._page.on_watched(self._painter.wake)
        self._page.on_target_clicked(self.select)
        advice = advice_for_run(run.reason, run.course.points, run.poses, run.targets)
        self._page.gui.add_html(panels.next_run([each.sentence for each in advice]))
        path = Path()
        for pose, residual_mm in zip(run.poses, run.course.residual_mm, strict=True):
            if pose is None:
                path.break_off()
            else:
                path.add(pose.t_mm, float(residual_mm))
        self._page.turn_upright(object_axes(run.course, run.targets))
        self._page.draw_targets(run.targets, self._worst_mm)
        self._page.draw_path(*path.segments(), self._worst_mm)
        self._painter.start()
        self._painter.wake()
        threading.Thread(target=self._play, name="player", daemon=True).start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return self._page.url

    def go(self, k: int) -> None:
        """Show the k-th frame."""
        self._k = min(max(k, 0), len(self._run) - 1)
        self._slider.value = self._k  # type: ignore[misc]  # a property of viser's with a setter of another kind
        self._painter.wake()

    def select(self, target: int) -> None:
        """Show a target's sightings."""
        self._target = target
        self._number.value = max(target, 0)  # type: ignore[misc]  # as above
        self._painter.wake()

    def jump(self, step: int) -> None:
        """Show the next frame with the reason chosen, or with step −1 the one before; round the end to the other."""
        found = np.flatnonzero(self._meant)
        if len(found):
            at = np.searchsorted(found, self._k, side="right" if step > 0 else "left") - (step < 0)
            self.go(int(found[at % len(found)]))

    def close(self) -> None:
        """Take the page away."""
        self._is_closed.set()
        self._is_playing.set()
        self._painter.close()
        self._page.close()

    def _add_timeline(self) -> None:
        gui = self._page.gui
        with self._page.timeline():
            self._slider = gui.add_slider("Frame", 0, max(len(self._run) - 1, 1), 1, 0, hint="Counted from 0")
            moves = gui.add_button_group("Go", tuple(_MOVES), hint="Jumps go to the frames chosen below")
            reasons = gui.add_dropdown("Jump to", tuple(self._choices), hint="Others are faint in the timeline")

        @self._slider.on_update
        def _(_: object) -> None:
            self._k = int(self._slider.value)
            self._painter.wake()

        @moves.on_click
        def _(_: object) -> None:
            was_playing = self._is_playing.is_set()
            self._is_playing.clear()
            match _MOVES[moves.value]:
                case "jump", step:
                    self.jump(step)
                case "go", step:
                    self.go(self._k + step)
                case _ if not was_playing:
                    self._is_playing.set()

        @reasons.on_update
        def _(_: object) -> None:
            self._filter(reasons.value)
            self._painter.wake()

    def _add_target(self) -> None:
        gui = self._page.gui
        with gui.add_folder("Target"):
            self._number = gui.add_number("Number", 0, min=0, step=1, hint="Or click one in the scene")
            self._card = gui.add_html('<div class="tf dim">Click a target in the scene, or name it by number.</div>')

        @self._number.on_update
        def _(_: object) -> None:
            self._target = int(self._number.value)
            self._painter.wake()

    def _filter(self, words: str) -> None:
        """Jumps go to these frames from now on."""
        self._meant = self._choices[words]
        self._strip = panels.strip(
            self._run.course.is_positioned, self._run.course.residual_mm, self._meant, self._worst_mm
        )

    def _play(self) -> None:
        while not self._is_closed.is_set():
            self._is_playing.wait()
            if self._k >= len(self._run) - 1:
                self._is_playing.clear()
            elif not self._is_closed.wait(1 / _PLAY_FRAMES_PER_S) and self._is_playing.is_set():
                self.go(self._k + 1)

    def _paint(self) -> None:
        run, k = self._run, self._k
        moment = run.moment(k)
        self._page.draw(moment, run.frames_per_s, run.latency_ms(k), 0)
        words = panels.frame_words(run.course.frame, k, run.is_finished)
        self._page.draw_strip(panels.with_now(self._strip, k, words))
        if self._target >= 0:
            sightings = run.sightings(self._target)
            self._card.content = panels.target_card(self._target, run.targets, sightings, moment.frame)
            self._page.draw_selected(self._target, *self._sights(sightings))

    def _sights(self, sightings: Sightings) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s"]]:
        """Where a target was seen from, and the residuals there."""
        step = len(sightings.frame) // 200 + 1
        at = [self._run.position(int(frame)) for frame in sightings.frame[::step]]
        seen = zip([self._run.poses[k] for k in at], sightings.residual_mm[::step], strict=True)
        known = [(pose.t_mm, residual) for pose, residual in seen if pose is not None]
        if not known:
            return np.zeros((0, 3)), np.zeros(0)
        return np.array([t_mm for t_mm, _ in known]), np.array([residual for _, residual in known])


def open_run(
    out: FilePath, recording: FilePath | None = None, host: str = "127.0.0.1", port: int = 8080
) -> tuple[RunViewer, FinishedRun]:
    """The page of a finished run; its recording is looked for beside it where none is named.

    Raises:
        RecordingError: the folder holds no results, or none yet, or the recording is another one.
        MapError: the map cannot be read.
        ViewerError: the port is taken, or the address is none of this machine's.
    """
    run = FinishedRun(out, recording or recording_beside(out))
    return RunViewer(run, host, port), run


def who_can_see(host: str) -> str:
    """What it means to listen there, in a sentence; empty if only this machine can."""
    try:
        is_loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_loopback = False
    if is_loopback:
        return ""
    return (
        f"listening on {host}: everybody who can reach this machine over the network sees the images and the map, "
        f"without a password; leave out --host to keep them to yourself."
    )


class _Server(viser.ViserServer):
    """A server that never offers its page to the world."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: no tunnel is opened, whoever asks."""
        return None


class _Painter:
    """Draws on a thread of its own, once for all that has happened since it last did."""

    def __init__(self, paint: Callable[[], None]) -> None:
        self._paint = paint
        self._due = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def wake(self) -> None:
        """Something has changed."""
        self._due.set()

    def close(self) -> None:
        self._closing.set()
        self._due.set()
        self._thread.join(timeout=5)

    def _run(self) -> None:
        while True:
            self._due.wait()
            self._due.clear()
            if self._closing.is_set():
                return
            self._paint()
            self._closing.wait(_PAUSE_S)


class _Page:
    """The page itself: panels at its sides, the scene between them. All drawing is done by one thread."""

    def __init__(self, host: str, port: int, title: str) -> None:
        _check_free(host, port)
        with redirect_stdout(io.StringIO()):  # it would tell of itself
            self._server = _Server(host, port, label=f"trifix · {title}", verbose=False)
        if port and self._server.get_port() != port:  # somebody was faster
            self._server.stop()
            raise ViewerError(_taken(host, port))
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{'127.0.0.1' if host in ('0.0.0.0', '::', '') else shown}:{self._server.get_port()}"
        self.gui = self._server.gui
        self._scene = self._server.scene
        self._is_dark = False
        self._targets = ReferenceMap.empty()
        self._extent_mm = self._radius_mm = 0.0
        self._is_magnification_chosen = False
        self._hidden: set[str] = set()
        self._path_mm = np.zeros((0, 3))
        self._eye = self._middle = np.zeros(3)
        self._framed_mm = 0.0
        self._axes = np.eye(3)
        self._worst_mm = 1.0
        self._clicked: Callable[[int], None] = lambda _: None
        self._theme()
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(372)
        self._status = self.gui.add_html(panels.status(None))
        self._numbers = self.gui.add_html("")
        self._left = self.gui.add_panel()
        self._left_tab = self._left.add_tab("What the cameras see")
        with self._left_tab:
            blank = np.full((SHOWN_PX * 3 // 4, SHOWN_PX, 3), 38, dtype=np.uint8)
            self._images = [self.gui.add_image(blank, label=name, jpeg_quality=85) for name in ("Left", "Right")]
            self._dots_legend = self.gui.add_html("")
            self._scene_legend = self.gui.add_html("")
        self._left.dock_left()
        self._left.set_width(340)
        self._build_scene()

    @property
    def is_watched(self) -> bool:
        """Whether a browser shows it."""
        return bool(self._server.get_clients())

    def on_watched(self, wake: Callable[[], None]) -> None:
        """Call this when a browser comes."""
        self._server.on_client_connect(lambda _: wake())

    def on_target_clicked(self, clicked: Callable[[int], None]) -> None:
        """Call this with the identity of a target that is clicked."""
        self._clicked = clicked
        self._scene.on_click()(self._click)

    def turn_upright(self, axes: Float[np.ndarray, "3 3"]) -> None:
        """Stand the object on its feet: its right, down and away are rows; until then, as the first frame saw it."""
        self._axes = axes
        self._scene.set_up_direction(-axes[1])

    def close(self) -> None:
        """Take it away."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def timeline(self, title: str = "Timeline") -> viser.GuiTabHandle:
        """The window below the scene; what is added within it goes there."""
        panel = self.gui.add_panel()
        tab = panel.add_tab(title)
        with tab:
            self._strip = self.gui.add_html("")
        panel.float(x=14, y=-14, width=652)
        return tab

    def add_view(self, wake: Callable[[], None]) -> None:
        """What can be chosen about the drawing."""
        with self._left_tab, self.gui.add_folder("View"):
            names = tuple(_times(each) for each in _MAGNIFICATIONS)
            self._magnify = self.gui.add_dropdown(
                "Uncertainty", names, initial_value=names[0], hint="Ellipsoids of one sigma, enlarged so many times"
            )
            shown = {
                "Path": ("/path", "/path_points"),
                "Lines of sight": ("/sight",),
                "Sensor": ("/sensor",),
                "Grid": ("/grid",),
            }
            for label, nodes in shown.items():
                self._add_switch(label, nodes)
            dark = self.gui.add_checkbox("Dark", initial_value=False)
            fit = self.gui.add_button("Look at everything")

        @self._magnify.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            self._is_magnification_chosen |= event.client is not None  # none is told of what the program sets itself
            self._draw_ellipsoids()

        @dark.on_update
        def _(_: object) -> None:
            self._is_dark = dark.value
            self._theme()
            self._colour_lines()

        @fit.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None:
                self._frame_scene([event.client])

    def draw(self, moment: Moment, frames_per_s: float, latency_ms: float, dropped: int) -> None:
        """Show one frame."""
        with self._server.atomic():
            self._draw_words(moment, frames_per_s, latency_ms, dropped)
            self._draw_images(moment)
            self._draw_sensor(moment)
            self._draw_place(moment)

    def draw_strip(self, html: str) -> None:
        """Show the outcome of many frames."""
        self._strip.content = html

    def draw_targets(self, targets: ReferenceMap, worst_mm: float) -> None:
        """Show the map, if it has changed."""
        old = self._targets
        self._scene_legend.content = panels.scene_legend(targets, worst_mm)
        if (
            len(old) == len(targets)
            and np.array_equal(old.id, targets.id)
            and np.array_equal(old.state, targets.state)
            and np.allclose(old.xyz_mm, targets.xyz_mm, rtol=0, atol=0.02)
            and np.allclose(old.cov_mm2, targets.cov_mm2, rtol=0.1, atol=0)
        ):
            return
        self._targets = targets
        self._measure()
        with self._server.atomic():
            for state, handle in self._marks.items():
                rows = np.flatnonzero(targets.state == state)
                handle.batched_positions = _metres(targets.xyz_mm[rows])
                handle.batched_wxyzs = facing_wxyz(targets.view[rows]).astype(np.float32)
                handle.batched_scales = _metres(np.full(len(rows), self._radius_mm))
            self._draw_ellipsoids()

    def draw_path(
        self,
        lines_mm: Float[np.ndarray, "s 2 3"],
        of_lines_mm: Float[np.ndarray, "s"],
        points_mm: Float[np.ndarray, "n 3"],
        of_points_mm: Float[np.ndarray, "n"],
        worst_mm: float,
    ) -> None:
        """Show where the sensor was."""
        with self._server.atomic():
            self._path.points = _metres(lines_mm)
            self._path.colors = _both_ends(residual_colours(of_lines_mm, worst_mm))
            self._path_points.points = _metres(points_mm)
            self._path_points.colors = residual_colours(of_points_mm, worst_mm)
            self._path_points.point_size = max(0.002 * self._extent_mm, 0.5) * _UNIT
        self._worst_mm = worst_mm
        self._path_mm = points_mm
        if len(points_mm) and len(self._targets):
            reach_mm = self._extent_mm + float(np.linalg.norm(np.ptp(points_mm, axis=0)))
            if reach_mm > _OUTGROWN * self._framed_mm:
                is_first, self._framed_mm = not self._framed_mm, reach_mm
                eyes = [(each, each.camera.position) for each in self._server.get_clients().values()]
                self._frame_scene([each for each, at in eyes if is_first or np.allclose(at, self._eye, atol=1e-3)])

    def draw_selected(
        self, target: int, from_mm: Float[np.ndarray, "s 3"], residual_mm: Float[np.ndarray, "s"]
    ) -> None:
        """Show one target, and from where it was seen."""
        rows = np.flatnonzero(self._targets.id == target)
        is_there = bool(len(rows))
        with self._server.atomic():
            self._chosen.visible = self._chosen_label.visible = is_there
            self._chosen_sights.visible = is_there and bool(len(from_mm))
            if is_there:
                at = self._targets.xyz_mm[rows[0]]
                self._chosen.position = self._chosen_label.position = at * _UNIT
                self._chosen.wxyz = facing_wxyz(self._targets.view[rows[:1]])[0]
                self._chosen.scale = 1.9 * self._radius_mm * _UNIT
                self._chosen_label.text = f"target {target}"
                self._chosen_sights.points = _metres(_lines(from_mm, at[None]))
                self._chosen_sights.colors = _both_ends(residual_colours(residual_mm, self._worst_mm))

    def _theme(self) -> None:
        self.gui.configure_theme(
            dark_mode=self._is_dark, show_logo=False, show_share_button=False, brand_color=(43, 128, 196)
        )

    def _colour_lines(self) -> None:
        """Lines that are neither to stand out nor to vanish, on either ground."""
        self._sight.colors = np.array(_SIGHT[self._is_dark], dtype=np.uint8)
        self._grid.cell_color = self._grid.section_color = _FLOOR[self._is_dark]

    def _build_scene(self) -> None:
        scene, none = self._scene, np.zeros((0, 3))
        scene.set_up_direction("-y")
        scene.configure_default_lights(cast_shadow=False)
        self._server.initial_camera.near, self._server.initial_camera.far = 0.002, 300.0
        self._server.initial_camera.fov = _FOV_RAD
        self._marks = {}
        self._ellipsoids = {}
        for state, mesh in _MESHES.items():
            colour = COLOUR[state]
            vertices, faces = mesh()
            self._marks[state] = scene.add_batched_meshes_simple(
                f"/targets/{state.name}", vertices, faces, np.zeros((0, 4)), none, batched_colors=colour, lod="off",
                batched_scales=np.zeros(0), cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            vertices, faces = ball()
            self._ellipsoids[state] = scene.add_batched_meshes_simple(
                f"/uncertainty/{state.name}", vertices, faces, np.zeros((0, 4)), none, batched_colors=colour,
                batched_scales=np.zeros((0, 3)), opacity=0.4, lod="off", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._path = scene.add_line_segments(
            "/path", np.zeros((0, 2, 3)), np.zeros((0, 2, 3), dtype=np.uint8), thickness=3.0, thickness_units="screen"
        )
        self._path_points = scene.add_point_cloud(
            "/path_points", none, np.zeros((0, 3), dtype=np.uint8), point_size=0.001, point_shape="circle"
        )
        self._sight = scene.add_line_segments(
            "/sight", np.zeros((0, 2, 3)), _SIGHT[False], thickness=1.0, thickness_units="screen"
        )
        self._grid = scene.add_grid(
            "/grid", plane="xz", infinite_grid=True, cell_size=0.05, section_size=0.25, cell_color=_FLOOR[False],
            section_color=_FLOOR[False], cell_thickness=0.4, section_thickness=0.8, shadow_opacity=0.0, visible=False,
        )  # fmt: skip
        self._sensor = scene.add_frame("/sensor", show_axes=False, visible=False)
        self._frusta = [
            scene.add_camera_frustum(
                f"/sensor/{name}", 0.7, 4 / 3, color=colour, thickness=2.0, thickness_units="screen", cast_shadow=False,
                receive_shadow=False,
            )
            for name, colour in (("left", LEFT), ("right", RIGHT))
        ]  # fmt: skip
        self._place = scene.add_icosphere("/place", 1.0, PLACE, opacity=0.35, visible=False, cast_shadow=False)
        self._place_label = scene.add_label("/place_label", "stick one here", visible=False, anchor="bottom-center")
        vertices, faces = ring()
        self._chosen = scene.add_mesh_simple("/chosen", vertices, faces, color=PLACE, visible=False, cast_shadow=False)
        self._chosen_label = scene.add_label("/chosen_label", "", visible=False, anchor="bottom-center")
        self._chosen_sights = scene.add_line_segments(
            "/chosen_sights", np.zeros((0, 2, 3)), np.zeros((0, 2, 3), dtype=np.uint8), thickness=1.0,
            thickness_units="screen", visible=False,
        )  # fmt: skip

    def _add_switch(self, label: str, nodes: tuple[str, ...]) -> None:
        switch = self.gui.add_checkbox(label, initial_value=True)

        @switch.on_update
        def _(_: object) -> None:
            self._hidden = self._hidden - set(nodes) if switch.value else self._hidden | set(nodes)
            for node in nodes:
                handle = self._scene.get_handle_by_name(node)
                if handle is not None:
                    handle.visible = switch.value

    def _click(self, event: viser.SceneClickEvent) -> None:
        """Choose the target nearest to the ray, if there is one."""
        rows = np.flatnonzero(self._targets.state != TargetState.removed)
        away_mm = self._targets.xyz_mm[rows] - np.array(event.ray_origin) / _UNIT
        ray = np.array(event.ray_direction) / np.linalg.norm(event.ray_direction)
        along_mm = away_mm @ ray
        beside_mm = np.linalg.norm(away_mm - along_mm[:, None] * ray, axis=1)
        misses = np.where(along_mm > 0, beside_mm / np.maximum(1.2 * self._radius_mm, _NEARLY_RAD * along_mm), np.inf)
        if len(rows) and misses.min() < 1:
            self._clicked(int(self._targets.id[rows[int(misses.argmin())]]))

    def _measure(self) -> None:
        """How large the scene is, and so the marks."""
        trusted = self._targets.xyz_mm[self._targets.state == TargetState.trusted]
        shown = trusted if len(trusted) > 2 else self._targets.xyz_mm[self._targets.state != TargetState.removed]
        if not len(shown):
            return
        low, high = np.percentile(shown, [2, 98], axis=0)
        extent = float(np.linalg.norm(high - low))
        if not 0.8 * self._extent_mm < extent < 1.25 * self._extent_mm:
            self._extent_mm = max(extent, 1.0)
            some = shown[:: len(shown) // 200 + 1]
            apart = np.linalg.norm(some[:, None] - shown[None], axis=2)
            gap = float(np.median(np.partition(apart, 1, axis=1)[:, 1])) if len(shown) > 1 else np.inf
            self._radius_mm = float(np.clip(0.35 * gap, 0.006 * self._extent_mm, 0.02 * self._extent_mm))
        if not self._is_magnification_chosen:
            best = default_magnification(self._targets.cov_mm2[self._targets.state == TargetState.trusted], extent)
            self._magnify.value = _times(best)  # type: ignore[misc]  # as above

    def _draw_ellipsoids(self) -> None:
        factor = _MAGNIFICATIONS[[_times(each) for each in _MAGNIFICATIONS].index(self._magnify.value)]
        for state, handle in self._ellipsoids.items():
            rows = np.flatnonzero((self._targets.state == state) & (factor > 0))
            wxyz, sigma = ellipsoids(self._targets.cov_mm2[rows])
            handle.batched_positions = _metres(self._targets.xyz_mm[rows])
            handle.batched_wxyzs = wxyz.astype(np.float32)
            shown = np.maximum(factor * sigma, 1e-3)
            largest = shown.max(axis=1, keepdims=True, initial=1e-3)
            handle.batched_scales = _metres(shown * np.minimum(0.1 * self._extent_mm / largest, 1.0))

    def _draw_words(self, moment: Moment, frames_per_s: float, latency_ms: float, dropped: int) -> None:
        self._status.content = panels.status(moment)
        self._numbers.content = panels.numbers(moment, frames_per_s, latency_ms, dropped)
        self._dots_legend.content = panels.dots_legend(moment)

    def _draw_images(self, moment: Moment) -> None:
        for camera, handle in enumerate(self._images):
            handle.visible = camera < len(moment.shots)
            if handle.visible:
                handle.image = drawn(moment.shots[camera], _wanted_px(moment, camera))
                self._frusta[camera].image = None if moment.shots[camera].image is None else handle.image[::2, ::2]

    def _draw_sensor(self, moment: Moment) -> None:
        is_known = moment.pose is not None
        self._sensor.visible = is_known and "/sensor" not in self._hidden
        self._sight.visible = moment.is_positioned and "/sight" not in self._hidden
        if moment.pose is None:
            return
        self._sensor.position = moment.pose.t_mm * _UNIT
        x, y, z, w = moment.pose.quaternion_xyzw
        self._sensor.wxyz = np.array([w, x, y, z])
        for camera, handle in enumerate(self._frusta):
            handle.visible = moment.rig is not None or camera == 0
            self._shape_frustum(handle, camera, moment.rig)
            handle.color = (LEFT, RIGHT)[camera] if moment.is_positioned else _REFUSED
        seen = self._targets.xyz_mm[np.isin(self._targets.id, moment.targets)]
        self._sight.points = _metres(_lines(moment.pose.t_mm[None], seen))

    def _shape_frustum(self, handle: viser.CameraFrustumHandle, camera: int, rig: StereoRig | None) -> None:
        handle.scale = 0.16 * self._extent_mm * _UNIT
        if rig is None:
            return
        of: Camera = rig.left if camera == 0 else rig.right
        handle.fov, handle.aspect = 2 * float(np.arctan(of.height_px / 2 / of.fv_px)), of.width_px / of.height_px
        if camera == 1:
            T_left_right = rig.T_right_left.inverse()
            x, y, z, w = T_left_right.quaternion_xyzw
            handle.wxyz, handle.position = np.array([w, x, y, z]), T_left_right.t_mm * _UNIT

    def _draw_place(self, moment: Moment) -> None:
        place = None if moment.advice is None else moment.advice.place_mm
        self._place.visible = self._place_label.visible = place is not None
        if place is not None:
            self._place.position = self._place_label.position = place * _UNIT
            self._place.scale = 1.6 * self._radius_mm * _UNIT

    def _frame_scene(self, clients: Sequence[viser.ClientHandle]) -> None:
        """Look at targets and path over the sensor's shoulder, above the timeline, and put the grid below them.

        Browsers that come later do so too; of those that are there, the ones named.
        """
        path_mm = self._path_mm
        targets = self._targets.xyz_mm[self._targets.state == TargetState.trusted]
        targets = targets if len(targets) > 2 else self._targets.xyz_mm
        middle = targets.mean(axis=0)
        back = path_mm.mean(axis=0) - middle
        if np.linalg.norm(back) < 0.5 * self._extent_mm:  # all around it
            back = path_mm[0] - middle
        back = back / max(float(np.linalg.norm(back)), 1e-9)
        towards = back + 0.8 * np.cross(back, self._axes[1]) - 0.6 * self._axes[1]
        towards /= np.linalg.norm(towards)
        right = np.cross(self._axes[1], towards)
        right /= np.linalg.norm(right)
        down = np.cross(towards, right)
        shown = np.concatenate([targets, path_mm + 0.1 * self._extent_mm * back, path_mm])
        x, y, near = (shown @ axis for axis in (right, down, towards))
        x0, y0 = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
        spread = np.maximum(np.abs(x - x0) / _FREE_WIDTH, np.abs(y - y0) / _FREE_HEIGHT) / np.tan(_FOV_RAD / 2)
        distance = 1.12 * float((spread + near).max() - near.mean())
        lower = (1 - _FREE_HEIGHT) * distance * np.tan(_FOV_RAD / 2)
        self._middle = (x0 * right + (y0 + lower) * down + near.mean() * towards) * _UNIT
        self._eye = self._middle + distance * towards * _UNIT
        camera = self._server.initial_camera
        camera.position, camera.look_at = self._eye, self._middle
        for client in clients:
            client.camera.position, client.camera.look_at = self._eye, self._middle
        below = float(((shown - middle) @ self._axes[1]).max()) + 0.15 * self._extent_mm
        self._grid.position = (middle + below * self._axes[1]) * _UNIT
        self._grid.wxyz = quaternions_wxyz(self._axes.T[None])[0]
        self._grid.cell_size = _round_mm(self._extent_mm / 4) * _UNIT
        self._grid.section_size = 5 * self._grid.cell_size
        self._grid.fade_distance = 4 * distance * _UNIT
        self._grid.visible = "/grid" not in self._hidden


def _metres(mm: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Millimetres as the scene takes them."""
    return np.asarray(mm * _UNIT, dtype=np.float32)


def _both_ends(rgb: UInt8[np.ndarray, "s 3"]) -> UInt8[np.ndarray, "s 2 3"]:
    """Colours of lines, one each; the scene takes these, unlike all others, for amounts of light."""
    light = np.round(255 * (rgb / 255) ** 2.2).astype(np.uint8)
    return np.repeat(light[:, None], 2, axis=1)


def _lines(a_mm: Float[np.ndarray, "m 3"], b_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "s 2 3"]:
    """Lines between one place and many."""
    return np.stack(np.broadcast_arrays(a_mm, b_mm), axis=1)


def _wanted_px(moment: Moment, camera: int) -> Float[np.ndarray, "n 2"]:
    """Where one of the images shows the place at which a target is wanted."""
    place = None if moment.advice is None else moment.advice.place_mm
    if place is None or moment.pose is None or moment.rig is None or len(moment.shots) < 2:
        return _NOTHING
    xyz = moment.pose.inverse().apply(place[None])
    of = moment.rig.left if camera == 0 else moment.rig.right
    uv_px = of.project(xyz if camera == 0 else moment.rig.T_right_left.apply(xyz))
    return np.asarray(uv_px[np.isfinite(uv_px).all(axis=1)])


def _times(magnification: float) -> str:
    return f"× {magnification:,.0f}".replace(",", " ") if magnification else "not shown"


def _round_mm(value: float) -> float:
    """The next power of ten, or half or a fifth of it."""
    power = 10.0 ** np.ceil(np.log10(max(value, 1e-3)))
    return float(min((power, power / 2, power / 5), key=lambda each: abs(each - value)))


def _check_free(host: str, port: int) -> None:
    """Refuses an address where nothing can listen."""
    if not 0 <= port <= 65535:
        raise ViewerError(f"There is no port {port}, expected 1 to 65535, or 0 for any that is free.")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as fault:
        if fault.errno == errno.EADDRINUSE:
            raise ViewerError(_taken(host, port)) from None
        reason = "not an address of this machine" if fault.errno is None or fault.errno < 0 else fault.strerror
        raise ViewerError(
            f"Cannot listen on {host}, port {port} ({reason}); name others with --host, --port."
        ) from None


def _taken(host: str, port: int) -> str:
    return f"Port {port} of {host} is taken; stop what uses it, or name another with --port (0: any that is free)."
