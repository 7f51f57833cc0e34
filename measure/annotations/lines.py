"""Lines of text on a scan: their fields of known form, and the side of the film from which they are legible.

Fields (camera, run, frame, date, height, scale) are found by one table of patterns. An ambiguous field has a text and
no value, such as a date whose day may be the month.

A line is legible in its right orientation, and less so mirrored or upside down. Under the right scan orientation all
lines are legible from one side of the film.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from difflib import SequenceMatcher

from measure.marks.shapes import Side

_ALIKE = 0.75  # least ratio of equal characters of one line in two readings
_PLAINLY = 5.0  # lead in legible characters that decides an orientation: odds of a thousand to one
CAMERA = ("camera_type", "camera_number", "principal_distance_mm")  # fields of a camera's plate
STRIP = ("run", "frames", "date", "time", "height", "scale")  # fields of a flight's title
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
_FIRST_YEAR = 20  # of two digits: 1920 and later; below, the century is ambiguous
_DISTANCE = r"((?:8[5-9]|1[45]\d|20\d|21\d|30\d)[.,]\d{1,3})"  # principal distances of existing cameras, mm
_BEFORE_NUMBER = r"(?:N[RO]\.? ?|AG ?)"  # also for a number right after a type: UAg 1003
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
    """Text of a line in one orientation. confidence: mean over its characters, 0 to 1; legible: effective number of
    legible characters."""

    text: str
    confidence: float
    legible: float


@dataclass(frozen=True)
class Line:
    """One line of text.

    ways: readings by the four possible orientations along its direction. pose: the orientation taken as right.
    outline_px: corners (column, row) of the rectangle around it, clockwise in the scan. side: of the scan.
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
        """Effective number of legible characters."""
        return self.ways[self.pose].legible

    @property
    def lead(self) -> float:
        """Lead of its orientation over any other, in legible characters."""
        return self.legible - max((way.legible for pose, way in self.ways.items() if pose != self.pose), default=0.0)

    @property
    def center_px(self) -> tuple[float, float]:
        col, row = (sum(values) / len(self.outline_px) for values in zip(*self.outline_px, strict=True))
        return col, row


@dataclass(frozen=True)
class KnownLine:
    """A line at the same place on all frames with one scan orientation.

    pose: orientation of the line in the scan. outline_mm: corners relative to the centre of the exposed frame, right
    and up in the scan.
    """

    text: str
    pose: str
    side: Side
    outline_mm: tuple[tuple[float, float], ...]

    def matches(self, line: Line) -> bool:
        """Whether a line is clearly this one; its digits may differ."""
        own, other = masked_text(self.text), masked_text(line.text)
        same = SequenceMatcher(None, own, other).ratio() >= _ALIKE
        return same and line.pose == self.pose and line.lead >= _PLAINLY


def masked_text(text: str) -> str:
    """Text that is equal on all frames of a roll: digits become 0, other signs than letters are dropped."""
    return re.sub(r"\d", "0", re.sub(r"[\W_]", "", text.upper()))


def read_from_one_face(lines: Sequence[Line]) -> tuple[Line, ...]:
    """Readings of all lines from the side of the film with more legible text, the longest first."""
    faces = [[_best(line, mirrored) for line in lines] for mirrored in (False, True)]
    face = max(faces, key=lambda face: sum(line.legible for line in face))
    return tuple(sorted(face, key=lambda line: (-line.legible, line.center_px)))


def _best(line: Line, mirrored: bool) -> Line:
    poses = [pose for pose in line.ways if pose.endswith("m") == mirrored]
    return replace(line, pose=max(poses, key=lambda pose: line.ways[pose].legible))


# Fields of single lines.


@dataclass(frozen=True)
class TextField:
    """One field of a line. value: "" where the text is ambiguous."""

    name: str
    text: str
    value: str
    line: Line


def _number(match: re.Match[str]) -> str:
    return re.sub(r"[ ,.]", "", match[1])


def _height(match: re.Match[str]) -> str:
    """Flying height with its unit; it has three to five digits."""
    digits = _number(match)
    return f"{int(digits)} {'m' if match[2].lower() == 'm' else 'ft'}" if 3 <= len(digits) <= 5 else ""


def _scale(match: re.Match[str]) -> str:
    digits = _number(match)
    return f"1:{int(digits)}" if digits.isdigit() and 3 <= len(digits) <= 6 else ""


def _frames(match: re.Match[str]) -> str:
    return f"{match[1]}-{match[2]}" if int(match[1]) < int(match[2]) else ""


def _date(match: re.Match[str]) -> str:
    """ISO date; "" where day and month cannot be distinguished."""
    first, second, year = int(match[1]), int(match[2]), _year(match[3])
    readings = {_iso_date(year, month, day) for day, month in ((first, second), (second, first))} - {""}
    return readings.pop() if len(readings) == 1 else ""


def _named_date(match: re.Match[str]) -> str:
    """ISO date; year and month where no day stands before the month."""
    month, year = _MONTHS.index(match[2][:3].upper()) + 1, _year(match[3])
    return _iso_date(year, month, int(match[1])) if match[1] else _iso_date(year, month, 1)[:-3]


def _iso_date(year: str, month: int, day: int) -> str:
    """ISO date; "" without a year, and for a day that the calendar does not have."""
    try:
        return date(int(year), month, day).isoformat()
    except ValueError:
        return ""


def _year(text: str) -> str:
    if len(text) == 4:
        return text
    return f"19{text}" if int(text) >= _FIRST_YEAR else ""


def _as_it_stands(match: re.Match[str]) -> str:
    return match[1].replace(",", ".")


def _type(match: re.Match[str]) -> str:
    """The camera's maker, if the plate names one."""
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


def find_fields(lines: Sequence[Line]) -> tuple[TextField, ...]:
    """Find all fields of the lines, in their order, and the frame number if one number lies in the run's range."""
    found = [field for line in lines for field in _fields_of_line(line)]
    return (*found, *_frame_number(lines, found))


def is_plate(line: Line) -> bool:
    """Whether the line is part of the camera's plate."""
    return any(field.name in CAMERA for field in _fields_of_line(line))


def signs(line: Line) -> int:
    """Number of plate and title fields in a line."""
    return sum(field.name in (*CAMERA, *STRIP) for field in _fields_of_line(line))


def is_of_film(line: Line) -> bool:
    """Whether the line is the film maker's edge print, which may lie at any side of a frame."""
    return _FILM.search(line.text.upper()) is not None


def _fields_of_line(line: Line) -> list[TextField]:
    text = line.text.upper()
    fields: dict[str, TextField] = {}
    for name, pattern, value in _PATTERNS:
        match = re.search(pattern, text)
        if match is not None and name not in fields:
            fields[name] = TextField(name, line.text[match.start() : match.end()].strip(), value(match), line)
    return list(fields.values())


def _frame_number(lines: Sequence[Line], found: Sequence[TextField]) -> list[TextField]:
    """The frame number: the only number within the range of the run's frames, with as many digits."""
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
    return [TextField("frame", digits, digits, line) for digits, line in numbers.items()] if len(numbers) == 1 else []
