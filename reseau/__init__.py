"""The names of `measure`, `adjust` and `pipeline` under one import: `import reseau`.

The packages are loaded when one of their names is first used. docs/how-to/python.md has an example.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("measure", "adjust", "pipeline")  # a name is looked up in this order; no two have the same one
_INSTALLED = Path(__file__).resolve().parents[1]  # the folder that holds this package and those


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("importlib.metadata").version("reseau")
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    refuse_hidden_packages()
    for package in map(import_module, PACKAGES):
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    refuse_hidden_packages()
    return sorted({"__version__", *(name for one in PACKAGES for name in import_module(one).__all__)})


def refuse_hidden_packages() -> None:
    """Check that Python finds the packages of this installation, and not files of the user's with their names.

    Raises
    ------
    ImportError
        If a module such as `measure.py` in the user's folder comes before the package; the message names it.
    """
    for package in PACKAGES:
        spec = find_spec(package)
        found = Path(spec.origin).resolve() if spec and spec.origin else None
        if found != _INSTALLED / package / "__init__.py":
            what = f"{found} hides" if found else "Python does not find"
            remedy = "Rename that file, or start Python from another folder." if found else "Install reseau again."
            raise ImportError(f"{what} the package {package!r} of reseau. {remedy}")
