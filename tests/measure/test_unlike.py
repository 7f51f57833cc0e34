"""Small disks with dust on them, against the others of their frame."""

import numpy as np
from drawn import drawn, ellipse, scan_of

from measure.status import Status
from measure.targets import TargetPrediction, measure_disks

CONTRAST, GROUND = 15000.0, 25000.0


def test_a_speck_that_passes_for_the_disk_is_told_by_the_other_disks() -> None:
    """A dark speck on a dark disk looks like another dark disk: only its contrast and its form are not the others'."""
    rng = np.random.default_rng(1)
    picture = GROUND + rng.normal(0, 500, (60, 40 * 12))
    predictions = []
    for number in range(12):
        place = np.array([20 + 40 * number, 30]) + rng.uniform(-0.5, 0.5, 2)
        shape = 2.6 * np.diag([1.0, rng.uniform(0.85, 0.95)])
        window = picture[:, 40 * number : 40 * number + 40]
        at = place - (40 * number, 0)
        window -= rng.normal(1.0, 0.04) * CONTRAST * drawn(ellipse(at, shape), 40, 60, 1.0)
        if number == 7:
            speck = drawn(ellipse(at + np.array([0.6, 0.5]), 2.9 * np.eye(2)), 40, 60, 1.0)
            window += (GROUND - 1.6 * CONTRAST - window) * speck
        predictions.append(TargetPrediction(str(number), place + 0.3, 1.05 * shape, 4.0))
    marks = measure_disks(scan_of(picture), predictions)
    assert [mark.point for mark in marks if mark.status is Status.WEAK] == ["7"]
    assert "unlike the other targets" in marks[7].reason
    assert all(mark.status is Status.MEASURED for mark in marks if mark.point != "7")
