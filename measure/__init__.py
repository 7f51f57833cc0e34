"""A scan in, comparator coordinates out: marks and targets to a few hundredths of a pixel, with honest covariances.

docs/code.md lists its modules in the order in which a scan goes through them.
"""
