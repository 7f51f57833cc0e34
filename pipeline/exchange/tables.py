"""Tables of results: all, in this program's own conventions, in CSV and Parquet; image coordinates for BINGO."""

import io
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from itertools import chain

import numpy as np

from adjust.problem.parameter import Parameter
from pipeline.errors import InputError, missing_extra
from pipeline.exchange.block import ImageBlock, OutFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.results.adjustment_record import AdjustmentRecord, Quantity
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.csv_table import csv_line

CSV = PARQUET = Convention(
    (0.0, 0.0),
    "column right, row down; comparator and camera mm with x right and y up; rotation R3(kappa) R2(phi) R1(omega)",
    "this program's own, docs/method/theory.md",
)

Cell = str | float | bool | None
Row = dict[str, Cell]
Table = dict[str, list[Cell]]


def write_csv(block: ImageBlock, options: ExportOptions) -> Written:
    """Write one CSV file per table; numbers with all their digits."""
    head = f"# {CSV.axes}; the CENTRE of the top-left pixel is (0, 0)"
    files = {}
    for name, table in tables(block).items():
        rows = (csv_line([_cell(value) for value in row]) for row in zip(*table.values(), strict=True))
        files[f"{name}.csv"] = "\n".join([head, csv_line(list(table)), *rows]) + "\n"
    return Written(files)


def write_parquet(block: ImageBlock, options: ExportOptions) -> Written:
    """Write one Parquet file per table. Raises InputError where pyarrow is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise missing_extra("the format parquet", "pyarrow", "parquet") from None
    files = {}
    for name, table in tables(block).items():
        written = io.BytesIO()
        described = pyarrow.table(table).replace_schema_metadata({"conventions": CSV.axes})
        pyarrow.parquet.write_table(described, written)
        files[f"{name}.parquet"] = written.getvalue()
    return Written(files)


def tables(block: ImageBlock) -> Mapping[str, Table]:
    """Tables by name; cells without a value are None. Angles in degrees, their covariances in rad as in
    adjustment.npz."""
    rows: dict[str, Iterable[Row]] = {"marks": (_mark(frame, mark) for frame in block.frames for mark in frame.marks)}
    if adjustment := block.adjustment:
        rows |= {
            "images": (
                {"image": frame.image, "camera": frame.camera, **_values_and_sigmas(known.exterior.elements)}
                for frame in block.oriented_frames()
                for known in [adjustment.images[frame.image]]
            ),
            "transformations": _transformations(adjustment, block),
            "covariances": _covariances(block),
            "points": (
                {"point": id, **_values_and_sigmas(dict(zip("XYZ", point.axes, strict=True)))}
                for id, point in adjustment.points.items()
            ),
            "cameras": _cameras(adjustment),
        }
    columns: dict[str, Table] = {}
    for name, each in rows.items():
        cells = list(each)
        columns[name] = {column: [row[column] for row in cells] for column in (cells[0] if cells else ())}
    return columns


def _mark(frame: OutFrame, mark: ComparatorPoint) -> Row:
    assert mark.xy_mm is not None
    place, sigma = mark.xy_mm, (None, None) if mark.sigma_mm is None else mark.sigma_mm.tolist()
    col, row = frame.pixels((mark,))[0].tolist() if frame.pitch_um else (None, None)
    camera = (None, None) if frame.model is None else frame.camera_mm((mark,))[0].tolist()
    return {
        "image": mark.image,
        "camera": frame.camera,
        "point": mark.point,
        "kind": mark.kind,
        "status": str(mark.status),
        "x_mm": float(place[0]),
        "y_mm": float(place[1]),
        "sx_mm": sigma[0],
        "sy_mm": sigma[1],
        "rho": mark.rho,
        "col_px": col,
        "row_px": row,
        "camera_x_mm": camera[0],
        "camera_y_mm": camera[1],
        "reason": mark.reason,
    }


def _transformations(adjustment: AdjustmentRecord, block: ImageBlock) -> Iterable[Row]:
    for frame in block.frames:
        if frame.model is not None:
            film = adjustment.images[frame.image].transformation
            known: Row = {"image": frame.image, "kind": film.kind, "mirrored": film.mirrored}
            yield from _parameters(known, film.parameters)


def _covariances(block: ImageBlock) -> Iterable[Row]:
    """Covariances of each image's orientation and film: lower triangle; mm, object units and rad."""
    scans, of_image = defaultdict[str, list[str]](list), defaultdict[str, list[Parameter]](list)
    for frame in block.frames:
        scans[block.project.image_frame(frame.image)].append(frame.image)
    covariances = (block.covariance, *block.covariance.images)
    for each in chain.from_iterable(covariance.parameters for covariance in covariances):
        if each.kind in ("exterior", "film"):  # scans of one frame have one orientation, and films of their own
            for image in scans[each.owner] if each.kind == "exterior" else [each.owner]:
                of_image[image].append(each)
    for frame in block.frames:
        own = of_image.get(frame.image, [])
        matrix = block.covariance.select(own)
        for i, first in enumerate(own):
            for j, second in enumerate(own[: i + 1]):
                covariance = float(matrix[i, j])
                yield {"image": frame.image, "first": first.text, "second": second.text, "covariance": covariance}


def _cameras(adjustment: AdjustmentRecord) -> Iterable[Row]:
    for name, camera in adjustment.cameras.items():
        point, distortion = camera.principal_point_mm, camera.distortion
        quantities = {"c_mm": camera.principal_distance_mm, "x0_mm": point.x, "y0_mm": point.y, **distortion.parameters}
        for id, fiducial in camera.fiducials.items():
            quantities |= {f"fiducial {id} x_mm": fiducial.x_mm, f"fiducial {id} y_mm": fiducial.y_mm}
        yield from _parameters({"camera": name, "distortion": distortion.family}, quantities)


def _parameters(known: Row, quantities: Mapping[str, Quantity]) -> Iterable[Row]:
    for name, each in quantities.items():
        yield {**known, "parameter": name, "value": _finite(each.value), "sigma": _finite(each.sigma)}


def _values_and_sigmas(quantities: Mapping[str, Quantity]) -> Row:
    values: Row = {name: each.value for name, each in quantities.items()}
    return values | {f"s{name}": _finite(each.sigma) for name, each in quantities.items()}


def _finite(value: float) -> Cell:
    return value if math.isfinite(value) else None


def _cell(value: Cell) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)


BINGO = Convention(
    (float("nan"), float("nan")),
    "no pixels: x right, y up in mm from the fiducial frame's middle, of a digital camera from its principal point",
    "support.pix4d.com, article 203590305: a line with image and camera, one a point with x and y in mm from the "
    "centre of the image, an empty line behind each image. Which way y points it does not say: up, as everywhere in "
    "photogrammetry",
)


def write_bingo(block: ImageBlock, options: ExportOptions) -> Written:
    """Write bingo.txt with the corrected coordinates of every point of every adjusted image."""
    block.needs_orientation("bingo")
    _check_words(frame.image for frame in block.frames)
    _check_words(mark.point for frame in block.frames for mark in frame.observed_marks(fiducials=False))
    unknown = (scan.image for scan in block.frames if scan.model is None)
    left_out = [f"{image}: it has no part in the adjustment, so its film is not known." for image in unknown]
    texts, interior = [], dict[str, str]()
    for frame in block.whole(scan for scan in block.frames if scan.model is not None):
        lens, camera, marks = frame.lens, _word(frame.camera), frame.observed_marks(fiducials=False)
        # From the centre of the fiducial frame; of a digital camera, which has none, from the principal point.
        origin = np.zeros(2) if block.camera_file(frame.camera).fiducials else lens.interior[1:]
        x, y = lens.interior[1:] - origin
        point = f"principal point {x:.5f}, {y:.5f} mm"
        interior[camera] = (
            f"Camera {camera}: c = {lens.interior[0]:.5f} mm, {point}; the coordinates are free of distortion."
        )
        refined, found = lens.ideal_from_observed(frame.camera_mm(marks))
        lines = [f"{_word(frame.image)} {camera}"]
        for mark, (x, y), usable in zip(marks, (refined - origin).tolist(), found, strict=True):
            if usable:
                lines.append(f"{_word(mark.point)} {x:.6f} {y:.6f}")
            else:
                left_out.append(f"{frame.image}, point {mark.point}: the lens folds there.")
        texts.append("\n".join(lines) + "\n")
    lost = (
        "standard deviations (BINGO takes them by groups)",
        "exterior orientations and object points, whose files no public text describes",
        "fiducial marks",
    )
    return Written({"bingo.txt": "\n".join(texts)}, lost, tuple(interior.values()), tuple(left_out))


def _check_words(names: Iterable[str]) -> None:
    """Raise InputError where two names of images or of points become one word."""
    words = dict[str, str]()
    for name in names:
        if (other := words.setdefault(_word(name), name)) != name:
            both = f"{other!r} and {name!r} would both be {_word(name)!r}"
            raise InputError(f"bingo: {both}, since blanks separate words there. Rename one of them.")


def _word(name: str) -> str:
    """The name without blanks, which separate the words of a line."""
    return "_".join(name.split())
