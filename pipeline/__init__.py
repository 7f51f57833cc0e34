"""A folder of scans in, everything out: the only package that knows the other three.

docs/code.md lists its modules stage by stage.
"""
