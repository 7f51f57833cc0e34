"""The adjustment checked against OpenCV's calibration."""
