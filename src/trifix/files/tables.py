"""Strict tables of text: CSV in and out. Knows columns and numbers, and nothing of what they mean.

A table is refused at its first fault, with file, line and column: half a table read silently is worse than none.
Lines that begin with ``#`` are comments, columns are found by name in any order, and unknown columns are ignored.
"""

import csv
import difflib
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool, Float

from trifix.errors import RecordingError, TrifixError

COVARIANCE = ("xx", "xy", "xz", "yy", "yz", "zz")
"""Columns of a 3x3 covariance: its upper triangle, row by row."""

LINE = "#line"
"""Under this name a table holds the line of the file that each of its rows stands in, for later complaints."""

Table = Mapping[str, np.ndarray]
"""Columns by name, and ``LINE``."""

_EXPECTED: Mapping[type, str] = {float: "a finite number", int: "an integer", str: "text"}
_UNKNOWN: Mapping[type, str] = {float: "nan", int: "-1"}


def read_table(
    path: Path,
    required: Mapping[str, type],
    optional: Mapping[str, type] | None = None,
    *,
    may_be_nan: Collection[str] = (),
    error: type[TrifixError] = RecordingError,
) -> dict[str, np.ndarray]:
    """The named columns of a CSV file with a header, as arrays of float64, int64 or objects (``str``), and ``LINE``.

    Optional columns are there only if the file has them; an empty cell in one is NaN, -1 or "". The columns named in
    ``may_be_nan`` may hold values that are not finite, for the caller to judge.

    Raises:
        error: the file is missing or is no table, a required column is missing, a line has too few or too many
            cells, or a cell is not what its column holds.
    """
    rows = _rows(path, ",", error)
    header = [name.rstrip() for name in next(rows, (0, []))[1]]
    if not header:
        raise error(f"{path} is empty: expected a header with the columns {', '.join(required)}.")
    wanted = dict(required) | {name: kind for name, kind in (optional or {}).items() if name in header}
    for name in wanted:
        if name not in header:
            near = difflib.get_close_matches(name, header, n=1)
            raise error(
                f"{path}: column '{name}' is missing; the header has {', '.join(header)}"
                + (f" (is '{near[0]}' meant?)." if near else ".")
            )
        if header.count(name) > 1:
            raise error(f"{path}: column '{name}' stands {header.count(name)} times in the header, expected once.")
    return _columns(path, rows, header, wanted, frozenset(optional or ()), frozenset(may_be_nan), error)


def read_bare_table(
    path: Path, columns: Mapping[str, type], delimiter: str = ",", *, error: type[TrifixError] = RecordingError
) -> dict[str, np.ndarray]:
    """The columns of a file without a header, in the order given, and ``LINE``; delimiter " " is any white space.

    Raises:
        error: as ``read_table``.
    """
    rows = _rows(path, delimiter, error)
    return _columns(path, rows, list(columns), columns, frozenset(), frozenset(), error)


def refuse_where(
    wrong: Bool[np.ndarray, "n"],
    path: Path,
    table: Table,
    name: str,
    expected: str,
    error: type[TrifixError] = RecordingError,
) -> None:
    """Refuses the first wrong value of a column, if there is one.

    Raises:
        error: with file, line, column, what was found and what was expected.
    """
    if wrong.any():
        row = int(wrong.argmax())
        raise error(f"{path}, line {table[LINE][row]}, column '{name}': found {table[name][row]}, expected {expected}.")


def write_table(path: Path, columns: Mapping[str, Sequence[str]]) -> None:
    """Writes columns of text, all of one length, as CSV with a header."""
    path.write_text(table_text(columns), encoding="utf-8")


def table_text(columns: Mapping[str, Sequence[str]]) -> str:
    """Columns of text, all of one length, as CSV with a header."""
    return "\n".join([",".join(columns), *map(",".join, zip(*columns.values(), strict=True))]) + "\n"


def write_atomically(path: Path, text: str) -> None:
    """Writes a file so that whoever looks sees the old one or the new one, never half of it."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)  # noqa: PTH105  (the name of the operation that is atomic)
    finally:
        part.unlink(missing_ok=True)


def fixed(value: float, decimals: int = 6) -> str:
    """A number with so many decimals, zero never negative; empty where it is not a number."""
    if math.isnan(value):
        return ""
    text = f"{value:.{decimals}f}"
    return text[1:] if text[0] == "-" and not text.strip("-0.") else text


def significant(value: float, digits: int = 9) -> str:
    """A number with so many digits, zero never negative; empty where it is not a number: for covariances."""
    return "" if math.isnan(value) else f"{value + 0.0:.{digits}g}"


def upper_triangle(cov: Float[np.ndarray, "n k k"]) -> Float[np.ndarray, "n m"]:
    """The entries on and above the diagonal of symmetric matrices, row by row."""
    row, column = np.triu_indices(cov.shape[-1])
    return np.asarray(cov[:, row, column])


def from_upper_triangle(entries: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k k"]:
    """Symmetric matrices from their entries on and above the diagonal, row by row."""
    size = (math.isqrt(8 * entries.shape[1] + 1) - 1) // 2
    row, column = np.triu_indices(size)
    cov = np.empty((len(entries), size, size))
    cov[:, row, column] = cov[:, column, row] = entries
    return cov


def read_text(path: Path, error: type[TrifixError]) -> str:
    """The text of a file.

    Raises:
        error: there is no such file, it cannot be read, or it is not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise error(f"{path} does not exist.") from None
    except IsADirectoryError:
        raise error(f"{path} is a folder, expected a file.") from None
    except UnicodeDecodeError as fault:
        raise error(f"{path} is not text: byte {fault.start} is not UTF-8.") from None
    except OSError as fault:
        raise error(f"{path} cannot be read: {fault.strerror}.") from None


def _rows(path: Path, delimiter: str, error: type[TrifixError]) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line that is neither empty nor a comment."""
    lines: Iterable[str] = (
        "" if line.lstrip()[:1] in ("", "#") else line for line in read_text(path, error).split("\n")
    )
    if delimiter == " ":
        lines = (" ".join(line.split()) for line in lines)
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        for cells in reader:
            if cells:
                yield reader.line_num, cells
    except csv.Error as fault:
        raise error(f"{path}, line {reader.line_num} is not CSV: {fault}.") from None


def _columns(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    header: list[str],
    wanted: Mapping[str, type],
    may_be_empty: frozenset[str],
    may_be_nan: frozenset[str],
    error: type[TrifixError],
) -> dict[str, np.ndarray]:
    lines: list[int] = []
    table: list[list[str]] = []
    for line, row_cells in rows:
        if len(row_cells) != len(header):
            raise error(
                f"{path}, line {line}: found {len(row_cells)} cells, expected {len(header)} ({', '.join(header)})."
            )
        lines.append(line)
        table.append(row_cells)
    by_name = dict(zip(header, zip(*table, strict=True), strict=True)) if table else dict.fromkeys(header, ())

    def refuse(name: str, row: int) -> NoReturn:
        found = by_name[name][row]
        raise error(
            f"{path}, line {lines[row]}, column '{name}': found {repr(found) if found else 'an empty cell'}, "
            f"expected {_EXPECTED[wanted[name]]}."
        )

    columns: dict[str, np.ndarray] = {LINE: np.array(lines, dtype=np.int64)}
    for name, kind in wanted.items():
        cells = by_name[name]
        empty = np.array([not cell for cell in cells], dtype=bool)
        if empty.any() and name not in may_be_empty:
            refuse(name, int(empty.argmax()))
        if kind is str:
            columns[name] = np.array([cell.rstrip() for cell in cells], dtype=object)
            continue
        full = [cell or _UNKNOWN[kind] for cell in cells]
        try:
            column = _numbers(full, kind)
        except (ValueError, OverflowError):
            refuse(name, next(row for row, cell in enumerate(full) if not _is_number(cell, kind)))
        strange = ~np.isfinite(column) & ~empty
        if strange.any() and name not in may_be_nan:
            refuse(name, int(strange.argmax()))
        columns[name] = column
    return columns


def _numbers(cells: Sequence[str], kind: type) -> np.ndarray:
    """The numbers in cells, as float64 or int64; ValueError or OverflowError if one is none."""
    if "_" in "".join(cells):  # Python would read 1_000
        raise ValueError
    return np.fromiter(map(kind, cells), np.float64 if kind is float else np.int64, len(cells))


def _is_number(cell: str, kind: type) -> bool:
    try:
        _numbers([cell], kind)
    except (ValueError, OverflowError):
        return False
    return True
