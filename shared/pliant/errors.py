"""Errors that the user can fix: one line with what, where and what to do, no traceback."""


class PliantError(Exception):
    """Base of every error that a user can mend.  The command line prints its text and exits 1."""


class DatasetError(PliantError):
    """A source of frames cannot be read: missing folder, no images, broken timestamps."""


class SourceLostError(DatasetError):
    """A source failed after its first frame: the run ends early and keeps what came before."""


class CalibrationError(PliantError):
    """A calibration is missing, malformed or impossible."""


class ConfigError(PliantError):
    """A configuration file or ``--set`` names an unknown key or an impossible value."""


class MessageError(PliantError):
    """Bytes that are not the message that their topic carries."""


class BusError(PliantError):
    """A peer cannot be reached, or a port is in use."""


class SessionOverError(BusError):
    """Nothing is left to do: everything of the session is on the recorder's disk."""


class RecordingError(PliantError):
    """A recording cannot be written or read."""


class MapError(PliantError):
    """A map that was kept cannot be read, written or used."""


class ResultError(PliantError):
    """A result folder or a trajectory file cannot be read, or would be overwritten."""


class StateError(PliantError):
    """The state of a service cannot be saved or loaded."""
