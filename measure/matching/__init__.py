"""Least-squares matching: a mark, or a corner, measured to the noise of the film."""
