"""Keys of the quantities of an adjustment: their text in files and their description in messages."""

import re
from collections.abc import Collection, Iterable, Sequence
from typing import Literal, NamedTuple

from adjust.errors import DatumError

Kind = Literal["interior", "fiducial", "scanner", "board", "point", "exterior", "film", "join"]

MANY = "*"  # owner or id that stands for several
# By kind: code in files, and its owner in messages, one or several.
_KINDS: dict[Kind, tuple[str, str, str]] = {
    "interior": ("IO", "camera {owner}", ""),
    "fiducial": ("FID", "fiducial {id}, camera {owner}", "several fiducials, camera {owner}"),
    "scanner": ("SC", "scanner {owner}", ""),
    "board": ("BD", "board {owner}", "several boards"),
    "point": ("PT", "point {id}", "several points"),
    "exterior": ("EO", "image {owner}", "several images"),
    "film": ("T", "the film transformation of image {owner}", "several film transformations"),
    "join": ("JOIN", "join {id}, frame {owner}", "several joins"),
}
CODES = {kind: code for kind, (code, _, _) in _KINDS.items()}
_KIND_OF_CODE = {code: kind for kind, code in CODES.items()}


class Parameter(NamedTuple):
    """Key of a quantity, fixed or estimated.

    Attributes
    ----------
    kind : kind of its owner.
    owner : camera, scanner, board, image or frame; empty for an object point.
    id : fiducial, object point or join; else empty.
    quantity : name without a dot: "c", "x", "omega".
    """

    kind: Kind
    owner: str
    id: str
    quantity: str

    @staticmethod
    def interior(camera: str, quantity: str) -> "Parameter":
        """Key of c, x0, y0 or a distortion parameter."""
        return Parameter("interior", camera, "", quantity)

    @staticmethod
    def fiducial(camera: str, id: str, axis: str) -> "Parameter":
        """Key of a fiducial's x or y."""
        return Parameter("fiducial", camera, id, axis)

    @staticmethod
    def scanner(name: str, term: str) -> "Parameter":
        """Key of a scanner term."""
        return Parameter("scanner", name, "", term)

    @staticmethod
    def board(name: str, bend: str) -> "Parameter":
        """Key of a bend of a board."""
        return Parameter("board", name, "", bend)

    @staticmethod
    def point(id: str, axis: str) -> "Parameter":
        """Key of an object point's X, Y or Z."""
        return Parameter("point", "", id, axis)

    @staticmethod
    def exterior(image: str, element: str) -> "Parameter":
        """Key of X0, Y0, Z0, omega, phi or kappa; image: the frame's name where it has several scans."""
        return Parameter("exterior", image, "", element)

    @staticmethod
    def film(image: str, quantity: str) -> "Parameter":
        """Key of a film transformation parameter."""
        return Parameter("film", image, "", quantity)

    @staticmethod
    def join(frame: str, point: str, axis: str) -> "Parameter":
        """Key of x or y, in the camera frame, of a point common to several scans of one frame."""
        return Parameter("join", frame, point, axis)

    @property
    def text(self) -> str:
        """Name in files: `IO.<camera>.k3`, `FID.<camera>.<id>.x`, `PT.<id>.X`.

        The text is unique, and `parameter_from_text` reads it back: if it holds two names, a dot in the second is
        written %2E, and a percent sign %25 where it would be ambiguous.
        """
        match self.kind:
            case "point":
                owner = self.id
            case "fiducial" | "join" if self.id:
                id = self.id
                if "." in id or "%" in id:
                    id = re.sub(r"%(?=2E|25)", "%25", id).replace(".", "%2E")
                owner = f"{self.owner}.{id}"
            case _:
                owner = self.owner
        return f"{CODES[self.kind]}.{owner}.{self.quantity}"

    @property
    def label_in_camera(self) -> str:
        """Name of a quantity of a camera within the camera."""
        return f"{self.quantity} of fiducial {self.id}" if self.id else self.quantity

    @property
    def label(self) -> str:
        """Name in messages: "k3 of camera Wild RC8", "x of fiducial 3, camera Wild RC8"."""
        return f"{self.quantity} of {self._owner_label}"

    @property
    def any_owner(self) -> "Parameter":
        """Key of the same quantity of several owners: of any image, of any fiducial of the camera."""
        if self.kind in ("interior", "scanner"):
            return self
        is_part = self.kind in ("fiducial", "point")
        return self._replace(id=MANY) if is_part else self._replace(owner=MANY, id="")

    @property
    def _owner_label(self) -> str:
        _, one, several = _KINDS[self.kind]
        return (several if several and MANY in (self.owner, self.id) else one).format(owner=self.owner, id=self.id)


def description(parameters: Iterable[Parameter]) -> str:
    """Describe several quantities, grouped by owner: "c and x0 of camera K; Z0 of several images"."""
    quantities: dict[str, list[str]] = {}
    for each in parameters:
        quantities.setdefault(each._owner_label, []).append(each.quantity)
    return "; ".join(f"{enumeration(names)} of {owner}" for owner, names in quantities.items())


def parameter_from_text(text: str, cameras: Collection[str] = ()) -> Parameter:
    """Parse a text written by `Parameter.text`. Raises ValueError for any other.

    cameras: all cameras of the file. An earlier version did not escape dots in the ids of fiducials; such an id is
    recognised by its camera.
    """
    parameter = _parameter(text)
    if parameter.kind != "fiducial" or not cameras or parameter.owner in cameras:
        return parameter
    names = text.removeprefix(f"{CODES['fiducial']}.").removesuffix(f".{parameter.quantity}")
    possible = [camera for camera in cameras if names.startswith(f"{camera}.")]
    if len(possible) != 1:
        return parameter
    return Parameter.fiducial(possible[0], names.removeprefix(f"{possible[0]}."), parameter.quantity)


def parameters_from_texts(texts: Sequence[str]) -> tuple[Parameter, ...]:
    """Parse all texts of one file. Raises ValueError for an invalid text."""
    cameras = {each.owner for each in map(_parameter, texts) if each.kind == "interior"}
    return tuple(parameter_from_text(text, cameras) for text in texts)


def _parameter(text: str) -> Parameter:
    code, _, rest = text.partition(".")
    owner, dot, quantity = rest.rpartition(".")
    kind = _KIND_OF_CODE.get(code)
    if kind is None or not dot or not quantity.isidentifier():
        raise ValueError(f"{text!r} names no quantity of an adjustment")
    if kind == "point":
        return Parameter.point(owner, quantity)
    if kind not in ("fiducial", "join") or owner == MANY:
        return Parameter(kind, owner, "", quantity)
    owner, dot, id = owner.rpartition(".")
    if not dot:
        raise ValueError(f"{text!r} names no quantity of an adjustment: {CODES[kind]} takes two names")
    id = re.sub(r"%(2E|25)", lambda escaped: "." if escaped[1] == "2E" else "%", id)
    return Parameter(kind, owner, id, quantity)


def as_parameter(parameter: Parameter | str) -> Parameter:
    """Return a key unchanged, or parse a text."""
    return parameter_from_text(parameter) if isinstance(parameter, str) else parameter


def object_coordinate(text: str) -> Parameter:
    """Parse a coordinate such as "12.X". Raises DatumError where the last part is not X, Y or Z."""
    point, _, axis = text.rpartition(".")
    if axis not in ("X", "Y", "Z"):
        raise DatumError(f"The datum coordinate {text} is none: write the point, a dot and X, Y or Z, such as 12.X.")
    return Parameter.point(point, axis)


def enumeration(names: Sequence[str]) -> str:
    """Join words with commas, and `and` before the last one."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def shortened(names: Sequence[str], most: int) -> str:
    """Join the first names with commas, and say how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
