"""Every technique on every scene: parts measured side by side, kept as files, and never measured twice.

A part is a file of its own, written when it is whole; its key stands for all that it depends on. What is asked for and
stands there already, with the same key, is read. Knows no technique and draws nothing.
"""

import difflib
import hashlib
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import msgspec

from trifix.config import Config, paper_options, to_toml, with_overrides
from trifix.errors import ConfigError, TrifixError
from trifix.experiments.measuring import Part, measure
from trifix.files.tables import write_atomically
from trifix.outputs.summary import versions
from trifix.sources.scenes import Sensing, recipe_of
from trifix.sources.simulation import simulate
from trifix.stages.identify.congruence import Technique

SCENES = ("statue", "plane", "sphere", "head", "head-front")
"""The paper's, in its order."""
TECHNIQUES: tuple[Technique, ...] = tuple(each for each in get_args(Technique) if each != "index")
"""All that the paper names; the index is ours."""
_NEAREST_MM, _FARTHEST_MM = Sensing().depth_mm
WORKING_RANGE = {"match.min_depth_mm": str(_NEAREST_MM), "match.max_depth_mm": str(_FARTHEST_MM)}
"""The depths for which the sensor of the scenes is made: pairs that meet elsewhere are no targets."""
_SHOWN_EVERY = 20  # frames
_DRAWN_BY = ("experiments/figures.py", "experiments/page.py", "cli.py", "__main__.py")  # a part does not depend on it


Show = Callable[[str, int, int], None]
"""Called with the name of a part, the number of its frames that are done, and the number of all."""


@dataclass(frozen=True, slots=True)
class Task:
    """A scene to simulate, or a technique to try on it."""

    name: str
    """Of the task, for whoever waits."""
    key: str
    """Stands for all that it depends on."""
    scene: str
    """Name of the scene."""
    room: Path
    """Folder of its recording and truth."""
    seed: int
    """Of the simulation."""
    frames: int
    """Of the recording."""
    options: Config | None = None
    """Of the technique; None to simulate."""
    file: Path | None = None
    """Where the part goes."""


def run_paper(
    out: Path,
    scenes: Sequence[str] = SCENES,
    techniques: Sequence[str] = TECHNIQUES,
    frames: int | None = None,
    seed: int = 0,
    show: Show | None = None,
    workers: int = 2,
) -> list[Part]:
    """The parts of all scenes and techniques, scene by scene; those that ``out`` lacks are measured.

    Without ``frames``, each scene has its own number.

    Raises:
        TrifixError: a name is unknown, a number impossible, or ``out`` is somebody else's.
    """
    simulations, measurements = tasks(out, scenes, techniques, frames, seed)
    _make_folder(out)
    parts = {task.name: read_part(task) for task in measurements}
    missing = [task for task in measurements if parts[task.name] is None]
    needed = [task for task in simulations if any(each.scene == task.scene for each in missing)]
    if missing:
        parts |= _measured(needed, missing, show or (lambda part, done, of: None), workers)
    return [part for task in measurements if (part := parts[task.name]) is not None]


def tasks(
    out: Path, scenes: Sequence[str], techniques: Sequence[str], frames: int | None, seed: int
) -> tuple[list[Task], list[Task]]:
    """What there is to simulate and to measure, each with the key of all that it depends on.

    Raises:
        TrifixError: as ``run_paper``.
    """
    for name in techniques:
        _refuse_unknown(name, TECHNIQUES)
    if frames is not None and frames < 1:
        raise ConfigError(f"An experiment of {frames} frames cannot be made: at least 1 is needed.")
    if seed < 0:
        raise ConfigError(f"The seed is {seed}: it must not be negative.")
    code = code_key()
    simulations, measurements = [], []
    for scene in dict.fromkeys(scenes):
        n = recipe_of(scene).frames if frames is None else frames
        room = out / "recordings" / scene
        key = _key(scene, str(seed), str(n), code)
        simulations.append(Task(f"{scene}: simulate", key, scene, room, seed, n))
        for technique in TECHNIQUES:
            if technique in techniques:
                options = with_overrides(paper_options(technique), WORKING_RANGE)
                name, file = f"{scene}: {technique}", out / "parts" / f"{scene}-{technique}.json"
                measurements.append(Task(name, _key(key, to_toml(options)), scene, room, seed, n, options, file))
    return simulations, measurements


def read_part(task: Task) -> Part | None:
    """A part that stands there whole and was made from the same; else None."""
    assert task.file is not None
    try:
        part = msgspec.json.decode(task.file.read_bytes(), type=Part)
    except (OSError, msgspec.DecodeError):
        return None
    return part if part.key == task.key else None


def code_key() -> str:
    """Stands for the program as it is: its sources, and the versions of what it computes with."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    for file in sorted(package.rglob("*.py")):
        name = file.relative_to(package).as_posix()
        if name not in _DRAWN_BY:
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _key(*of: str) -> str:
    return hashlib.sha256("\0".join(of).encode()).hexdigest()


def _refuse_unknown(name: str, known: Sequence[str]) -> None:
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
        raise ConfigError(f"There is no technique {name!r}; did you mean {near!r}? Known are {', '.join(known)}.")


def _make_folder(out: Path) -> None:
    """Makes the folder, unless it is there and empty, or an experiment's.

    Raises:
        ConfigError: it is no folder, or holds something else.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file, expected a folder for the experiment: name another.")
    parts = out / "parts"
    if out.exists() and any(out.iterdir()) and not parts.is_dir():
        raise ConfigError(f"{out} holds files that are not an experiment's: name a new or an empty folder.")
    parts.mkdir(parents=True, exist_ok=True)


# --- side by side ----------------------------------------------------------------------------------------------------


def _measured(
    simulations: Sequence[Task], measurements: Sequence[Task], show: Show, workers: int
) -> dict[str, Part | None]:
    """Each scene is simulated first; then its techniques, as workers come free."""
    context = multiprocessing.get_context("spawn")  # a fork would copy threads in the middle of what they do
    progress: SimpleQueue[tuple[str, int, int]] = context.SimpleQueue()
    last_word, silence = context.Pipe(duplex=False)
    parts: dict[str, Part | None] = {}
    done_of = dict.fromkeys((task.name for task in (*simulations, *measurements)), 0)
    total = sum(task.frames for task in (*simulations, *measurements))

    def tell(part: str, done: int, of: int) -> None:
        done_of[part] = done
        show("in all", sum(done_of.values()), total)
        show(part, done, of)

    workers = max(1, min(workers, os.cpu_count() or 1, len(measurements)))
    with (
        TemporaryDirectory(prefix="trifix-") as scratch,
        closing(silence),
        ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(progress, last_word, scratch)) as executor,
        _ending_at_once(executor, silence),
    ):
        running: dict[Future[Part | None], Task] = {executor.submit(_simulate, task): task for task in simulations}
        while running:
            done, _ = wait(running, timeout=0.1, return_when=FIRST_COMPLETED)
            while not progress.empty():
                tell(*progress.get())
            for future in done:
                task = running.pop(future)
                try:
                    part = future.result()
                except BrokenProcessPool as error:
                    raise TrifixError(
                        f"{task.name}: the process ended before its time (out of memory?); finished parts are kept: "
                        "run the same command again."
                    ) from error
                tell(task.name, task.frames, task.frames)
                if part is not None:
                    parts[task.name] = part
                    continue
                for each in measurements:
                    if each.scene == task.scene:
                        running[executor.submit(_measure, each)] = each
    return parts


@contextmanager
def _ending_at_once(executor: ProcessPoolExecutor, silence: Connection) -> Iterator[None]:
    """Ends the workers where they stand if all goes wrong: what they write gets its name when it is whole."""
    try:
        yield
    except BaseException:
        silence.close()
        executor.shutdown(cancel_futures=True)
        raise


def _begin(progress: "SimpleQueue[tuple[str, int, int]]", last_word: Connection, scratch: str) -> None:
    """Readies a worker process: where it reports and writes what it need not keep. It outlives no parent."""
    global _progress, _scratch
    _progress, _scratch = progress, Path(scratch)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent tells
    threading.Thread(target=_end_with_parent, args=(last_word,), daemon=True).start()


def _end_with_parent(last_word: Connection) -> None:
    """Ends this process when the other end of the pipe is closed, by the parent or by its death."""
    last_word.poll(None)
    os._exit(1)


def _simulate(task: Task) -> None:
    """In a worker: the recording of a scene, unless it is there."""
    mark = task.room / "key"
    if mark.exists() and mark.read_text(encoding="utf-8") == task.key:
        return
    shutil.rmtree(task.room, ignore_errors=True)
    simulate(task.scene, task.room, "dots", task.seed, task.frames, _Reporter(task.name))
    write_atomically(mark, task.key)


def _measure(task: Task) -> Part:
    """In a worker: one part, written when it is whole."""
    assert task.options is not None
    assert task.file is not None
    part = measure(task.key, task.scene, task.room, _scratch, task.options, _Reporter(task.name))
    write_atomically(task.file, msgspec.json.encode(part).decode())
    return part


class _Reporter:
    """Reports how far a task has come."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, done: int, of: int) -> None:
        if done < of and done % _SHOWN_EVERY == 0:
            _progress.put((self._name, done, of))


_progress: "SimpleQueue[tuple[str, int, int]]"
_scratch: Path
