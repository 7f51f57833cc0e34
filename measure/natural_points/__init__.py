"""The same points of the terrain in three frames or more, without any target."""
