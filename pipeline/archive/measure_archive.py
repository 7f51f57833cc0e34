"""A project's scans measured into its store: only what is missing or changed, whatever happens to the rest."""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from measure.errors import MeasurementError
from measure.scans.remote import fetch_location
from pipeline.archive.cluster import cluster_executor
from pipeline.archive.decision_check import tell_inapplicable
from pipeline.archive.judging import judge_lots, latest
from pipeline.archive.key import shard_of
from pipeline.archive.moved import find_moved, hash_contents
from pipeline.archive.store import Store
from pipeline.archive.thumbnails import ThumbnailStore
from pipeline.archive.together import find_copies, input_of, judged_lots
from pipeline.archive.work import Work
from pipeline.archive.work_options import WorkOptions
from pipeline.files.project_file import Project
from pipeline.measuring.learn_stage import learn_marks
from pipeline.measuring.measurable import check_measurable
from pipeline.measuring.roll import with_known_lines
from pipeline.measuring.scan_task import scan_tasks
from pipeline.measuring.tied import tied
from pipeline.measuring.tone_stage import said_of_tones
from pipeline.progress import Reporter
from pipeline.text.wording import counted, gathered
from pipeline.workers import worker_pool


def measure_archive(
    project: Project,
    store: Store,
    made_from: Callable[[], Mapping[str, str]],
    learned_folder: Path,
    reporter: Reporter,
    options: WorkOptions | None = None,
) -> str:
    """Measure what is missing of the project's scans, and judge all of them together, unless that is as it was.

    Returns the digest of that judging; "" of a shard, which does not judge. Raises InputError for what is wrong in the
    user's own files, before anything is measured, and MeasurementError where no scan at all could be measured; a scan
    that fails is a result. made_from: what a judging says that it is of, asked when all is measured; learned_folder:
    where what is learned of marks is written.
    """
    options = options or WorkOptions()
    names = check_measurable(project)
    with executor_of(project, options) as executor, ThumbnailStore.beside(store.path) as thumbnails:
        # Once nothing stands in the way of measuring again.
        lost = store.forget_damaged() if options.retry or store.has_damaged_rows() else 0
        if lost:
            reporter.say(f"{store.path}: {counted(lost, 'result')} stored there not as written: measured again")
        if options.retry:
            store.forget_failed()
        if options.moved:
            thumbnails.rekey(find_moved(store, project, reporter))
        work = Work(project, store, executor, options, thumbnails)
        learned = learn_marks(project, reporter, work.measure, executor, learned_folder, store)
        tasks = scan_tasks(learned, names, said_of_tones(learned, reporter, work.measure, store))
        tasks, _ = with_known_lines(tasks, work.measure, reporter)
        store.set_project({work.state(task).uri: task.name for task in tasks})
        if options.shard is not None:
            part, parts = options.shard
            work.complete([task for task in tasks if shard_of(task.name, parts) == part], reporter)
            return ""
        work.complete(tasks, reporter)
        if options.moved:
            hash_contents(store, tasks, work, reporter)
        _check_any(store)
        copies = find_copies(store, tasks, work)
        made = made_from()
        told = input_of(tasks, work, copies, made)
        before = latest(store)
        if before is not None and before.input == told:
            tell_inapplicable(learned, store, before.digest, work)
            return before.digest
        share = partial(tied, learned, reporter=reporter, executor=executor)
        lots = judged_lots(learned, tasks, work, copies, share, told)
        digest = judge_lots(store, made, told, lots)
        tell_inapplicable(learned, store, digest, work)
        return digest


def executor_of(project: Project, options: WorkOptions) -> AbstractContextManager[Executor]:
    """What works on the project's scans: processes here, or the workers of a cluster."""
    if options.cluster is not None:
        return cluster_executor(
            options.cluster, [fetch_location(path) for path in project.scans.values()], options.workers
        )
    return worker_pool(len(project.scans), options.workers)


def _check_any(store: Store) -> None:
    """Raises MeasurementError where no scan at all could be measured, with all that was said of them."""
    failures = store.failures()
    if failures is not None:
        raise MeasurementError("\n".join(gathered(failures)))
