"""What can go wrong through nobody's mistake but the input's: one sentence each, saying what was found, what was
expected and what to do. What happens in honest use (a frame that cannot be positioned) is a value, not an error."""


class TrifixError(Exception):
    """A fault in what was given to trifix. Its text is one sentence for the person who gave it."""


class CalibrationError(TrifixError):
    """A calibration that is missing, broken or impossible."""


class RecordingError(TrifixError):
    """A recording that is missing, incomplete or contradicts itself."""


class CameraError(TrifixError):
    """A camera that cannot be opened."""


class MapError(TrifixError):
    """A reference map that cannot be used."""


class ConfigError(TrifixError):
    """An option that does not exist or has an impossible value."""


class SimulationError(TrifixError):
    """A scene that does not exist or cannot be simulated as asked."""


class AdjustmentError(TrifixError):
    """Observations that do not determine what is to be adjusted."""


class ViewerError(TrifixError):
    """A page that cannot be shown: what it needs is missing, or its port is taken."""
