"""How coarsely a JPEG file rounds: its quantisation tables (ITU-T T.81, B.2.4.1)."""

_DQT = 0xDB
UNKNOWN_DN = 15.0  # where a file does not say it: as at quality 50, which no scan should be below
_COARSE = 15  # coefficients in the order of the table: up to two periods in a block of 8 px, as blurred edges have them


def jpeg_headers(data: bytes) -> list[tuple[int, bytes]]:
    """Marker and body of the segments before the picture's data."""
    headers, position = [], 2
    while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] not in (0xDA, 0xD9):
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        headers.append((data[position + 1], data[position + 4 : position + 2 + length]))
        position += 2 + max(length, 2)
    return headers


def rounding_step_dn(data: bytes) -> float:
    """The mean step to which the coarser detail of the luminance is rounded, in grey values: from a JPEG file, or its
    beginning up to the picture's data."""
    for marker, body in jpeg_headers(data):
        if marker == _DQT:
            table = _table(body, 0)
            if table:
                return sum(table[:_COARSE]) / _COARSE
    return UNKNOWN_DN


def _table(body: bytes, wanted: int) -> list[int]:
    """The 64 steps of a table of that number, empty where the segment does not hold it."""
    position = 0
    while position < len(body):
        size, number = 1 + (body[position] >> 4), body[position] & 15
        steps = body[position + 1 : position + 1 + 64 * size]
        if number == wanted and len(steps) == 64 * size:
            return [int.from_bytes(steps[at : at + size], "big") for at in range(0, len(steps), size)]
        position += 1 + 64 * size
    return []
