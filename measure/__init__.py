"""Measurement of marks and targets in scans: comparator coordinates to a few hundredths of a pixel, with covariances.

The entry point is `measure_fiducials(open_scan(path), layout, pitch_um)`; names are loaded when first used.
docs/how-to/python.md has an example. docs/code.md lists the modules in the order of processing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
