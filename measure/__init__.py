"""A scan in, comparator coordinates out: marks and targets to a few hundredths of a pixel, with honest covariances.

`measure_fiducials(open_scan(path), layout, pitch_um)` is the way in; the names below are loaded when first used.
docs/how-to/python.md has an example. docs/code.md lists the modules in the order in which
a scan goes through them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
