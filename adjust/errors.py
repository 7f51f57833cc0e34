"""What adjust raises."""

from collections.abc import Mapping


class AdjustmentError(Exception):
    """A network that cannot be adjusted: contradictory, incomplete or empty.

    The message says what is wrong, at which image, point or mark, what would be right and what to do. A singular
    network is no error: it is a result whose null directions are named.
    """


class UnorientedError(AdjustmentError):
    """Images for which no orientation is found, though it is for others; reasons: a sentence on each, by its name."""

    def __init__(self, reasons: Mapping[str, str]) -> None:
        super().__init__(next(iter(reasons.values())))
        self.reasons = dict(reasons)


class NoImageError(AdjustmentError):
    """An adjustment that cannot start, for with the approximations some point has no image; reasons: a sentence on each
    frame of such a point, by its name; none where it is the whole camera's fault."""

    def __init__(self, message: str, reasons: Mapping[str, str]) -> None:
        super().__init__(message)
        self.reasons = dict(reasons)


class DatumError(AdjustmentError):
    """A choice of the datum that holds the object too much or too little, or names what there is not."""
