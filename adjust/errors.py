"""What adjust raises."""


class AdjustmentError(Exception):
    """A network that cannot be adjusted: contradictory, incomplete or empty.

    The message says what is wrong, at which image, point or mark, what would be right and what to do. A singular
    network is no error: it is a result whose null directions are named.
    """


class NoImageError(AdjustmentError):
    """An adjustment that cannot start, for with the approximations some point has no image."""


class DatumError(AdjustmentError):
    """A choice of the datum that holds the object too much or too little, or names what there is not."""
