"""Why a mark that the others predict was not found at its place: what its picture there says."""

from dataclasses import dataclass

from measure.frames.faint_marks import FaintMark
from measure.reason import Code, Reason

_SHOWS = 1 / 3  # of the others' contrast: ground that leaves less to a mark hides it


@dataclass(frozen=True)
class Ground:
    """The ground at a mark's place. is_light: whether a mark is sought that is lighter than it; room_dn: by which such
    a mark could change it, the scan having none lighter or darker; sigma_dn: its own standard deviation."""

    is_light: bool
    room_dn: float
    sigma_dn: float


def reason_unseen(ground: Ground, usual_dn: float, reach_px: float, seen: FaintMark | None, certain: bool) -> Reason:
    """A sentence, the first that holds: ground as dark as anything in the scan leaves a dark mark no room; too little
    of it shows to give its place; what answers is no more than rounding; texture hides it.

    usual_dn: by which the other marks change their ground. seen: the strongest answer within reach_px, and certain
    whether chance would not make it.
    """
    if ground.room_dn < _SHOWS * usual_dn:
        shade = "light" if ground.is_light else "dark"
        return Reason(
            f"the ground at its place is so {shade} that the mark could change it by {_grey(ground.room_dn)} only, the "
            f"others by {usual_dn:.0f}",
            Code.GROUND,
        )
    if seen is not None and certain:
        return Reason(
            f"only {1 - seen.fit.damaged_fraction:.0%} of it shows: that gives its place to {seen.sigma_px:.1f} px "
            "only",
            Code.COVERED,
        )
    within = f"within {reach_px:.0f} px of its place"
    could = min(ground.room_dn, usual_dn)
    if seen is not None and abs(seen.fit.stored_contrast_dn) < _SHOWS * could:
        return Reason(
            f"nothing {within} looks like it: what does so most changes the ground by "
            f"{_grey(abs(seen.fit.stored_contrast_dn))}, where the mark could by {could:.0f}",
            Code.NOT_FOUND,
        )
    return Reason(
        f"nothing {within} stands out of the texture like it: the ground there varies by {_grey(ground.sigma_dn)}, and "
        f"a mark could change it by {could:.0f}",
        Code.CONTRAST,
    )


def _grey(dn: float) -> str:
    if dn < 0.5:
        return "less than half a grey value"
    return f"{dn:.0f} grey value{'s' if round(dn) > 1 else ''}"
