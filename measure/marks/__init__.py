"""Fiducial marks: drawings, templates, and their rendering."""
