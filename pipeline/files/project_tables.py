"""Tables of project.toml, and all keys for the documentation."""

import math
from typing import Annotated, Any

from measure.fiducials.options import Reads
from measure.geometry import POSES
from pipeline.files.adjust_table import AdjustSettings
from pipeline.files.camera_tables import CameraTable, DistortionTable, FiducialTable, SigmaTable, Source
from pipeline.files.mark_table import MARK_TABLES
from pipeline.files.target_table import TARGET_TABLES, TieTable
from pipeline.text.table_models import (
    FilePath,
    FilePaths,
    Key,
    Sigma,
    Values,
    choice,
    key_rows,
    number_or_pair,
    number_or_word,
    table_model,
)
from pipeline.text.text_file import FINEST_PITCH_UM

_COARSEST_PITCH_UM = 1e4  # larger values were probably meant as nm: at this pitch no mark is visible
TONES = ("linear", "srgb")  # in addition to auto and an exponent
UNITS_MM = {"m": 1000.0, "dm": 100.0, "cm": 10.0, "mm": 1.0}


def _pitch(value: Any) -> tuple[float, float]:
    pitch = number_or_pair(value)
    if not all(0.0 < each < math.inf for each in pitch):
        raise ValueError(f"must be positive, not {list(pitch)}.")
    if min(pitch) < FINEST_PITCH_UM:
        raise ValueError(f"{min(pitch):g} µm is finer than any scanner. Give µm: 20.0, not 0.02.")
    if max(pitch) > _COARSEST_PITCH_UM:
        raise ValueError(f"{max(pitch):g} µm is coarser than any scan. Give µm: 20.0, not 20000.")
    return pitch


@table_model
class MeasureTable:
    """The table [measure]."""

    pose: Annotated[
        str, choice("auto", *POSES), "Scan orientation: counter-clockwise turn of the scan, then m if mirrored."
    ] = "auto"
    writing: Annotated[Reads, "In which scans the writing about the frame is read."] = "pose"
    tone: Annotated[float | str, number_or_word("auto", *TONES), "How grey values grow with light."] = "auto"


@table_model
class ScannerTable:
    """The table [scanner]."""

    lens: Annotated[
        FilePath | None, "camera.yaml of the digital camera that photographed the film; goes with pitch_um."
    ] = None


@table_model
class ObjectTable:
    """The table [object]."""

    points: Annotated[FilePath | None, "points.csv: object points."] = None
    images: Annotated[FilePath | None, "images.csv: exterior orientations; absent: found."] = None
    distances: Annotated[FilePath | None, "distances.csv: measured distances."] = None
    unit: Annotated[str, choice(*UNITS_MM), "Unit of the object coordinates."] = "m"
    crs: Annotated[str, 'Coordinate reference system, such as "EPSG:25832".'] = ""
    board_bend: Annotated[Sigma, "Of the board's middle off its plane, object units."] = 0.0
    transparent: Annotated[bool, "Whether a flat field is visible from both sides."] = False
    antenna_offset: Annotated[
        tuple[float, float, float], "Of the observed stations from the projection centres; goes with images."
    ] = (0.0, 0.0, 0.0)


@table_model
class ProjectTable:
    """project.toml."""

    camera: Annotated[FilePath, 'Camera file, or "library:NAME".']
    scans: Annotated[FilePaths | None, "Scans, by names and patterns; absent: comparator.csv is given."] = None
    exclude: Annotated[FilePaths, "Patterns of scans to leave out."] = ()
    comparator: Annotated[FilePath, "Read where there are no scans, written otherwise."] = "comparator.csv"
    pitch_um: Annotated[
        tuple[float, float] | None,
        Key("number or [x, y]", _pitch),
        "Of a pixel of the scans; absent: by the files' resolution tags, or the marks.",
    ] = None
    output: Annotated[FilePath, "Folder of the results."] = "out"
    measure: Annotated[MeasureTable, "How to measure."] = MeasureTable()
    scanner: Annotated[ScannerTable, "What took the scans."] = ScannerTable()
    targets: Annotated[Values | None, "What the targets are; absent: only fiducials are measured."] = None
    ties: Annotated[Values | None, "Natural points; absent: none are sought."] = None
    object: Annotated[ObjectTable, "Object space."] = ObjectTable()
    adjust: Annotated[AdjustSettings, "How to adjust."] = AdjustSettings()


def keys_text() -> str:
    """Tables of all keys of project.toml and camera.toml, in Markdown."""
    tables: list[tuple[str, type]] = [
        ("project.toml", ProjectTable),
        ("[measure]", MeasureTable),
        ("[scanner]", ScannerTable),
        ("[object]", ObjectTable),
        *((f'[targets], kind = "{kind}"', model) for kind, model in TARGET_TABLES.items()),
        ("[ties]", TieTable),
        ("[adjust]", AdjustSettings),
        ("camera.toml", CameraTable),
        ("[sigma]", SigmaTable),
        ("[distortion]", DistortionTable),
        ("[[fiducial]]", FiducialTable),
        *((f'[mark.NAME], kind = "{kind}"', model) for kind, model in MARK_TABLES.items()),
        ("[source]", Source),
    ]
    lines = ["# Keys of project.toml and camera.toml", ""]
    for title, model in tables:
        lines += [f"## {title}", "", "| key | type | unit | default | meaning |", "|---|---|---|---|---|"]
        lines += [f"| `{r.name}` | {r.type} | {r.unit} | {r.default} | {r.meaning} |" for r in key_rows(model)]
        lines.append("")
    return "\n".join(lines)
