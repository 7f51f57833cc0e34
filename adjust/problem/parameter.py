"""The identity of every quantity of an adjustment: a key, its text in files, and its words in messages."""

import re
from collections.abc import Collection, Iterable, Sequence
from typing import Literal, NamedTuple

from adjust.errors import DatumError

Kind = Literal["interior", "fiducial", "scanner", "board", "point", "exterior", "film", "join"]

MANY = "*"  # in the place of an owner or an id: several of them
CODES: dict[Kind, str] = {
    "interior": "IO",
    "fiducial": "FID",
    "scanner": "SC",
    "board": "BD",
    "point": "PT",
    "exterior": "EO",
    "film": "T",
    "join": "JOIN",
}
_KINDS = {code: kind for kind, code in CODES.items()}
_PLURALS: dict[Kind, str] = {
    "fiducial": "several fiducials",
    "board": "several boards",
    "point": "several points",
    "exterior": "several images",
    "film": "several film transformations",
    "join": "several joins",
}


class Parameter(NamedTuple):
    """Which quantity: fixed or estimated, of a camera, a fiducial, an image and so on.

    owner: the camera, scanner, board, image or frame, empty for an object point. id: of a fiducial or an object point,
    the point that joins scans of a frame; empty otherwise. quantity: its name there, without a dot: "c", "x", "omega".
    """

    kind: Kind
    owner: str
    id: str
    quantity: str

    @staticmethod
    def interior(camera: str, quantity: str) -> "Parameter":
        """c, x0, y0 or a distortion parameter."""
        return Parameter("interior", camera, "", quantity)

    @staticmethod
    def fiducial(camera: str, id: str, axis: str) -> "Parameter":
        """x or y."""
        return Parameter("fiducial", camera, id, axis)

    @staticmethod
    def scanner(name: str, term: str) -> "Parameter":
        """A term of the scanner's bend."""
        return Parameter("scanner", name, "", term)

    @staticmethod
    def board(name: str, bend: str) -> "Parameter":
        """A bend of a board of targets."""
        return Parameter("board", name, "", bend)

    @staticmethod
    def point(id: str, axis: str) -> "Parameter":
        """X, Y or Z."""
        return Parameter("point", "", id, axis)

    @staticmethod
    def exterior(image: str, element: str) -> "Parameter":
        """X0, Y0, Z0, omega, phi or kappa; image: the frame's name where it has several scans."""
        return Parameter("exterior", image, "", element)

    @staticmethod
    def film(image: str, quantity: str) -> "Parameter":
        """A parameter of the film transformation."""
        return Parameter("film", image, "", quantity)

    @staticmethod
    def join(frame: str, point: str, axis: str) -> "Parameter":
        """x or y in the camera of a point that scans of one frame have in common."""
        return Parameter("join", frame, point, axis)

    @property
    def text(self) -> str:
        """As files name it: `IO.<camera>.k3`, `FID.<camera>.<id>.x`, `PT.<id>.X`.

        One text is of one key only, and `parameter_from_text` reads it back: where two names stand in it, a dot in the
        second is written %2E.
        """
        match self.kind:
            case "point":
                owner = self.id
            case "fiducial" | "join" if self.id:
                owner = f"{self.owner}.{_escape_dots(self.id)}"
            case _:
                owner = self.owner
        return f"{CODES[self.kind]}.{owner}.{self.quantity}"

    @property
    def label_in_camera(self) -> str:
        """The quantity of a camera, by itself or by its fiducial."""
        return f"{self.quantity} of fiducial {self.id}" if self.id else self.quantity

    @property
    def label(self) -> str:
        """As messages name it: "k3 of camera Wild RC8", "x of fiducial 3, camera Wild RC8"."""
        return f"{self.quantity} of {self._owner_label}"

    @property
    def any_owner(self) -> "Parameter":
        """The quantity of all that are alike: of any image, of any fiducial of the camera."""
        match self.kind:
            case "interior" | "scanner":
                return self
            case "fiducial":
                return self._replace(id=MANY)
            case "point":
                return self._replace(id=MANY)
            case _:
                return self._replace(owner=MANY, id="")

    @property
    def _owner_label(self) -> str:
        match self.kind:
            case "fiducial":
                of = _PLURALS["fiducial"] if self.id == MANY else f"fiducial {self.id}"
                return f"{of}, camera {self.owner}"
            case "point":
                return _PLURALS["point"] if self.id == MANY else f"point {self.id}"
            case "interior":
                return f"camera {self.owner}"
            case "scanner":
                return f"scanner {self.owner}"
            case kind if self.owner == MANY:
                return _PLURALS[kind]
            case "exterior":
                return f"image {self.owner}"
            case "film":
                return f"the film transformation of image {self.owner}"
            case "join":
                return f"join {self.id}, frame {self.owner}"
            case _:
                return f"board {self.owner}"


def description(parameters: Iterable[Parameter]) -> str:
    """Several in words, those of one owner together: "c and x0 of camera K; Z0 of several images"."""
    quantities: dict[str, list[str]] = {}
    for each in parameters:
        quantities.setdefault(each._owner_label, []).append(each.quantity)
    return "; ".join(f"{enumeration(names)} of {owner}" for owner, names in quantities.items())


def parameter_from_text(text: str, cameras: Collection[str] = ()) -> Parameter:
    """The key of a text that `Parameter.text` has written. Raises ValueError for any other.

    cameras: all that the file has. An earlier version wrote a dot in a fiducial's id as it is; such an id is known by
    its camera.
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
    """The keys of all texts of one file. Raises ValueError for a text that names nothing."""
    cameras = {each.owner for each in map(_parameter, texts) if each.kind == "interior"}
    return tuple(parameter_from_text(text, cameras) for text in texts)


def _parameter(text: str) -> Parameter:
    code, _, rest = text.partition(".")
    owner, dot, quantity = rest.rpartition(".")
    kind = _KINDS.get(code)
    if kind is None or not dot or not quantity.isidentifier():
        raise ValueError(f"{text!r} names no quantity of an adjustment")
    if kind == "point":
        return Parameter.point(owner, quantity)
    if kind not in ("fiducial", "join") or owner == MANY:
        return Parameter(kind, owner, "", quantity)
    owner, dot, id = owner.rpartition(".")
    if not dot:
        raise ValueError(f"{text!r} names no quantity of an adjustment: {CODES[kind]} takes two names")
    return Parameter(kind, owner, _unescape_dots(id), quantity)


def as_parameter(parameter: Parameter | str) -> Parameter:
    """A key as it is, or that of a text."""
    return parameter_from_text(parameter) if isinstance(parameter, str) else parameter


def object_coordinate(text: str) -> Parameter:
    """The coordinate that a user calls "12.X". Raises DatumError where the last part is not X, Y or Z."""
    point, _, axis = text.rpartition(".")
    if axis not in ("X", "Y", "Z"):
        raise DatumError(f"The datum coordinate {text} is none: write the point, a dot and X, Y or Z, such as 12.X.")
    return Parameter.point(point, axis)


def _escape_dots(name: str) -> str:
    """A percent sign is written %25 where it could be mistaken for the beginning of %2E or %25."""
    return re.sub(r"%(?=2E|25)", "%25", name).replace(".", "%2E") if "." in name or "%" in name else name


def _unescape_dots(name: str) -> str:
    return re.sub(r"%(2E|25)", lambda found: "." if found[1] == "2E" else "%", name)


def enumeration(names: Sequence[str]) -> str:
    """Words as a sentence lists them: with commas, and `and` before the last one."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
