"""Calibration boards: specifications, detection, and measurement of their points."""
