"""Noise of film and scanner: scale, grain, damage, and robust least squares."""
