"""What a scan's pixel can measure."""

FINEST_PITCH_UM = 0.1  # below it mm or m were meant: no scanner and no sensor has such pixels
