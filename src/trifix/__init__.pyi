from trifix.config import Config
from trifix.errors import TrifixError
from trifix.evaluation import evaluate
from trifix.files.maps import read_map
from trifix.files.recordings import Recording
from trifix.geometry.camera import Camera
from trifix.geometry.pose import Pose
from trifix.outputs.report import Report
from trifix.outputs.results import ResultsWriter
from trifix.positioner import Positioner
from trifix.sources.simulation import simulate
from trifix.stages.detect import detect
from trifix.stages.identify import identifier
from trifix.stages.match import match
from trifix.stages.orient import orient
from trifix.stages.triangulate import triangulate
from trifix.stages.update import update
from trifix.stages.verify import verify

__all__ = [
    "Camera",
    "Config",
    "Pose",
    "Positioner",
    "Recording",
    "Report",
    "ResultsWriter",
    "TrifixError",
    "detect",
    "evaluate",
    "identifier",
    "match",
    "orient",
    "read_map",
    "simulate",
    "triangulate",
    "update",
    "verify",
]

__version__: str
