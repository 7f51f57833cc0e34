"""Text files: CSV and TOML tables with error messages that name the place, atomic writing, wording of messages."""
