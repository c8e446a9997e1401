"""Options are read from their declarations, and what is wrong with a given one is said in a sentence."""

from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Literal

import pytest

from trifix.config import Config, read_config, sentences, to_toml, with_overrides, with_values
from trifix.errors import ConfigError


@dataclass(frozen=True)
class MixOptions:
    """Options of a stage made up for the tests."""

    depth_mm: float = 2.5
    """How deep (mm), in a sentence
    of two lines."""
    times: int = 3
    """How often."""
    way: Literal["up", "down"] = "up"
    """Which way."""
    is_slow: bool = False
    """Whether to take time."""
    name: str = "plain"
    """What to call it."""

    def __post_init__(self) -> None:
        if self.depth_mm <= 0:
            raise ConfigError(f"mix.depth_mm is {self.depth_mm}, expected more than 0.")


@dataclass(frozen=True)
class Kitchen:
    """Two stages composed."""

    mix: MixOptions = field(default_factory=MixOptions)
    """The first."""
    bake: MixOptions = field(default_factory=MixOptions)
    """The second."""


def message(values: object) -> str:
    with pytest.raises(ConfigError) as caught:
        with_values(Kitchen(), values, source="my.toml")
    return str(caught.value)


def test_given_values_take_their_place_and_the_rest_keeps_its_default() -> None:
    kitchen = with_values(Kitchen(), {"bake": {"depth_mm": 4, "way": "down", "name": "sweet"}}, source="my.toml")
    assert kitchen.mix == MixOptions()
    assert kitchen.bake == MixOptions(depth_mm=4.0, way="down", name="sweet")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"mix": {"dept_mm": 1}}, "my.toml: mix.dept_mm is unknown; did you mean mix.depth_mm?"),
        ({"mixx": {}}, "my.toml: mixx is unknown; did you mean mix?"),
        ({"boil": {}}, "my.toml: boil is unknown; expected one of mix, bake."),
        ({"mix": 3}, "my.toml: mix is 3, expected a section [mix]."),
        ({"mix": {"depth_mm": "deep"}}, 'my.toml: mix.depth_mm is "deep", expected a number.'),
        ({"mix": {"depth_mm": float("nan")}}, "my.toml: mix.depth_mm is nan, expected a finite number."),
        ({"mix": {"depth_mm": float("-inf")}}, "my.toml: mix.depth_mm is -inf, expected a finite number."),
        ({"mix": {"times": 2.5}}, "my.toml: mix.times is 2.5, expected a whole number."),
        ({"mix": {"times": True}}, "my.toml: mix.times is true, expected a whole number."),
        ({"mix": {"is_slow": 1}}, "my.toml: mix.is_slow is 1, expected true or false."),
        ({"mix": {"way": "left"}}, 'my.toml: mix.way is "left", expected one of "up", "down".'),
        ({"mix": {"name": [1, "a"]}}, 'my.toml: mix.name is [1, "a"], expected a text.'),
        ({"mix": {"name": date(2026, 1, 2)}}, 'my.toml: mix.name is "2026-01-02", expected a text.'),
        ({"mix": {"times": {"a": 1}}}, "my.toml: mix.times is a section, expected a whole number."),
        ({"mix": {"depth_mm": -1}}, "my.toml: mix.depth_mm is -1.0, expected more than 0."),
    ],
)
def test_an_error_names_source_key_finding_and_expectation(values: object, text: str) -> None:
    assert message(values) == text


def test_each_sentence_is_found_under_its_field() -> None:
    assert sentences(MixOptions)["depth_mm"] == "How deep (mm), in a sentence of two lines."
    assert list(sentences(MixOptions)) == ["depth_mm", "times", "way", "is_slow", "name"]


def test_toml_holds_sections_values_and_sentences() -> None:
    lines = to_toml(Kitchen()).splitlines()
    assert lines[:5] == [
        "[mix]",
        "# How deep (mm), in a sentence of two lines.",
        "depth_mm = 2.5",
        "# How often.",
        "times = 3",
    ]
    assert 'name = "plain"' in lines
    assert "is_slow = false" in lines
    assert lines.index("[bake]") > lines.index("[mix]")


def test_every_option_has_its_sentence() -> None:
    uncommented = [
        line
        for above, line in zip(to_toml(Config()).splitlines(), to_toml(Config()).splitlines()[1:], strict=False)
        if " =" in line and not line.startswith("#") and not above.startswith("# ")
    ]
    assert uncommented == []


def test_the_effective_options_are_read_back_as_they_were(tmp_path: Path) -> None:
    changed = with_overrides(Config(), {"match.max_depth_mm": "900", "match.max_size_ratio": "1e9"})
    assert changed != Config()
    path = tmp_path / "options.toml"
    path.write_text(to_toml(changed), encoding="utf-8")
    assert read_config(path) == changed
    assert read_config(str(path)) == changed


def test_overrides_need_no_quotes_and_take_effect_together() -> None:
    config = with_overrides(Config(), {"detect.polarity": "dark", "match.max_depth_mm": "900"})
    assert config.detect.polarity == "dark"
    assert config.match.max_depth_mm == 900.0
    assert with_overrides(Config(), {"detect.polarity": '"dark"'}).detect.polarity == "dark"


def test_an_unknown_override_names_the_nearest() -> None:
    with pytest.raises(
        ConfigError, match=r"^command line: match\.max_dept_mm is unknown; did you mean match\.max_depth_mm\?$"
    ):
        with_overrides(Config(), {"match.max_dept_mm": "900"})


def test_a_section_cannot_be_a_value_too() -> None:
    with pytest.raises(ConfigError, match=r"^command line: match\.max_depth_mm goes inside match, which"):
        with_overrides(Config(), {"match": "3", "match.max_depth_mm": "900"})


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"[match", "is not TOML"),
        (b"\xff\xfe", "is not text"),
        (None, "does not exist."),
    ],
)
def test_a_file_that_is_no_configuration_is_refused(tmp_path: Path, content: bytes | None, text: str) -> None:
    path = tmp_path / "options.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read_config(path)
    assert text in str(caught.value)
    assert str(path) in str(caught.value)
