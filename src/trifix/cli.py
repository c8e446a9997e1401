"""The command line: one short function a command, in the order of a working day.

Numerics load when a function first asks for them, so that help and usage errors come at once. What goes wrong is said
in one sentence on stderr. Exit codes: 0 complete, 1 bad input, 2 usage, 130 interrupted.

A command takes ``json: Json = False`` and ends with ``answer(record, json, for_people)``: see ``console.py``.
"""

import math
import os
import shlex
import signal
import stat
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter
from rich.progress import Progress, TaskID
from rich.text import Text

import trifix
from trifix.console import Json, answer, progress_bar, table_of
from trifix.errors import CalibrationError, MapError, RecordingError, TrifixError, ViewerError

app = App(
    name="trifix",
    help="Where is the sensor? Verified poses of a hand-held stereo sensor from identical round targets.",
    version=lambda: f"trifix {trifix.__version__}",
    default_parameter=Parameter(negative=()),
    print_error=False,
    exit_on_error=False,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


def _is_setting(_: object, settings: tuple[str, ...]) -> None:
    for each in settings:
        if "=" not in each:
            raise ValueError(f'"{each}" has no value; write stage.key=value.')


Level = Literal["images", "dots", "points"]
Technique = Literal["index", "frequency", "minimal", "delaunay", "triangles", "hashing", "distances", "icp"]
Out = Annotated[Path, Parameter(name=["--out", "-o"])]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True, show_default=False)]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", validator=_is_setting, show_default=False)]


@app.command(sort_key=0)
def run(
    recording: Path,
    /,
    *,
    out: Out,
    online: bool = False,
    level: Annotated[Level | None, Parameter(name="--from")] = None,
    map_: Annotated[Path | None, Parameter(name="--map")] = None,
    map_mode: Literal["frozen", "grow"] | None = None,
    polarity: Literal["auto", "dark", "bright"] | None = None,
    paper: bool = False,
    identify: Technique | None = None,
    verify: Literal["probability", "residual"] | None = None,
    update: Literal["joint", "kalman", "mean"] | None = None,
    frame_triangles: Literal["auto", "all", "local"] | None = None,
    sigma_px: float | None = None,
    target_diameter_mm: float | None = None,
    no_adjust: bool = False,
    refine_rig: bool = False,
    scale_bars: Path | None = None,
    control: Path | None = None,
    config: Path | None = None,
    settings: Settings = (),
    json: Json = False,
) -> None:
    """Position every frame of a recording.

    Args:
        recording: Folder of the recording.
        out: Folder for the results.
        online: Judge every frame by what was known at its time, and never rewrite a row.
        level: Begin with images, dots or points; without it, with the richest that the recording holds.
        map_: CSV file of targets known beforehand; its coordinates become the world's.
        map_mode: Leave the given map as it is (frozen, the default), or let it grow by what else stands still.
        polarity: Brightness of the targets against what surrounds them.
        paper: Judge frames as in the paper: by one tolerance and residuals alone, online; begin with its options
            instead of a file's.
        identify: Technique by which points are matched to the map.
        verify: Believe a pose that cannot be chance, or whose residuals are small.
        update: Average the sightings of all targets together, of each by their covariances, or of each all alike.
        frame_triangles: Look at all triangles of a frame, or at those between neighbours.
        sigma_px: Standard deviation of a dot's centre to start from, where the recording states none (px); 0.3 unless
            an option says otherwise.
        target_diameter_mm: Diameter of the targets (mm); pairs of dots that are not that large are left out.
        no_adjust: Leave poses and targets as each frame by itself gave them, not adjusted all together in the end.
        refine_rig: Adjust the calibration as well, and write it as calibration.yaml.
        scale_bars: CSV file of known distances, target_a,target_b,length_mm,sigma_mm; the targets' ids are those of the
            map.csv of an earlier run of the same recording.
        control: CSV file of targets whose places are known, id,x_mm,y_mm,z_mm; its coordinates become the world's.
        config: TOML file of options; `trifix config` prints one.
        settings: An option by its full name, such as match.max_depth_mm=900; may be repeated.
    """
    if map_ is None and map_mode is not None:
        raise CycloptsError(msg="--map-mode says what becomes of a given map: name it with --map.")
    if paper and config is not None:
        raise CycloptsError(msg="--paper begins with the paper's options and --config with a file's: choose one.")
    options = _options(
        config,
        settings,
        {
            "detect.polarity": polarity,
            "identify.technique": identify,
            "identify.frame_triangles": frame_triangles,
            "noise.sigma_px": sigma_px,
            "match.target_diameter_mm": target_diameter_mm,
            "verify.method": verify,
            "update.method": update,
            "adjust.adjusts": "false" if no_adjust else None,
            "adjust.refines_rig": "true" if refine_rig else None,
        },
        is_paper=paper,
    )
    asked = {"--refine-rig": options.adjust.refines_rig, "--scale-bars": scale_bars, "--control": control}
    for name in (name for name, value in asked.items() if value and (online or paper or not options.adjust.adjusts)):
        raise CycloptsError(msg=f"{name} needs the adjustment of the whole recording, which was left out.")
    if map_ is not None and control is not None:
        raise CycloptsError(msg="--map and --control both say what the world is: choose one.")
    given = None if map_ is None else _read_map(map_)
    constraints = trifix.Constraints(
        given,
        control=None if control is None else trifix.read_control(control),
        lengths=() if scale_bars is None else trifix.read_scale_bars(scale_bars),
    )
    frames = trifix.read_recording(recording, level, options.noise.sigma_px)
    if options.adjust.refines_rig and (frames.level == "points" or frames.rigs):
        what = "points only" if frames.level == "points" else "a rig for each frame"
        raise CalibrationError(f"{recording} has {what}: a rig is refined where one saw the dots of all frames.")
    is_map_frozen = given is not None and map_mode != "grow"
    _position(frames, out, options, json, constraints, is_map_frozen, is_online=online or paper)


@app.command(sort_key=1)
def live(
    *,
    out: Out,
    left: str | None = None,
    right: str | None = None,
    side_by_side: str | None = None,
    calibration: Path | None = None,
    max_skew_ms: float = 10.0,
    replay: Path | None = None,
    speed: float | Literal["max"] = 1.0,
    level: Annotated[Level | None, Parameter(name="--from")] = None,
    maps: Annotated[tuple[Path, ...], Parameter(name="--map", show_default=False)] = (),
    map_mode: Literal["frozen", "grow"] | None = None,
    publish: str | None = None,
    viewer: Annotated[bool, Parameter(negative="--no-viewer")] = True,
    port: int = 8080,
    config: Path | None = None,
    settings: Settings = (),
    json: Json = False,
) -> None:
    """Position what cameras see, as it comes; ctrl-C ends the run.

    A camera is a number, a URL, a GStreamer pipeline (in quotes) or a video file.

    Args:
        out: Folder for the results; with several maps, each has a folder in it.
        left: The left camera.
        right: The right camera.
        side_by_side: One camera that delivers both images beside one another.
        calibration: File of the cameras' calibration.
        max_skew_ms: A pair of images is refused if they were taken further apart (ms).
        replay: Folder of a recording to play in place of cameras.
        speed: How many times as fast as it was recorded; max leaves out no frame and waits for none.
        level: Begin with images, dots or points of the recording.
        maps: CSV file of a body's targets; may be repeated, and each body has a pose of its own.
        map_mode: Leave given maps as they are (frozen, the default), or let them grow by what else stands still.
        publish: Send a datagram a frame to udp://HOST:PORT; without a HOST, to this machine.
        viewer: Show the run in a browser.
        port: Port at which this machine's browser finds it, 0 for any that is free; of further bodies, the next ones.
        config: TOML file of options; `trifix config` prints one.
        settings: An option by its full name, such as match.max_depth_mm=900; may be repeated.
    """
    if [left is not None or right is not None, side_by_side is not None, replay is not None].count(True) != 1:
        raise CycloptsError(msg="Name either two cameras (--left, --right), or one (--side-by-side), or a --replay.")
    if (left is None) != (right is None):
        raise CycloptsError(msg="Name both cameras, --left and --right.")
    if (replay is None) != (calibration is not None):
        raise CycloptsError(msg="Cameras need a --calibration; a recording has its own.")
    if not maps and map_mode is not None:
        raise CycloptsError(msg="--map-mode says what becomes of a given map: name it with --map.")
    if speed != "max" and not 0 < speed < math.inf:
        raise CycloptsError(msg="--speed must be positive and finite, or max.")
    if max_skew_ms < 0:
        raise CycloptsError(msg="--max-skew-ms must not be negative.")
    options = _options(config, settings)
    given = _bodies(maps)
    source: trifix.Replay | trifix.CameraFrames
    if replay is not None:
        recording = trifix.read_recording(replay, level, options.noise.sigma_px)
        source = trifix.Replay(recording, math.inf if speed == "max" else speed)
        name, begins_with, is_noise_stated = recording.path.resolve().name, recording.level, recording.is_noise_stated
    else:
        assert calibration is not None, "asked before"
        source = _cameras(left, right, side_by_side, calibration, max_skew_ms)
        name, begins_with, is_noise_stated = "live", "images", False
    bodies = {
        body: trifix.Positioner(options, map, map is not None and map_mode != "grow", is_noise_stated)
        for body, map in given.items()
    }
    folders = {body: out / body if len(bodies) > 1 else out for body in bodies}
    _run_live(source, bodies, folders, name, begins_with, publish, port if viewer else None, speed == "max", json)


def _bodies(maps: tuple[Path, ...]) -> "dict[str, trifix.ReferenceMap | None]":
    """The map of each body, by its name; a single body without a map has none."""
    given: dict[str, trifix.ReferenceMap | None] = {}
    for path in maps:
        name = path.stem if path.stem != "map" else path.resolve().parent.name  # as `trifix run` calls them all
        if name in given:
            raise MapError(f"{path}: another map is called {name} as well; give the file another name.")
        given[name] = _read_map(path)
    return given or {"": None}


def _cameras(
    left: str | None, right: str | None, side_by_side: str | None, calibration: Path, max_skew_ms: float
) -> "trifix.CameraFrames":
    from trifix.files.calibrations import read_rig
    from trifix.sources.cameras import CameraFrames, SideBySide, TwoCameras, VideoCamera

    rig = read_rig(calibration)
    width, height = rig.left.width_px, rig.left.height_px
    if side_by_side is not None:
        return CameraFrames(SideBySide(VideoCamera(side_by_side, (width + rig.right.width_px, height))), rig)
    assert left is not None, "asked before"
    assert right is not None, "asked before"
    cameras = VideoCamera(left, (width, height)), VideoCamera(right, (rig.right.width_px, rig.right.height_px))
    return CameraFrames(TwoCameras(*cameras, max_skew_ms), rig)


@app.command(sort_key=1)
def simulate(
    scene: str,
    /,
    *,
    out: Out,
    level: Level = "dots",
    seed: int = 0,
    frames: int | None = None,
    json: Json = False,
) -> None:
    """Make a recording whose truth is known.

    Args:
        scene: Name of the scene; a wrong one lists them all.
        out: Folder for the recording and its truth.
        level: What to record.
        seed: Another seed makes another recording of the same scene.
        frames: Number of frames; without it, the scene's own.
    """
    _simulate(scene, out, level, seed, frames)
    made = {"recording": out / "recording", "truth": out / "truth"}
    answer({"scene": scene, "level": level, "seed": seed, **made}, json, lambda: None)


@app.command(sort_key=2)
def calibrate(
    recording: Path,
    /,
    *,
    out: Out,
    target: Literal["chessboard", "charuco", "dots"],
    columns: int = 0,
    rows: int = 0,
    square_mm: float | None = None,
    marker_mm: float | None = None,
    dictionary: str = "DICT_4X4_50",
    pitch_mm: float | None = None,
    rings: bool = False,
    model: Literal["radtan", "equidistant"] = "radtan",
    every: int = 1,
    keep_all: bool = False,
    json: Json = False,
) -> None:
    """Calibrate the sensor from a recording of a board.

    Args:
        recording: Folder with the images of both cameras; a calibration.yaml in it is not read.
        out: Folder for calibration.yaml, calibration.json and the page calibration.html.
        target: What is on the board.
        columns: Inner corners in a row (one fewer than squares), or dots in a row.
        rows: Inner corners in a column, or dots in a column.
        square_mm: Side of a square of a chessboard or ChArUco board (mm).
        marker_mm: Side of a marker of a ChArUco board (mm).
        dictionary: OpenCV's name of the ChArUco markers' dictionary.
        pitch_mm: Distance between the centres of neighbouring dots (mm).
        rings: Three dots are rings, one at a corner, one in its row and one in its column; the grid may then reach
            beyond the images, and columns and rows need not be told.
        model: Distortion model of both cameras.
        every: Look at every so many pairs; for videos.
        keep_all: Give views a say whose residuals stand out.
    """
    length_mm, name = (pitch_mm, "--pitch-mm") if target == "dots" else (square_mm, "--square-mm")
    is_counted = target == "dots" and rings
    missing = [
        name
        for name, is_there in (
            (name, length_mm is not None),
            ("--columns", columns or is_counted),
            ("--rows", rows or is_counted),
            ("--marker-mm", marker_mm is not None or target != "charuco"),
        )
        if not is_there
    ]
    if missing:
        raise CycloptsError(msg=f"--target {target} needs {' and '.join(missing)}.")
    if rings and target != "dots":
        raise CycloptsError(msg="--rings says that three dots are rings: it goes with --target dots.")
    if every < 1:
        raise CycloptsError(msg="--every must be at least 1.")
    from trifix.boards import Board, find_views
    from trifix.calibration import calibrate as solve
    from trifix.files.images import read_image_pairs
    from trifix.outputs.calibrations import calibration_table, record_of, summarise, write_calibration

    board = Board(target, length_mm or 0.0, columns, rows, marker_mm or 0.0, dictionary, rings)
    if not recording.is_dir():
        raise RecordingError(f"{recording} is not a folder, expected a recording of images.")
    pairs = read_image_pairs(recording)
    with progress_bar("pairs") as progress:
        task = progress.add_task("looking")
        search = find_views(pairs, board, every, lambda done, of: progress.update(task, completed=done, total=of))
    found = solve(search.views, board.pitch_mm, search.left_size_px, search.right_size_px, model, not keep_all)
    summary = summarise(found, search, board, recording.resolve().name)
    write_calibration(found, summary, out)
    answer(record_of(summary, out), json, lambda: calibration_table(summary, out))


@app.command(sort_key=2)
def demo(*, out: Out = Path("demo"), json: Json = False) -> None:
    """Simulate a small recording as images, position it and report on it.

    Args:
        out: Folder for everything.
    """
    if not (out / "truth").is_dir():  # written last: an earlier demo's recording is whole, and would be the same
        _simulate("demo", out, "images")
    _position(trifix.read_recording(out / "recording"), out / "results", trifix.Config(), json)


@app.command(sort_key=3)
def evaluate(
    results: Path, truth: Path, /, *, wrong_mm: float = 3.0, wrong_deg: float = 0.5, json: Json = False
) -> None:
    """Compare results with the truth.

    Args:
        results: Folder that `trifix run` wrote.
        truth: Folder of the truth.
        wrong_mm: A pose further off than this is wrong (mm).
        wrong_deg: A pose turned by more than this is wrong (degrees).
    """
    if not (0 < wrong_mm < math.inf and 0 < wrong_deg < math.inf):
        raise CycloptsError(msg="--wrong-mm and --wrong-deg must be positive and finite.")
    from trifix.evaluation import table

    found = trifix.evaluate(results, truth, wrong_mm=wrong_mm, wrong_deg=wrong_deg)
    answer(found, json, lambda: table_of(table(found)))


@app.command(sort_key=3)
def compare(
    first: Path,
    second: Path,
    /,
    *,
    page: Annotated[Path | None, Parameter(name=["--out", "-o"])] = None,
    json: Json = False,
) -> None:
    """Show two runs of one recording side by side.

    Args:
        first: Folder that `trifix run` wrote.
        second: Another of the same recording.
        page: HTML file to write, with the figures side by side.
    """
    from trifix.outputs.comparison import compare_runs, comparison_table, read_run, write_comparison

    runs = read_run(first), read_run(second)
    found = compare_runs(*runs)
    if page is not None:
        write_comparison(found, *runs, page)
    answer({**asdict(found), "page": page}, json, lambda: comparison_table(found))


@app.command(sort_key=3)
def view(
    results: Path,
    /,
    *,
    recording: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    json: Json = False,
) -> None:
    """Go through a finished run in the browser: frame by frame, its refusals, its targets' sightings.

    Args:
        results: Folder that `trifix run` wrote.
        recording: Folder of the recording, for its images; without it, one of the right name beside the results.
        host: Address to listen on; at the default, only this machine sees the page.
        port: Port to listen on; 0 is any that is free.
    """
    from trifix.outputs.viewer import open_run, who_can_see

    viewer, run = open_run(results, recording, host, port)
    if warning := who_can_see(host):
        print(f"trifix: {warning}", file=sys.stderr)
    if not run.is_finished:
        print(f"trifix: the run in {results} did not reach its end; what it left is shown.", file=sys.stderr)
    answer({"url": viewer.url, "finished": run.is_finished}, json, lambda: f"{viewer.url}  (ctrl-C ends it)")
    sys.stdout.flush()
    with suppress(KeyboardInterrupt):
        threading.Event().wait()
    viewer.close()


experiment = App(name="experiment", help="Repeat the paper's experiments on simulated recordings.", sort_key=4)
app.command(experiment)


@experiment.command
def paper(
    *,
    out: Out,
    scenes: Names = (),
    techniques: Names = (),
    frames: int | None = None,
    seed: int = 0,
    workers: int = 2,
    json: Json = False,
) -> None:
    """Try every technique of the paper on its scenes, and show what comes out beside the paper's numbers.

    What is finished is kept: after an interrupt, the same command goes on where it was.

    Args:
        out: Folder for the page, its figures and tables, and the parts of which they are made.
        scenes: Names of scenes; without any, the paper's five.
        techniques: Names of techniques; without any, all of them.
        frames: Number of frames of each scene; without it, the scene's own.
        seed: Another seed makes other recordings of the same scenes.
        workers: Processes to work side by side.
    """
    from trifix.experiments.page import claims, claims_table, write_experiment
    from trifix.experiments.paper import SCENES, TECHNIQUES, run_paper

    with ExitStack() as bars:
        progress = progress_bar()
        tasks: dict[str, TaskID] = {}

        def show(part: str, done: int, of: int) -> None:
            if not progress.live.is_started:
                bars.enter_context(progress)
            if part not in tasks:
                tasks[part] = progress.add_task(part, total=of)
            progress.update(tasks[part], completed=done, visible=done < of)

        parts = run_paper(out, scenes or SCENES, techniques or TECHNIQUES, frames, seed, show, workers)
    page = write_experiment(parts, out, shlex.join(["trifix", *sys.argv[1:]]))
    misidentified = sum(len(part.misidentified) for part in parts)
    record = {"claims": claims(parts), "misidentified": misidentified, "page": page}
    answer(record, json, lambda: claims_table(parts, page))


@app.command(sort_key=5)
def acceptance(
    *,
    out: Out,
    recordings: int = 2,
    seed: int = 1,
    frames: int = 800,
    bars: Literal[0, 1, 2] = 2,
    limit_mm: float = 0.015,
    limit_mm_per_m: float = 0.015,
    json: Json = False,
) -> None:
    """Measure the test lengths of a simulated artefact: a virtual acceptance test after VDI/VDE 2634 part 1.

    Args:
        out: Folder for the page, the figure and the table of lengths.
        recordings: Recordings to simulate, each of another hand and other noise.
        seed: Of the first of them; the others follow.
        frames: Number of frames of each.
        bars: Scale bars to use.
        limit_mm: Error that is permitted to any length (mm).
        limit_mm_per_m: What is permitted besides, per metre of length (mm).
    """
    import numpy as np

    from trifix.experiments.acceptance import Limit, run_acceptance
    from trifix.experiments.acceptance_page import acceptance_rows, write_acceptance

    if min(recordings, frames) < 1 or seed < 0 or not 0 < limit_mm < math.inf or not 0 <= limit_mm_per_m < math.inf:
        raise CycloptsError(msg="--recordings and --frames must be at least 1, --seed and the limits not negative.")
    with progress_bar() as progress:
        tasks: dict[str, TaskID] = {}

        def show(part: str, done: int, of: int) -> None:
            if part not in tasks:
                tasks[part] = progress.add_task(part, total=of)
            progress.update(tasks[part], completed=done)

        seeds = np.arange(seed, seed + recordings)
        found = run_acceptance(seeds, frames, bars, Limit(limit_mm, limit_mm_per_m), show=show)
    page = write_acceptance(found, out, shlex.join(["trifix", *sys.argv[1:]]))
    record = {
        "lengths": found.lengths,
        "limit": found.limit,
        "exceeding": found.exceeding,
        "missing": found.missing,
        "largest_mm": found.largest_mm,
        "normalised_rms": found.normalised_rms,
        "page": page,
    }
    answer(record, json, lambda: table_of([*acceptance_rows(found), ("page", str(page))]))


@app.command(sort_key=6)
def config(*, config: Path | None = None, settings: Settings = (), json: Json = False) -> None:
    """Print the options in effect, each with its meaning, as TOML.

    Args:
        config: TOML file of options.
        settings: An option by its full name, such as match.max_depth_mm=900; may be repeated.
    """
    from trifix.config import to_toml

    options = to_toml(_options(config, settings))
    answer(tomllib.loads(options), json, lambda: print(options, end=""))


@app.command(sort_key=7)
def warmup(*, json: Json = False) -> None:
    """Compile the inner loops, once for this machine, so that the first frame need not wait for it."""
    names = _compile()
    answer({"modules": names}, json, lambda: None)


def _compile() -> list[str]:
    import pkgutil

    from trifix import kernels

    names = [f"{kernels.__name__}.{module.name}" for module in pkgutil.iter_modules(kernels.__path__)]
    with progress_bar("modules") as progress:
        for name in progress.track(names, description="compiling"):
            import_module(name).warm_up()
    return names


_REFRESH_S = 0.1
_INTERRUPTED = "interrupted; what was finished until then is whole."


def main() -> None:
    """Run the command line and leave with its exit code."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as ctrl-C: finished results stay whole
    _find_room_for_compiled_code()
    try:
        app(sys.argv[1:])
        sys.stdout.flush()
    except CycloptsError as error:
        _leave(str(error), 2)
    except TrifixError as error:
        _leave(str(error), 1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains as it ends
        _leave("whoever read the output has gone, so not all of it was printed.", 1)
    except OSError as error:
        _leave(f"{error.filename}: {error.strerror}." if error.filename else f"{error}.", 1)
    except KeyboardInterrupt:
        _leave(_INTERRUPTED, 130)
    except SystemError as error:  # what an interrupt inside compiled code looks like
        if not _comes_of_interrupt(error):
            raise
        _leave(_INTERRUPTED, 130)


def _comes_of_interrupt(error: BaseException | None) -> bool:
    return error is not None and (
        isinstance(error, KeyboardInterrupt)
        or _comes_of_interrupt(error.__cause__)
        or _comes_of_interrupt(error.__context__)
    )


def _find_room_for_compiled_code() -> None:
    """Names a folder of this user among the temporary ones where neither the package's nor the user's can be written.

    Only a folder that nobody else can write: what is read from it is run.
    """
    kernels = Path(trifix.__file__).parent / "kernels" / "__pycache__"
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"))
    if "NUMBA_CACHE_DIR" in os.environ or _can_be_written(kernels) or _can_be_written(_at_home(cache)):
        return
    import tempfile

    room = Path(tempfile.gettempdir()) / f"trifix-{os.getuid()}"
    try:
        room.mkdir(mode=0o700, exist_ok=True)
        found = room.lstat()
        is_ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    except FileExistsError:
        is_ours = False
    os.environ["NUMBA_CACHE_DIR"] = str(room) if is_ours else tempfile.mkdtemp(prefix="trifix-")


def _at_home(path: Path) -> Path:
    return Path(os.path.expanduser(path))  # noqa: PTH111  (Path.expanduser fails for a user without a home)


def _can_be_written(folder: Path) -> bool:
    """Whether files can be made in a folder, or the folder itself where it does not exist."""
    nearest = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def _leave(sentence: str, code: int) -> None:
    print(f"trifix: {sentence}", file=sys.stderr)
    sys.exit(code)


def _options(
    file: Path | None,
    settings: tuple[str, ...],
    shorthands: dict[str, object] | None = None,
    is_paper: bool = False,
) -> "trifix.Config":
    """The options of a file, the paper's or the defaults, with what was said on the command line in their place."""
    from trifix.config import paper_options, with_overrides

    given = {key: str(value) for key, value in (shorthands or {}).items() if value is not None}
    for each in settings:
        key, value = each.split("=", 1)
        given[key.strip()] = value.strip()
    start = paper_options() if is_paper else trifix.read_config(file) if file else trifix.Config()
    return with_overrides(start, given)


def _read_map(path: Path) -> "trifix.ReferenceMap":
    """The map in a file, which must hold something."""
    given = trifix.read_map(path)
    if not len(given):
        raise MapError(f"{path}: found no target, expected at least three; choose another map or none.")
    return given


def _simulate(scene: str, out: Path, level: Level, seed: int = 0, frames: int | None = None) -> None:
    """Make a recording; the bar appears with its first frame, so that a refusal stands alone."""
    progress = progress_bar()
    task = progress.add_task("simulating")
    with ExitStack() as bar:

        def show(done: int, of: int) -> None:
            if not progress.live.is_started:
                bar.enter_context(progress)
            progress.update(task, completed=done, total=of)

        trifix.simulate(scene, out, level, seed, frames, show)


def _position(
    recording: "trifix.Recording",
    out: Path,
    options: "trifix.Config",
    json: bool,
    constraints: "trifix.Constraints | None" = None,
    is_map_frozen: bool = False,
    is_online: bool = False,
) -> None:
    """Judge every frame, write down what was found, and say what it amounts to."""
    from trifix.config import to_toml
    from trifix.files.calibrations import write_rig
    from trifix.outputs.terminal import summary_table

    given = None if constraints is None else constraints.given
    positioner = trifix.Positioner(options, given, is_map_frozen)
    report = trifix.Report()
    adjusted: trifix.Adjusted | trifix.NotAdjusted | None = None
    fault: MapError | None = None
    final: Sequence[trifix.Step] = ()
    with (
        trifix.ResultsWriter(
            out, recording.path.resolve().name, recording.level, to_toml(options), is_online
        ) as results,
        progress_bar() as progress,
    ):
        with _between_frames() as stop_if_told:
            judged, is_doubt_told = [], False
            for step in progress.track(positioner.run(recording), len(recording), description="positioning"):
                results.write(step)
                if results.doubt and not is_doubt_told:
                    is_doubt_told = True
                    progress.console.print(Text(results.doubt, "yellow"))
                stop_if_told()
                if is_online:
                    report.show(step)
                else:
                    judged.append(step.remembered())
            if not is_online:
                results.start_over()
                revised = list[trifix.Step]()
                for step in progress.track(positioner.revise(judged), len(recording), description="revising"):
                    results.write(step)
                    revised.append(replace(step, identification=None))
                    stop_if_told()
                final = revised
                if options.adjust.adjusts:
                    results.start_over()  # what has been found stands, whatever becomes of the adjustment
                    known = options, constraints or trifix.Constraints(), recording.is_noise_stated
                    final, adjusted, fault = _adjusted(revised, *known, progress, stop_if_told)
                    for step in final:
                        results.write(step)
                again = zip(recording, final, strict=True)
                for frame, step in progress.track(again, len(recording), description="reporting"):
                    report.show(replace(step, frame=replace(frame, rig=step.frame.rig)))  # with its images
                    stop_if_told()
        summary = results.finish(adjusted)
    rig = final[0].frame.rig if final else None
    if rig is not None and isinstance(adjusted, trifix.Adjusted) and adjusted.rig_change:
        write_rig(rig, out / "calibration.yaml")
    page = out / "report.html"
    report.write(page, summary)
    answer({**asdict(summary), "report": page}, json, lambda: summary_table(summary, page))
    if fault is not None:
        raise fault


def _adjusted(
    steps: "Sequence[trifix.Step]",
    options: "trifix.Config",
    constraints: "trifix.Constraints",
    is_noise_stated: bool,
    progress: Progress,
    stop_if_told: Callable[[], None],
) -> "tuple[Sequence[trifix.Step], trifix.Adjusted | trifix.NotAdjusted, MapError | None]":
    """The steps adjusted together, what came of it, and the fault in what was given that is told when all is done."""
    task = progress.add_task("adjusting", total=None, unit="steps")

    def watch() -> None:
        progress.advance(task)
        stop_if_told()

    try:
        final, adjusted = trifix.adjust_steps(steps, options, constraints, is_noise_stated=is_noise_stated, watch=watch)
        fault = None
    except MapError as error:
        final, adjusted, fault = steps, trifix.NotAdjusted(str(error)), error
    progress.update(task, total=progress.tasks[task].completed)
    return final, adjusted, fault


def _run_live(
    source: "trifix.Replay | trifix.CameraFrames",
    bodies: "dict[str, trifix.Positioner]",
    folders: dict[str, Path],
    name: str,
    level: Level,
    publish: str | None,
    port: int | None,
    is_lossless: bool,
    json: bool,
) -> None:
    """Judge frames as they come until their source or the operator ends it, and say what it amounts to."""
    from rich.console import Console, Group
    from rich.live import Live as Display

    from trifix.config import to_toml
    from trifix.live import Live, Rates, Viewer
    from trifix.outputs.publish import Publisher
    from trifix.outputs.terminal import live_lines, summary_table

    if not is_lossless:
        _compile()
    with ExitStack() as open_things:
        viewers: dict[str, Viewer] = {}
        if port is not None:
            try:
                from trifix.outputs.viewer import Viewer as Page

                for k, body in enumerate(bodies):
                    page = open_things.enter_context(closing(Page(port=port + k if port else 0, title=body or name)))
                    viewers[body] = page
                    print(f"{body or 'viewer'}  {page.url}", file=sys.stderr)
            except ViewerError as error:
                raise ViewerError(f"{error} Without a viewer: --no-viewer.") from error
        publisher = None
        if publish is not None:
            publisher = open_things.enter_context(closing(Publisher(publish)))
        reports, doubts = {body: trifix.Report() for body in bodies}, set[str]()
        results = {
            body: open_things.enter_context(
                trifix.ResultsWriter(folders[body], name, level, to_toml(positioner.config), is_online=True)
            )
            for body, positioner in bodies.items()
        }

        def watch(body: str, step: trifix.Step, rates: Rates) -> None:
            if publisher is not None:
                publisher.send(body, step, rates)
            results[body].write(step, rates.dropped)
            reports[body].show(step)

        stopped = _told_to_stop(open_things)
        run = Live(bodies, [watch], viewers, is_lossless)
        run.follow(source)
        console = Console(stderr=True)
        with Display(console=console, auto_refresh=False) as display:
            is_over = False
            while not is_over:
                is_over = run.wait(_REFRESH_S)
                for doubt in {each.doubt for each in results.values()} - doubts - {""}:
                    doubts.add(doubt)
                    console.print(Text(doubt, "yellow"))
                display.update(live_lines({body: run.status(body) for body in bodies}), refresh=True)
                if stopped():
                    run.stop()
        if not console.is_terminal:
            console.line()
        if stopped() and isinstance(source, trifix.Replay):
            raise KeyboardInterrupt  # the recording goes on; cameras end when they are told to
        summaries = {body: each.finish() for body, each in results.items()}
    pages = {body: folder / "report.html" for body, folder in folders.items()}
    for body, summary in summaries.items():
        reports[body].write(pages[body], summary)
    found = {body: {**asdict(summary), "report": pages[body]} for body, summary in summaries.items()}
    answer(
        found if len(found) > 1 else found[next(iter(found))],
        json,
        lambda: Group(*(summary_table(summary, pages[body]) for body, summary in summaries.items())),
    )


def _told_to_stop(restored: ExitStack) -> Callable[[], bool]:
    """Whether an interrupt has come since; a second one interrupts."""
    told: list[int] = []

    def note(number: int, frame: object) -> None:
        told.append(number)
        if len(told) > 1:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        restored.callback(signal.signal, number, signal.signal(number, note))
    return lambda: bool(told)


@contextmanager
def _between_frames() -> Iterator[Callable[[], None]]:
    """Lets an interrupt wait for the end of a frame, as compiled code does not survive one; a second does not wait."""
    told: list[int] = []

    def note(number: int, frame: object) -> None:
        told.append(number)
        if len(told) > 1:  # an exception would end in the middle of compiled code, print in that of a line
            cursor = "\x1b[?25h\n" if os.isatty(2) else ""  # which the progress bar hides
            os.write(2, f"{cursor}trifix: {_INTERRUPTED}\n".encode())
            os._exit(130)

    def stop_if_told() -> None:
        if told:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop_if_told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
