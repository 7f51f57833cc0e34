"""A scan into its camera's frame: one chain of named transformations, inverted, and the picture sampled through it."""
