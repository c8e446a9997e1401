"""Reference maps as files: map.csv in and out, and a point cloud for others to look at. Knows no recording."""

import difflib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import MapError
from trifix.files.tables import (
    COVARIANCE,
    LINE,
    Table,
    fixed,
    from_upper_triangle,
    read_table,
    refuse_where,
    significant,
    table_text,
    upper_triangle,
    write_atomically,
)
from trifix.records import ReferenceMap, TargetState

_XYZ = ("x_mm", "y_mm", "z_mm")
_LARGEST_ID = 2**53  # further on, programs that hold numbers as float64 mistake one for another
_LEAST_ACROSS_MM = 5.0  # less, and no three targets stand far enough from one line to hold a pose
_VIEW = ("nx", "ny", "nz")
_STATES = tuple(state.name for state in TargetState if state is not TargetState.removed)


def read_map(path: Path | str) -> ReferenceMap:
    """The map in a map.csv; only ``id`` and the position are required, the rest may be missing or empty.

    Without a covariance a target is where it is said to be, without a state it is trusted. Directions are normalised.

    Raises:
        MapError: the file is missing, broken, names a target twice, or holds an impossible value; or its targets
            lie so near to one another that they must be given in metres.
    """
    path = Path(path)
    table = read_table(
        path,
        {"id": int} | dict.fromkeys(_XYZ, float),
        dict.fromkeys((*COVARIANCE, *_VIEW), float) | {"sightings": int, "state": str},
        error=MapError,
    )
    identity = table["id"]
    refuse_where((identity < 0) | (identity > _LARGEST_ID), path, table, "id", f"0 to {_LARGEST_ID}", MapError)
    refuse_twice(path, table)
    xyz = np.stack([table[name] for name in _XYZ], axis=1)
    across = float(np.linalg.norm(np.ptp(xyz, axis=0))) if len(xyz) >= 3 else np.inf
    if across < _LEAST_ACROSS_MM:
        raise MapError(
            f"{path}: all {len(xyz)} targets lie within {across:.3g} mm, expected at least {_LEAST_ACROSS_MM:g}; are "
            f"{', '.join(_XYZ)} in metres? Multiply them by 1000."
        )
    return ReferenceMap.given(
        xyz_mm=xyz,
        cov_mm2=covariances(path, table),
        view=_views(path, table),
        id=identity,
        sightings=table.get("sightings", np.zeros(len(identity), dtype=np.int64)).clip(min=0),
        state=_states(path, table),
    )


def write_map(map: ReferenceMap, path: Path) -> None:
    """Writes all targets but the removed ones as map.csv, at once or not at all."""
    rows = np.flatnonzero(map.state != TargetState.removed)
    entries = upper_triangle(map.cov_mm2[rows])
    columns = {"id": [str(i) for i in map.id[rows]]}
    columns |= {name: [fixed(x) for x in map.xyz_mm[rows, i]] for i, name in enumerate(_XYZ)}
    columns |= {name: [significant(x) for x in entries[:, i]] for i, name in enumerate(COVARIANCE)}
    columns["sightings"] = [str(n) for n in map.sightings[rows]]
    columns |= {name: [fixed(x) for x in map.view[rows, i]] for i, name in enumerate(_VIEW)}
    columns["state"] = [TargetState(s).name for s in map.state[rows]]
    write_atomically(path, table_text(columns))


def write_ply(map: ReferenceMap, path: Path) -> None:
    """Writes the trusted targets as an ASCII PLY point cloud in millimetres, at once or not at all."""
    xyz = map.xyz_mm[map.state == TargetState.trusted]
    header = [
        "ply",
        "format ascii 1.0",
        "comment targets in world coordinates, millimetres",
        f"element vertex {len(xyz)}",
        *(f"property double {axis}" for axis in "xyz"),
        "end_header",
    ]
    rows = [" ".join(map_fixed) for map_fixed in ([fixed(x) for x in p] for p in xyz)]
    write_atomically(path, "\n".join([*header, *rows]) + "\n")


def refuse_twice(path: Path, table: Table) -> None:
    """Refuses a table that names a target twice.

    Raises:
        MapError: with both lines.
    """
    identity = table["id"]
    first, count = np.unique(identity, return_index=True, return_counts=True)[1:]
    if (count > 1).any():
        twice = identity[first[int((count > 1).argmax())]]
        lines = table[LINE][identity == twice]
        raise MapError(f"{path}, line {lines[1]}: id {twice} already stands in line {lines[0]}, expected it once.")


def covariances(path: Path, table: Table) -> Float[np.ndarray, "k 3 3"]:
    """Covariances (mm²), zero where all six cells are empty."""
    entries = _group(path, table, COVARIANCE)
    cov = from_upper_triangle(np.nan_to_num(entries))
    negative = np.linalg.eigvalsh(cov)[:, 0] < -1e-6 * np.abs(cov).max(axis=(1, 2), initial=0.0)  # 1e-6: as printed
    if negative.any():
        raise MapError(
            f"{path}, line {table[LINE][int(negative.argmax())]}: xx ... zz is no covariance, one of its axes has a "
            f"negative variance."
        )
    return cov


def _views(path: Path, table: Table) -> Float[np.ndarray, "k 3"]:
    """Unit directions, NaN where all three cells are empty."""
    view = _group(path, table, _VIEW)
    length = np.linalg.norm(view, axis=1, keepdims=True)
    if (length == 0).any():
        raise MapError(f"{path}, line {table[LINE][int((length == 0).argmax())]}: nx, ny, nz is zero, no direction.")
    return np.asarray(view / length)


def _states(path: Path, table: Table) -> Int[np.ndarray, "k"]:
    """States, trusted where the cell is empty."""
    names = table.get("state", np.full(len(table[LINE]), "", dtype=object))
    for row, name in enumerate(names):
        if name and name not in _STATES:
            near = difflib.get_close_matches(name, _STATES, n=1, cutoff=0.0)[0]
            raise MapError(
                f"{path}, line {table[LINE][row]}, column 'state': found '{name}', expected {', '.join(_STATES)} or "
                f"nothing; the nearest is {near}."
            )
    return np.array([TargetState[name or "trusted"] for name in names], dtype=np.int64)


def _group(path: Path, table: Table, names: tuple[str, ...]) -> Float[np.ndarray, "k m"]:
    """Columns that belong together, each row full or empty (NaN)."""
    nothing = np.full(len(table[LINE]), np.nan)
    values = np.stack([table.get(name, nothing) for name in names], axis=1)
    empty = np.isnan(values)
    torn = empty.any(axis=1) & ~empty.all(axis=1)
    if torn.any():
        row = int(torn.argmax())
        missing = " and ".join(name for name, is_empty in zip(names, empty[row], strict=True) if is_empty)
        raise MapError(
            f"{path}, line {table[LINE][row]}: {missing} is empty, expected all of {', '.join(names)} or none."
        )
    return values
