"""Where the compiled inner loops are kept on this machine, and how they get there before they are needed."""

import os
import stat
from importlib import import_module
from pathlib import Path

import trifix
from trifix.console import progress_bar


def compile_all() -> list[str]:
    """Compiles the inner loops, or reads what was compiled before; returns the names of their modules."""
    import pkgutil

    from trifix import kernels

    names = [f"{kernels.__name__}.{module.name}" for module in pkgutil.iter_modules(kernels.__path__)]
    with progress_bar("modules") as progress:
        for name in progress.track(names, description="compiling"):
            import_module(name).warm_up()
    return names


def find_room() -> None:
    """Names a folder of this user among the temporary ones where neither the package's nor the user's can be written.

    Only a folder that nobody else can write: what is read from it is run.
    """
    kernels = Path(trifix.__file__).parent / "kernels" / "__pycache__"
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"))
    if "NUMBA_CACHE_DIR" in os.environ or can_be_written(kernels) or can_be_written(_at_home(cache)):
        return
    import tempfile

    room = Path(tempfile.gettempdir()) / f"trifix-{os.getuid()}"
    try:
        room.mkdir(mode=0o700, exist_ok=True)
        found = room.lstat()
        is_ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    except FileExistsError:
        is_ours = False
    os.environ["NUMBA_CACHE_DIR"] = str(room) if is_ours else tempfile.mkdtemp(prefix="trifix-")


def can_be_written(folder: Path) -> bool:
    """Whether files can be made in a folder, or the folder itself where it does not exist."""
    nearest = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def _at_home(path: Path) -> Path:
    return Path(os.path.expanduser(path))  # noqa: PTH111  (Path.expanduser fails for a user without a home)
