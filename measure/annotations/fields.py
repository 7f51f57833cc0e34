"""Lines of writing in a scan, and what they say: camera, run, frame, date, height, scale, where their form is known.

One table of patterns. What is ambiguous has a text and no value: a date whose day may be its month, a number that is
perhaps another one's."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher

from measure.marks.shapes import Side

_ALIKE = 0.75  # of the characters of a line that is read twice
_PLAINLY = 5.0  # characters by which one way reads better than any other: a thousand to one
CAMERA = ("camera_type", "camera_number", "principal_distance_mm")  # what a camera's own plate says
STRIP = ("run", "frames", "date", "time", "height", "scale")  # what a title says that was made for the flight
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
_FIRST_YEAR = 20  # of two digits: film from 1920 on; below it may be either century
_DISTANCE = r"((?:8[5-9]|1[45]\d|20\d|21\d|30\d)[.,]\d{1,3})"  # of the cameras that there are, mm
_BEFORE_NUMBER = r"(?:N[RO]\.? ?|AG ?)"  # also of a number that stands right behind a type: UAg 1003
_TYPES = (
    r"[WM]ILD[\w /.-]*",
    r"(?:\d\d ?/ ?\d ?)?S?UA[GS][A-Z-]*",
    r"RMK ?[A-Z]*[\d /]*",
    r"LMK[\d /]*",
    "ZEISS",
    "FAIRCHILD",
)
_MAKERS = {"ILD": "Wild", "UAG": "Wild", "RMK": "Zeiss", "ZEISS": "Zeiss", "LMK": "Jena", "FAIRCHILD": "Fairchild"}
_FILM = re.compile(r"KODAK|SAFETY|\bFILM\b|ESTAR|AGFA|GEVAERT|AVIPHOT|ILFORD|FERRANIA|AEROGRAPHIC|PLUS.?X|DOUBLE.?X")


@dataclass(frozen=True)
class Reading:
    """What a line says if it lies in one way. confidence: the mean of its characters', 0 to 1; legible: how many of
    them can be read."""

    text: str
    confidence: float
    legible: float


@dataclass(frozen=True)
class Line:
    """One line of writing.

    ways: what is read of it by the pose in which it may lie (that of a writing which lies upright in its own frame);
    only the four along its own direction: a quarter turn is no question. pose: the way that is taken for the right one.
    outline_px: the corners (column, row) of the rectangle about it, clockwise in the scan. side: of the scan, at which
    it stands.
    """

    ways: Mapping[str, Reading]
    pose: str
    outline_px: tuple[tuple[float, float], ...]
    side: Side

    @property
    def text(self) -> str:
        return self.ways[self.pose].text

    @property
    def confidence(self) -> float:
        return self.ways[self.pose].confidence

    @property
    def legible(self) -> float:
        """How many of its characters can be read."""
        return self.ways[self.pose].legible

    @property
    def lead(self) -> float:
        """By how many characters its way reads better than any other."""
        return self.legible - max((way.legible for pose, way in self.ways.items() if pose != self.pose), default=0.0)

    @property
    def center_px(self) -> tuple[float, float]:
        col, row = (sum(values) / len(self.outline_px) for values in zip(*self.outline_px, strict=True))
        return col, row


@dataclass(frozen=True)
class KnownLine:
    """A line that stands at one place on frames that lie alike in their scans.

    pose: the way in which it lies in the scan. outline_mm: its corners from the middle of the exposed frame, as the
    scan shows them, to the right and up.
    """

    text: str
    pose: str
    side: Side
    outline_mm: tuple[tuple[float, float], ...]

    def matches(self, line: Line) -> bool:
        """Whether it is plainly that line, which may say another number."""
        own, other = masked_text(self.text), masked_text(line.text)
        same = SequenceMatcher(None, own, other).ratio() >= _ALIKE
        return same and line.pose == self.pose and line.lead >= _PLAINLY


def masked_text(text: str) -> str:
    """A text of which frames of a roll have the same: every digit is a 0, and only letters count beside them."""
    return re.sub(r"\d", "0", re.sub(r"[\W_]", "", text.upper()))


def read_from_one_face(lines: Sequence[Line]) -> tuple[Line, ...]:
    """The lines as they read from the side of the film from which most can be read, those first that say most."""
    faces = [[_best(line, mirrored) for line in lines] for mirrored in (False, True)]
    face = max(faces, key=lambda face: sum(line.legible for line in face))
    return tuple(sorted(face, key=lambda line: (-line.legible, line.center_px)))


def _best(line: Line, mirrored: bool) -> Line:
    poses = [pose for pose in line.ways if pose.endswith("m") == mirrored]
    return replace(line, pose=max(poses, key=lambda pose: line.ways[pose].legible))


# What single lines of writing say: camera, run, frame, date, height, scale, where their form is known.
#
# One table of patterns. What is ambiguous has a text and no value: a date whose day may be its month, a number that is
# perhaps another one's.


@dataclass(frozen=True)
class Field:
    """One field that a line says. value: "" where the text is ambiguous."""

    name: str
    text: str
    value: str
    line: Line


def _number(match: re.Match[str]) -> str:
    return re.sub(r"[ ,.]", "", match[1])


def _height(match: re.Match[str]) -> str:
    """With its unit. A height of a flight has three to five digits."""
    digits = _number(match)
    return f"{int(digits)} {'m' if match[2].lower() == 'm' else 'ft'}" if 3 <= len(digits) <= 5 else ""


def _scale(match: re.Match[str]) -> str:
    digits = _number(match)
    return f"1:{int(digits)}" if digits.isdigit() and 3 <= len(digits) <= 6 else ""


def _frames(match: re.Match[str]) -> str:
    return f"{match[1]}-{match[2]}" if int(match[1]) < int(match[2]) else ""


def _date(match: re.Match[str]) -> str:
    """ISO; day first, as most of the world writes, where only that is possible or both are the same."""
    first, second, year = int(match[1]), int(match[2]), _year(match[3])
    readings = {(day, month) for day, month in ((first, second), (second, first)) if day <= 31 and 1 <= month <= 12}
    if not year or len(readings) != 1:
        return ""
    ((day, month),) = readings
    return f"{year}-{month:02d}-{day:02d}" if day else ""


def _named_date(match: re.Match[str]) -> str:
    month, year = _MONTHS.index(match[2][:3].upper()) + 1, _year(match[3])
    return f"{year}-{month:02d}" + (f"-{int(match[1]):02d}" if match[1] else "") if year else ""


def _year(text: str) -> str:
    if len(text) == 4:
        return text
    return f"19{text}" if int(text) >= _FIRST_YEAR else ""


def _as_it_stands(match: re.Match[str]) -> str:
    return match[1].replace(",", ".")


def _type(match: re.Match[str]) -> str:
    """The maker, where the plate names one; what else it says stays text."""
    return next((maker for letters, maker in _MAKERS.items() if letters in match[1]), "")


Reader = Callable[[re.Match[str]], str]
_PATTERNS: tuple[tuple[str, str, Reader], ...] = (
    ("camera_type", rf"({'|'.join(_TYPES)})", _type),
    ("camera_number", rf"{_BEFORE_NUMBER}(\d{{3,6}}) ?(?={_DISTANCE}(?!\d)|\D|$)", _as_it_stands),
    ("principal_distance_mm", rf"(?:^|[^\d.,]|{_BEFORE_NUMBER}\d{{3,6}}){_DISTANCE}(?![\d.,/-])", _as_it_stands),
    ("run", r"\bRUN ?(?:NO\.? ?)?([0-9A-Z]{1,5})(?![\w.,:/'-])", _as_it_stands),
    ("frames", r"(?<![\w.-])(\d{2,5}) ?- ?(\d{2,5})(?![\w.-])", _frames),
    ("date", r"(?<!\d)(\d{1,2}) ?[./-] ?(\d{1,2}) ?[./-] ?(\d{4}|\d{2})(?!\d)", _date),
    ("date", rf"(\d{{1,2}})?[ .]*({'|'.join(_MONTHS)})[A-Z]*[ .]*(\d{{4}}|\d\d)(?!\d)", _named_date),
    ("time", r"(?<![\d:])((?:[01]?\d|2[0-3]):[0-5]\d)(?![\d:]|[ ,.]\d)", _as_it_stands),
    ("height", r"(?<![\d.])(\d[\d,. ]*\d) ?('|FT|FEET|M\b|M ?(?=A))", _height),
    ("scale", r"(?<![\dOL])[1IL] ?: ?([\dOIL][\dOIL,. ]{2,}[\dOIL])", _scale),
    ("number", r"^(\d{1,6})$", _as_it_stands),
)


def find_fields(lines: Sequence[Line]) -> tuple[Field, ...]:
    """All fields of the lines, in their order; then the frame's own number, where one of the numbers lies among those
    of the run's frames."""
    found = [field for line in lines for field in _fields_of_line(line)]
    return (*found, *_frame_number(lines, found))


def is_plate(line: Line) -> bool:
    """Whether it is of the camera's own plate."""
    return any(field.name in CAMERA for field in _fields_of_line(line))


def signs(line: Line) -> int:
    """How many fields of a plate or a title it says."""
    return sum(field.name in (*CAMERA, *STRIP) for field in _fields_of_line(line))


def is_of_film(line: Line) -> bool:
    """Whether its maker wrote it on the film's edge, which any side of a frame may be."""
    return _FILM.search(line.text.upper()) is not None


def _fields_of_line(line: Line) -> list[Field]:
    text = line.text.upper()
    fields: dict[str, Field] = {}
    for name, pattern, value in _PATTERNS:
        match = re.search(pattern, text)
        if match is not None and name not in fields:
            fields[name] = Field(name, line.text[match.start() : match.end()].strip(), value(match), line)
    return list(fields.values())


def _frame_number(lines: Sequence[Line], found: Sequence[Field]) -> list[Field]:
    """The only number with as many digits as the run's frames have that lies among them."""
    ranges: Mapping[str, tuple[str, str]] = {
        field.value: (field.value.split("-")[0], field.value.split("-")[1])
        for field in found
        if field.name == "frames" and field.value
    }
    if len(ranges) != 1:
        return []
    ((first, last),) = ranges.values()
    plates_and_titles = [field.line for field in found if field.name in (*CAMERA, *STRIP)]
    numbers: dict[str, Line] = {}
    for line in lines:
        if line in plates_and_titles:
            continue
        for digits in re.findall(r"\d+", line.text):
            if len(first) <= len(digits) <= len(last) and int(first) <= int(digits) <= int(last):
                numbers.setdefault(digits, line)
    return [Field("frame", digits, digits, line) for digits, line in numbers.items()] if len(numbers) == 1 else []
