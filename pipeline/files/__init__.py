"""Readers of the user's files, checked key by key and column by column."""
