"""Least-squares calibration from comparator coordinates: one adjustment of all unknowns, fiducial marks included.

Enter by `adjust(network)`; the names below are imported on first use. docs/how-to/python.md has
an example. docs/code.md lists the modules in the order of processing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
