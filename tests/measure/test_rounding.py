"""Marks in 8 bit with less noise than a grey value's step."""

import numpy as np
from drawn import scan_of
from true_marks import KIND, some_mark, whitened_rms

from measure.matching.window import Coding
from measure.targets.disks import fit_disk


def test_disks_in_whole_grey_values_are_as_far_off_as_they_say() -> None:
    rng = np.random.default_rng(3)
    errors, covariances = [], []
    for _ in range(20):
        mark = some_mark(KIND["ellipse"], 1.0, rng)
        ground = 60 + rng.uniform(-0.5, 0.5) + 1.5 * rng.uniform() * np.arange(mark.size) / mark.size
        disk = fit_disk(scan_of(ground + 120 * mark.picture, 255), mark.place[:, 2] + 0.3, mark.place[:, :2])
        errors.append(disk.center_px - mark.place[:, 2])
        covariances.append(disk.covariance_px2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.0025
    assert 0.7 < whitened_rms(errors, covariances) < 1.3


def test_the_step_is_that_of_all_grey_values() -> None:
    for grey, step in (([60.0, 61, 64, 60], 1.0), ([514.0, 257, 1028], 257.0)):
        steps = Coding(np.array(grey)).steps_dn(np.ones(len(grey), bool))
        assert steps is not None
        assert np.all(steps == step)
    for grey in ([0.3, 1.0, 1.1, 1.5], [60.0] * 4):
        assert Coding(np.array(grey)).steps_dn(np.ones(4, bool)) is None
