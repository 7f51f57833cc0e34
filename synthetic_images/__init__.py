"""Scenes in, film scans and their truth out."""
