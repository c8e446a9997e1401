"""`pytest tests/golden --renew-golden` writes the golden outputs anew; say in the commit why they changed."""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--renew-golden", action="store_true", help="write the golden outputs of the stages anew")
