from trifix.bundle import Adjusted, Constraints, NotAdjusted, adjust_steps
from trifix.config import Config, read_config
from trifix.errors import TrifixError
from trifix.evaluation import evaluate
from trifix.files.constraints import read_control, read_scale_bars
from trifix.files.maps import read_map
from trifix.files.recordings import Recording, read_recording
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.live import Live
from trifix.offline import Positions, position
from trifix.outputs.publish import Publisher
from trifix.outputs.report import Report
from trifix.outputs.results import ResultsWriter
from trifix.positioner import Positioner
from trifix.records import (
    Dots,
    Fix,
    Frame,
    KnownLength,
    NoFix,
    Reason,
    ReferenceMap,
    SensorPoints,
    Step,
    StereoDots,
    StereoImages,
    StereoMatches,
)
from trifix.sources.cameras import CameraFrames, Shot, SideBySide, TwoCameras, VideoCamera
from trifix.sources.replay import Replay
from trifix.sources.simulation import simulate
from trifix.stages.detect import detect
from trifix.stages.identify import identifier
from trifix.stages.match import match
from trifix.stages.orient import orient
from trifix.stages.triangulate import correct_eccentricity, triangulate
from trifix.stages.update import update
from trifix.stages.verify import verify

__all__ = [
    "Adjusted",
    "Camera",
    "CameraFrames",
    "Config",
    "Constraints",
    "Dots",
    "Fix",
    "Frame",
    "KnownLength",
    "Live",
    "NoFix",
    "NotAdjusted",
    "Pose",
    "Positioner",
    "Positions",
    "Publisher",
    "Reason",
    "Recording",
    "ReferenceMap",
    "Replay",
    "Report",
    "ResultsWriter",
    "SensorPoints",
    "Shot",
    "SideBySide",
    "Step",
    "StereoDots",
    "StereoImages",
    "StereoMatches",
    "StereoRig",
    "TrifixError",
    "TwoCameras",
    "VideoCamera",
    "adjust_steps",
    "correct_eccentricity",
    "detect",
    "evaluate",
    "identifier",
    "match",
    "orient",
    "position",
    "read_config",
    "read_control",
    "read_map",
    "read_recording",
    "read_scale_bars",
    "simulate",
    "triangulate",
    "update",
    "verify",
]

__version__: str
