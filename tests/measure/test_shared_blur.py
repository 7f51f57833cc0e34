"""What marks tell of one another's blur, against blurs drawn at random about the scan's own."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from measure.shared_blur import shared_blurs

PIXEL = 1 / 12


def fits(seen_px: Any, sigmas: Any) -> list[Any]:
    """As matches have them: seen_px with the pixel's share."""
    blurs = np.sqrt(np.asarray(seen_px) ** 2 - PIXEL)
    return [SimpleNamespace(blur_px=blur, blur_sigma=sigma) for blur, sigma in zip(blurs, sigmas, strict=True)]


def test_a_faint_mark_gets_the_blur_of_the_others_and_those_need_none() -> None:
    told = shared_blurs(fits([1.2, 1.2, 1.21, 1.19, 0.95], [0.01, 0.01, 0.02, 0.02, 0.2]))
    assert told[:4] == [None] * 4
    assert told[4] is not None
    assert np.hypot(told[4].blur_px, np.sqrt(PIXEL)) == pytest.approx(1.2, rel=0.01)
    assert not told[4].differs


def test_marks_of_one_blur_are_rarely_doubted_and_another_blur_is() -> None:
    rng = np.random.default_rng(1)
    doubted, found = 0, 0
    for _ in range(300):
        sigmas = rng.uniform(0.01, 0.15, 8)
        own = 1.1 * np.exp(rng.normal(0, np.hypot(sigmas, 0.05)))
        doubted += any(each is not None and each.differs for each in shared_blurs(fits(own, sigmas)))
        own[0], sigmas[0] = 0.6, 0.08
        told = shared_blurs(fits(own, sigmas))[0]
        found += told is not None and told.differs
    assert doubted <= 12  # 1 in 100, and more for how much they differ is an estimate itself
    assert found > 270


def test_too_few_marks_tell_nothing() -> None:
    assert shared_blurs(fits([1.2, 1.2, 1.2, 0.6], [0.01, np.inf, np.inf, 0.1])) == [None] * 4
