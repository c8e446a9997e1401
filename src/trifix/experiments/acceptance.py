"""A virtual acceptance test: how wrong are lengths that the program measures, on a simulated artefact?

After VDI/VDE 2634 part 1 (point by point probing; at least seven measuring lines through the volume, five test lengths
on each) and in the spirit of ISO 10360-13: single views, joined by reference targets, and scale bars of known length.
The artefact is ``trifix simulate artefact``; nothing of it was ever built, and no certificate follows from it.

Lengths are taken from the map of a whole run, adjusted together, as ``trifix run`` gives it. Knows no page and no file.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from trifix.bundle import Constraints, NotAdjusted, adjust_steps
from trifix.config import Config
from trifix.errors import TrifixError
from trifix.positioner import Positioner
from trifix.records import Fix, KnownLength, PositionedReason, ReferenceMap, Step
from trifix.sources.scenes import BARS_MM, LINES_MM, ON_A_LINE
from trifix.sources.simulation import Simulation, simulate_frames

BAR_SIGMA_MM = 0.002
"""Standard deviation of a scale bar's calibrated length: 2 µm."""
_NEAR_MM = 3.0  # a target of the map this near to where a true one should be is that one

Show = Callable[[str, int, int], None]
"""Called with what is done, and how much of how much of it."""


@dataclass(frozen=True, slots=True)
class Limit:
    """The largest error that is permitted: E = a + L / K (VDI/VDE 2634 part 1)."""

    constant_mm: float = 0.015
    """a (mm)."""
    slope_mm_m: float = 0.015
    """1 / K (mm per metre)."""

    def at(self, length_mm: float) -> float:
        """The largest error of a length (mm)."""
        return self.constant_mm + self.slope_mm_m * length_mm / 1000


@dataclass(frozen=True, slots=True)
class TestLength:
    """One length, measured and true."""

    __test__ = False  # no test of pytest's

    seed: int
    """Of the recording."""
    line: int
    """Measuring line, from 1."""
    length_mm: float
    """True length (mm)."""
    error_mm: float
    """Measured less true (mm)."""
    sigma_mm: float
    """Standard deviation that the joint covariance of the map predicts for it (mm)."""


@dataclass(frozen=True, slots=True)
class Acceptance:
    """What came of it."""

    lengths: tuple[TestLength, ...]
    """All test lengths of all recordings."""
    limit: Limit
    """What is permitted."""
    frames: int
    """Of each recording."""
    bars: int
    """Scale bars that were used."""
    missing: int
    """Test lengths that could not be measured, as a target was not in the map."""

    @property
    def exceeding(self) -> int:
        """Lengths whose error is larger than permitted."""
        return sum(abs(each.error_mm) > self.limit.at(each.length_mm) for each in self.lengths)

    @property
    def is_met(self) -> bool:
        """Whether all lengths were measured, none with more error than permitted."""
        return not self.exceeding and not self.missing

    @property
    def largest_mm(self) -> float:
        """Largest error (mm)."""
        return max((abs(each.error_mm) for each in self.lengths), default=float("nan"))

    @property
    def normalised_rms(self) -> float:
        """Root mean square of the errors over their predicted standard deviations: 1 if these are honest."""
        return float(np.sqrt(np.mean([(each.error_mm / each.sigma_mm) ** 2 for each in self.lengths])))


def run_acceptance(
    seeds: Int[np.ndarray, "s"],
    frames: int,
    bars: int = len(BARS_MM),
    limit: Limit = Limit(),
    config: Config | None = None,
    show: Show | None = None,
) -> Acceptance:
    """The test lengths of the artefact, measured in one recording a seed.

    Raises:
        TrifixError: a recording could not be positioned or adjusted.
    """
    lengths: list[TestLength] = []
    missing = 0
    for seed in seeds.tolist():
        found, lost = _measured(seed, frames, bars, config or Config(), show)
        lengths += found
        missing += lost
    return Acceptance(tuple(lengths), limit, frames, bars, missing)


def _measured(seed: int, frames: int, bars: int, config: Config, show: Show | None) -> tuple[list[TestLength], int]:
    simulation = simulate_frames("artefact", seed, "dots", frames)
    positioner = Positioner(config, is_noise_stated=True)
    judged = list[Step]()
    for step in positioner.run(simulation.frames):
        judged.append(step.remembered())
        if show is not None:
            show(f"recording {seed}", len(judged), frames)
    steps = [*positioner.revise(judged)]
    row_of = _rows_of_true_targets(steps, simulation)
    first_end = len(LINES_MM) * ON_A_LINE
    known = []
    for k in range(bars):
        ends = [row_of.get(first_end + 2 * k + end, -1) for end in (0, 1)]
        if min(ends) < 0:
            raise TrifixError(f"Scale bar {k + 1} of recording {seed} was not found: are {frames} frames too few?")
        a, b = steps[-1].map.id[ends].tolist()
        known.append(
            KnownLength(a, b, _true_length(simulation, first_end + 2 * k, first_end + 2 * k + 1), BAR_SIGMA_MM)
        )
    adjusted, outcome = adjust_steps(steps, config, Constraints(lengths=known), is_noise_stated=True)
    if isinstance(outcome, NotAdjusted):
        raise TrifixError(f"Recording {seed} could not be adjusted: {outcome.why}")
    map = adjusted[-1].map
    lengths, missing = list[TestLength](), 0
    for line in range(len(LINES_MM)):
        start = line * ON_A_LINE
        for end in range(start + 1, start + ON_A_LINE):
            if start not in row_of or end not in row_of:
                missing += 1
                continue
            length_mm, sigma_mm = map.distance(row_of[start], row_of[end])
            true_mm = _true_length(simulation, start, end)
            lengths.append(TestLength(seed, line + 1, true_mm, length_mm - true_mm, sigma_mm))
    return lengths, missing


def _true_length(simulation: Simulation, a: int, b: int) -> float:
    xyz_mm = simulation.truth.targets.xyz_mm
    return float(np.linalg.norm(xyz_mm[a] - xyz_mm[b]))


def _rows_of_true_targets(steps: list[Step], simulation: Simulation) -> dict[int, int]:
    """Row in the map of each true target that is there, by place."""
    first = next(
        (k for k, step in enumerate(steps) if _defines_world(step)),
        None,
    )
    if first is None:
        raise TrifixError("No frame defines the world, so nothing can be measured.")
    T_world_map = simulation.truth.frames.T_map_sensor[first].inverse()
    true_mm = T_world_map.apply(simulation.truth.targets.xyz_mm)
    map = steps[-1].map
    alive = np.flatnonzero(map.alive)
    distance = _distances(map, alive, true_mm)
    nearest = distance.argmin(axis=1)
    is_there = distance[np.arange(len(true_mm)), nearest] < _NEAR_MM
    return {int(k): int(alive[nearest[k]]) for k in np.flatnonzero(is_there)}


def _defines_world(step: Step) -> bool:
    return isinstance(step.fix, Fix) and step.fix.reason is PositionedReason.defines_world


def _distances(
    map: ReferenceMap, rows: Int[np.ndarray, "a"], true_mm: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k a"]:
    return np.asarray(np.linalg.norm(true_mm[:, None] - map.xyz_mm[rows][None], axis=2))
