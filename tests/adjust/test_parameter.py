"""The key of a quantity: its text in files is one key's only and is read back, its words name no internal code."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from two_cameras import Name, two_cameras

from adjust.errors import DatumError
from adjust.problem.parameter import (
    CODES,
    Parameter,
    description,
    object_coordinate,
    parameter_from_text,
    parameters_from_texts,
)
from adjust.solution.adjustment import adjust

ROOT = Path(__file__).parents[2]
CODE = re.compile(rf"({'|'.join(CODES.values())})\.")


def test_ordinary_names_are_written_as_they_always_were() -> None:
    keys = {
        "IO.Wild RC8 13.5.k3": Parameter.interior("Wild RC8 13.5", "k3"),
        "FID.Wild RC8 13.5.3.x": Parameter.fiducial("Wild RC8 13.5", "3", "x"),
        "SC.S 1.a20": Parameter.scanner("S 1", "a20"),
        "BD.board.bend_x": Parameter.board("board", "bend_x"),
        "PT.12.4.X": Parameter.point("12.4", "X"),
        "EO.roll 7/frame.8.Z0": Parameter.exterior("roll 7/frame.8", "Z0"),
        "T.f1.a1": Parameter.film("f1", "a1"),
        "JOIN.f.1.p3.y": Parameter.join("f.1", "p3", "y"),
    }
    assert {key.text: key for key in keys.values()} == keys
    assert parameters_from_texts(list(keys)) == tuple(keys.values())


def test_a_dot_in_the_second_of_two_names_is_distinguished_from_that_between_them() -> None:
    one, other = Parameter.fiducial("A", "B.1", "x"), Parameter.fiducial("A.B", "1", "x")
    assert (one.text, other.text) == ("FID.A.B%2E1.x", "FID.A.B.1.x")
    assert [parameter_from_text(each.text) for each in (one, other)] == [one, other]


def random_name(rng: np.random.Generator) -> str:
    """Of pieces that separators, escapes and codes are made of."""
    pieces = [*"Ab1.%*ß点x /,;=", "..", "%2E", "%25", "2E", "25", "IO.", "\\", '"']
    return "".join(rng.choice(pieces, rng.integers(1, 6)))


def test_texts_of_any_names_are_unique_and_are_read_back() -> None:
    rng = np.random.default_rng(38)
    keys: set[Parameter] = set()
    while len(keys) < 4000:
        owner, id, quantity = random_name(rng), random_name(rng), str(rng.choice(["c", "x", "k3", "X0"]))
        if owner != "*":  # many owners in a list of what moves together
            keys |= {Parameter.fiducial(owner, id, quantity), Parameter.join(owner, id, quantity)}
        keys |= {
            Parameter.interior(owner, quantity),
            Parameter.point(id, quantity),
            Parameter.exterior(owner, quantity),
        }
    assert len({each.text for each in keys}) == len(keys)
    assert all(parameter_from_text(each.text) == each for each in keys)


def test_one_of_many_is_read_back_too() -> None:
    of = [Parameter.fiducial("K.1", "2.3", "x"), Parameter.point("2", "X"), Parameter.exterior("f", "Z0")]
    of += [Parameter.film("f", "a1"), Parameter.join("f", "2.3", "x"), Parameter.interior("K", "c")]
    texts = [each.any_owner.text for each in of]
    assert texts == ["FID.K.1.*.x", "PT.*.X", "EO.*.Z0", "T.*.a1", "JOIN.*.x", "IO.K.c"]
    assert [parameter_from_text(text) for text in texts] == [each.any_owner for each in of]


@pytest.mark.parametrize("text", ["", "IO", "IO.K", "XX.K.c", "FID.K.x", "IO.K.", "f1 X", "IO.f.1 X", "K.c"])
def test_what_names_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="names no quantity"):
        parameter_from_text(text)


def test_fiducials_of_earlier_files_are_known_by_their_camera() -> None:
    texts = ["IO.K.c", "IO.W.1.c", "FID.K.7.1.x", "FID.K.7.y", "FID.W.1.3.x", "FID.K.8%2E1.x"]
    marks = [(each.owner, each.id) for each in parameters_from_texts(texts)[2:]]
    assert marks == [("K", "7.1"), ("K", "7"), ("W.1", "3"), ("K", "8.1")]


def test_messages_name_quantities_in_words() -> None:
    mark = Parameter.fiducial("Wild RC8", "3", "x")
    assert mark.label == "x of fiducial 3, camera Wild RC8"
    assert Parameter.interior("Wild RC8", "k3").label == "k3 of camera Wild RC8"
    assert Parameter.exterior("f.1", "omega").label == "omega of image f.1"
    assert Parameter.film("f1", "a2").label == "a2 of the film transformation of image f1"
    moved = [Parameter.interior("K", "c"), mark, mark._replace(quantity="y"), Parameter.exterior("*", "Z0")]
    assert description(moved) == "c of camera K; x and y of fiducial 3, camera Wild RC8; Z0 of several images"


def test_a_coordinate_is_called_by_its_point() -> None:
    assert object_coordinate("roll.1.X") == Parameter.point("roll.1", "X")
    with pytest.raises(DatumError, match=r"a dot and X, Y or Z"):
        object_coordinate("12")


HOSTILE = "a, b=c; d.e ß点.1"


@pytest.mark.parametrize(
    ("cameras", "prefixes"), [(("A", "A.B"), ("B.", "")), ((HOSTILE, f"{HOSTILE}.{HOSTILE}"), (f"{HOSTILE}.", ""))]
)
def test_names_that_would_run_together_have_values_of_their_own(
    cameras: tuple[str, str], prefixes: tuple[str, str]
) -> None:
    """The same network under plain names gives the same values, standard deviations and covariances."""
    plain = adjust(*two_cameras(("K", "W"), (str, str), str, str))
    of: tuple[Name, Name] = (f"{prefixes[0]}{{}}".format, f"{prefixes[1]}{{}}".format)
    other = adjust(*two_cameras(cameras, of, lambda name: f"{HOSTILE}.{name}", lambda id: f"{HOSTILE}.{id}"))
    assert plain.converged
    assert other.converged
    assert len(set(other.names)) == len(other.names)
    np.testing.assert_array_equal(other.values, plain.values)
    own, alike = ([] for _ in range(2))
    for camera, name, mark in zip("KW", cameras, of, strict=True):
        own += [Parameter.fiducial(camera, id, axis) for id in "1234" for axis in "xy"]
        alike += [Parameter.fiducial(name, mark(id), axis) for id in "1234" for axis in "xy"]
    np.testing.assert_array_equal(other.values_of(alike), plain.values_of(own))
    np.testing.assert_array_equal(other.cofactor_of(alike), plain.cofactor_of(own))
    assert [other.sigma(each) for each in alike] == [plain.sigma(each) for each in own]
    assert min(plain.sigma(each) for each in own) > 1e-4


def test_no_other_module_takes_names_apart_or_builds_them() -> None:
    """No text begins with a code and a dot; none is split at dots but for suffixes of files and keys of tables."""
    found = []
    for package in ("adjust", "pipeline"):
        for file in sorted((ROOT / package).rglob("*.py")):
            if file != ROOT / "adjust" / "problem" / "parameter.py":
                found += [f"{file.relative_to(ROOT)}: {what}" for what in dotted_names(file)]
    assert set(found) == {
        "pipeline/archive/work.py: rpartition",  # a scan's suffix
        "pipeline/report/many_frames.py: rpartition",  # a scan's suffix
        "pipeline/design/sweeps.py: split",  # a key of a scene's table
        "pipeline/rendered/design_table.py: split",  # a key of a scene's table
        "pipeline/review/mark_handles.py: split",  # a key of a drawing's table
    }


def dotted_names(file: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and CODE.match(node.value):
            found.append(repr(node.value))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            texts = [each.value for each in node.args if isinstance(each, ast.Constant)]
            if "split" in node.func.attr or "partition" in node.func.attr:
                found += [node.func.attr] if "." in texts else []
    return found
