"""The datum, and everything else that the observations do not determine."""
