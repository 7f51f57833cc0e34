from adjust import *
from measure import *
from pipeline import *

__version__: str
PACKAGES: tuple[str, ...]

def refuse_hidden_packages() -> None: ...
