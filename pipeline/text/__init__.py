"""The ground of all files: tables with errors that name their place, CSV, TOML, writing whole or not at all, words."""
