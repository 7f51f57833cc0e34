"""Calibration boards: what is printed on them, where a picture shows them, and their points measured."""
