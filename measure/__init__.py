"""A scan in, comparator coordinates out: marks and targets to a few hundredths of a pixel, with honest covariances."""
