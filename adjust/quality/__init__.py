"""What the result says of itself: residuals, tests, reliability, significance."""
