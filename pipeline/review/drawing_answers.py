"""Answers to requests about a camera drawn by a user."""

from dataclasses import replace
from typing import Any

from measure.errors import MeasurementError
from measure.marks.shapes import MarkShape, Point
from pipeline.files.camera_file import CameraFile
from pipeline.files.mark_table import Clicks
from pipeline.review.camera_drawing import (
    CameraDrawing,
    FramePlacement,
    camera_path,
    drawn_camera,
    learned_remarks,
    parse_drawing,
    place_frame,
    save_drawing,
    save_learned,
)
from pipeline.review.drawing_view import drawing_json, drawn_mark, take_step
from pipeline.review.frame_view import camera_as_shown, check_clicks
from pipeline.review.pictures import Pictures
from pipeline.review.requests import DrawnCamera, Query, ShownMarks, parse_values
from pipeline.review.session import Session

_WIDEST_PX = 2000  # px, largest half width of the window around a mark


class DrawingAnswers:
    """Answers to requests about drawings. Stateless: each request contains the whole drawing."""

    def __init__(self, session: Session, pictures: Pictures) -> None:
        self._session, self._pictures = session, pictures

    def draw(self, query: Query, body: Any) -> Any:
        """Apply a step to the drawing; returns the drawing as shown."""
        given = parse_values(DrawnCamera, body)
        drawing, placement = self._placed(given.drawing)
        if step := given.step:
            scan = self._session.scan_location(drawing.image)
            drawing = self._pictures.compute(scan, lambda file: take_step(drawing, placement, step, file))
            placement = self._placement(drawing)
        return drawing_json(drawing, placement)

    def picture(self, query: Query) -> bytes:
        """Rendered drawing or residual image around the mark shown."""
        drawing, placement = self._placed(query.table("drawing"))
        half, shown = query.whole("half", 8, _WIDEST_PX), drawn_mark(drawing, placement)
        if shown is None or not isinstance(shown.mark, MarkShape):
            raise MeasurementError("nothing is drawn there")
        matrix, blur_px = shown.pixel_from_mark, shown.clicked.blur_px
        if query.text("of") == "drawing":
            return self._pictures.drawing(shown.mark, matrix, blur_px, half)
        return self._pictures.residual(self._session.scan_location(drawing.image), shown.mark, matrix, blur_px, half)

    def save(self, query: Query, body: Any) -> Any:
        """Write the camera file; returns a message with the next step."""
        given = parse_values(DrawnCamera, body)
        drawing, placement = self._placed(given.drawing)
        project, path = self._session.project, camera_path(self._session.folder, given.file)
        if drawing.mark.get("kind") == "learned" and drawing.marks:
            camera = drawn_camera(drawing, placement, path)
            camera.layout()
            known = replace(project, pitch_um=placement.pitch_um, pose="auto")
            clicks = Clicks(drawing.image, {one.id: one.px for one in drawing.marks}, who=self._session.who)
            learned = camera_as_shown(known, camera, clicks)
            return self._saved(save_learned(learned, learned_remarks(drawing.image), path))
        scan = self._session.scan_location(drawing.image)
        return self._saved(self._pictures.compute(scan, lambda file: save_drawing(drawing, placement, file, path)))

    def save_learned(self, query: Query, body: Any) -> Any:
        """Write a camera of the project with marks learned at clicked places of one scan."""
        given = parse_values(ShownMarks, body)
        path, project = camera_path(self._session.folder, given.file), self._session.project
        self._session.scan_location(given.image)  # raises KeyError for an unknown image
        camera = project.image_camera(given.image)
        check_clicks(camera, given.image, given.px)
        learned = camera_as_shown(project, camera, Clicks(given.image, given.px, who=self._session.who))
        return self._saved(save_learned(learned, learned_remarks(given.image), path))

    def _saved(self, camera: CameraFile) -> Any:
        file, project = camera.path.name, self._session.project
        names = {project.missing_camera, *(one.path.name for one in project.cameras.values())}
        first = "" if file in names else f'name it in the project, camera = "{file}", then '
        return {"text": f"Saved {camera.path} with {len(camera.fiducials)} marks. Next: {first}reseau measure."}

    def _placed(self, given: Any) -> tuple[CameraDrawing, FramePlacement]:
        drawing = parse_drawing(given)
        return drawing, self._placement(drawing)

    def _placement(self, drawing: CameraDrawing) -> FramePlacement:
        project = self._session.project
        size_px, file_um = self._pictures.size(self._session.scan_location(drawing.image))
        known_um: Point | None = project.pitch_um or file_um
        return place_frame(
            drawing, size_px, known_um, "as the project says" if project.pitch_um else "as the file says"
        )
