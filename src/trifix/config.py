"""All options in one place: every stage's own options composed, read from TOML, written to TOML.

An option is declared once, in the frozen dataclass beside the stage that it steers: its name, unit, type, default and
the sentence that explains it. This module reads all of that from the declaration and knows no single option.
"""

import ast
import difflib
import inspect
import json
import textwrap
import tomllib
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from math import isfinite
from pathlib import Path
from typing import ClassVar, Literal, Protocol, TypeVar, get_args, get_origin, get_type_hints, runtime_checkable

import msgspec

from trifix.adjustment import AdjustOptions, RigSigmas
from trifix.errors import ConfigError
from trifix.files.tables import read_text
from trifix.stages.detect import DetectOptions
from trifix.stages.identify import IdentifyOptions
from trifix.stages.identify.congruence import Technique
from trifix.stages.match import MatchOptions
from trifix.stages.predict import PredictOptions
from trifix.stages.tend import TendOptions
from trifix.stages.triangulate import TriangulateOptions
from trifix.stages.update import UpdateOptions
from trifix.stages.verify import VerifyOptions
from trifix.stages.weigh import NoiseOptions


@runtime_checkable
class Dataclass(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[object]]]


Options = TypeVar("Options", bound=Dataclass)


@dataclass(frozen=True, slots=True)
class IslandOptions:
    """What becomes of frames that nothing connects to the map."""

    max_islands: int = 12
    """Maps beside the world's to keep at most, those of most frames; 0 for none."""
    min_points: int = 4
    """Points that a frame must have to found one."""

    def __post_init__(self) -> None:
        if self.max_islands < 0 or self.min_points < 3:
            raise ConfigError("islands.max_islands must be at least 0 and islands.min_points at least 3.")


@dataclass(frozen=True, slots=True)
class BundleOptions:
    """What is adjusted together once the whole recording is known."""

    adjusts: bool = True
    """Adjust all poses and targets together; otherwise they stay as each frame by itself gave them."""
    refines_rig: bool = False
    """Adjust the cameras' relative pose, focal lengths, principal points and distortion as well."""
    search: AdjustOptions = field(default_factory=AdjustOptions)
    """How observations are weighed, and when to stop."""
    rig: RigSigmas = field(default_factory=RigSigmas)
    """How far the calibration may be off, where it is refined."""


@dataclass(frozen=True, slots=True)
class Config:
    """Every stage's options, in the order of the work."""

    detect: DetectOptions = field(default_factory=DetectOptions)
    """What counts as a dot."""
    match: MatchOptions = field(default_factory=MatchOptions)
    """Which dots of the two images may be the same target."""
    triangulate: TriangulateOptions = field(default_factory=TriangulateOptions)
    """Where two rays that do not quite meet have their point."""
    noise: NoiseOptions = field(default_factory=NoiseOptions)
    """How noisy the recording is taken to be."""
    identify: IdentifyOptions = field(default_factory=IdentifyOptions)
    """Where to look for the target that a point is."""
    predict: PredictOptions = field(default_factory=PredictOptions)
    """How the sensor may move between frames."""
    verify: VerifyOptions = field(default_factory=VerifyOptions)
    """When a pose is believed."""
    update: UpdateOptions = field(default_factory=UpdateOptions)
    """How the map grows."""
    tend: TendOptions = field(default_factory=TendOptions)
    """How the map is kept clean."""
    islands: IslandOptions = field(default_factory=IslandOptions)
    """What becomes of frames that nothing connects to the map."""
    adjust: BundleOptions = field(default_factory=BundleOptions)
    """What is adjusted together once the whole recording is known."""


def read_config(path: Path | str) -> Config:
    """The options of a TOML file; what it leaves out keeps its default.

    Raises:
        ConfigError: the file cannot be read, or holds an unknown key or an impossible value.
    """
    text = read_text(Path(path), ConfigError)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML ({error}); `trifix config` prints one to start from.") from error
    return with_values(Config(), values, source=str(path))


def paper_options(technique: Technique = "frequency") -> Config:
    """The options under which frames are judged as in the paper (Khoury 2006), by one of its techniques.

    One tolerance for all lengths, which 99.7 % of the true sides keep in the simulated scenes, and one threshold for
    all residuals; verification by them alone, over all hypotheses at once; every point stays in the list.
    """
    return Config(
        identify=IdentifyOptions(
            technique=technique,
            frame_triangles="all",
            max_sigmas=0.0,
            tolerance_mm=0.4,
            portion=1_000_000_000,
            max_hypotheses=1_000_000,
            widens=False,
        ),
        verify=VerifyOptions(method="residual", max_residual_mm=0.5),
        update=UpdateOptions(method="kalman", max_misses=0),
        tend=TendOptions(tends=False),
        islands=IslandOptions(max_islands=0),
        adjust=BundleOptions(adjusts=False),
    )


def with_overrides(config: Config, overrides: Mapping[str, str]) -> Config:
    """The same options but for those given as text, such as ``{"match.max_depth_mm": "900"}``.

    Raises:
        ConfigError: a key is unknown or its value impossible.
    """
    values: dict[str, object] = {}
    for key, text in overrides.items():
        *sections, name = key.split(".")
        section = values
        for each in sections:
            inner = section.setdefault(each, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"command line: {key} goes inside {each}, which was given a value of its own.")
            section = inner
        section[name] = _toml_value(text)
    return with_values(config, values, source="command line")


def to_toml(config: Dataclass) -> str:
    """The options as TOML that ``read_config`` reads back, each under its sentence."""
    return "\n".join(_toml_lines(config, section="")).strip() + "\n"


def with_values(options: Options, values: object, source: str, section: str = "") -> Options:
    """A frozen dataclass, nested or not, with the given values in place of its own.

    ``source`` and ``section`` say in an error where the value stood.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{source}: {section} is {_shown(values)}, expected a section [{section}].")
    types = get_type_hints(type(options))
    known = [each.name for each in fields(options)]
    changed: dict[str, object] = {}
    for name, value in values.items():
        key = f"{section}.{name}" if section else name
        if name not in known:
            raise ConfigError(f"{source}: {key} is unknown; {_suggestion(name, known, section)}")
        current = getattr(options, name)
        if is_dataclass(current) and not isinstance(current, type):
            changed[name] = with_values(current, value, source, key)
        else:
            changed[name] = _converted(value, types[name], source, key)
    try:
        return replace(options, **changed)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error


@cache
def sentences(options: type) -> dict[str, str]:
    """The sentence under each field of a dataclass: the string that follows it in the source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(options))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for declaration, below in zip(body.body, body.body[1:], strict=False):
        match declaration, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(sentence))):
                found[name] = " ".join(sentence.split())
    return found


def _converted(value: object, expected: object, source: str, key: str) -> object:
    try:
        converted: object = msgspec.convert(value, type=expected)
    except (msgspec.ValidationError, OverflowError) as error:
        raise ConfigError(f"{source}: {key} is {_shown(value)}, expected {_described(expected)}.") from error
    if isinstance(converted, float) and not isfinite(converted):
        raise ConfigError(f"{source}: {key} is {_shown(value)}, expected a finite number.")
    return converted


def _suggestion(name: str, known: list[str], section: str) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {section}.{near[0]}?" if section else f"did you mean {near[0]}?"
    return f"expected one of {', '.join(known)}."


def _described(expected: object) -> str:
    """A type in words."""
    if get_origin(expected) is Literal:
        return "one of " + ", ".join(map(_shown, get_args(expected)))
    words: dict[object, str] = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    return words[expected]


def _shown(value: object) -> str:
    """A value as it would stand in TOML."""
    match value:
        case dict():
            return "a section"
        case float():
            return repr(value)
        case _:
            return json.dumps(value, ensure_ascii=False, default=str)


def _toml_value(text: str) -> object:
    """What the text says in TOML; the text itself where it says nothing, so that quotes are not needed."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _toml_lines(options: Dataclass, section: str) -> list[str]:
    explained = sentences(type(options))
    own, below = [f"[{section}]"] if section else [], []
    for each in fields(options):
        value = getattr(options, each.name)
        if is_dataclass(value) and not isinstance(value, type):
            below += ["", *_toml_lines(value, f"{section}.{each.name}" if section else each.name)]
            continue
        if each.name in explained:
            own += textwrap.wrap(explained[each.name], 117, initial_indent="# ", subsequent_indent="# ")
        own.append(f"{each.name} = {_shown(value)}")
    return own + below
