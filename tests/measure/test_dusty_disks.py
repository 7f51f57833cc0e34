"""Small disks with dust on them, against the others of their frame."""

import numpy as np
import pytest
from drawn import drawn, ellipse, scan_of, whitened

from measure.flags import Status
from measure.results import Covariance, SecondPlace
from measure.targets.disks import FittedDisk, dust_reasons
from measure.targets.identification import TargetPrediction, measure_disks

CONTRAST, GROUND = 15000.0, 25000.0


def test_a_speck_that_passes_for_the_disk_is_known_by_the_other_disks() -> None:
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
    assert "not like the other targets" in marks[7].reason
    assert all(mark.status is Status.MEASURED for mark in marks if mark.point != "7")


@pytest.mark.study
def test_small_disks_whose_edges_are_as_soft_as_a_spots_are_measured_where_all_are_alike() -> None:
    rng = np.random.default_rng(2)
    picture = GROUND + rng.normal(0, 500, (60, 40 * 24))
    predictions, places = [], []
    for number in range(24):
        place = np.array([20 + 40 * number, 30]) + rng.uniform(-0.5, 0.5, 2)
        shape = 2.1 * np.diag([1.0, rng.uniform(0.8, 0.95)])
        blurred = drawn(ellipse(place - (40 * number, 0), shape), 40, 60, 1.45)
        picture[:, 40 * number : 40 * number + 40] += rng.normal(1.0, 0.04) * CONTRAST * blurred
        predictions.append(TargetPrediction(str(number), place + 0.3, 1.05 * shape, 4.0))
        places.append(place)
    marks = measure_disks(scan_of(picture), predictions)
    assert sum(mark.status is Status.MEASURED for mark in marks) >= 20
    errors = [
        whitened(np.asarray(mark.center_px) - place, np.asarray(mark.covariance_px2))
        for mark, place in zip(marks, places, strict=True)
        if mark.status is Status.MEASURED
    ]
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3  # three standard deviations of 40 numbers
    lone = measure_disks(scan_of(picture), predictions[:6])
    assert all(mark.status is not Status.MEASURED for mark in lone)


@pytest.mark.parametrize(("share", "doubted"), [(0.0, 0.04), (0.2, 0.15)])
def test_targets_are_odd_by_more_than_noise_and_what_all_differ_by(share: float, doubted: float) -> None:
    """Looks drawn as the comparison takes them to be, 5 % in contrast and 2 % in form, in noise of half to five times
    that variance; a share of them changed by 20 standard deviations; their paint slopes by no more than
    noise of 0.1 px."""
    rng, of_slope = np.random.default_rng(3), np.random.default_rng(4)
    spread = np.array([0.014, 0.014, 0.014, 0.05, 0.1])
    weak, odd = [], []
    for _ in range(15):
        disks, is_odd = [], rng.uniform(size=25) < share
        for change in 20.0 * is_odd * rng.choice((-1, 1), 25):
            mixing = (np.eye(5) + rng.normal(0, 0.3, (5, 5))) * spread
            noise = rng.uniform(0.5, 5) * mixing @ mixing.T
            observation = rng.normal(0, spread) + rng.multivariate_normal(np.zeros(5), noise)
            observation[3] += change * np.hypot(spread[3], np.sqrt(noise[3, 3]))
            values, vectors = np.linalg.eigh(
                [[observation[0] + observation[1], observation[2]], [observation[2], observation[0] - observation[1]]]
            )
            shape, blur = 3 * (vectors * np.exp(values)) @ vectors.T, float(np.sqrt(max(1.5 + observation[4], 0.1)))
            contrast = float(np.exp(observation[3])) * CONTRAST
            sloping = SecondPlace(of_slope.normal(0, 0.1, 2), 0.01 * np.eye(2))
            known = Covariance.from_noise(0.001 * np.eye(2))
            disks.append(FittedDisk(np.zeros(2), known, shape, contrast, 100.0, blur, 0.0, noise, sloping))
        weak += [bool(reason) for reason in dust_reasons(disks, [3 * np.eye(2)] * 25)]
        odd += is_odd.tolist()
    assert np.mean(np.array(weak)[~np.array(odd)]) < doubted
    assert np.all(np.array(weak)[odd])
