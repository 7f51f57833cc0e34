"""The adjustment as a whole: its options, its runs, slips in what was given, and what the result is worth."""
