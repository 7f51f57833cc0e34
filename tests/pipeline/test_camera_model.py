"""What is known of an image before its targets are, and what a camera's file may have meant otherwise."""

from pathlib import Path

import pytest

from measure.results import FrameMeasurement
from pipeline.files.camera_file import read_camera
from pipeline.measuring.target_identification import misplaced_principal_point
from pipeline.results.measured_record import MeasuredScan

MEASURED = MeasuredScan("v.tif", 2001, 1801, (20.0, 20.0), FrameMeasurement("v", ()))
FIDUCIALS = '[[fiducial]]\nid = "1"\nxy_mm = [18.0, -16.0]\nmark = "dot"\n[mark.dot]\nkind = "dot"\nradius_mm = 0.2\n'


@pytest.mark.parametrize(
    ("given", "rest", "is_told"),
    [
        ("principal_point_mm = [0.0, 0.0]", "", True),
        ("principal_point_mm = [20.3, 18.1]", "", True),  # y counted downwards
        ("principal_point_mm = [20.3, -18.1]", "", False),
        ("", "", False),
        ("principal_point_mm = [0.0, 0.0]", FIDUCIALS, False),
    ],
)
def test_a_principal_point_that_counts_from_elsewhere_is_reported(
    given: str, rest: str, is_told: bool, tmp_path: Path
) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(f'name = "c"\nframe_mm = [40.0, 36.0]\nprincipal_distance_mm = 60.0\n{given}\n{rest}')
    result = misplaced_principal_point(read_camera(path), MEASURED)
    assert ("the middle of this scan is [20, -18]" in result) == is_told
