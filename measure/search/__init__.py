"""Where in its scan a camera's frame lies."""
