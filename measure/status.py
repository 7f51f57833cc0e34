"""The statuses of a measured mark, in one table: the documentation and the report are made from it."""

from enum import StrEnum


class Status(StrEnum):
    """What became of a mark. Only `measured` and `weak` are observations of the adjustment."""

    MEASURED = "measured"
    WEAK = "weak"
    PREDICTED = "predicted"
    REJECTED = "rejected"
    ABSENT = "absent"

    @property
    def is_observation(self) -> bool:
        return self in (Status.MEASURED, Status.WEAK)


MEANING = {
    Status.MEASURED: "Found, fitted and consistent with all checks.",
    Status.WEAK: "Fitted, but damaged, faint, partly covered or not well known; its standard deviation says how well.",
    Status.PREDICTED: "Not seen; the coordinates are where the other marks say it should be.",
    Status.REJECTED: "Something was found and measured, but a check says that it is not this mark.",
    Status.ABSENT: "Not found, outside the scan or unreadable.",
}
