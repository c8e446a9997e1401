"""What all tests share: shapes and types checked at run time, and the folder of real recordings."""

import os
from pathlib import Path

import jaxtyping
import pytest

ROOT = Path(__file__).resolve().parent.parent

# Every shape in a signature is checked on every call; compiled loops are left out, as their caller is compiled too.
CHECKED = [
    f"trifix.{entry.stem}" for entry in (ROOT / "src" / "trifix").iterdir() if entry.stem not in ("kernels", "cli")
]
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"  # an int is a float, as for mypy
jaxtyping.install_import_hook(CHECKED, CHECKER)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings, named by TRIFIX_DATA."""
    folder = Path(os.environ.get("TRIFIX_DATA", ROOT.parent / "shared" / "data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real recordings in {folder}; name their folder with TRIFIX_DATA")
    return folder
