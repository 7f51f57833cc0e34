"""Annotations on the film: lines of writing found, read, and which way they lie."""
