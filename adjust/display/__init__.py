"""Plots (Matplotlib) and tables (pandas) of results, where these packages are installed."""
