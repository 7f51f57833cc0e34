"""Calibration of digital cameras from images of a board: `reseau calibrate`."""
