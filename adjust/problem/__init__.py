"""Adjustment problem: network, numbered unknowns, condition equations F1 to F4, and the form of the result."""
