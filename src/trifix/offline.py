"""A whole recording in one call: positioned, judged again by all that became known, adjusted together.

For those who want the answers and neither files nor progress; ``running.py`` does the same with both.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from trifix.bundle import Adjusted, Constraints, NotAdjusted, adjust_steps
from trifix.config import Config
from trifix.files.recordings import Recording, read_recording
from trifix.positioner import Positioner
from trifix.records import Fix, NoFix, ReferenceMap


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """A whole recording, positioned."""

    frame: Int[np.ndarray, "n"]
    """Numbers of the frames."""
    timestamp_ns: Int[np.ndarray, "n"]
    """Their times (ns)."""
    fixes: tuple[Fix | NoFix, ...]
    """The answer for each of them."""
    map: ReferenceMap
    """The targets, as known in the end."""
    noise_scale: float
    """Factor on all standard deviations that the recording turned out to need."""
    adjusted: Adjusted | NotAdjusted
    """What adjusting everything together did, or why nothing was adjusted."""


def position(
    recording: Recording | Path | str,
    config: Config | None = None,
    map: ReferenceMap | None = None,
    is_map_frozen: bool = False,
) -> Positions:
    """Every frame of a recording positioned by all that the whole recording tells, adjusted together, in one call.

    Raises:
        TrifixError: the recording cannot be read.
    """
    positioner = Positioner(config, map, is_map_frozen)
    if not isinstance(recording, Recording):
        recording = read_recording(Path(recording), sigma_px=positioner.config.noise.sigma_px)
    steps = [step.remembered() for step in positioner.run(recording)]
    revised = [replace(step, identification=None) for step in positioner.revise(steps)]
    final, adjusted = adjust_steps(
        revised, positioner.config, Constraints(map), is_noise_stated=recording.is_noise_stated
    )
    fixes = tuple(step.fix for step in final)
    targets = final[-1].map.copy() if final else positioner.map.copy()
    scale = final[-1].noise_scale if final else positioner.noise.scale
    return Positions(recording.index, recording.timestamp_ns, fixes, targets, scale, adjusted)
