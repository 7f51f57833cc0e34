"""A folder of overlapping frames without any orientation, oriented by COLMAP and adjusted here."""
