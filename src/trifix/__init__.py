"""Where is the sensor? Verified poses of a hand-held stereo sensor from identical round targets.

    from trifix import Positioner, read_recording

Names are loaded when they are first used, so that `trifix --help` waits for no numerics; `__init__.pyi` tells type
checkers the same names.
"""

from importlib import import_module
from importlib.metadata import version

_MODULE_OF = {
    "Adjusted": "trifix.bundle",
    "Camera": "trifix.geometry.camera",
    "CameraFrames": "trifix.sources.cameras",
    "Config": "trifix.config",
    "Constraints": "trifix.bundle",
    "Dots": "trifix.records",
    "Fix": "trifix.records",
    "Frame": "trifix.records",
    "KnownLength": "trifix.records",
    "Live": "trifix.live",
    "NoFix": "trifix.records",
    "NotAdjusted": "trifix.bundle",
    "Pose": "trifix.geometry.pose",
    "Positioner": "trifix.positioner",
    "Positions": "trifix.offline",
    "Publisher": "trifix.outputs.publish",
    "Reason": "trifix.records",
    "Recording": "trifix.files.recordings",
    "ReferenceMap": "trifix.records",
    "Replay": "trifix.sources.replay",
    "Report": "trifix.outputs.report",
    "ResultsWriter": "trifix.outputs.results",
    "SensorPoints": "trifix.records",
    "Shot": "trifix.sources.cameras",
    "SideBySide": "trifix.sources.cameras",
    "Step": "trifix.records",
    "StereoDots": "trifix.records",
    "StereoImages": "trifix.records",
    "StereoMatches": "trifix.records",
    "StereoRig": "trifix.geometry.camera",
    "TrifixError": "trifix.errors",
    "TwoCameras": "trifix.sources.cameras",
    "VideoCamera": "trifix.sources.cameras",
    "adjust_steps": "trifix.bundle",
    "correct_eccentricity": "trifix.stages.triangulate",
    "detect": "trifix.stages.detect",
    "evaluate": "trifix.evaluation",
    "identifier": "trifix.stages.identify",
    "match": "trifix.stages.match",
    "orient": "trifix.stages.orient",
    "position": "trifix.offline",
    "read_config": "trifix.config",
    "read_control": "trifix.files.constraints",
    "read_map": "trifix.files.maps",
    "read_recording": "trifix.files.recordings",
    "read_scale_bars": "trifix.files.constraints",
    "simulate": "trifix.sources.simulation",
    "triangulate": "trifix.stages.triangulate",
    "update": "trifix.stages.update",
    "verify": "trifix.stages.verify",
}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("trifix")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'trifix' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
