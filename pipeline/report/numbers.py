"""Formatting of numbers to the digits that the standard deviation supports: with true minus signs and powers of ten in
the report, as they are typed in the terminal."""

import math
from collections.abc import Iterable

NONE = "–"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_TYPED = str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789")


def fixed(value: float | None, decimals: int = 2, sign: bool = False) -> str:
    """Format a number with fixed decimals; a dash for None or a non-finite number."""
    if value is None or not math.isfinite(value):
        return NONE
    rounded = round(value, decimals) + 0.0  # no minus sign before a zero
    text = f"{rounded:+.{decimals}f}" if sign else f"{rounded:.{decimals}f}"
    return text.replace("-", "−")


def fixed_list(values: Iterable[float] | None, decimals: int, separator: str = ", ", sign: bool = False) -> str:
    """Format numbers with fixed decimals; a dash for None."""
    return NONE if values is None else separator.join(fixed(value, decimals, sign) for value in values)


def value_and_sigma(value: float | None, sigma: float | None, size: float = 0.0) -> tuple[str, str]:
    """Format the value to the last digit that its sigma supports, and the sigma to two digits.

    size: of the number whose power of ten both are written with; 0: the larger of the two.

    >>> value_and_sigma(153.66401, 0.00412)
    ('153.6640', '0.0041')
    >>> value_and_sigma(1.7427e-07, 3.1e-09)
    ('1.743 × 10⁻⁷', '0.031 × 10⁻⁷')
    >>> value_and_sigma(153.664, 0.0)
    ('153.664', 'fixed')
    """
    if value is None or not math.isfinite(value):
        return NONE, NONE
    if sigma is None or not math.isfinite(sigma):
        return significant(value, 6), NONE
    if sigma == 0.0:
        return significant(value, 8), "fixed"
    power = _power(size or max(abs(value), sigma))
    scale = 10.0**power
    decimals = min(max(1 - math.floor(math.log10(sigma / scale)), 0), 12)
    return _scaled(value / scale, decimals, power), _scaled(sigma / scale, decimals, power)


def significant(value: float | None, digits: int = 3) -> str:
    """Format a number to significant digits; a dash for None or a non-finite number."""
    if value is None or not math.isfinite(value):
        return NONE
    power = _power(abs(value))
    mantissa = value / 10.0**power
    whole = len(f"{abs(mantissa):.0f}")  # digits before the point are never dropped for a power of ten
    return f"{mantissa:.{max(digits, whole)}g}".replace("-", "−") + _times(power)


def typed(text: str) -> str:
    """Number as it is typed into a calculator or a file: -5.991e-6 for −5.991 × 10⁻⁶."""
    return text.replace(" × 10", "e").translate(_TYPED)


def _power(size: float) -> int:
    """Power of ten to write separately; 0 for sizes that are legible without."""
    return 0 if size == 0.0 or 1e-3 <= size < 1e7 else math.floor(math.log10(size))


def _scaled(value: float, decimals: int, power: int) -> str:
    return fixed(value, decimals) + _times(power)


def _times(power: int) -> str:
    return f" × 10{str(power).translate(_SUPERSCRIPT)}" if power else ""
