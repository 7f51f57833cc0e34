"""Files of other programs: XML, and what is imported before it is written as files of this one."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np

from adjust.functional_model.lens import Distortion, Prior
from pipeline.errors import InputError
from pipeline.exchange.formats import Convention
from pipeline.files.camera_file import CameraFile, GivenFiducial
from pipeline.files.camera_tables import DEFAULT_SIGMA_MM
from pipeline.text.files import read_bytes
from pipeline.text.wording import counted
from pipeline.types import Array

Element = ElementTree.Element
Content: TypeAlias = "str | float | Array | Mapping[str, Content] | Sequence[tuple[str, Content]]"

Y_DOWN_Z_FORWARD = np.diag([1.0, -1.0, -1.0])  # from the camera's axes (y up, looking along -z) to these programs' axes
DEEPEST = 100  # largest nesting depth of elements: no format here has ten


class _Builder(ElementTree.TreeBuilder):
    """Builder of a tree of limited depth, without a document type, since it may define entities."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.depth = path, 0

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        self.depth += 1
        if self.depth > DEEPEST:
            raise InputError(f"{self.path}: its elements are nested more than {DEEPEST} deep; no such file is read.")
        return super().start(tag, attrs)

    def end(self, tag: str) -> Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise InputError(
            f"{self.path}: has a document type (<!DOCTYPE>), and entities are not expanded here. No program's "
            "measurements have one: remove it, or export the file again."
        )


def read_xml(path: Path) -> Element:
    """Read the root element of a file. Raises InputError for a missing file, broken XML, and any document type."""
    try:
        return ElementTree.XML(read_bytes(path), ElementTree.XMLParser(target=_Builder(path)))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; an XML file is needed here.") from None
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: is not valid XML ({error}). Export it again from the other program.") from None


def child_text(element: Element, name: str, path: Path) -> str:
    """Text of the one child element of a name. Raises InputError where there is none, or several."""
    found = element.findall(name)
    if len(found) > 1:
        raise InputError(
            f"{path}: <{element.tag}> has {len(found)} times <{name}>; once is right. Remove the wrong one."
        )
    if not found or found[0].text is None:
        raise InputError(f"{path}: <{element.tag}> has no <{name}>. Is it a file of this format?")
    return found[0].text.strip()


def child_numbers(element: Element, name: str, count: int, path: Path) -> list[float]:
    """The given count of numbers in the text of a child element. Raises InputError for any other text."""
    text = child_text(element, name, path)
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{path}: <{name}> is {text[:60]!r}; it should be {counted(count, 'number')}.")
    return values


def xml_text(name: str, content: Content) -> str:
    """Document with one root element: text, numbers, or elements by their names (pairs, where a name recurs)."""
    root = _element(name, content)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode", short_empty_elements=False)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def _element(name: str, content: Content) -> Element:
    element = Element(name)
    if isinstance(content, str):
        element.text = content
    elif isinstance(content, float | np.ndarray):
        element.text = " ".join(repr(float(value)) for value in np.ravel(content))
    else:
        children = content.items() if isinstance(content, Mapping) else content
        element.extend(_element(*child) for child in children)
    return element


@dataclass(frozen=True)
class ForeignMark:
    """A mark of another program. place (2,): column and row, with the first pixel's centre at (0, 0); covariance_px2
    (2, 2): None where the other program has none."""

    image: str
    point: str
    kind: Literal["fiducial", "target"]
    place: Array
    covariance_px2: Array | None


@dataclass(frozen=True)
class ForeignPose:
    """Exterior orientation of an image: rotation (3, 3) from the object to axes x right, y up, looking along -z;
    station (3,); camera: name of its camera, "" where the other program has one of all images."""

    image: str
    rotation: Array
    station: Array
    camera: str = ""


@dataclass(frozen=True)
class ImportOptions:
    """Options of the import.

    Attributes
    ----------
    pitch_um : pixel pitch of the other program's images.
    sigma_px : standard deviation of marks that have none.
    from_middle : the principal point refers to the centre of the image, as for a film camera.
    """

    pitch_um: float | None = None
    sigma_px: float | None = None
    from_middle: bool = False
    fiducials: bool = False


@dataclass(frozen=True)
class Incoming:
    """Content of another program's files. notes: remarks for the user; tables: files that are written as they are;
    left_out: what cannot be read, with the reasons."""

    marks: tuple[ForeignMark, ...] = ()
    cameras: tuple[CameraFile, ...] = ()
    poses: tuple[ForeignPose, ...] = ()
    notes: tuple[str, ...] = ()
    tables: dict[str, str] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()


def opencv_camera(
    path: Path,
    name: str,
    interior_px: Sequence[float],
    lens: Mapping[str, float],
    size_px: tuple[float, float] | None,
    options: ImportOptions,
    convention: Convention,
    family: str = "opencv",
) -> CameraFile:
    """Camera in OpenCV's model, or its fisheye model, with all parameters fixed.

    The principal point is in comparator coordinates of the image, or relative to the image's centre.

    Parameters
    ----------
    interior_px : fx, fy, cx, cy (4,) in px of the convention.

    Raises
    ------
    InputError : the pitch, or the size that is needed for the centre, is unknown.
    """
    if options.pitch_um is None:
        raise InputError(f"{path}: counts in pixels: give the pixel size in µm with --pitch-um.")
    fx, fy, cx, cy = interior_px
    if not (min(fx, fy) > 0.0 and np.isfinite([*interior_px, *lens.values()]).all()):
        raise InputError(f"{path}: {name}: focal lengths are to be positive, and all values of the lens finite.")
    pitch = options.pitch_um / 1000.0
    first = np.array(convention.first_pixel_px)
    if options.from_middle:
        if size_px is None:
            raise InputError(
                f"{path}: does not say the picture's size, so its middle is not known. Leave --from-middle out."
            )
        first += (np.array(size_px) - 1.0) / 2.0
    x0, y0 = (np.array([cx, cy]) - first) * (pitch, -pitch)
    given = {key: Prior(float(value)) for key, value in {"b1": fx / fy - 1.0, **lens}.items() if value != 0.0}
    return CameraFile(
        path=path,
        name=name,
        frame_mm=None if size_px is None else (float(size_px[0] * pitch), float(size_px[1] * pitch)),
        principal_distance_mm=float(fy * pitch),
        principal_point_mm=(float(x0), float(y0)),
        principal_distance_sigma_mm=0.0,
        principal_point_sigma_mm=(0.0, 0.0),
        distortion=Distortion(family, given) if given or family != "opencv" else Distortion(),
        fiducials=(),
    )


def fiducial_camera(name: str, places: Mapping[str, Array]) -> CameraFile:
    """Camera of which only fiducial marks are known, mm.

    They may be counted from a corner of the frame, so the principal point starts at the centre of the marks.
    """
    xy = np.array(list(places.values()))
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    sigma = (DEFAULT_SIGMA_MM, DEFAULT_SIGMA_MM)
    fiducials = [GivenFiducial(id, (float(x), float(y)), sigma, None, True) for id, (x, y) in places.items()]
    return CameraFile(
        path=Path(name),
        name=name,
        frame_mm=None,
        principal_distance_mm=None,
        principal_point_mm=(float(middle[0]), float(middle[1])),
        principal_distance_sigma_mm=math.inf,
        principal_point_sigma_mm=(math.inf, math.inf),
        distortion=Distortion(),
        fiducials=tuple(fiducials),
    )


def foreign_pose(image: str, rotation: Array, translation: Array, camera: str) -> ForeignPose:
    """Convert an orientation with axes x right, y down, z forward: `camera = rotation X + translation`."""
    return ForeignPose(image, np.asarray(Y_DOWN_Z_FORWARD @ rotation), np.asarray(-rotation.T @ translation), camera)
