"""One page that shows a run: what came of it, where the targets and the sensor were, what its frames looked like.

Made from the Steps as they pass, of which it keeps a few numbers each (of a long run, some of them) and a handful of
small pictures. Computes no result of its own and asks nothing of the network: all figures are part of the page.
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from trifix.files.tables import write_atomically
from trifix.geometry.camera import StereoRig
from trifix.outputs.course import Course
from trifix.outputs.figures import path_figure, time_figure
from trifix.outputs.history import Thinned
from trifix.outputs.page import environment
from trifix.outputs.samples import KINDS, Samples
from trifix.outputs.space import space_of
from trifix.outputs.summary import Summary
from trifix.records import Fix, NoFix, PositionedReason, Reason, ReferenceMap, Step

_NONE = np.zeros(0, dtype=np.int64)
_NOWHERE = np.full(9, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class _Moment:
    """What is kept of a frame."""

    frame: int
    outcome: str
    points: int
    matched: int
    residual_mm: float
    pose: Float[np.ndarray, "9"]
    """Position, down and forward."""
    identified: Int[np.ndarray, "c"]


class Report:
    """Watches a run and writes its page.

    report = Report()
    for step in steps:
        report.show(step)
    report.write(out / "report.html", summary)
    """

    def __init__(self) -> None:
        self._samples = Samples()
        self._moments: Thinned[_Moment] = Thinned()
        self._rig: StereoRig | None = None
        self._map = ReferenceMap.empty()

    def show(self, step: Step) -> None:
        """Look at the next frame."""
        self._samples.show(step)
        self._map = step.map
        if self._rig is None:
            self._rig = step.frame.rig
        frame, points = step.frame.index, 0 if step.points is None else len(step.points)
        match step.fix:
            case Fix() as fix:
                T, identified = fix.T_world_sensor, step.map.id[fix.target]
                pose = np.concatenate([T.t_mm, T.R[:, 1], T.R[:, 2]])
                moment = _Moment(frame, "positioned", points, len(fix.point), fix.rms_mm, pose, identified)
            case NoFix() as refusal:
                moment = _Moment(frame, refusal.why.name, points, refusal.matched, np.nan, _NOWHERE, _NONE)
        self._moments.add(moment)

    def write(self, path: Path, summary: Summary) -> None:
        """Write the page, self-contained."""
        course = self._course()
        samples = self._samples.chosen()
        drawn = {kind for each in samples for picture in each.pictures for kind, uv in picture.dots.items() if len(uv)}
        page = environment().get_template("report.html.jinja")
        text = page.render(
            summary=summary,
            written=datetime.now().astimezone(),
            time_figure=time_figure(course) if len(course.frame) else "",
            path_figure=path_figure(course, self._map) if len(course.frame) else "",
            space=space_of(
                course, self._map, self._rig, [each.identified for each in self._moments.items], summary.advice
            ),
            samples=samples,
            kinds=[kind for kind in KINDS if kind in drawn],
            sentences={each.name: each.value for each in (*PositionedReason, *Reason)},
            refusals=[each.name for each in Reason],
        )
        write_atomically(path, text)

    def _course(self) -> Course:
        kept = self._moments.items
        pose = np.array([each.pose for each in kept]).reshape(-1, 9)
        return Course(
            frame=np.array([each.frame for each in kept], dtype=np.int64),
            outcome=[each.outcome for each in kept],
            points=np.array([each.points for each in kept], dtype=np.int64),
            matched=np.array([each.matched for each in kept], dtype=np.int64),
            residual_mm=np.array([each.residual_mm for each in kept]),
            position_mm=pose[:, :3],
            down=pose[:, 3:6],
            forward=pose[:, 6:],
        )
