"""Fiducial marks: the search for the frame, its interior orientation, and the checks of its marks."""
