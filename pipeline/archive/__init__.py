"""The archive of measured scans: what is kept of each, by which key, and what is still to be measured."""
