"""Tone curve and sharpening of a scan: priors, declarations in the file, and estimation from marks."""
