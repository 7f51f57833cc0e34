"""Detection: where in a scan something looks like a mark, by normalised cross-correlation, and how significantly."""
