"""Exceptions raised by measure."""


class MeasurementError(Exception):
    """A scan cannot be opened, or contradicts its description.

    The message states what is wrong, in which file, what would be valid, and the remedy. A mark that cannot be measured
    is not an error but a measurement with a status and a reason.
    """


class MissingError(MeasurementError):
    """The file does not exist."""


class UnreachableError(MeasurementError):
    """A store or a server did not deliver the file, which may be intact."""


class TooLargeError(MeasurementError):
    """The file declares more pixels than the limit that the user can raise."""
