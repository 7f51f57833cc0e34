"""Functional model: object, camera, film and comparator coordinates, with the derivatives."""
