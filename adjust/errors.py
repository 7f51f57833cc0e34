"""Exceptions of adjust."""

from collections.abc import Collection, Mapping


class AdjustmentError(Exception):
    """Error: the network cannot be adjusted because it is contradictory, incomplete or empty.

    The message says what is wrong, in which image, point or mark, what would be right and what to do. A singular
    network is no error: its result names the null directions.
    """


class UnorientedError(AdjustmentError):
    """Error: no orientation is found for some images.

    reasons: one sentence by name of the image; few: those that show too few known points for an orientation.
    """

    def __init__(self, reasons: Mapping[str, str], few: Collection[str] = ()) -> None:
        super().__init__(next(iter(reasons.values())))
        self.reasons, self.few = dict(reasons), frozenset(few)


class NoImageError(AdjustmentError):
    """Error: the adjustment cannot start because some point has no image with the approximations.

    reasons: one sentence by name of the frame; empty where a whole camera is at fault.
    """

    def __init__(self, message: str, reasons: Mapping[str, str]) -> None:
        super().__init__(message)
        self.reasons = dict(reasons)


class DatumError(AdjustmentError):
    """Error: the chosen datum over- or under-constrains the object, or names unknown points."""
