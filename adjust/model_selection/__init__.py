"""Which model the observations ask for, and what a planned network would give."""
