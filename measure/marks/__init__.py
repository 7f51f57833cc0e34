"""What a mark is, and how it looks in a scan."""
