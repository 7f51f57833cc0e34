"""Writing on a scan: found, read, and what its lines say."""

import cv2
import numpy as np
import pytest
from drawn import Array, make_scan
from studies import parametrize_with_studies

from measure.annotations import text as networks_module
from measure.annotations.lines import Line, Reading, find_fields, is_of_film, is_plate, signs
from measure.annotations.text import Networks, networks, read_writing

SIZE_PX = 640
TITLE, PLATE = "RUN 20 CST 7300", "Nr 13043"
SIDES = ("top", "right", "bottom", "left")  # clockwise


def required() -> Networks:
    found = networks()
    assert found is not None, f"{networks_module.MISSING}; `make test` installs them"
    return found


def written_film(dark: float = 3000.0, light: float = 14000.0) -> Array:
    """A title above the exposed frame, upright; a plate below it, upside down."""
    rng = np.random.default_rng(3)
    grey = np.full((SIZE_PX, SIZE_PX), dark)
    grey[90:-70, 70:-70] = dark + 0.5 * (light - dark)
    letters = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    cv2.putText(letters, PLATE, (380, 50), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2, cv2.LINE_AA)
    letters = letters[::-1, ::-1].copy()
    cv2.putText(letters, TITLE, (100, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2, cv2.LINE_AA)
    return np.asarray(grey + letters / 255.0 * (light - dark) + rng.normal(0, 200, grey.shape))


def posed(grey: Array, pose: str) -> Array:
    """As a scan of that pose shows it: mirrored first, then turned counter-clockwise."""
    mirrored = grey[:, ::-1] if pose.endswith("m") else grey
    return np.ascontiguousarray(np.rot90(mirrored, int(pose.rstrip("m")) // 90))


def read(grey: Array, frame_px: Array | None = None) -> tuple[Line, ...]:
    scan = make_scan(grey)
    return read_writing(scan, required(), frame_px)


@parametrize_with_studies("pose", ["0", "90", "270", "180m"], quick=(3,))
def test_title_and_plate_are_read_whichever_way_the_scan_lies(pose: str) -> None:
    title, plate = read(posed(written_film(), pose))
    assert (title.text.replace(" ", ""), title.pose) == (TITLE.replace(" ", ""), pose)
    assert plate.text.replace(" ", "") == PLATE.replace(" ", "")
    mirrored = "m" if pose.endswith("m") else ""
    turn = int(pose.rstrip("m"))
    assert plate.pose == f"{(turn + 180) % 360}{mirrored}"
    top = SIDES[-turn // 90 % 4]  # neither moves by a mirror that leaves the top where it is
    assert (title.side, plate.side) == (top, SIDES[(SIDES.index(top) + 2) % 4])
    for line in (title, plate):
        assert line.legible > 0.8 * len(line.text.replace(" ", ""))
        assert line.legible > 2 * sorted(way.legible for way in line.ways.values())[-2]


def test_no_other_side_is_read_where_the_lines_of_some_are_enough() -> None:
    scan = make_scan(written_film())
    lines = read_writing(scan, required(), enough=lambda lines: len(lines) == 1)
    assert len(lines) == 1


def test_dark_letters_on_light_film_are_read_as_well_and_the_outline_lies_about_them() -> None:
    film = written_film(dark=60000.0, light=30000.0)
    title, plate = read(film)
    assert (title.text.replace(" ", ""), title.pose) == (TITLE.replace(" ", ""), "0")
    film[90:-70, 70:-70] = 60000.0
    for line, first_row in ((title, 0), (plate, SIZE_PX // 2)):
        row, col = np.nonzero(film[first_row : first_row + SIZE_PX // 2] < 45000)
        drawn = np.array([[col.min(), row.min() + first_row], [col.max(), row.max() + first_row]])
        outline = np.array(line.outline_px)
        assert np.abs(np.stack([outline.min(axis=0), outline.max(axis=0)]) - drawn).max() < 8
        assert line.center_px == pytest.approx(drawn.mean(axis=0), abs=5)


def test_a_line_across_two_parts_of_a_long_strip_is_one_line_where_it_is_drawn() -> None:
    strip = np.zeros((64, 960), np.uint8)
    cv2.putText(strip, TITLE, (520, 42), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2, cv2.LINE_AA)
    (place,) = networks_module.find_writing(strip, required())
    col, row, width, _ = cv2.boundingRect(strip)
    assert np.abs(place.outline_px()[:2, 0] - (col, col + width)).max() < 10
    assert row < place.center_px[1] < 42


def test_a_number_that_is_the_same_upside_down_does_not_tell_its_turn() -> None:
    letters = np.zeros((60, SIZE_PX), np.uint8)
    (half, _), _ = cv2.getTextSize("608", cv2.FONT_HERSHEY_SIMPLEX, 0.9, 2)
    cv2.putText(letters, "608", (SIZE_PX // 2 - half, 41), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2, cv2.LINE_AA)
    grey = np.full((SIZE_PX, SIZE_PX), 3000.0)
    grey[10:70] += 40.0 * np.maximum(letters, letters[::-1, ::-1])
    (number,) = read(grey)
    assert [number.ways[way].text.replace(" ", "") for way in ("0", "180")] == ["608809"] * 2
    assert number.ways["180"].legible == pytest.approx(number.ways["0"].legible, rel=0.15)


def test_only_the_frames_surroundings_are_read() -> None:
    """What the ground shows within the frame is no writing on the film."""
    corners = np.array([[70.0, 90.0], [570.0, 90.0], [570.0, 570.0], [70.0, 570.0]])
    letters = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    cv2.putText(letters, "HELLO", (250, 150), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2, cv2.LINE_AA)
    grey = written_film() + letters * 30.0
    assert sorted(line.text.replace(" ", "") for line in read(grey, corners)) == ["Nr13043", "RUN20CST7300"]
    assert "HELLO" in {line.text for line in read(grey[80:])}


def test_film_without_writing_says_nothing() -> None:
    grey = written_film(dark=3000.0, light=3000.0)
    assert read(grey) == ()


def test_without_the_package_there_are_no_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks_module, "PACKAGE", "no_such_package_of_networks")
    assert networks.__wrapped__() is None


def line(text: str) -> Line:
    return Line({"0": Reading(text, 0.98, float(len(text)))}, "0", ((0.0, 0.0),) * 4, "top")


def read_fields(*texts: str) -> dict[str, str]:
    return {field.name: field.value for field in find_fields([line(text) for text in texts])}


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("Nr13043 152.75", {"camera_number": "13043", "principal_distance_mm": "152.75"}),
        ("Nr13043152.75", {"camera_number": "13043", "principal_distance_mm": "152.75"}),
        ("UAg1003 152.44", {"camera_type": "Wild", "camera_number": "1003", "principal_distance_mm": "152.44"}),
        ("WILD15/4UAG", {"camera_type": "Wild"}),
        ("RMK A 15/23", {"camera_type": "Zeiss"}),
        ("f = 305.12", {"principal_distance_mm": "305.12"}),
        ("RUN 20", {"run": "20"}),
        ("RUN72C6", {"run": "72C6"}),
        ("157-191", {"frames": "157-191"}),
        ("155-16", {"frames": ""}),
        ("CAC145-5004", {}),
        ("25.2.1972", {"date": "1972-02-25"}),
        ("U.T.22.3.79", {"date": "1979-03-22"}),
        ("27-3-97", {"date": "1997-03-27"}),
        ("1/3/85", {"date": ""}),
        ("1/3/05", {"date": ""}),
        ("MARCH 1985", {"date": "1985-03"}),
        ("7 JULY 1989", {"date": "1989-07-07"}),
        ("99 JUL 57", {"date": ""}),
        ("0 JAN 1950", {"date": ""}),
        ("31.02.1957", {"date": ""}),
        ("29.02.1956", {"date": "1956-02-29"}),
        ("MAY 15", {"date": ""}),
        ("7300'ASL", {"height": "7300 ft"}),
        ("14,000'", {"height": "14000 ft"}),
        ("2200m ASL", {"height": "2200 m"}),
        ("1:10,000", {"scale": "1:10000"}),
        ("l:100o0 approx", {"scale": ""}),
        ("12:45", {"time": "12:45"}),
        ("5804", {"number": "5804"}),
        ("ACT DEVELOPMENT RECORD 1997", {}),
        ("Survey Office", {}),
    ],
)
def test_a_line_says(text: str, fields: dict[str, str]) -> None:
    assert read_fields(text) == fields


def test_the_frames_number_is_the_only_one_among_the_runs() -> None:
    assert read_fields("8601-8639", "8617", "RUN7", "14,000'")["frame"] == "8617"
    assert read_fields("5004-5024", "CAC145-5004")["frame"] == "5004"
    assert "frame" not in read_fields("157-191", "157", "AUS167")  # two of them
    assert "frame" not in read_fields("018-068", "44")  # not as they are written
    assert "frame" not in read_fields("157-191", "158-160", "157")  # two runs


def test_plates_titles_and_the_films_own_name_are_distinguished() -> None:
    assert is_plate(line("Nr13043 152.75"))
    assert not is_plate(line("RUN 20"))
    assert signs(line("16.5.68")) == 1
    assert signs(line("RUN 7 16.5.68")) == 2
    assert signs(line("AUSTRALIAN")) == 0
    assert is_of_film(line("KODAK SAFETY FILM"))
    assert not is_of_film(line("ADASTRAPHOTO"))
