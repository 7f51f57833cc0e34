"""Linear algebra of large networks: small matrices, fronts, factors. It knows numbers only."""
