"""What a command shows: progress on stderr; on stdout a table for people, or one JSON object for programs.

Every command takes the option ``json: Json = False`` and ends with one call of ``answer``, to which it gives the same
result twice: the record that programs read, and how it looks to people. Nothing else is printed on stdout. Knows no
command, and loads no numerics.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

Json = Annotated[bool, Parameter(name="--json", help="Print one JSON object instead of what people read.")]
"""The option of every command."""


def answer(record: object, json: bool, for_people: Callable[[], RenderableType | None]) -> None:
    """Prints a command's result: the record as one JSON object, or what people read, if there is anything.

    The record is a dict or a dataclass of plain values, paths and arrays among them; NaN becomes null.
    """
    if json:
        text = msgspec.json.format(msgspec.json.encode(record, enc_hook=_plain), indent=2).decode()
        print(text)
    elif (shown := for_people()) is not None:
        Console().print(shown)


def _plain(value: object) -> object:
    """What JSON can hold in the place of what it cannot."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # arrays and numbers of numpy, which need not be loaded for the others
        return value.tolist()
    raise NotImplementedError(f"{type(value).__name__} has no place in JSON")


def table_of(rows: list[tuple[str, str]]) -> Table:
    """Names and values, one below the other."""
    table = Table.grid(padding=(0, 3))
    for row in rows:
        table.add_row(*map(Text, row))
    return table


class _Rate(ProgressColumn):
    """How fast it goes."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        unit = task.fields.get("unit", self._unit)
        return Text(f"{task.completed / task.elapsed:.1f} {unit}/s" if task.elapsed else "")


def progress_bar(unit: str = "frames") -> Progress:
    """A progress bar on stderr, with the rate and the time that remains."""
    return Progress(
        TextColumn("{task.description:12}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(unit),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
    )


@contextmanager
def progress_bars(unit: str = "frames", keeps_finished: bool = True) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar for each part that is told of: its name, how much is done, of how much.

    The first appears with the first word of a part, so that a refusal before it stands alone.
    """
    progress, tasks = progress_bar(unit), dict[str, TaskID]()
    with ExitStack() as shown:

        def show(part: str, done: int, of: int) -> None:
            if not progress.live.is_started:
                shown.enter_context(progress)
            if part not in tasks:
                tasks[part] = progress.add_task(part)
            progress.update(tasks[part], completed=done, total=of, visible=keeps_finished or done < of)

        yield show
