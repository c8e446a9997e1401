"""What is known of targets by other means: lengths between them, and places of some. Knows files and no map.

Both name targets by the id of the map.csv of an earlier run of the same recording; whether a target exists is for
others to say.
"""

from pathlib import Path

import numpy as np

from trifix.errors import MapError
from trifix.files.maps import covariances, refuse_twice
from trifix.files.tables import LINE, read_table, refuse_where
from trifix.records import KnownLength, ReferenceMap

_XYZ = ("x_mm", "y_mm", "z_mm")


def read_scale_bars(path: Path | str) -> list[KnownLength]:
    """The lengths in a CSV file ``target_a,target_b,length_mm,sigma_mm``.

    Raises:
        MapError: the file is missing, broken or empty, or holds an impossible length.
    """
    path = Path(path)
    columns = {"target_a": int, "target_b": int, "length_mm": float, "sigma_mm": float}
    table = read_table(path, columns, error=MapError)
    if not len(table[LINE]):
        raise MapError(f"{path}: found no scale bar, expected a line for each: {','.join(columns)}.")
    for name in ("length_mm", "sigma_mm"):
        refuse_where(table[name] <= 0, path, table, name, "a positive number of millimetres", MapError)
    is_same = table["target_a"] == table["target_b"]
    refuse_where(is_same, path, table, "target_b", "another target than target_a", MapError)
    pairs = np.sort(np.stack([table["target_a"], table["target_b"]], axis=1), axis=1)
    seen: dict[tuple[int, ...], int] = {}
    bars = []
    for row, (pair, line) in enumerate(zip(pairs.tolist(), table[LINE].tolist(), strict=True)):
        before = seen.setdefault(tuple(pair), line)
        if before != line:
            raise MapError(
                f"{path}, line {line}: the targets {pair[0]} and {pair[1]} already stand in line {before}, expected "
                "them once."
            )
        numbers = float(table["length_mm"][row]), float(table["sigma_mm"][row])
        ends = int(table["target_a"][row]), int(table["target_b"][row])
        bars.append(KnownLength(*ends, *numbers, f"{path}, line {line}"))
    return bars


def read_control(path: Path | str) -> ReferenceMap:
    """The places in a CSV file ``id,x_mm,y_mm,z_mm``, with a covariance ``xx..zz`` or ``sigma_mm``, or exact.

    Raises:
        MapError: the file is missing or broken, names a target twice, has fewer than three, or says an impossible
            error.
    """
    path = Path(path)
    optional = dict.fromkeys(("xx", "xy", "xz", "yy", "yz", "zz", "sigma_mm"), float)
    table = read_table(path, {"id": int} | dict.fromkeys(_XYZ, float), optional, error=MapError)
    refuse_twice(path, table)
    if len(table[LINE]) < 3:
        raise MapError(f"{path}: found {len(table[LINE])} control targets, expected at least three.")
    cov = covariances(path, table)
    sigma = table.get("sigma_mm", np.full(len(cov), np.nan))
    refuse_where(
        sigma < 0, path, {**table, "sigma_mm": sigma}, "sigma_mm", "a positive number of millimetres", MapError
    )
    both = (sigma > 0) & cov.any(axis=(1, 2))
    refuse_where(both, path, {**table, "sigma_mm": sigma}, "sigma_mm", "it or a covariance, not both", MapError)
    known = np.flatnonzero(sigma > 0)
    cov[known] = sigma[known, None, None] ** 2 * np.eye(3)
    xyz = np.stack([table[name] for name in _XYZ], axis=1)
    return ReferenceMap.given(xyz, cov, id=table["id"])
