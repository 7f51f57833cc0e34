"""How long the scans that are left will take: by kind of scan, from those of it that are done."""

from collections import Counter, defaultdict
from collections.abc import Sequence

from pipeline.measuring.scan_task import ScanTask

_HOUR_S, _MINUTE_S = 3600.0, 60.0
_NAMED = 3


class ExpectedTime:
    """Counts what is done of each kind: scans of one camera, of one sort of file."""

    def __init__(self, tasks: Sequence[ScanTask], cameras: Sequence[str], at_a_time: int) -> None:
        """tasks: all that are to be measured; cameras: of each; at_a_time: how many processes measure them."""
        kinds = zip(tasks, cameras, strict=True)
        self._kind = {task.name: f"{camera} {task.shown_scan.rpartition('.')[2].lower()}" for task, camera in kinds}
        self._left = Counter(self._kind.values())
        self._done, self._bytes = defaultdict[str, list[float]](list), defaultdict[str, float](float)
        self._at_a_time = at_a_time

    def is_done(self, name: str, seconds: float, bytes_read: int) -> None:
        kind = self._kind[name]
        self._left[kind] -= 1
        self._done[kind].append(seconds)
        self._bytes[kind] += max(bytes_read, 0)

    @property
    def left_s(self) -> float:
        """A kind of which nothing is done takes as long as all others on the average."""
        all_s = [seconds for each in self._done.values() for seconds in each]
        usual = sum(all_s) / len(all_s) if all_s else 0.0
        means = {kind: sum(each) / len(each) for kind, each in self._done.items()}
        return sum(left * means.get(kind, usual) for kind, left in self._left.items()) / self._at_a_time

    @property
    def sentence(self) -> str:
        """About how long, and by which kinds."""
        kinds = [
            f"{kind}: {self._left[kind]} left, {duration(sum(done) / len(done), 1)} and "
            f"{self._bytes[kind] / len(done) / 1e6:.0f} MB read each"
            for kind, done in sorted(self._done.items())
        ]
        more = f"; and {len(kinds) - _NAMED} kinds more" if len(kinds) > _NAMED else ""
        return f"about {duration(self.left_s)} left ({'; '.join(kinds[:_NAMED])}{more})"


def duration(seconds: float, decimals: int = 0) -> str:
    """In words, to two digits or so. decimals: of less than ten seconds."""
    if seconds >= 2 * _HOUR_S:
        return f"{seconds / _HOUR_S:.1f} hours"
    return (
        f"{seconds / _MINUTE_S:.0f} minutes"
        if seconds >= 2 * _MINUTE_S
        else f"{seconds:.{decimals if seconds < 10 else 0}f} s"
    )
