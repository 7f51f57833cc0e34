"""Tie points: the same natural points in several scans, and the places that join the parts of one frame."""
