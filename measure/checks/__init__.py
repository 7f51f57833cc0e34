"""Measured frames checked by what else is known: the pitch of the scan, and the camera's other frames."""
