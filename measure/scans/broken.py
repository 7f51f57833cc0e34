"""How a scan file that cannot be read is told: damaged ones, and kinds that are not read."""

import struct
from pathlib import Path

from tifffile import TiffFileError

from measure.errors import MeasurementError

# What libraries raise of a file that is not as it should be.
DECODING_ERRORS = (
    RuntimeError,
    ValueError,
    OSError,
    LookupError,
    ArithmeticError,
    TypeError,
    AttributeError,
    MemoryError,
    struct.error,
    TiffFileError,
)


def broken(path: Path, what: str) -> MeasurementError:
    """what: a part of a sentence."""
    return MeasurementError(
        f"{path} is damaged or truncated ({what.rstrip('.')}): copy it anew from the original, or rescan"
    )


def unsupported(path: Path, what: str) -> MeasurementError:
    """what: a part of a sentence."""
    return MeasurementError(
        f"{path} is a TIFF of a kind that is not read ({what}): save it as grey or RGB with 8 or 16 bits a sample"
    )
