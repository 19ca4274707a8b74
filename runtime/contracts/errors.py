"""The one family of errors that the project raises on purpose.

Every message is one line: what was found, what was expected, what to do. The command line prints it and exits with
``exit_code``; anything outside this family is a bug and keeps its traceback.
"""

from __future__ import annotations


class EdgeError(Exception):
    """Base of all errors raised on purpose.

    Attributes:
        exit_code: what the command line exits with: 2 the user's input is wrong, 1 the goal was missed.
    """

    exit_code = 2


class ManifestError(EdgeError):
    """A model directory is incomplete, altered, or of another schema."""


class FormatError(EdgeError):
    """A file of a known kind does not hold what its kind demands."""


class FrameError(EdgeError):
    """A stereo frame is unusable: a view is missing, broken, or does not fit the other."""


class SourceError(EdgeError):
    """A source URI is wrong, or what it names is not there."""


class SessionError(EdgeError):
    """A model cannot be loaded or run by ONNX Runtime."""


class RigError(EdgeError):
    """The camera rig is too far from the one the model was made for."""


class OutputError(EdgeError):
    """A place to write to is taken or cannot be written."""


class CheckpointError(EdgeError):
    """Weights or priors do not fit the preset."""


class MissingExtraError(EdgeError):
    """An optional package is needed and not installed; the message holds the line to install it."""


class GoalMissedError(EdgeError):
    """The command ran, but the goal it was given was missed (parity, budget)."""

    exit_code = 1
