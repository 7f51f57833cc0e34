"""What is written about a frame, drawn as it lies in the scan, and what of it spoke for the pose."""

from markupsafe import Markup

from measure.annotations.fields import Line
from measure.geometry import up_from_camera
from pipeline.drawing import svg
from pipeline.results.measured_scan import MeasuredScan

_WIDTH_PX = 1000.0  # plates of 20 mm on film of 230 are read
_LEAST_PX = 7.0  # of letters


def written(scan: MeasuredScan | None) -> Markup | None:
    """The scan's outline with its lines of writing in place; None where none was read. Those that the pose's evidence
    quotes stand out."""
    if scan is None or not scan.frame.writing:
        return None
    zoom = _WIDTH_PX / max(scan.width_px, scan.height_px)
    width, height = scan.width_px * zoom, scan.height_px * zoom
    evidence = " ".join(scan.frame.pose.evidence if scan.frame.pose else ())
    drawn = [svg.line([1, width - 1, width - 1, 1], [1, 1, height - 1, height - 1], "scan", closed=True)]
    drawn += [_line(line, zoom, f'"{line.text}"' in evidence) for line in scan.frame.writing]
    return svg.picture(width, height, "What is written about the frame, as it lies in the scan", *drawn, class_="film")


def _line(line: Line, zoom: float, told: bool) -> Markup:
    """The text over the rectangle in which it was read, turned and mirrored as it lies."""
    outline = [(col * zoom, row * zoom) for col, row in line.outline_px]
    cols, rows = zip(*outline, strict=True)
    center = (sum(cols) / len(cols), sum(rows) / len(rows))
    up = up_from_camera(line.pose)
    sides = max(cols) - min(cols), max(rows) - min(rows)
    size = max(0.8 * min(sides), _LEAST_PX)
    # SVG counts rows downwards, and so do letters.
    matrix = (up[0, 0], -up[1, 0], -up[0, 1], up[1, 1], *center)
    text = svg.tag(
        "text",
        line.text,
        transform=f"matrix({' '.join(f'{value:g}' for value in matrix)})",
        class_="told" if told else "read",
        font_size=f"{size:.1f}",
        text_anchor="middle",
        dominant_baseline="central",
        textLength=f"{max(sides):.1f}",
        lengthAdjust="spacingAndGlyphs",
    )
    return svg.line(cols, rows, "told" if told else "read", closed=True) + text
