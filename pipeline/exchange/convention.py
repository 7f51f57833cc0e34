"""What every format states of itself, and what writing one gives."""

from collections.abc import Mapping
from dataclasses import dataclass

FORMATS = ("csv", "parquet", "opencv", "colmap", "micmac", "mmvii", "metashape", "asp", "bingo", "geojson")
IMPORTED = ("micmac", "mmvii", "metashape", "opencv", "colmap", "certificate")
LARGEST_MISFIT_PX = 0.05  # of a lens in another program's model: a third of a good mark's own standard deviation


@dataclass(frozen=True)
class Convention:
    """Where a format counts from. first_pixel_px: the coordinates that it gives to the centre of the first pixel;
    axes: of picture and camera; source: the public text that says so."""

    first_pixel_px: tuple[float, float]
    axes: str
    source: str


@dataclass(frozen=True)
class ExportOptions:
    """pitch_um: of resampled frames, None that of each scan; with_lens: frames are resampled with their lens taken
    out; largest_misfit_px: a lens that another program's model cannot take better is not handed on."""

    pitch_um: float | None = None
    with_lens: bool = False
    largest_misfit_px: float = LARGEST_MISFIT_PX


@dataclass(frozen=True)
class Written:
    """A format's files by their places below the folder. lost: what it has no place for; notes: what to know of it;
    left_out: images, or parts of them, that did not go out, each with the reason."""

    files: Mapping[str, str | bytes]
    lost: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
