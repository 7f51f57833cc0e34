"""Measure a project's scans into its results database: only what is missing or changed."""

from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from measure.errors import MeasurementError
from measure.scans.remote import fetch_location, scan_path
from pipeline.archive.checked_results import CheckRun, latest, second_pass_input, store_lots
from pipeline.archive.cross_scan_checks import check_lots, find_copies, hash_inputs
from pipeline.archive.made_from import measured_from
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.review_decisions import tell_inapplicable
from pipeline.archive.thumbnails import ThumbnailDatabase
from pipeline.archive.work import Work
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.files.scan_files import as_named
from pipeline.measuring.learn_stage import collect_tones, learn_marks
from pipeline.measuring.roll import add_known_lines
from pipeline.measuring.scan_task import ScanTask, scan_tasks
from pipeline.measuring.tie_stage import check_tie_names, tie_scans
from pipeline.provenance import FileIdentity, FileStates, content_hash, parts_hash, shard_number
from pipeline.terminal import Reporter
from pipeline.text.wording import counted, gathered
from pipeline.workers import WorkOptions, cluster_executor, worker_pool


def check_measurable(project: Project) -> tuple[str, ...]:
    """Return the names of the images to be measured. Raises InputError for errors in the user's files."""
    if not project.scans:
        raise InputError(f'{project.path}: scans is missing: which pictures to measure, such as ["scans/*.tif"].')
    sought = [one for camera in project.cameras.values() for one in camera.fiducials if not one.passed_over]
    if not sought and project.targets is None and project.ties is None:
        raise InputError(
            f"{project.path}: nothing to measure: all fiducials of {project.default_camera.path} have mark = "
            '"none", and the project has no [targets] or [ties]. Draw the marks, or add one of the two tables.'
        )
    check_tie_names(project)
    for camera in project.cameras.values():
        if len(camera.layout_marks) + len(camera.learned) == 1:
            raise InputError(
                f"{camera.path} has one fiducial mark, and a frame is found by two or more. Add the others, or pass it "
                'over with mark = "none".'
            )
    listed = project.given_images.exterior if project.given_images else {}
    names = (*project.scans, *(name for name in listed if name not in project.scans and name not in project.left_out))
    scan_tasks(project, names)  # raises for undefined targets and for fiducials that have no drawing
    return names


def find_touched(database: ResultsDatabase, project: Project) -> dict[str, str]:
    """Re-key the results of files of another time with the content that was measured; return {old fingerprint: new}."""
    known, hashes = database.identities(), database.content_hashes()
    files, keys = FileStates(project.path.resolve().parent), dict[str, str]()
    reviewed = {one.image for one in project.decisions}
    for name, file in as_named(project.scans).items():
        state = files.get(file)
        earlier, content = known.get(state.uri), hashes.get(state.uri)
        if earlier and content and state.is_touched(earlier.state) and content_hash(Path(file)) == content:
            keys |= database.move(state.uri, FileIdentity(state, earlier.parts_hash), name in reviewed)
    return keys


def find_moved(database: ResultsDatabase, project: Project, reporter: Reporter) -> dict[str, str]:
    """Re-key the results of moved files by content hash and return {old fingerprint: new}.

    Only results whose content was hashed by an earlier call with `--moved` are found.
    """
    known, files = database.identities(), FileStates(project.path.resolve().parent)
    states = {name: files.get(file) for name, file in as_named(project.scans).items()}
    unknown = {name: state for name, state in states.items() if state != getattr(known.get(state.uri), "state", None)}
    taken = {state.uri for name, state in states.items() if name not in unknown}
    free = {content: uri for uri, content in database.content_hashes().items() if uri not in taken}
    sizes = {known[uri].state.bytes for uri in free.values()}
    reviewed = {one.image for one in project.decisions}
    found, keys = 0, dict[str, str]()
    with reporter.stage("recognising scan") as count:
        for done, (name, state) in enumerate(unknown.items(), 1):
            count(name, done, len(unknown))
            path = project.scans[name]
            uri = free.pop(content_hash(path), "") if state.bytes in sizes else ""
            if uri and uri not in taken:  # nor has another file come to its place
                keys |= database.move(uri, FileIdentity(state, parts_hash(path)), name in reviewed)
                taken.add(state.uri)
                found += 1
    if unknown:
        reporter.say(f"{found} of {len(unknown)} new or changed files have the content of ones that are measured")
    return keys


def hash_contents(
    database: ResultsDatabase, folder: Path, tasks: Sequence[ScanTask], work: Work, everywhere: bool
) -> None:
    """Hash the whole files of scans without a content hash, so that they are recognised when touched.

    everywhere: those of any size, so that they are recognised after a move, too. folder: that of the project.
    """
    hashed, files, left = database.content_hashes(), FileStates(folder), dict[str, Path]()
    for task in (task for task in tasks if task.scan):
        state, path = work.state(task), scan_path(task.scan)
        is_wanted = state.uri not in hashed and (everywhere or state.is_cheap)
        if is_wanted and files.get(path) == state:  # else it was changed since it was measured
            left[state.uri] = path
    for uri, path in left.items():
        database.set_content_hashes({uri: content_hash(path)})


def measure_archive(
    project: Project, database: ResultsDatabase, learned_folder: Path, reporter: Reporter, options: WorkOptions
) -> CheckRun | None:
    """Measure the missing scans of a project and check all of them together, unless nothing has changed.

    Returns
    -------
    The check run; None for a shard, which has no cross-scan checks.

    Raises
    ------
    InputError
        Errors in the user's files, before anything is measured.
    MeasurementError
        No scan could be measured; single failures are results.
    """
    names = check_measurable(project)
    database.set_project_folder(project.path.parent)
    with open_executor(project, options) as executor, ThumbnailDatabase(database.path) as thumbnails:
        # After all checks that could prevent a new measurement.
        lost = database.forget_damaged() if options.retry or database.has_damaged_rows() else 0
        if lost:
            reporter.say(f"{database.path}: {counted(lost, 'result')} damaged (digest differs): measured again")
        if options.retry:
            database.forget_failed()
        thumbnails.rekey(find_touched(database, project))
        if options.moved:
            thumbnails.rekey(find_moved(database, project, reporter))
        work = Work(project, database, executor, options, thumbnails)
        learned = learn_marks(project, reporter, work.measure, executor, learned_folder, database)
        tasks = scan_tasks(learned, names, collect_tones(learned, reporter, work.measure, database))
        tasks, _ = add_known_lines(tasks, work.measure, reporter)
        database.set_project({work.state(task).uri: task.name for task in tasks})
        if options.shard is not None:
            part, parts = options.shard
            work.complete([task for task in tasks if shard_number(task.name, parts) == part], reporter)
            return None
        work.complete(tasks, reporter)
        hash_contents(database, project.path.resolve().parent, tasks, work, options.moved)
        if (failures := database.failures()) is not None:
            raise MeasurementError("\n".join(gathered(failures)))
        copies = find_copies(database, tasks, work)
        made = measured_from(project)
        input_hash = hash_inputs(tasks, work, copies, made)
        check_run = latest(database)
        if check_run is None or check_run.input not in (input_hash, second_pass_input(input_hash, project.adjust)):
            share = partial(tie_scans, learned, reporter=reporter, executor=executor)
            lots = check_lots(learned, tasks, work, copies, share, input_hash)
            check_run = store_lots(database, made, input_hash, lots)
        tell_inapplicable(learned, check_run, work.decisions, work.counting)
        return check_run


def open_executor(project: Project, options: WorkOptions) -> AbstractContextManager[Executor]:
    """Executor for the project's scans: local processes or the workers of a cluster."""
    if options.cluster is not None:
        return cluster_executor(
            options.cluster, [fetch_location(each) for each in project.scans.values()], options.workers
        )
    return worker_pool(len(project.scans), options.workers)
