"""The revision of how scans are measured."""

MEASURE_REVISION = 1
