"""Kinds of marks with a measurement of their own: corners of the frame, and marks that nobody has drawn."""
