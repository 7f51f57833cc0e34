"""What is written on the film: found, read, and told which way it lies."""
