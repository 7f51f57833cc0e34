"""The table [ties] of project.toml: natural points, and how much of their heights is known."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from adjust.functional_model.lens import Prior
from adjust.problem.network import ObjectPoint
from pipeline.text.tables import Table

if TYPE_CHECKING:
    from measure.tie_points.find_points import TieOptions


@dataclass(frozen=True)
class TieSettings:
    """height: of the ground on which the natural points lie, object units, with its standard deviation; None where it
    is not known."""

    options: "TieOptions"
    height: Prior | None = None

    def point(self, id: str) -> ObjectPoint:
        """A natural point as an object point: unknown but for its height, where that is given."""
        return ObjectPoint(id, None, None, self.height)


def read_ties(table: Table) -> TieSettings:
    """Read the table. Raises InputError naming the key that is wrong."""
    from measure.tie_points.find_points import TieOptions

    usual = TieOptions()
    wanted, images = table.whole("wanted", usual.wanted), table.whole("images", usual.images)
    try:
        options = TieOptions(wanted, images)
    except ValueError as error:
        raise table.error("wanted", f"these natural points are impossible: {error}.") from None
    height = None
    if "height" in table or "height_sigma" in table:
        height = Prior(table.number("height"), table.number("height_sigma", least=0.0))
    table.done()
    return TieSettings(options, height)
