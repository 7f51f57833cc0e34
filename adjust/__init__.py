"""Comparator coordinates in, calibration out: one least-squares adjustment of everything, fiducial marks included.

docs/code.md lists its modules in the order in which the observations go through them.
"""
