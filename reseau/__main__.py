"""The command `reseau`, also as `python -m reseau`."""

import sys
from importlib import import_module

from reseau import refuse_hidden_packages

_WRONG_INPUT = 2  # the exit code


def main() -> None:
    """Run the command line, or name the user's file that hides a package."""
    try:
        refuse_hidden_packages()
    except ImportError as error:
        print(f"reseau: {error}", file=sys.stderr)
        sys.exit(_WRONG_INPUT)
    import_module("pipeline.main").main()


if __name__ == "__main__":
    main()
