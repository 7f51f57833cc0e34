"""Linear algebra of large networks: small matrices, fronts, factors. Independent of photogrammetry."""
