"""From a folder of scans to all results: the only package that depends on the other three.

The names below read and write the files described in docs/how-to/python.md. They are loaded on first use. docs/code.md
lists the modules stage by stage.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
