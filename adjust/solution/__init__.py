"""Adjustment as a whole: options, runs, blunder hypotheses, explanations and the result."""
