"""Results as plots of Matplotlib and as tables of pandas, where these are installed."""
