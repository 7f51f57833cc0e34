"""Rendered scenes as projects, and projects against their truth."""
