"""Checks of the values of a scene: each raises ValueError with the allowed values."""


def one_of(what: str, value: object, allowed: tuple[object, ...]) -> None:
    """Check that a value is one of those allowed."""
    if value not in allowed:
        raise ValueError(f"{what}: {value!r} is none of {', '.join(repr(one) for one in allowed)}")


def positive(what: str, *values: float) -> None:
    """Check that all values are positive."""
    if not all(value > 0.0 for value in values):
        raise ValueError(f"{what} must be positive, not {', '.join(format(value, 'g') for value in values)}")


def not_negative(what: str, value: float) -> None:
    """Check that a value is 0 or positive."""
    if not value >= 0.0:
        raise ValueError(f"{what} must be 0 or positive, not {value:g}")


def unique(what: str, ids: list[str]) -> None:
    """Check that no name is given twice."""
    twice = sorted({id for id in ids if ids.count(id) > 1})
    if twice:
        raise ValueError(f"{what} {twice[0]!r} is given twice; every {what} has a name of its own")
