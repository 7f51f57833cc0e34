"""Targets that name themselves: ring codes, sheets of dots, calibration boards."""
