"""Quality of an adjustment: residuals, cofactors, tests, reliability, significance, correlations."""
