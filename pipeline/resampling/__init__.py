"""Resampling of scans into the camera's frame: a chain of named transformations is inverted, and the scan
interpolated."""
