"""Adjustment of comparator coordinates, and its result files."""
