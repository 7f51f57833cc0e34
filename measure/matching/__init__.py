"""Least-squares matching of marks and frame corners."""
