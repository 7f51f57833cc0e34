"""A folder of scans in, everything out: the only package that knows the other three.

The names below read and write the files that docs/how-to/python.md works with. They are loaded when first used.
docs/code.md lists the modules stage by stage.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
