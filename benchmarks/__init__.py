"""Benchmarks and studies, the sources of the figures in docs/: `python -m benchmarks` lists them."""
