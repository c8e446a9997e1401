"""Where compiled code is kept."""

import os
from pathlib import Path

import pytest

from trifix import compiled


def test_compiled_code_goes_among_temporary_files_only_where_it_has_no_other_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "unset")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    compiled.find_room()
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setattr(compiled, "can_be_written", lambda folder: False)
    compiled.find_room()
    room = Path(os.environ.pop("NUMBA_CACHE_DIR"))
    assert (room.parent, room.stat().st_mode & 0o077) == (tmp_path, 0)
    room.chmod(0o777)  # somebody else could have put code there
    compiled.find_room()
    assert Path(os.environ["NUMBA_CACHE_DIR"]) != room
    assert Path(os.environ["NUMBA_CACHE_DIR"]).parent == tmp_path


def test_a_folder_can_be_written_if_its_nearest_parent_can(tmp_path: Path) -> None:
    assert compiled.can_be_written(tmp_path / "a" / "b")
    (tmp_path / "file").touch()
    assert not compiled.can_be_written(tmp_path / "file" / "b")
