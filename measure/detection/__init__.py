"""Detection of marks in a scan by normalised cross-correlation, and its significance."""
