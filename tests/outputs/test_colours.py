"""The colours of the pages, as different eyes see them."""

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from trifix.outputs import page

CSS = (Path(page.__file__).parent / "page.css").read_text(encoding="utf-8")
MEANINGS = ("good", "bad", "path", "mark", "amber", "faint")
# Machado, Oliveira, Fernandes 2009: what the three kinds of colour blindness make of linear RGB, at full severity.
EYES = {
    "all cones": np.eye(3),
    "no red cones": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no green cones": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no blue cones": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def colours(theme: str) -> dict[str, np.ndarray]:
    """Linear RGB of the variables of a theme."""
    block = re.findall(r":root \{(.*?)\}", CSS, flags=re.DOTALL)[theme == "dark"]
    found = {}
    for name, hex_ in re.findall(r"--(\w+): #(\w{6})", block):
        s = np.array([int(hex_[i : i + 2], 16) for i in (0, 2, 4)]) / 255
        found[name] = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return found


def luminance(rgb: np.ndarray) -> float:
    return float(rgb @ [0.2126, 0.7152, 0.0722])


def oklab(rgb: np.ndarray) -> np.ndarray:
    """Perceived colour (Ottosson 2020), times 100."""
    lms = np.array(
        [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
         [0.0883024619, 0.2817188376, 0.6299787005]]
    ) @ rgb.clip(0, 1)  # fmt: skip
    mix = np.array(
        [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
         [0.0259040371, 0.7827717662, -0.8086757660]]
    )  # fmt: skip
    return np.asarray(100 * mix @ np.cbrt(lms))


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("eyes", EYES)
def test_colours_with_different_meanings_look_different_to_all_eyes(eyes: str, theme: str):
    seen = {name: oklab(EYES[eyes] @ rgb) for name, rgb in colours(theme).items()}
    apart = {pair: float(np.linalg.norm(seen[pair[0]] - seen[pair[1]])) for pair in combinations(MEANINGS, 2)}
    assert min(apart.values()) > 7, apart
    assert apart["good", "bad"] > 15


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_lines_and_text_stand_out_from_the_card(theme: str):
    of = {name: luminance(rgb) for name, rgb in colours(theme).items()}

    def contrast(name: str) -> float:
        low, high = sorted((of[name], of["card"]))
        return (high + 0.05) / (low + 0.05)

    assert {name: contrast(name) for name in ("good", "bad", "path", "mark") if contrast(name) < 3} == {}
    assert {name: contrast(name) for name in ("ink", "faint") if contrast(name) < 4.5} == {}
