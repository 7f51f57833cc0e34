"""Which of the eight ways a frame lies in its scan."""
