"""The list of attempts to find a frame: which are made, by how many hypotheses each is judged, and what is taken."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from drawn import scan_of
from drawn_frames import ALIKE

from measure.detection.correlation import CLOSE, GRAINY
from measure.fiducials import stages
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.options import FiducialOptions
from measure.fiducials.search import FrameSearch, PitchHypothesis, pitch_hypotheses
from measure.fiducials.stages import Attempt, Found, Kind, find_frame
from measure.flags import FRAMES_BY_CHANCE, NO_REASON, Reason
from measure.scans.scan import Scan
from measure.tone.curve import Tone

GIVEN = PitchHypothesis((0.05, 0.05), 0.04, (0.05, 0.05))
SCAN = scan_of(np.zeros((400, 400)))


class Stand:
    """What an attempt finds, in a frame's stead."""

    def __init__(self, name: str) -> None:
        self.name, self.is_complete, self.accepted, self.measured_count = name, False, False, 0
        self.is_sure, self.agrees, self.scan = False, False, SCAN
        self.failed_fits: list[int] = []
        self.inliers, self.pixel_from_camera = np.ones(3, bool), np.eye(2, 3)

    def misfit(self, ids: Sequence[str]) -> Reason:
        return Reason(f"not {self.name}")

    def is_nearer_than(self, other: "Stand | None") -> bool:
        return other is None


def search_attempts(
    monkeypatch: pytest.MonkeyPatch, *expected: float | None, given: int = 1, at_given: int | None = None
) -> tuple[Found, list[int]]:
    """What a list of attempts comes to, each of two hypotheses and with so many frames that chance is expected to make
    a hypothesis, and how many hypotheses each was judged by. given: how many of them believe what they find; at_given:
    which of the others is under the given pitch."""
    checked: list[int] = []

    def attempt(number: int) -> Attempt:
        kind = "given" if number < given else "pitch" if number != at_given else "faint"
        return Attempt(
            cast(Kind, kind), cast(FrameSearch, SimpleNamespace(number=number)), [GIVEN, GIVEN], number == at_given
        )

    def make(attempt: Attempt, tried: int) -> Any:
        number = cast(Any, attempt.search).number
        each = expected[number]
        checked.append(tried)
        return [], [] if each is None else [(tried * each, cast(Frame, Stand(str(number))))]

    monkeypatch.setattr(stages, "list_attempts", lambda *_: [attempt(number) for number in range(len(expected))])
    monkeypatch.setattr(stages, "make_attempt", make)
    monkeypatch.setattr(stages, "doubt_frame", lambda *_: NO_REASON)
    return find_frame(SCAN, ALIKE, [[GIVEN]], True, FiducialOptions()), checked


def name(found: Found) -> str:
    return cast(Stand, found.frame).name if found.frame else ""


def test_each_attempt_is_tested_by_all_hypotheses_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be taken by itself may be chance after so many others; its pitch is worth to be given then."""
    found, checked = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 5)
    assert checked == [2, 4, 6]
    assert name(found) == ""
    assert [cast(Stand, frame).name for frame in found.unsure] == ["2"]
    assert found.misfit.startswith("not 0; under another pitch 3 of them fit")
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 7)
    assert (name(found), found.is_taken) == ("2", True)


def test_attempts_under_the_given_pitch_are_tested_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    found, checked = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 5, at_given=2)
    assert checked == [2, 4, 4]
    assert name(found) == "2"
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 3, at_given=2)
    assert (name(found), found.unsure) == ("", ())
    assert "3 faint marks fit, where 0.01 such false alarms are expected" in found.misfit
    assert "another pitch does not separate them; click the visible marks in `reseau review`" in found.misfit
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, 0.3, at_given=2)
    assert found.misfit == "not 0"  # chance makes more than one


def test_what_is_settled_is_not_inspected_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    found, checked = search_attempts(monkeypatch, np.inf, 1e-5, 1e-9)
    assert checked == [2, 4]
    assert name(found) == "1"


def test_where_nothing_was_detected_the_reason_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    found, _ = search_attempts(monkeypatch, None, None)
    assert name(found) == ""
    assert found.misfit == "no two of the camera's marks were found in the scan"


@pytest.mark.parametrize(("times", "looks"), [(1.0, 7), (2.0, 8), (0.5, 8), (None, 4)])
def test_the_attempts_in_their_order(times: float | None, looks: int) -> None:
    """As given, longer one way and filling the scan, at a closer look as given and slightly longer, with what grain
    hides and without it; a small scan is searched as a whole at once.
    Where no pitch is given, or one at which the frame is far from filling the scan, pixels of any size may be longer
    one way, too."""
    filling_um = 1000 * max(ALIKE.frame_mm) / SCAN.width_px
    given_um, is_given = None if times is None else (times * filling_um,) * 2, times is not None
    hypotheses = pitch_hypotheses(SCAN, ALIKE, given_um, FiducialOptions())
    listed = stages.list_attempts(FrameSearch(SCAN, ALIKE, FiducialOptions()), hypotheses, is_given)
    assert len(listed) == looks
    assert [each.is_given for each in listed] == [True, *[False] * (looks - 1)]
    assert [each.hypotheses for each in listed[: len(hypotheses)]] == hypotheses
    close = listed[len(hypotheses) :]
    closer_each = [True, False] if is_given else [False]
    assert [each.search.surroundings for each in close] == [CLOSE for _ in closer_each] + [GRAINY for _ in closer_each]
    assert [each.at_given for each in close] == 2 * closer_each


def test_marks_are_fitted_from_other_tone_curves_only_where_their_fits_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    scan, options = SCAN.replace_tone(Tone.unknown()), FiducialOptions(pose="0")
    place = Placement("0", np.eye(2, 3), 1.0, 4, 1, 1, GIVEN.mm)
    monkeypatch.setattr(FrameSearch, "search_scan", lambda *_: [place])
    monkeypatch.setattr(stages, "_likely_placements", lambda *_: [place])
    monkeypatch.setattr(stages, "doubt_frame", lambda *_: NO_REASON)
    for failed, expected in (([1], [1.6, 1.0, 0.5]), ([], [1.6, 1.6, 1.6])):
        begun: list[float] = []

        def measure(scan: Scan, *_: object, begun: list[float] = begun, failed: list[int] = failed) -> Any:
            begun.append(round(scan.tone.equivalent_power(0.1, 0.9)[0], 1))
            frame = Stand("right")
            frame.failed_fits, frame.accepted, frame.measured_count = failed, begun[-1] < 0.7, 4
            frame.is_sure = frame.is_complete = frame.accepted
            return frame

        monkeypatch.setattr(stages, "measure_frame", measure)
        found = find_frame(scan, ALIKE, [[GIVEN], [GIVEN]], True, options)
        assert found.is_taken == bool(failed)
        assert begun[:3] == expected
