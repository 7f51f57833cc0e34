"""Projects from rendered scenes, and comparison of their results with the truth."""
