"""What measure raises."""


class MeasurementError(Exception):
    """A scan that cannot be opened, or that cannot be what it is said to be.

    The message says what is wrong, in which file, what would be right and what to do. A mark that cannot be measured is
    no error: it is a measurement with a status and a reason.
    """


class MissingError(MeasurementError):
    """There is no such file."""


class UnreachableError(MeasurementError):
    """A store or a server did not give it: what is there is not known, and may be whole."""


class TooLargeError(MeasurementError):
    """The file claims more pixels than are read, unless the user allows them."""
