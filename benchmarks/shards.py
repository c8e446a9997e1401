"""Long runs in pieces that are never done twice: a shard is a few hundred frames on one map.

Each finished shard is one line of a file in the folder of the run, so that a run that was killed goes on where it
stood. What a shard gives depends on its number and the run's seed alone; so does the sum over all of them.
"""

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import trifix
from trifix.config import Config, to_toml


@dataclass(frozen=True, slots=True)
class Task:
    """One shard of a run."""

    kind: str
    """What its frames are like."""
    number: int
    """Which of that kind it is."""
    frames: int
    """Frames in it."""
    seed: int
    """Seed of the run."""
    config: Config
    """Options of the program."""

    @property
    def key(self) -> str:
        """Its name in the file of the run."""
        return f"{self.kind}/{self.number}"

    def rng(self) -> np.random.Generator:
        """The shard's own random numbers, the same whenever and wherever it is done."""
        kind = int.from_bytes(sha256(self.kind.encode()).digest()[:4])
        return np.random.default_rng([self.seed, kind, self.number])


def tasks(kinds: Iterable[str], frames: int, shard: int, seed: int, config: Config) -> list[Task]:
    """The shards of a run of so many frames a kind, the kinds taking turns."""
    sizes = [min(shard, frames - first) for first in range(0, frames, shard)]
    kinds = list(kinds)
    return [Task(kind, k, size, seed, config) for k, size in enumerate(sizes) for kind in kinds]


def run(
    file: Path,
    todo: list[Task],
    work: Callable[[Task], dict[str, object]],
    told: Callable[[Mapping[str, dict]], str],
    jobs: int = 1,
) -> dict[str, dict]:
    """What every shard gave, those found in the file not done again. ``told`` says how it stands, beside the bar.

    Raises:
        SystemExit: the file is of another run or another state of the program.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    head = {"seed": todo[0].seed, "shard": todo[0].frames, "config": to_toml(todo[0].config), "program": _program()}
    done = _finished(file, head)
    left = [task for task in todo if task.key not in done]
    frames, start = 0, perf_counter()
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        speed_estimate_period=300,
    )
    with file.open("a") as lines, progress:
        bar = progress.add_task(told(done), total=sum(task.frames for task in todo))
        progress.advance(bar, sum(task.frames for task in todo if task.key in done))
        for task, result in _results(left, work, jobs):
            done[task.key] = result
            lines.write(json.dumps({"key": task.key, **result}) + "\n")
            lines.flush()
            frames += task.frames
            progress.update(bar, advance=task.frames, description=told(done))
    if frames:
        progress.console.print(f"{frames} frames, {frames / (perf_counter() - start):.0f} a second")
    return {task.key: done[task.key] for task in todo}


def console() -> Console:
    """Where tables go; wide enough for them where there is no terminal."""
    return Console(width=None if sys.stdout.isatty() else 120)


def _results(left: list[Task], work: Callable[[Task], dict[str, object]], jobs: int):
    if jobs == 1:
        yield from ((task, work(task)) for task in left)
        return
    with get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(_Worked(work), left)


@dataclass(frozen=True, slots=True)
class _Worked:
    """A shard's task beside what it gave, for results that come in any order."""

    work: Callable[[Task], dict[str, object]]

    def __call__(self, task: Task) -> tuple[Task, dict[str, object]]:
        return task, self.work(task)


def _finished(file: Path, head: dict[str, object]) -> dict[str, dict]:
    """The shards in the file; a line that was cut off in the middle is taken out of it."""
    text = file.read_text() if file.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if not whole:
        file.write_text(json.dumps(head) + "\n")
        return {}
    first, *rest = whole.splitlines()
    if json.loads(first) != head:
        other = ", ".join(key for key, value in head.items() if json.loads(first).get(key) != value)
        raise SystemExit(f"{file} is of a run with another {other}; name another folder with --out, or remove it.")
    if len(whole) < len(text):
        file.write_text(whole)
    return {line.pop("key"): line for line in map(json.loads, rest)}


def _program() -> str:
    """Changes with every change of the program's source."""
    root = Path(trifix.__file__).parent
    return sha256(b"".join(path.read_bytes() for path in sorted(root.rglob("*.py")))).hexdigest()[:16]
