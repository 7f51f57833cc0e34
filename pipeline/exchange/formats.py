"""Table of the exchange formats: writer, reader, and coordinate conventions of each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from pipeline.errors import InputError
from pipeline.text.wording import did_you_mean

LARGEST_MISFIT_PX = 0.05  # of a lens in another program's model: a third of the standard deviation of a good mark


@dataclass(frozen=True)
class Format:
    """An exchange format. module: in this folder, imported on demand; writer, reader: names of its functions, ""
    without."""

    module: str
    writer: str = ""
    reader: str = ""


TABLE = {
    "csv": Format("tables", "write_csv"),
    "parquet": Format("tables", "write_parquet"),
    "opencv": Format("opencv_format", "write", "read"),
    "colmap": Format("colmap_format", "write", "read"),
    "micmac": Format("micmac_format", "write", "read"),
    "mmvii": Format("mmvii_format", "write", "read"),
    "metashape": Format("metashape_format", "write", "read"),
    "asp": Format("asp_format", "write"),
    "bingo": Format("bingo_format", "write"),
    "geojson": Format("geojson_format", "write"),
    "certificate": Format("certificate", "", "read"),
}
FORMATS = tuple(name for name, each in TABLE.items() if each.writer)
IMPORTED = tuple(name for name, each in TABLE.items() if each.reader)


@dataclass(frozen=True)
class Convention:
    """Coordinate convention of a format. first_pixel_px: coordinates of the first pixel's centre; axes: of image and
    camera; source: public text that documents them."""

    first_pixel_px: tuple[float, float]
    axes: str
    source: str


@dataclass(frozen=True)
class ExportOptions:
    """Options of the export.

    Attributes
    ----------
    pitch_um : pixel pitch of the resampled frames; None: that of each scan.
    with_lens : the frames are resampled with their distortion removed.
    largest_misfit_px : a lens with a larger misfit in another program's model is not exported.
    """

    pitch_um: float | None = None
    with_lens: bool = False
    largest_misfit_px: float = LARGEST_MISFIT_PX


@dataclass(frozen=True)
class Written:
    """Files of a format by their paths below the folder.

    Attributes
    ----------
    lost : data that the format cannot hold.
    notes : remarks for the user.
    left_out : images, or parts of them, that were not exported, with the reasons.
    readme_text : of the folder; "" before it is written.
    """

    files: Mapping[str, str | bytes]
    lost: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    readme_text: str = ""


def format_writer(name: str) -> tuple[Callable[..., Written], Convention]:
    """Writer of a format, and its convention. Raises InputError for a format that cannot be written."""
    module, known = _module(name, FORMATS, "")
    return getattr(module, known.writer), module.CONVENTION


def format_reader(name: str) -> Callable[..., Any]:
    """Reader of a format. Raises InputError for a format that cannot be read."""
    module, known = _module(name, IMPORTED, " to import")
    reader: Callable[..., Any] = getattr(module, known.reader)
    return reader


def _module(name: str, possible: tuple[str, ...], use: str) -> tuple[Any, Format]:
    if name not in possible:
        hint = did_you_mean(name, possible)
        raise InputError(f"there is no format {name!r}{use}; possible are {', '.join(possible)}.{hint}")
    return import_module(f"pipeline.exchange.{TABLE[name].module}"), TABLE[name]
