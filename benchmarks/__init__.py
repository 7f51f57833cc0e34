"""The studies that the figures of docs/ come from: `python -m benchmarks` lists them."""
