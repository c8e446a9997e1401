"""What a user imports, and what an import costs."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import trifix

NUMERICS = ["numpy", "cv2", "numba", "scipy", "matplotlib"]


def loaded_after(code: str, packages: list[str]) -> set[str]:
    """Which of the packages a fresh process has loaded after the code."""
    report = f"\nimport sys\nprint(*[name for name in {packages} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code + report], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_loads_no_numerics() -> None:
    assert loaded_after("import trifix; dir(trifix); trifix.__version__", NUMERICS) == set()


def test_a_public_name_loads_what_it_needs() -> None:
    assert "numpy" in loaded_after("from trifix import Pose; Pose.identity()", NUMERICS)


def test_options_load_no_plots_and_no_slow_parts_of_scipy() -> None:
    slow = ["matplotlib", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.stats", "scipy.spatial"]
    assert loaded_after("from trifix import Config; Config()", slow) == set()


@pytest.mark.parametrize("name", trifix.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(trifix, name).__doc__


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'trifix' has no attribute 'nothing'"):
        trifix.nothing  # noqa: B018


def test_type_checkers_are_told_the_same_names() -> None:
    stub = Path(str(trifix.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    told = {
        alias.asname or alias.name: node.module
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(told) == trifix.__all__
    for name, module in told.items():
        assert getattr(import_module(str(module)), name) is getattr(trifix, name)
