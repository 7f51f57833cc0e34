"""The marks of a frame sighted at full resolution, and the frame fitted to those that agree."""
