"""Blocks of overlapping frames without known orientation: oriented by COLMAP and adjusted here."""
