"""The compiled inner loops.

Each module stands alone: a cached kernel does not notice that a kernel in another file has changed. Every new type of
argument is compiled anew, an array's layout and whether it may be written included: ``floats`` and ``integers`` stand
where arrays come in from outside.
"""

import numpy as np


def floats(array: np.ndarray) -> np.ndarray:
    """The array as compiled loops take it: double precision, in one piece, writeable; itself if it is so already."""
    return array if array.dtype is _FLOAT and array.flags.carray else np.array(array, dtype=np.float64, order="C")


def integers(array: np.ndarray) -> np.ndarray:
    """The same with 64-bit integers."""
    return array if array.dtype is _INTEGER and array.flags.carray else np.array(array, dtype=np.int64, order="C")


_FLOAT, _INTEGER = np.dtype(np.float64), np.dtype(np.int64)
