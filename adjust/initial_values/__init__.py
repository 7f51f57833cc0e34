"""Initial values for an adjustment: the user need not supply approximations."""
