"""Identification of object points among the marks of an image without known orientation."""
