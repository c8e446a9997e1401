"""One page that shows a run: what came of it, where the targets and the sensor were, what its frames looked like.

Made from the Steps as they pass, of which it keeps a few numbers each and a handful of small pictures. Computes no
result of its own and asks nothing of the network: figures and pictures are part of the page.
"""

from array import array
from datetime import datetime
from pathlib import Path

import numpy as np
from jaxtyping import Int

from trifix.files.tables import write_atomically
from trifix.geometry.camera import StereoRig
from trifix.outputs.course import Course
from trifix.outputs.figures import path_figure, time_figure
from trifix.outputs.page import environment
from trifix.outputs.samples import KINDS, Samples
from trifix.outputs.space import space_of
from trifix.outputs.summary import Summary
from trifix.records import Fix, NoFix, PositionedReason, Reason, ReferenceMap, Step

_NONE = np.zeros(0, dtype=np.int64)


class Report:
    """Watches a run and writes its page.

    report = Report()
    for step in steps:
        report.show(step)
    report.write(out / "report.html", summary)
    """

    def __init__(self) -> None:
        self._samples = Samples()
        self._frame, self._points, self._matched = array("q"), array("q"), array("q")
        self._residual_mm, self._pose = array("d"), array("d")
        self._outcome: list[str] = []
        self._identified: list[Int[np.ndarray, c]] = []
        self._rig: StereoRig | None = None
        self._map = ReferenceMap.empty()

    def show(self, step: Step) -> None:
        """Look at the next frame."""
        self._samples.show(step)
        self._frame.append(step.frame.index)
        self._points.append(0 if step.points is None else len(step.points))
        self._map = step.map
        if self._rig is None:
            self._rig = step.frame.rig
        match step.fix:
            case Fix() as fix:
                self._identified.append(step.map.id[fix.target])
                T = fix.T_world_sensor
                self._outcome.append("positioned")
                self._matched.append(len(fix.point))
                self._residual_mm.append(fix.rms_mm)
                self._pose.extend((*T.t_mm, *T.R[:, 1], *T.R[:, 2]))
            case NoFix() as refusal:
                self._outcome.append(refusal.why.name)
                self._identified.append(_NONE)
                self._matched.append(refusal.matched)
                self._residual_mm.append(np.nan)
                self._pose.extend((np.nan,) * 9)

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
            space=space_of(course, self._map, self._rig, self._identified, summary.advice),
            samples=samples,
            kinds=[kind for kind in KINDS if kind in drawn],
            sentences={each.name: each.value for each in (*PositionedReason, *Reason)},
            refusals=[each.name for each in Reason],
        )
        write_atomically(path, text)

    def _course(self) -> Course:
        pose = np.array(self._pose).reshape(-1, 9)
        return Course(
            frame=np.array(self._frame, dtype=np.int64),
            outcome=self._outcome,
            points=np.array(self._points, dtype=np.int64),
            matched=np.array(self._matched, dtype=np.int64),
            residual_mm=np.array(self._residual_mm),
            position_mm=pose[:, :3],
            down=pose[:, 3:6],
            forward=pose[:, 6:],
        )
