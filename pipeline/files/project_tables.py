"""Tables of project.toml, among them [adjust], and all keys for the documentation.

Keys are checked by `pipeline.text.table_models.read_model`.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal, get_args

from adjust.functional_model.scanner import is_term
from adjust.functional_model.transformation import FILM_NAMES, film_kind
from adjust.problem.network import Transformation
from adjust.quality.critical_values import PRIOR_GROUPS, WeightFunction
from adjust.solution.options import MEASURED_KINDS, Datum, Method
from measure.fiducials.options import Reads
from measure.geometry import POSES
from pipeline.files.camera_tables import CameraTable, DistortionTable, FiducialTable, SigmaTable, Source
from pipeline.files.mark_table import MARK_TABLES
from pipeline.files.target_table import TARGET_TABLES, TieSettings
from pipeline.text import table_models
from pipeline.text.files import FINEST_PITCH_UM

ScannerSetting = Literal["none", "auto", "bend"] | tuple[str, ...]

_COARSEST_PITCH_UM = 1e4  # larger values were probably meant as nm: at this pitch no mark is visible
TONES = ("linear", "srgb")  # in addition to auto and an exponent
UNITS_MM = {"m": 1000.0, "dm": 100.0, "cm": 10.0, "mm": 1.0}


def scanner_setting(*words: str) -> table_models.Key:
    """Type of a scanner's bend: one of some words, or a list of terms."""

    def read(value: Any) -> str | tuple[str, ...]:
        if not isinstance(value, list | tuple):
            return str(table_models.choice(*words).read(value))
        terms = table_models.texts(value)
        for term in terms:
            if not is_term(term):
                raise ValueError(
                    f"names {term!r}; a bend has the terms a20, b11 and the like, with the degrees in x and y, "
                    "together 2 to 6, and stretch, shear, tilt_x, tilt_y."
                )
        if len(set(terms)) < max(len(terms), 1):
            raise ValueError('is empty or names a term twice. Where there is to be no bend, write "none".')
        return terms

    return table_models.Key("word or list of terms", read)


def _robust(value: Any) -> bool | str:
    if isinstance(value, bool):
        return value
    if table_models.text(value) not in get_args(WeightFunction):
        raise ValueError(f"is {value!r}; possible are true, false, {', '.join(get_args(WeightFunction))}.")
    return str(value)


def _variance_components(value: Any) -> bool | tuple[str, ...]:
    if isinstance(value, bool):
        return value
    names, known = table_models.texts(value), (*MEASURED_KINDS, *PRIOR_GROUPS)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"names {unknown[0]!r}; possible are {', '.join(known)}.")
    return names


def _datum_names(value: Any) -> tuple[str, ...]:
    names = table_models.texts(value)
    if value == []:
        raise ValueError("is an empty list. Leave it out where the program is to choose.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"names {twice[0]!r} twice.")
    return names


def _scanner_sigma(value: Any) -> float:
    sigma_um = table_models.sigma(value)
    if sigma_um == 0.0:
        raise ValueError('is 0, which would fix every term at 0: write scanner = "none" for that.')
    return sigma_um


Film = Annotated[
    Transformation, table_models.Key("text", partial(table_models.known_name, find=film_kind, names=FILM_NAMES))
]
ScannerSigma = Annotated[float, table_models.Key("standard deviation", _scanner_sigma)]
_Names = Annotated[tuple[str, ...], table_models.Key("list of texts", _datum_names)]


@table_models.table_model
class AdjustSettings:
    """The table [adjust]: film model, datum, weights and tests. Standard deviations in µm at the film."""

    transformation: Annotated[Film | None, "Film deformation model; absent: affine, or none without fiducials."] = None
    datum: Annotated[Datum, "What fixes the object system."] = "control"
    datum_coordinates: Annotated[
        _Names, "The coordinates that a minimal datum holds; absent: the program chooses."
    ] = ()
    datum_points: Annotated[_Names, "The points over which a free network has inner constraints; absent: all."] = ()
    sigma_target_um: Annotated[table_models.Positive, "Of a target where comparator.csv has none."] = 5.0
    sigma_fiducial_um: Annotated[table_models.Positive, "Of a fiducial where comparator.csv has none."] = 5.0
    film_sigma_um: Annotated[
        table_models.NotNegative, "Film and scanner: added in quadrature to every comparator sigma."
    ] = 0.0
    unmodelled: Annotated[
        Literal["none", "estimate"], "Standard deviation of what the model lacks, one a camera, added to its targets."
    ] = "none"
    scanner: Annotated[
        ScannerSetting,
        scanner_setting("none", "auto", "bend"),
        "Bend of the scanner: none, bend (degrees 2, 3), auto (by tests), or terms.",
    ] = "none"
    scanner_sigma_um: Annotated[ScannerSigma, "Prior of every term of the bend, which is given as 0; absent: free."] = (
        math.inf
    )
    refraction: Annotated[bool, "Correct for atmospheric refraction."] = False
    earth_curvature: Annotated[bool, "Correct for the curvature of the earth."] = False
    robust: Annotated[
        bool | WeightFunction,
        table_models.Key("true, false or a weight function", _robust),
        "Reweight gross errors; true: Huber's weights.",
    ] = False
    variance_components: Annotated[
        bool | tuple[str, ...],
        table_models.Key("true, false or list of groups", _variance_components),
        "Estimate the variances of groups of observations.",
    ] = False
    snooping: Annotated[bool, "Take gross errors out one by one (data snooping)."] = False
    method: Annotated[Method, "One combined adjustment, or by observed elements."] = "combined"

    def __post_init__(self) -> None:
        """Raises WrongKey for keys that contradict each other."""
        for key, datum in (("datum_coordinates", "minimal"), ("datum_points", "free")):
            if getattr(self, key) and self.datum != datum:
                raise table_models.WrongKey(
                    key, f'goes with datum = "{datum}", and the datum here is "{self.datum}". Change one of the two.'
                )
        if self.robust and self.snooping:
            raise table_models.WrongKey(
                "snooping", "and robust both take out gross errors. Set one of the two to false."
            )


def _pitch(value: Any) -> tuple[float, float]:
    pitch = table_models.number_or_pair(value)
    if not all(0.0 < each < math.inf for each in pitch):
        raise ValueError(f"must be positive, not {value}.")
    if min(pitch) < FINEST_PITCH_UM:
        raise ValueError(f"{min(pitch):g} µm is finer than any scanner. Give µm: 20.0, not 0.02.")
    if max(pitch) > _COARSEST_PITCH_UM:
        raise ValueError(f"{max(pitch):g} µm is coarser than any scan. Give µm: 20.0, not 20000.")
    return pitch


_ORIENTATION = table_models.choice("auto", *POSES)


@table_models.table_model
class MeasureTable:
    """The table [measure]."""

    scan_orientation: Annotated[
        str | None, _ORIENTATION, "Counter-clockwise turn of the scan, then m if mirrored; absent: auto."
    ] = None
    pose: Annotated[str | None, _ORIENTATION, "Another name of scan_orientation."] = None
    writing: Annotated[Reads, "In which scans the writing about the frame is read."] = "pose"
    tone: Annotated[float | str, table_models.number_or_word("auto", *TONES), "How grey values grow with light."] = (
        "auto"
    )

    def __post_init__(self) -> None:
        """Raises WrongKey where both names of the scan orientation are given."""
        if self.pose and self.scan_orientation:
            raise table_models.WrongKey("pose", "and scan_orientation are one key. Take one of them out.")

    @property
    def orientation(self) -> str:
        return self.scan_orientation or self.pose or "auto"


@table_models.table_model
class ScannerTable:
    """The table [scanner]."""

    lens: Annotated[
        table_models.FilePath | None,
        "camera.yaml of the digital camera that photographed the film; goes with pitch_um.",
    ] = None


@table_models.table_model
class ObjectTable:
    """The table [object]."""

    points: Annotated[table_models.FilePath | None, "points.csv: object points."] = None
    images: Annotated[table_models.FilePath | None, "images.csv: exterior orientations; absent: found."] = None
    distances: Annotated[table_models.FilePath | None, "distances.csv: measured distances."] = None
    unit: Annotated[str, table_models.choice(*UNITS_MM), "Unit of the object coordinates."] = "m"
    crs: Annotated[str, 'Coordinate reference system, such as "EPSG:25832".'] = ""
    board_bend: Annotated[table_models.Sigma, "Of the board's middle off its plane, object units."] = 0.0
    transparent: Annotated[bool, "Whether a flat field is visible from both sides."] = False


@table_models.table_model
class ProjectTable:
    """project.toml."""

    camera: Annotated[table_models.FilePath, 'Camera file, or "library:NAME".']
    scans: Annotated[
        table_models.FilePaths | None, "Scans, by names and patterns; absent: comparator.csv is given."
    ] = None
    exclude: Annotated[table_models.FilePaths, "Patterns of scans to leave out."] = ()
    comparator: Annotated[table_models.FilePath, "Read where there are no scans, written otherwise."] = "comparator.csv"
    pitch_um: Annotated[
        tuple[float, float] | None,
        table_models.Key("number or [x, y]", _pitch),
        "Of a pixel of the scans; absent: by the files' resolution tags, or the marks.",
    ] = None
    output: Annotated[table_models.FilePath, "Folder of the results."] = "out"
    measure: Annotated[MeasureTable, "How to measure."] = MeasureTable()
    scanner: Annotated[ScannerTable, "What took the scans."] = ScannerTable()
    targets: Annotated[table_models.Values | None, "What the targets are; absent: only fiducials are measured."] = None
    ties: Annotated[TieSettings | None, "Natural points; absent: none are sought."] = None
    object: Annotated[ObjectTable, "Object space."] = ObjectTable()
    adjust: Annotated[AdjustSettings, "How to adjust."] = AdjustSettings()


def keys_text() -> str:
    """Tables of all keys of project.toml and camera.toml, in Markdown; keys of most kinds of marks or targets once."""
    tables: list[tuple[str, Iterable[table_models.KeyRow]]] = [
        ("project.toml", table_models.key_rows(ProjectTable)),
        ("[measure]", table_models.key_rows(MeasureTable)),
        ("[scanner]", table_models.key_rows(ScannerTable)),
        ("[object]", table_models.key_rows(ObjectTable)),
        *_rows_by_kind("[targets]", TARGET_TABLES),
        ("[ties]", table_models.key_rows(TieSettings)),
        ("[adjust]", table_models.key_rows(AdjustSettings)),
        ("camera.toml", table_models.key_rows(CameraTable)),
        ("[sigma]", table_models.key_rows(SigmaTable)),
        ("[distortion]", table_models.key_rows(DistortionTable)),
        ("[[fiducial]]", table_models.key_rows(FiducialTable)),
        *_rows_by_kind("[mark.NAME]", MARK_TABLES),
        ("[source]", table_models.key_rows(Source)),
    ]
    lines = ["# Keys of project.toml and camera.toml", ""]
    for title, rows in tables:
        lines += [f"## {title}", "", "| key | type | unit | default | meaning |", "|---|---|---|---|---|"]
        lines += [f"| `{r.name}` | {r.type} | {r.unit} | {r.default} | {r.meaning} |" for r in rows]
        lines.append("")
    return "\n".join(lines)


def _rows_by_kind(title: str, models: Mapping[str, type]) -> Iterator[tuple[str, list[table_models.KeyRow]]]:
    """Yield the rows that most kinds have, and those of each kind alone."""
    rows = {kind: list(table_models.key_rows(model)) for kind, model in models.items()}
    counts = Counter(itertools.chain.from_iterable(rows.values()))
    without = {row: [kind for kind in rows if row not in rows[kind]] for row in counts if 2 * counts[row] > len(rows)}
    notes = {row: f" Not of {', '.join(kinds)}." if kinds else "" for row, kinds in without.items()}
    yield f"{title}, every kind", [replace(row, meaning=row.meaning + notes[row]) for row in without]
    for kind in rows:
        if own := [row for row in rows[kind] if row not in without]:
            yield f'{title}, kind = "{kind}"', own
