"""Two runs of one recording side by side: which frames each positioned, how far their poses and maps are apart.

Looks at what their folders hold and nothing else. Knows no truth, so it cannot say which of the two is right: that is
asked of ``trifix evaluate``.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trifix.errors import RecordingError
from trifix.evaluation import Spread, compare_poses
from trifix.files.tables import write_atomically
from trifix.geometry.pose import Pose
from trifix.outputs.figures import difference_figure, path_figure, time_figure
from trifix.outputs.page import environment
from trifix.outputs.runs import Run
from trifix.outputs.space import space_of
from trifix.records import Reason, ReferenceMap

SIGMAS = 5.0
"""Two targets nearest to each other are the same if they are no further apart than this (standard deviations)."""
_LEAST_SIGMA_MM = 0.05  # of a difference between two maps, whose worlds are aligned no better
_SAME_WORLD_MM = 1.0  # targets given with one number are in one world if they are as near as this
_MOST_WORST = 5
_PRINTED_MM = 1e-6  # poses.csv tells no smaller difference


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """How far the two poses of each of n frames are apart; NaN where a run gave none."""

    frame: Int[np.ndarray, "n"]
    """Numbers of the frames that both judged."""
    mm: Float[np.ndarray, "n"]
    """Distance of the positions (mm)."""
    deg: Float[np.ndarray, "n"]
    """Angle between the rotations (degrees)."""
    sigmas: Float[np.ndarray, "n"]
    """Both in standard deviations, rms over the six degrees of freedom; NaN also where both poses are certain."""
    T_first_second: Pose
    """Takes the world of the second run to that of the first."""
    is_aligned: bool
    """The worlds differ: that motion was found by alignment over the common frames."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A number of each run."""

    first: float | None
    """Of the first."""
    second: float | None
    """Of the second."""


@dataclass(frozen=True, slots=True)
class FrameDifference:
    """How far the two poses of a frame are apart."""

    frame: int
    """Its number."""
    mm: float
    """Distance of the positions (mm)."""
    deg: float
    """Angle between the rotations (degrees)."""
    sigmas: float | None
    """Both in standard deviations; None where both poses are certain."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two runs side by side."""

    first: str
    """Folder of the first run."""
    second: str
    """Folder of the second."""
    recording: str
    """Name of the recording."""
    is_finished: tuple[bool, bool]
    """Whether each run reached its end."""
    is_online: tuple[bool, bool]
    """Whether each judged every frame by what was known at its time."""
    frames: int
    """Frames that both judged."""
    judged_by_one: int
    """Frames that only one of them judged; no further number counts these."""
    positioned_by_both: int
    """Frames to which both gave a pose."""
    positioned_by_first: int
    """Frames to which the first alone gave one."""
    positioned_by_second: int
    """Frames to which the second alone gave one."""
    positioned_by_none: int
    """Frames that both refused."""
    refused: dict[str, Pair]
    """Refused frames per reason."""
    special: dict[str, Pair]
    """Positioned frames per what is special about their pose."""
    is_aligned: bool
    """The worlds differ: the second was brought into the first by one rigid motion over the common frames."""
    difference_mm: Spread
    """Distance between the two positions of a frame (mm)."""
    difference_deg: Spread
    """Angle between its two rotations (degrees)."""
    difference_sigmas: Spread
    """Distance of its two poses in standard deviations, rms over the six degrees of freedom: about 1 where errors are
    independent and covariances honest, less where both runs share their errors."""
    furthest: tuple[FrameDifference, ...]
    """The frames whose poses are furthest apart (mm), worst first."""
    targets: dict[str, Pair]
    """Targets per state."""
    targets_in_both: int
    """Targets of the first map that stand in the second, nearest to each other and within ``SIGMAS``."""
    targets_in_first: int
    """Targets of the first map only."""
    targets_in_second: int
    """Targets of the second map only."""
    target_mm: Spread
    """Distance between the two places of a target in both maps (mm)."""
    target_sigmas: Spread
    """The same in standard deviations, rms over the three axes."""
    residual_mm: Pair
    """Rms residual of the identified points (mm)."""
    residual_px: Pair
    """Rms residual of the identified dots (px)."""
    noise_scale: Pair
    """Factor on all standard deviations that each run found."""
    frame_ms: Pair
    """Median time of a frame (ms)."""
    frame_ms_p99: Pair
    """99th percentile of it (ms)."""
    frames_per_s: Pair
    """Frames judged per second."""
    options: dict[str, tuple[object, object]]
    """Options that differ, by their full names."""
    versions: dict[str, tuple[object, object]]
    """Versions that differ."""


def differences(first: Run, second: Run) -> Differences:
    """How far the poses of two runs are apart, in one world.

    Raises:
        RecordingError: they are not of one recording.
    """
    frames = _common_frames(first, second)
    both = np.array([frame in first.poses and frame in second.poses for frame in frames], dtype=np.bool_)
    found = [frame for frame, is_found in zip(frames, both.tolist(), strict=True) if is_found]
    is_same_world = _is_same_world(first, second)
    ours, theirs = [first.poses[frame] for frame in found], [second.poses[frame] for frame in found]
    errors = compare_poses(theirs, ours, is_map_given=is_same_world)
    T = errors.T_truth_world
    cov = [first.cov[frame] + second.cov[frame] for frame in found]  # in sensor coordinates, which differ by little
    mm, deg, sigmas = np.full((3, len(frames)), np.nan)
    mm[both], deg[both] = errors.error_mm, errors.error_deg
    sigmas[both] = [_sigmas(a.inverse() @ T @ b, C) for a, b, C in zip(ours, theirs, cov, strict=True)]
    return Differences(np.array(frames, dtype=np.int64), mm, deg, sigmas, T, not is_same_world)


def compare_runs(first: Run, second: Run) -> Comparison:
    """Two runs side by side.

    Raises:
        RecordingError: they are not of one recording.
    """
    apart = differences(first, second)
    frames, one, two = set(apart.frame.tolist()), first.summary, second.summary
    ours, theirs = frames & set(first.poses), frames & set(second.poses)
    reasons = [Counter(name for name in run.reason if name) for run in (first, second)]
    by_reason = {name: Pair(reasons[0][name], reasons[1][name]) for name, _ in (reasons[0] + reasons[1]).most_common()}
    target_mm, target_sigmas = _target_differences(first.map, second.map, apart.T_first_second)
    times = [run.timings.get("total") for run in (one, two)]
    return Comparison(
        first=str(first.path),
        second=str(second.path),
        recording=one.recording,
        is_finished=(one.finished, two.finished),
        is_online=(one.is_online, two.is_online),
        frames=len(frames),
        judged_by_one=len(first.course.frame) + len(second.course.frame) - 2 * len(frames),
        positioned_by_both=len(ours & theirs),
        positioned_by_first=len(ours - theirs),
        positioned_by_second=len(theirs - ours),
        positioned_by_none=len(frames - ours - theirs),
        refused={name: pair for name, pair in by_reason.items() if name in Reason.__members__},
        special={name: pair for name, pair in by_reason.items() if name not in Reason.__members__},
        is_aligned=apart.is_aligned,
        difference_mm=_spread(apart.mm),
        difference_deg=_spread(apart.deg),
        difference_sigmas=_spread(apart.sigmas),
        furthest=_furthest(apart),
        targets={state: Pair(count, two.targets.get(state, 0)) for state, count in one.targets.items()},
        targets_in_both=len(target_mm),
        targets_in_first=int(first.map.alive.sum()) - len(target_mm),
        targets_in_second=int(second.map.alive.sum()) - len(target_mm),
        target_mm=Spread.of(target_mm),
        target_sigmas=Spread.of(target_sigmas),
        residual_mm=Pair(one.residual_mm.rms, two.residual_mm.rms),
        residual_px=Pair(one.residual_px.rms, two.residual_px.rms),
        noise_scale=Pair(one.noise_scale, two.noise_scale),
        frame_ms=Pair(*(None if each is None else each.median_ms for each in times)),
        frame_ms_p99=Pair(*(None if each is None else each.p99_ms for each in times)),
        frames_per_s=Pair(one.frames_per_s, two.frames_per_s),
        options=_unlike(_flat(one.options), _flat(two.options)),
        versions=_unlike(one.versions, two.versions),
    )


def comparison_table(comparison: Comparison) -> RenderableType:
    """Two runs side by side, for ``rich`` to print."""
    c = comparison
    table = Table.grid(padding=(0, 3))
    table.add_column(style="dim")
    table.add_column(justify="right")
    table.add_column(justify="right")
    table.add_row("", Text(c.first, "bold"), Text(c.second, "bold"))
    for name, one, two in pair_rows(c):
        table.add_row(name, one, two)
    between = Table.grid(padding=(0, 3))
    between.add_column(style="dim")
    between.add_column()
    for name, value in between_rows(c):
        between.add_row(name, Text(value))
    parts: list[RenderableType] = [table, Text(), between]
    if c.options or c.versions:
        unlike = Table.grid(padding=(0, 3))
        for name, values in {**c.options, **c.versions}.items():
            unlike.add_row(Text(name, "dim"), *(Text(_worded(value)) for value in values))
        parts += [Text(), unlike]
    return Group(*parts)


def pair_rows(comparison: Comparison) -> list[tuple[str, str, str]]:
    """Rows of (what, first, second) for people."""
    c = comparison
    positioned = Pair(c.positioned_by_both + c.positioned_by_first, c.positioned_by_both + c.positioned_by_second)
    modes = ["online" if is_online else "offline" for is_online in c.is_online]
    ends = ["" if is_finished else ", cut short" for is_finished in c.is_finished]
    return [
        ("judged", modes[0] + ends[0], modes[1] + ends[1]),
        ("positioned", *_shown(positioned, ".0f")),
        *((f"  {name.replace('_', ' ')}", *_shown(pair, ".0f")) for name, pair in c.special.items()),
        *((f"refused: {name.replace('_', ' ')}", *_shown(pair, ".0f")) for name, pair in c.refused.items()),
        *((f"targets, {state}", *_shown(pair, ".0f")) for state, pair in c.targets.items()),
        ("residual, rms (mm)", *_shown(c.residual_mm, ".3f")),
        ("residual, rms (px)", *_shown(c.residual_px, ".3f")),
        ("noise found", *_shown(c.noise_scale, ".2f")),
        ("time a frame, median (ms)", *_shown(c.frame_ms, ".2f")),
        ("time a frame, 99 % (ms)", *_shown(c.frame_ms_p99, ".2f")),
        ("frames/s", *_shown(c.frames_per_s, ".1f")),
    ]


def between_rows(comparison: Comparison) -> list[tuple[str, str]]:
    """Rows of (what, figure with unit) for people, of what is between the two."""
    c = comparison
    rows = [
        ("frames", f"{c.frames}" + (f", {c.judged_by_one} more judged by one run only" if c.judged_by_one else "")),
        (
            "positioned",
            f"{c.positioned_by_both} by both, {c.positioned_by_first} by the first only, "
            f"{c.positioned_by_second} by the second only, {c.positioned_by_none} by none",
        ),
        (
            "worlds",
            "different: the second was brought into the first by one rigid motion"
            if c.is_aligned
            else "the same, nothing was aligned",
        ),
        ("poses apart, median · rms · worst", _figures(c.difference_mm, " mm")),
        ("", _figures(c.difference_deg, "°")),
        ("", _figures(c.difference_sigmas, " sigma")),
    ]
    if c.furthest:
        rows.append(("furthest apart", ", ".join(f"frame {each.frame} ({each.mm:.3g} mm)" for each in c.furthest)))
    targets = f"{c.targets_in_both} in both, {c.targets_in_first} and {c.targets_in_second} in one only"
    return [
        *rows,
        ("targets", targets),
        ("targets apart, median · rms · worst", _figures(c.target_mm, " mm")),
        ("", _figures(c.target_sigmas, " sigma")),
    ]


def write_comparison(comparison: Comparison, first: Run, second: Run, path: Path) -> None:
    """Writes one self-contained page: the tables, and the figures of the two runs side by side.

    Raises:
        RecordingError: the page cannot be written there.
    """
    apart = differences(first, second)
    text = (
        environment()
        .get_template("comparison.html.jinja")
        .render(
            comparison=comparison,
            pair_rows=pair_rows(comparison),
            between_rows=between_rows(comparison),
            difference_figure=difference_figure(apart.frame, apart.mm, apart.deg, apart.sigmas)
            if comparison.positioned_by_both
            else "",
            runs=[
                {
                    "path": run.path,
                    "is_finished": run.summary.finished,
                    "space": space_of(run.course, run.map, None, run.identified(), run.summary.advice),
                    "time_figure": time_figure(run.course) if len(run.course.frame) else "",
                    "path_figure": path_figure(run.course, run.map) if len(run.course.frame) else "",
                }
                for run in (first, second)
            ],
            worded=_worded,
        )
    )
    try:
        write_atomically(path, text)
    except OSError as error:
        raise RecordingError(f"{path} cannot be written ({error.strerror}): name another file.") from error


def _common_frames(first: Run, second: Run) -> list[int]:
    """Numbers of the frames that both judged, in order.

    Raises:
        RecordingError: a frame was not taken at one time, or there is none in common.
    """
    times = [dict(zip(run.course.frame.tolist(), run.timestamp_ns.tolist(), strict=True)) for run in (first, second)]
    common = sorted(times[0].keys() & times[1].keys())
    for frame in common:
        if times[0][frame] != times[1][frame]:
            raise RecordingError(
                f"{first.path} and {second.path} are not of one recording: frame {frame} was taken at "
                f"{times[0][frame]} ns and {times[1][frame]} ns."
            )
    if not common and times[0] and times[1]:
        raise RecordingError(f"{first.path} and {second.path} have no frame in common: expected one recording.")
    return common


def _is_same_world(first: Run, second: Run) -> bool:
    """Whether one frame, or one given map, defines the world of both."""
    if first.world is not None or second.world is not None:
        return first.world == second.world
    ids, rows, other_rows = np.intersect1d(first.map.id, second.map.id, return_indices=True)
    distance_mm = np.linalg.norm(first.map.xyz_mm[rows] - second.map.xyz_mm[other_rows], axis=1)
    return not len(ids) or float(np.median(distance_mm)) < _SAME_WORLD_MM


def _sigmas(offset: Pose, cov: Float[np.ndarray, "6 6"]) -> float:
    """An offset in standard deviations, rms over six degrees of freedom; NaN where the covariance is none."""
    if np.linalg.eigvalsh(cov)[0] <= 0:
        return float("nan")
    delta = offset.log()
    return float(np.sqrt(delta @ np.linalg.solve(cov, delta) / 6))


def _furthest(apart: Differences) -> tuple[FrameDifference, ...]:
    known = np.flatnonzero(apart.mm > _PRINTED_MM)
    worst = known[np.argsort(-apart.mm[known], kind="stable")][:_MOST_WORST]
    columns = (apart.frame[worst], apart.mm[worst], apart.deg[worst], apart.sigmas[worst])
    return tuple(
        FrameDifference(frame, mm, deg, None if np.isnan(sigmas) else sigmas)
        for frame, mm, deg, sigmas in zip(*(column.tolist() for column in columns), strict=True)
    )


def _spread(value: Float[np.ndarray, "n"]) -> Spread:
    return Spread.of(value[np.isfinite(value)])


def _target_differences(
    first: ReferenceMap, second: ReferenceMap, T_first_second: Pose
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "c"]]:
    """How far targets of both maps are apart: in mm, and in standard deviations (rms over three axes)."""
    from scipy.spatial import KDTree

    ours, theirs = first.rows(np.flatnonzero(first.alive)), second.rows(np.flatnonzero(second.alive))
    if not len(ours) or not len(theirs):
        return np.zeros(0), np.zeros(0)
    moved = T_first_second.apply(theirs.xyz_mm)
    nearest = KDTree(moved).query(ours.xyz_mm)[1]
    is_mutual = KDTree(ours.xyz_mm).query(moved)[1][nearest] == np.arange(len(ours))
    row = np.flatnonzero(is_mutual)
    R = T_first_second.R
    cov = ours.cov_mm2[row] + R @ theirs.cov_mm2[nearest[row]] @ R.T + np.eye(3) * _LEAST_SIGMA_MM**2
    apart = ours.xyz_mm[row] - moved[nearest[row]]
    d2 = np.einsum("ni,ni->n", apart, np.linalg.solve(cov, apart[:, :, None])[:, :, 0])
    is_same = d2 <= SIGMAS**2
    return np.asarray(np.linalg.norm(apart[is_same], axis=1)), np.sqrt(d2[is_same] / 3)


def _flat(options: Mapping[str, object]) -> dict[str, object]:
    """Options by their full names."""
    flat: dict[str, object] = {}
    for section, value in options.items():
        if isinstance(value, dict):
            flat |= {f"{section}.{name}": each for name, each in value.items()}
        else:
            flat[section] = value
    return flat


def _unlike(one: Mapping[str, object], two: Mapping[str, object]) -> dict[str, tuple[object, object]]:
    """Entries that differ."""
    names = dict.fromkeys([*one, *two])
    return {name: (one.get(name), two.get(name)) for name in names if one.get(name) != two.get(name)}


def _shown(pair: Pair, form: str) -> tuple[str, str]:
    one, two = ("–" if each is None else format(each, form) for each in (pair.first, pair.second))
    return one, two


def _figures(spread: Spread, unit: str) -> str:
    if np.isnan(spread.rmse):
        return "none"
    return f"{spread.median:.3g} · {spread.rmse:.3g} · {spread.max:.3g}{unit}"


def _worded(value: object) -> str:
    return "none" if value is None else str(value)
