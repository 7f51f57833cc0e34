"""What the program writes, each format beside its reader."""
