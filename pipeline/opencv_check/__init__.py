"""Check of the adjustment against OpenCV's calibration."""
