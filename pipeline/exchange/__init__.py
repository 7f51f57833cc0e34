"""Out to and in from other programs, one file a format."""
