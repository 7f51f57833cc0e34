"""Files that were moved, renamed or touched, and have the content that was measured: their results are theirs."""

from collections import defaultdict
from collections.abc import Sequence

from measure.scans.remote import scan_path
from pipeline.archive.file_state import FileStates, Identity
from pipeline.archive.identity import content_hash, parts_hash
from pipeline.archive.store import Store
from pipeline.archive.work import Work
from pipeline.files.project_file import Project
from pipeline.files.scan_files import as_named
from pipeline.measuring.scan_task import ScanTask
from pipeline.progress import Reporter


def find_moved(store: Store, project: Project, reporter: Reporter) -> dict[str, str]:
    """Give files that the store does not know as they are the results of those whose whole content they have, and say
    what fingerprints these have now, by the earlier ones. Only results count whose content was hashed: an earlier call
    with `--moved` did that."""
    known, files = store.identities(), FileStates(project.path.resolve().parent)
    by_size = defaultdict[int, dict[str, str]](dict)
    for uri, content in store.content_hashes().items():
        by_size[known[uri].state.bytes][content] = uri
    states = {name: files.of(file) for name, file in as_named(project.scans).items()}
    unknown = {name: state for name, state in states.items() if state != getattr(known.get(state.uri), "state", None)}
    taken = {state.uri for name, state in states.items() if name not in unknown}
    found, keys = 0, dict[str, str]()
    with reporter.stage("looked for in the store") as count:
        for done, (name, state) in enumerate(unknown.items(), 1):
            count(name, done, len(unknown))
            if not by_size.get(state.bytes):
                continue
            path = project.scans[name]
            content = content_hash(path)
            uri = by_size[state.bytes].get(content, "")
            if content and uri and uri not in taken:
                keys |= store.move(uri, Identity(state, parts_hash(path, project.max_pixels)))
                taken.add(state.uri)
                del by_size[state.bytes][content]
                found += 1
    if unknown:
        reporter.say(
            f"{found} of {len(unknown)} files that are new or changed have the content of ones that are measured"
        )
    return keys


def hash_contents(store: Store, tasks: Sequence[ScanTask], work: Work, reporter: Reporter) -> None:
    """Hash the whole files of all scans whose content is not known, so that they are known when they are moved."""
    hashed = store.content_hashes()
    left = {
        work.state(task).uri: scan_path(task.scan) for task in tasks if task.scan and work.state(task).uri not in hashed
    }
    with reporter.stage("content hashed of") as count:
        for done, (uri, path) in enumerate(left.items(), 1):
            count(path.name, done, len(left))
            store.set_content_hashes({uri: content_hash(path)})
