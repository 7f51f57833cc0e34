"""Drawing in SVG, for the report and for separate files."""
