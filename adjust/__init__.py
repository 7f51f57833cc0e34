"""Comparator coordinates in, calibration out: one least-squares adjustment of everything, fiducial marks included."""
