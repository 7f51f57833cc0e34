"""Tables of project.toml, and all keys for the documentation."""

import math
from typing import Annotated, get_args

from pydantic import Field
from pydantic.dataclasses import dataclass

from measure.fiducials.options import Reads
from measure.geometry import POSES
from pipeline.files.adjust_table import AdjustSettings, read_adjust
from pipeline.files.camera_tables import CameraTable, DistortionTable, FiducialTable, SigmaTable, Source
from pipeline.files.mark_table import MARK_TABLES
from pipeline.files.target_table import TARGET_TABLES, TargetSettings, TieSettings, TieTable, read_targets, read_ties
from pipeline.text.table_models import FLAG, PATH, PATHS, SIGMA, TABLE, TEXT, TRIPLE, Key, choice, key_rows, subtable
from pipeline.text.tables import Table
from pipeline.text.text_file import FINEST_PITCH_UM

_COARSEST_PITCH_UM = 1e4  # larger values were probably meant as nm: at this pitch no mark is visible
TONES = ("linear", "srgb")  # in addition to auto and an exponent
_ADJUST = Key("table", lambda table, key: read_adjust(table.table(key)), AdjustSettings)
_TONE = Key(
    '"auto", "linear", "srgb" or a power',
    lambda table, key: table.number_or_text(key, "auto", ("auto", *TONES), above=0.0),
)
UNITS_MM = {"m": 1000.0, "dm": 100.0, "cm": 10.0, "mm": 1.0}


@dataclass(frozen=True, kw_only=True, config=TABLE)
class MeasureTable:
    """The table [measure]."""

    pose: Annotated[str, choice("auto", *POSES)] = Field(
        default="auto", description="Scan orientation: counter-clockwise turn of the scan, then m if mirrored."
    )
    writing: Annotated[Reads, choice(*get_args(Reads))] = Field(
        default="pose", description="In which scans the writing about the frame is read."
    )
    tone: Annotated[float | str, _TONE] = Field(default="auto", description="How grey values grow with light.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ScannerTable:
    """The table [scanner]."""

    lens: Annotated[str | None, PATH] = Field(
        default=None, description="camera.yaml of the digital camera that photographed the film; goes with pitch_um."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ObjectTable:
    """The table [object]."""

    points: Annotated[str | None, PATH] = Field(default=None, description="points.csv: object points.")
    images: Annotated[str | None, PATH] = Field(
        default=None, description="images.csv: exterior orientations; absent: found."
    )
    distances: Annotated[str | None, PATH] = Field(default=None, description="distances.csv: measured distances.")
    unit: Annotated[str, choice(*UNITS_MM)] = Field(default="m", description="Unit of the object coordinates.")
    crs: Annotated[str, TEXT] = Field(default="", description='Coordinate reference system, such as "EPSG:25832".')
    board_bend: Annotated[float, SIGMA] = Field(
        default=0.0, description="Of the board's middle off its plane, object units."
    )
    transparent: Annotated[bool, FLAG] = Field(
        default=False, description="Whether a flat field is visible from both sides."
    )
    antenna_offset: Annotated[tuple[float, float, float], TRIPLE] = Field(
        default=(0.0, 0.0, 0.0), description="Of the observed stations from the projection centres; goes with images."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ProjectTable:
    """project.toml."""

    camera: Annotated[str, PATH] = Field(description='Camera file, or "library:NAME".')
    scans: Annotated[tuple[str, ...] | None, PATHS] = Field(
        default=None, description="Scans, by names and patterns; absent: comparator.csv is given."
    )
    exclude: Annotated[tuple[str, ...], PATHS] = Field(default=(), description="Patterns of scans to leave out.")
    comparator: Annotated[str, PATH] = Field(
        default="comparator.csv", description="Read where there are no scans, written otherwise."
    )
    pitch_um: Annotated[tuple[float, float] | None, Key("number or [x, y]", lambda table, key: _pitch(table))] = Field(
        default=None, description="Of a pixel of the scans; absent: by the files' resolution tags, or the marks."
    )
    output: Annotated[str, PATH] = Field(default="out", description="Folder of the results.")
    measure: Annotated[MeasureTable, subtable(MeasureTable)] = Field(
        default=MeasureTable(), description="How to measure."
    )
    scanner: Annotated[ScannerTable, subtable(ScannerTable)] = Field(
        default=ScannerTable(), description="What took the scans."
    )
    targets: Annotated[TargetSettings | None, Key("table", lambda table, key: read_targets(table.table(key)))] = Field(
        default=None, description="What the targets are; absent: only fiducials are measured."
    )
    ties: Annotated[TieSettings | None, Key("table", lambda table, key: read_ties(table.table(key)))] = Field(
        default=None, description="Natural points; absent: none are sought."
    )
    object: Annotated[ObjectTable, subtable(ObjectTable)] = Field(default=ObjectTable(), description="Object space.")
    adjust: Annotated[AdjustSettings, _ADJUST] = Field(default=AdjustSettings(), description="How to adjust.")


def _pitch(table: Table) -> tuple[float, float]:
    pitch = table.number_or_pair("pitch_um")
    if not all(0.0 < value < math.inf for value in pitch):
        raise table.error("pitch_um", f"must be positive, not {list(pitch)}.")
    if min(pitch) < FINEST_PITCH_UM:
        raise table.error("pitch_um", f"{min(pitch):g} µm is finer than any scanner. Give µm: 20.0, not 0.02.")
    if max(pitch) > _COARSEST_PITCH_UM:
        raise table.error("pitch_um", f"{max(pitch):g} µm is coarser than any scan. Give µm: 20.0, not 20000.")
    return pitch


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
