"""A run from its frames to its results, as a command does it: progress, files, report, and an answer in the end.

Knows no option of the command line; what was asked for comes as options, constraints and sources.
"""

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live as Display
from rich.progress import Progress
from rich.text import Text

from trifix.bundle import Adjusted, Constraints, NotAdjusted, adjust_steps
from trifix.compiled import compile_all
from trifix.config import Config, to_toml
from trifix.console import answer, progress_bar
from trifix.errors import MapError, ViewerError
from trifix.files.calibrations import write_rig
from trifix.files.recordings import Level, Recording
from trifix.interrupts import between_frames, noted
from trifix.live import Live, Rates, Source, Viewer
from trifix.outputs.publish import Publisher
from trifix.outputs.report import Report
from trifix.outputs.results import ResultsWriter
from trifix.outputs.terminal import live_lines, summary_table
from trifix.positioner import Positioner
from trifix.records import Step
from trifix.sources.replay import Replay

_REFRESH_S = 0.1


def run_recording(
    recording: Recording,
    out: Path,
    options: Config,
    json: bool,
    constraints: Constraints | None = None,
    is_map_frozen: bool = False,
    is_online: bool = False,
) -> None:
    """Judges every frame, writes down what was found, and says what it amounts to.

    Online, that is all. Otherwise every frame is judged again by all that became known, and everything is adjusted
    together; whatever interrupts one of these passages, the results of the one before are whole.
    """
    constraints = constraints or Constraints()
    positioner = Positioner(options, constraints.given, is_map_frozen)
    report = Report()
    adjusted: Adjusted | NotAdjusted | None = None
    fault: MapError | None = None
    final: Sequence[Step] = ()
    name = recording.path.resolve().name
    with (
        ResultsWriter(out, name, recording.level, to_toml(options), is_online) as results,
        progress_bar() as progress,
    ):
        with between_frames() as stop_if_told:
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
                results.start_over(positioner.told_map())
                revised = list[Step]()
                for step in progress.track(positioner.revise(judged), len(recording), description="revising"):
                    results.write(step)
                    revised.append(replace(step, identification=None))
                    stop_if_told()
                final = revised
                if options.adjust.adjusts:
                    # what has been found stands, whatever becomes of the adjustment
                    results.start_over(positioner.told_map())
                    known = options, constraints, recording.is_noise_stated
                    final, adjusted, fault = _adjusted(revised, *known, progress, stop_if_told)
                    for step in final:
                        results.write(step)
                again = zip(recording, final, strict=True)
                for frame, step in progress.track(again, len(recording), description="reporting"):
                    report.show(replace(step, frame=replace(frame, rig=step.frame.rig)))  # with its images
                    stop_if_told()
        told_map = None if isinstance(adjusted, Adjusted) else positioner.told_map()
        summary = results.finish(adjusted, told_map)
    rig = final[0].frame.rig if final else None
    if rig is not None and isinstance(adjusted, Adjusted) and adjusted.rig_change:
        write_rig(rig, out / "calibration.yaml")
    page = out / "report.html"
    report.write(page, summary)
    answer({**asdict(summary), "report": page}, json, lambda: summary_table(summary, page))
    if fault is not None:
        raise fault


def _adjusted(
    steps: Sequence[Step],
    options: Config,
    constraints: Constraints,
    is_noise_stated: bool,
    progress: Progress,
    stop_if_told: Callable[[], None],
) -> tuple[Sequence[Step], Adjusted | NotAdjusted, MapError | None]:
    """The steps adjusted together, what came of it, and the fault in what was given that is told when all is done."""
    task = progress.add_task("adjusting", total=None, unit="steps")

    def watch() -> None:
        progress.advance(task)
        stop_if_told()

    try:
        final, adjusted = adjust_steps(steps, options, constraints, is_noise_stated=is_noise_stated, watch=watch)
        fault = None
    except MapError as error:
        final, adjusted, fault = steps, NotAdjusted(str(error)), error
    progress.update(task, total=progress.tasks[task].completed)
    return final, adjusted, fault


def run_live(
    source: Source,
    bodies: dict[str, Positioner],
    out: Path,
    name: str,
    level: Level,
    publish: str | None,
    port: int | None,
    is_lossless: bool,
    json: bool,
) -> None:
    """Judges frames as they come until their source or the operator ends it, and says what it amounts to.

    One body's results are in ``out``, those of several in a folder each. Without a ``port``, no page shows the run.
    """
    if not is_lossless:
        compile_all()
    folders = {body: out / body if len(bodies) > 1 else out for body in bodies}
    with ExitStack() as open_things:
        viewers = {} if port is None else _viewers(list(bodies), name, port, open_things)
        publisher = None
        if publish is not None:
            publisher = open_things.enter_context(closing(Publisher(publish)))
        reports, doubts = {body: Report() for body in bodies}, set[str]()
        results = {
            body: open_things.enter_context(
                ResultsWriter(folders[body], name, level, to_toml(positioner.config), is_online=True)
            )
            for body, positioner in bodies.items()
        }

        def watch(body: str, step: Step, rates: Rates) -> None:
            if publisher is not None:
                publisher.send(body, step, rates)
            results[body].write(step, rates.dropped)
            reports[body].show(step)

        is_stopped = open_things.enter_context(noted())
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
                if is_stopped():
                    run.stop()
        if not console.is_terminal:
            console.line()
        if is_stopped() and isinstance(source, Replay):
            raise KeyboardInterrupt  # the recording goes on; cameras end when they are told to
        summaries = {body: each.finish(told_map=bodies[body].told_map()) for body, each in results.items()}
    pages = {body: folder / "report.html" for body, folder in folders.items()}
    for body, summary in summaries.items():
        reports[body].write(pages[body], summary)
    found = {body: {**asdict(summary), "report": pages[body]} for body, summary in summaries.items()}
    answer(
        found if len(found) > 1 else found[next(iter(found))],
        json,
        lambda: Group(*(summary_table(summary, pages[body]) for body, summary in summaries.items())),
    )


def _viewers(bodies: Sequence[str], name: str, port: int, open_things: ExitStack) -> dict[str, Viewer]:
    """A page for each body, at the port and those after it."""
    viewers: dict[str, Viewer] = {}
    try:
        from trifix.outputs.viewer import Viewer as Page  # needs an extra

        for k, body in enumerate(bodies):
            page = open_things.enter_context(closing(Page(port=port + k if port else 0, title=body or name)))
            viewers[body] = page
            print(f"{body or 'viewer'}  {page.url}", file=sys.stderr)
    except ViewerError as error:
        raise ViewerError(f"{error} Without a viewer: --no-viewer.") from error
    return viewers
