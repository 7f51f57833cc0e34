"""Export to and import from other programs, one module per format."""
