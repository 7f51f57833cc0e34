"""The least-squares solution of blocks that share unknowns, and its covariance."""
