"""What of each scan the project asks for, before other scans have told anything: so that it is known without measuring
which results are of other options."""

from collections.abc import Callable

from measure.results import MEASURE_REVISION
from pipeline.archive.decided import by_image
from pipeline.archive.key import options_hash
from pipeline.files.decisions_file import Choice
from pipeline.files.project_file import Project
from pipeline.measuring.scan_task import options_of
from pipeline.results.fingerprints import fingerprint

_MEASURED = (Choice.PLACE, Choice.POSE, Choice.UNDO)  # decisions that change what is measured


def asked_of(project: Project) -> Callable[[str], str]:
    """A hash of it, by the image's name. Raises InputError for marks that cannot be sought."""
    options, hashes = options_of(project, {}), dict[int, str]()
    decided = {
        image: [one for one in decisions if one.decision in _MEASURED]
        for image, decisions in by_image(project.decisions).items()
    }

    def asked(image: str) -> str:
        own = options(image)
        if id(own) not in hashes:
            hashes[id(own)] = options_hash(f"{own.json} {MEASURE_REVISION}")
        told = decided.get(image)
        return fingerprint([hashes[id(own)], told]) if told else hashes[id(own)]

    return asked
