"""The table of formats: what writes and what reads each, where it counts from, and what goes out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from pipeline.errors import InputError
from pipeline.text.wording import did_you_mean

LARGEST_MISFIT_PX = 0.05  # of a lens in another program's model: a third of a good mark's own standard deviation


@dataclass(frozen=True)
class Format:
    """module: of this folder, imported where the format is asked for; writer, reader: its functions, "" without."""

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


def format_writer(name: str) -> tuple[Callable[..., Written], Convention]:
    """What writes a format, and its convention. Raises InputError for a format that is not written."""
    module, known = _module(name, FORMATS, "")
    return getattr(module, known.writer), module.CONVENTION


def format_reader(name: str) -> Callable[..., Any]:
    """What reads a format. Raises InputError for a format that is not read."""
    module, known = _module(name, IMPORTED, " to import")
    reader: Callable[..., Any] = getattr(module, known.reader)
    return reader


def _module(name: str, possible: tuple[str, ...], use: str) -> tuple[Any, Format]:
    if name not in possible:
        hint = did_you_mean(name, possible)
        raise InputError(f"there is no format {name!r}{use}; possible are {', '.join(possible)}.{hint}")
    return import_module(f"pipeline.exchange.{TABLE[name].module}"), TABLE[name]
