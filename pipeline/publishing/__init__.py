"""Provenance of results, and joint replacement of earlier results by those of a command."""
