"""Initial values for an adjustment: nobody has to supply approximations."""
