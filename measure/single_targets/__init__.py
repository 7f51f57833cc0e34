"""Disks and crosses of a test field: found in the whole frame in one pass, measured, assigned to their targets."""
