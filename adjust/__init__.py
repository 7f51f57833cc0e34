"""Comparator coordinates in, calibration out: one least-squares adjustment of everything, fiducial marks included.

`adjust(network, approximate(network))` is the way in; the names below are loaded when they are first used.
docs/how-to/python.md has an example. docs/code.md lists the modules in the order in which
the observations go through them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
