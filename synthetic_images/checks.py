"""What the values of a scene are held to: each raises ValueError saying what would be right."""


def one_of(what: str, value: object, allowed: tuple[object, ...]) -> None:
    """The value is one of those allowed."""
    if value not in allowed:
        raise ValueError(f"{what}: {value!r} is none of {', '.join(repr(one) for one in allowed)}")


def positive(what: str, *values: float) -> None:
    """All values are positive."""
    if not all(value > 0.0 for value in values):
        raise ValueError(f"{what} must be positive, not {', '.join(format(value, 'g') for value in values)}")


def not_negative(what: str, value: float) -> None:
    """The value is 0 or positive."""
    if not value >= 0.0:
        raise ValueError(f"{what} must be 0 or positive, not {value:g}")


def unique(what: str, ids: list[str]) -> None:
    """No name is given twice."""
    twice = sorted({id for id in ids if ids.count(id) > 1})
    if twice:
        raise ValueError(f"{what} {twice[0]!r} is given twice; every {what} has a name of its own")
