"""The exchange formats: writer, importer and coordinate convention of each, imported on demand."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from pipeline.errors import InputError
from pipeline.text.wording import did_you_mean

LARGEST_MISFIT_PX = 0.05  # of a lens in another program's model: a third of the standard deviation of a good mark


MODULES = {  # by format: where its functions write_FORMAT and import_FORMAT, and its convention FORMAT, are
    **dict.fromkeys(("csv", "parquet"), "tables"),
    **dict.fromkeys(("opencv", "colmap"), "pinhole"),
    **dict.fromkeys(("micmac", "mmvii"), "micmac_format"),
    "metashape": "metashape_format",
    "asp": "pinhole",
    "bingo": "tables",
    "geojson": "geojson_format",
    "certificate": "certificate",
}
FORMATS = tuple(name for name in MODULES if name != "certificate")
IMPORTED = ("opencv", "colmap", "micmac", "mmvii", "metashape", "certificate")


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


def format_function(use: Literal["write", "import"], name: str) -> tuple[Callable[..., Any], Convention]:
    """Writer or importer of a format, and its convention. Raises InputError for a format that has none."""
    possible = FORMATS if use == "write" else IMPORTED
    if name not in possible:
        words = f"{name!r}{' to import' if use == 'import' else ''}; possible are {', '.join(possible)}"
        raise InputError(f"there is no format {words}.{did_you_mean(name, possible)}")
    module = import_module(f"pipeline.exchange.{MODULES[name]}")
    return getattr(module, f"{use}_{name}"), getattr(module, name.upper())
