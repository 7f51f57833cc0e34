"""The noise of film and scanner: its scale, its grain, and least squares that hold in spite of damage."""
