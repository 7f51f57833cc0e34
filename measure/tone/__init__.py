"""The tone curve of a scan: what is known of it, what its file declares, what its marks tell."""
