"""The command line: one short function a command, in the order of a working day.

Numerics load when a function first asks for them, so that help and usage errors come at once. What goes wrong is said
in one sentence on stderr. Exit codes: 0 complete, 1 bad input, 2 usage, 130 interrupted.

A command takes ``json: Json = False`` and ends with ``answer(record, json, for_people)``: see ``console.py``. What a
run does between its options and its answer is in ``running.py``.
"""

import math
import os
import shlex
import signal
import sys
import threading
import tomllib
from contextlib import suppress
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

import trifix
from trifix.compiled import compile_all, find_room
from trifix.console import Json, answer, progress_bars, table_of
from trifix.errors import CalibrationError, MapError, RecordingError, TrifixError
from trifix.interrupts import INTERRUPTED, comes_of_interrupt

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
_place = count()  # of the next command in the list of them all


def _is_setting(_: object, settings: tuple[str, ...]) -> None:
    for each in settings:
        if "=" not in each:
            raise ValueError(f'"{each}" has no value; write stage.key=value.')


Level = Literal["images", "dots", "points"]
Technique = Literal["index", "frequency", "minimal", "delaunay", "triangles", "hashing", "distances", "icp"]
Out = Annotated[Path, Parameter(name=["--out", "-o"])]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True, show_default=False)]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", validator=_is_setting, show_default=False)]


@app.command(sort_key=next(_place))
def demo(*, out: Out = Path("demo"), json: Json = False) -> None:
    """Simulate a small recording as images, position it and report on it.

    Args:
        out: Folder for everything.
    """
    from trifix.running import run_recording

    if not (out / "truth").is_dir():  # written last: an earlier demo's recording is whole, and would be the same
        _simulate("demo", out, "images")
    run_recording(trifix.read_recording(out / "recording"), out / "results", trifix.Config(), json)


@app.command(sort_key=next(_place))
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
    _refuse_if(
        map_ is None and map_mode is not None, "--map-mode says what becomes of a given map: name it with --map."
    )
    _refuse_if(
        paper and config is not None, "--paper begins with the paper's options and --config with a file's: choose one."
    )
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
    _refuse_if(map_ is not None and control is not None, "--map and --control both say what the world is: choose one.")
    constraints = trifix.Constraints(
        None if map_ is None else _read_map(map_),
        control=None if control is None else trifix.read_control(control),
        lengths=() if scale_bars is None else trifix.read_scale_bars(scale_bars),
    )
    frames = trifix.read_recording(recording, level, options.noise.sigma_px)
    if options.adjust.refines_rig and (frames.level == "points" or frames.rigs):
        what = "points only" if frames.level == "points" else "a rig for each frame"
        raise CalibrationError(f"{recording} has {what}: a rig is refined where one saw the dots of all frames.")
    from trifix.running import run_recording

    is_map_frozen = map_ is not None and map_mode != "grow"
    run_recording(frames, out, options, json, constraints, is_map_frozen, is_online=online or paper)


@app.command(sort_key=next(_place))
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
    _refuse_if(
        [left is not None or right is not None, side_by_side is not None, replay is not None].count(True) != 1,
        "Name either two cameras (--left, --right), or one (--side-by-side), or a --replay.",
    )
    _refuse_if((left is None) != (right is None), "Name both cameras, --left and --right.")
    _refuse_if((replay is None) != (calibration is not None), "Cameras need a --calibration; a recording has its own.")
    _refuse_if(not maps and map_mode is not None, "--map-mode says what becomes of a given map: name it with --map.")
    _refuse_if(speed != "max" and not 0 < speed < math.inf, "--speed must be positive and finite, or max.")
    _refuse_if(max_skew_ms < 0, "--max-skew-ms must not be negative.")
    options = _options(config, settings)
    given = _bodies(maps)
    from trifix.running import run_live

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
    run_live(source, bodies, out, name, begins_with, publish, port if viewer else None, speed == "max", json)


@app.command(sort_key=next(_place))
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


@app.command(sort_key=next(_place))
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
    from trifix.outputs.comparison import compare_runs, comparison_table, write_comparison
    from trifix.outputs.runs import read_run

    runs = read_run(first), read_run(second)
    found = compare_runs(*runs)
    if page is not None:
        write_comparison(found, *runs, page)
    answer({**asdict(found), "page": page}, json, lambda: comparison_table(found))


@app.command(sort_key=next(_place))
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
    _refuse_if(
        not (0 < wrong_mm < math.inf and 0 < wrong_deg < math.inf),
        "--wrong-mm and --wrong-deg must be positive and finite.",
    )
    from trifix.evaluation import table

    found = trifix.evaluate(results, truth, wrong_mm=wrong_mm, wrong_deg=wrong_deg)
    answer(found, json, lambda: table_of(table(found)))


@app.command(sort_key=next(_place))
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
    board_sigma_mm: float | None = None,
    pitch_sigma: float = 1e-4,
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
        board_sigma_mm: By how much points of the board may be out of place, per coordinate (mm, one sigma). What the
            residuals tell, if not given; 0 for a board without errors.
        pitch_sigma: How well the side or the pitch is known, relative (one sigma).
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
    _refuse_if(rings and target != "dots", "--rings says that three dots are rings: it goes with --target dots.")
    _refuse_if(every < 1, "--every must be at least 1.")
    for name, sigma in (("--board-sigma-mm", board_sigma_mm or 0.0), ("--pitch-sigma", pitch_sigma)):
        _refuse_if(not 0.0 <= sigma < float("inf"), f"{name} is {sigma:g}, expected 0 or more.")
    from trifix.boards import Board, find_views
    from trifix.calibration import calibrate as solve
    from trifix.files.images import read_image_pairs
    from trifix.outputs.calibrations import calibration_table, record_of, summarise, write_calibration

    board = Board(target, length_mm or 0.0, columns, rows, marker_mm or 0.0, dictionary, rings)
    if not recording.is_dir():
        raise RecordingError(f"{recording} is not a folder, expected a recording of images.")
    pairs = read_image_pairs(recording)
    with progress_bars("pairs") as show:
        search = find_views(pairs, board, every, lambda done, of: show("looking", done, of))
    found = solve(
        search.views, board.pitch_mm, search.left_size_px, search.right_size_px, model, not keep_all, board_sigma_mm,
        pitch_sigma,
    )  # fmt: skip
    summary = summarise(found, search, board, recording.resolve().name)
    write_calibration(found, summary, out)
    answer(record_of(summary, out), json, lambda: calibration_table(summary, out))


@app.command(sort_key=next(_place))
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


@app.command(sort_key=next(_place))
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

    _refuse_if(
        min(recordings, frames) < 1 or seed < 0 or not 0 < limit_mm < math.inf or not 0 <= limit_mm_per_m < math.inf,
        "--recordings and --frames must be at least 1, --seed and the limits not negative.",
    )
    seeds, limit = np.arange(seed, seed + recordings), Limit(limit_mm, limit_mm_per_m)
    with progress_bars() as show:
        found = run_acceptance(seeds, frames, bars, limit, show=show)
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


experiment = App(
    name="experiment", help="Repeat the paper's experiments on simulated recordings.", sort_key=next(_place)
)
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

    with progress_bars(keeps_finished=False) as show:
        parts = run_paper(out, scenes or SCENES, techniques or TECHNIQUES, frames, seed, show, workers)
    page = write_experiment(parts, out, shlex.join(["trifix", *sys.argv[1:]]))
    misidentified = sum(len(part.misidentified) for part in parts)
    record = {"claims": claims(parts), "misidentified": misidentified, "page": page}
    answer(record, json, lambda: claims_table(parts, page))


@app.command(sort_key=next(_place))
def config(*, config: Path | None = None, settings: Settings = (), json: Json = False) -> None:
    """Print the options in effect, each with its meaning, as TOML.

    Args:
        config: TOML file of options.
        settings: An option by its full name, such as match.max_depth_mm=900; may be repeated.
    """
    from trifix.config import to_toml

    options = to_toml(_options(config, settings))
    answer(tomllib.loads(options), json, lambda: print(options, end=""))


@app.command(sort_key=next(_place))
def warmup(*, json: Json = False) -> None:
    """Compile the inner loops, once for this machine, so that the first frame need not wait for it."""
    names = compile_all()
    answer({"modules": names}, json, lambda: None)


def main() -> None:
    """Run the command line and leave with its exit code."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as ctrl-C: finished results stay whole
    find_room()
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
        _leave(INTERRUPTED, 130)
    except SystemError as error:  # what an interrupt inside compiled code looks like
        if not comes_of_interrupt(error):
            raise
        _leave(INTERRUPTED, 130)


def _leave(sentence: str, code: int) -> None:
    print(f"trifix: {sentence}", file=sys.stderr)
    sys.exit(code)


def _refuse_if(is_wrong: bool, sentence: str) -> None:
    """Refuses options that do not fit together."""
    if is_wrong:
        raise CycloptsError(msg=sentence)


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


def _simulate(scene: str, out: Path, level: Level, seed: int = 0, frames: int | None = None) -> None:
    with progress_bars() as show:
        trifix.simulate(scene, out, level, seed, frames, lambda done, of: show("simulating", done, of))
