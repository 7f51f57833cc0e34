"""Archive of measured scans: what is stored of each, under which key, and what remains to be measured."""
