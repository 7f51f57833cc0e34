"""Rendering of synthetic film scans with their true values."""
