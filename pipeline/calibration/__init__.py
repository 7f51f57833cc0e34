"""A digital camera from pictures of a board: `reseau calibrate`."""
