"""The marks of a frame as a table of pandas."""

import sys

import numpy as np
import pytest

from measure.flags import Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement

NOISE = Covariance.from_noise(np.diag([0.04, 0.09]))
FOUND = MarkMeasurement("1", "fiducial", np.array([10.0, 20.0]), NOISE, Status.MEASURED)
ABSENT = MarkMeasurement("2", "fiducial", None, None, Status.ABSENT, Reason("outside the scan", Code.OUTSIDE))
FRAME = FrameMeasurement("a", (FOUND, ABSENT))


def test_it_has_a_row_for_every_mark() -> None:
    pytest.importorskip("pandas", reason="pandas is missing: make test installs it")
    table = FRAME.to_pandas()
    assert list(table.point) == ["1", "2"]
    assert list(table.status) == ["measured", "absent"]
    numbers = table[["column_px", "row_px", "sigma_column_px", "sigma_row_px"]]
    np.testing.assert_allclose(numbers.iloc[0], [10.0, 20.0, 0.2, 0.3])
    assert table.column_px.isna().tolist() == [False, True]
    assert table.reason[1] == "outside the scan"


def test_without_pandas_one_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="Install: pip install pandas"):
        FRAME.to_pandas()
