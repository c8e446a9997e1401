"""Points x reference map -> hypotheses of which point is which target, likeliest first (the paper's part P7).

One file a technique. A technique keeps whatever it needs of the map's past (pair counts, an index) beside the map and
is told of every change. Hypotheses are not answers: verification decides. Knows no pose.
"""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int

from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify.congruence import IdentifyOptions
from trifix.stages.identify.frequency import FrequencyTriangles

__all__ = ["FrequencyTriangles", "Identifier", "IdentifyOptions", "identifier"]


@runtime_checkable
class Identifier(Protocol):
    """A technique with its memory."""

    def identify(self, points: SensorPoints, map: ReferenceMap) -> Iterator[Identification]:
        """Hypotheses in portions, likeliest first; the later ones are worked out only if asked for."""
        ...

    def learn(self, map: ReferenceMap, seen: Int[np.ndarray, "s"]) -> None:
        """Takes note of the map as it is now, after a frame in which the targets ``seen`` (rows) were seen."""
        ...


def identifier(options: IdentifyOptions) -> Identifier:
    """The technique that the options name, with an empty memory."""
    match options.technique:
        case "frequency":
            return FrequencyTriangles(options)
