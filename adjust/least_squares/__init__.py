"""Least-squares solution of blocks with shared unknowns, and its covariance."""
