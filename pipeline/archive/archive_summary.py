"""What `measure` says of many scans: where they stand, and the first of those that need a look."""

from collections.abc import Mapping
from pathlib import Path

from pipeline.archive.status import NAMED, ArchiveStatus, archive_status, worst_named
from pipeline.archive.verdicts import NEXT_STEP, Verdict
from pipeline.files.project_file import Project
from pipeline.report.data import Problem
from pipeline.report.verdict import Level
from pipeline.report.verdict import Verdict as ProjectVerdict
from pipeline.summary import Summary


def archive_summary(project: Project, files: Mapping[str, Path]) -> Summary:
    """What `measure` says of many scans."""
    return _summary(archive_status(project), files)


def shard_summary(project: Project, path: Path, shard: tuple[int, int]) -> Summary:
    """What `measure --shard` says: of the scans of that part."""
    status = archive_status(project, path)
    own = tuple(scan for scan in status.scans if scan.verdict not in (Verdict.WAITING, Verdict.OLD))
    return _summary(ArchiveStatus(own), {f"part {shard[0]} of {shard[1]}": path})


def _summary(status: ArchiveStatus, files: Mapping[str, Path]) -> Summary:
    told = ", ".join(f"{count} {verdict}" for verdict, count in status.counts.items() if count) or "none"
    sentence = f"Measured: {len(status.scans)} scans: {told}."
    named, more = worst_named(status.scans, NAMED, False)
    problems = [Problem(f"{scan.image}: {scan.verdict}: {scan.why}", NEXT_STEP[scan.verdict]) for scan in named]
    problems += [Problem(f"decisions.jsonl, {line}", "It does not count.") for line in status.idle_decisions]
    if more:
        problems.append(Problem(f"{more} more need a look.", "Run `reseau status` with --verdict or --csv."))
    level: Level = "good" if status.all_good else "look"
    return Summary(ProjectVerdict(level, sentence, tuple(problems), ()), {}, {}, None, None, files)
