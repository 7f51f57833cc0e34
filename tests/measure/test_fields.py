"""What lines of writing say, by lines that were read on real frames, and by what must not be taken for anything."""

import pytest

from measure.annotations.fields import Line, Reading, find_fields, is_of_film, is_plate, signs


def line(text: str) -> Line:
    return Line({"0": Reading(text, 0.98, float(len(text)))}, "0", ((0.0, 0.0),) * 4, "top")


def read_fields(*texts: str) -> dict[str, str]:
    return {field.name: field.value for field in find_fields([line(text) for text in texts])}


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("Nr13043 152.75", {"camera_number": "13043", "principal_distance_mm": "152.75"}),
        ("Nr13043152.75", {"camera_number": "13043", "principal_distance_mm": "152.75"}),
        ("Nr.13022 153.20", {"camera_number": "13022", "principal_distance_mm": "153.20"}),
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
        ("7/7/89", {"date": "1989-07-07"}),
        ("27-3-97", {"date": "1997-03-27"}),
        ("1/3/85", {"date": ""}),
        ("1/3/05", {"date": ""}),
        ("MARCH 1985", {"date": "1985-03"}),
        ("7 JULY 1989", {"date": "1989-07-07"}),
        ("7300'ASL", {"height": "7300 ft"}),
        ("14,000'", {"height": "14000 ft"}),
        ("7,000 ft.", {"height": "7000 ft"}),
        ("2200m ASL", {"height": "2200 m"}),
        ("1:10,000", {"scale": "1:10000"}),
        ("l:100o0 approx", {"scale": ""}),
        ("12:45", {"time": "12:45"}),
        ("5804", {"number": "5804"}),
        ("ACT DEVELOPMENT RECORD 1997", {}),
        ("A.C.T.", {}),
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
