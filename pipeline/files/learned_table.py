"""What a camera file says of marks that are learned: where somebody clicked, or from which scans they were learned."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from measure.geometry import POSES
from measure.marks.shapes import Point
from pipeline.text.image_names import image_name
from pipeline.text.tables import Table


@dataclass(frozen=True)
class Clicks:
    """Where somebody saw the marks in one scan: px by fiducial, column and row.

    sha256: of the scan's file, as it was then, and who saw them; "" where the camera's file says it.
    """

    scan: str
    px: Mapping[str, Point]
    sha256: str = ""
    who: str = ""


@dataclass(frozen=True)
class LearnedFrom:
    """The scan whose pictures the learned marks were first found by, the SHA-256 of its file, the pose in which it
    lies, and whether clicks show that. alike: the scans that lie like it: itself; and all that were there, where the
    marks were found by recurring in one place."""

    scan: str
    sha256: str
    pose: str
    clicked: bool
    alike: tuple[str, ...]


def read_clicks(table: Table, learned: Sequence[str]) -> Clicks:
    """learned: the fiducials to be learned. Raises InputError where some of them are not clicked."""
    scan = image_name(table.text("scan"))
    places = table.table("px")
    px = {id: places.pair(id) for id in learned if id in places}
    places.done()
    table.done()
    missing = [id for id in learned if id not in px]
    if missing or not px:
        raise table.error(
            "px", f"says nothing of {', '.join(missing) or 'any mark'}. Click all learned marks, or none."
        )
    return Clicks(scan, px)


def read_learned_from(table: Table) -> LearnedFrom:
    """As the program wrote it beside the templates."""
    learned = LearnedFrom(
        table.text("scan"),
        table.text("sha256"),
        table.text("pose", choices=POSES),
        table.flag("clicked", False),
        table.texts("alike"),
    )
    table.done()
    return learned
