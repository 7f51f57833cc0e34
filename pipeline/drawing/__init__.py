"""Pictures: drawing in SVG, for the report's page and for files of their own."""
