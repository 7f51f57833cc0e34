"""How the measuring of a project's scans is shared out, and what of it is done."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WorkOptions:
    """How the work is shared. shard: (K, N), only the scans of the K-th of N parts. cluster: a scheduler's address, or
    `local`. retry: measure again what failed. moved: keep results of files whose content is the same elsewhere.
    workers: processes, if not one a core. only_kept: nothing is measured; what is missing stays so."""

    shard: tuple[int, int] | None = None
    cluster: str | None = None
    retry: bool = False
    moved: bool = False
    workers: int | None = None
    only_kept: bool = False


class NotMeasured(Exception):
    """Something is missing, and nothing is to be measured now."""
