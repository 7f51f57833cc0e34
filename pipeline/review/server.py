"""Local web server of the review page: routes, answers, and who may ask.

Any page open in the same browser can send requests to 127.0.0.1 (CSRF), and a foreign host name can resolve to it (DNS
rebinding). Every request is therefore checked for its Host, its Origin and a cookie that only this browser has.
"""

import getpass
import hmac
import json
import secrets
import socket
import sys
import webbrowser
from collections.abc import Callable
from dataclasses import fields
from importlib import resources
from typing import Any

import anyio.to_thread
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from measure.errors import MeasurementError
from measure.fiducials.options import Click
from measure.geometry import POSES
from pipeline.errors import InputError
from pipeline.files.decisions_file import DecisionKind, LineError, parse_decision
from pipeline.files.mark_table import MARK_TABLES
from pipeline.files.project_file import Project
from pipeline.measuring.scan_task import sample_names
from pipeline.results.measured_record import MeasuredScan
from pipeline.review.drawing_view import DrawingAnswers
from pipeline.review.frame_view import mark_json, measured_as_shown, measured_from_clicks
from pipeline.review.pictures import Pictures
from pipeline.review.requests import Decide, MeasureFrame, Query, ShownMarks, parse_json, parse_values, whole
from pipeline.review.session import Filters, Session

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_SCRIPT = "text/javascript"
_FILES = {
    "review.js": _SCRIPT,
    "view.js": _SCRIPT,
    "draw.js": _SCRIPT,
    "review.css": "text/css",
    "index.html": "text/html",
}
_LARGEST_BODY = 200_000  # bytes
_WIDEST_PX = 60_000
_OFFERED, _TRIED = 100, 4  # scans offered for clicking a camera's marks, and scans for trying the learned templates
_HALF_PX = 40  # px, half width of a window around a mark of unknown size
_SPENT = "This page needs the address that `reseau review` printed, with what stands behind `token=` in it.\n"


class Guard:
    """ASGI middleware that refuses unauthorised requests. port: of the server."""

    def __init__(self, app: ASGIApp, port: int, token: str) -> None:
        self._app, self._token = app, token
        self._hosts = (f"127.0.0.1:{port}", f"localhost:{port}")
        self._cookie, self._secret = f"reseau_{port}", secrets.token_urlsafe(32)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = ((key.lower().encode(), value.encode()) for key, value in HEADERS.items())
                message["headers"] = [*message["headers"], *own]
            await send(message)

        await (self._refusal(Request(scope)) or self._app)(scope, receive, send_with_headers)

    def _refusal(self, request: Request) -> Response | None:
        """Response to an unauthorised request, or the redirect that sets the cookie; None for an authorised request."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if host not in self._hosts:
            return _refuse(f"This server answers to {self._hosts[0]} only.\n")
        needs_origin = request.method not in ("GET", "HEAD")
        if origin != f"http://{host}" and (origin is not None or needs_origin):
            return _refuse("Only the page itself may ask this.\n")
        if request.url.path == "/" and (given := request.query_params.get("token", "")):
            if not hmac.compare_digest(given.encode(), self._token.encode()):
                return _refuse(_SPENT)
            answer = RedirectResponse("/", status_code=303)  # a cookie in place of the token, which others could read
            answer.set_cookie(self._cookie, self._secret, httponly=True, samesite="strict")
            return answer
        own = request.cookies.get(self._cookie, "")
        return None if hmac.compare_digest(own.encode(), self._secret.encode()) else _refuse(_SPENT)


def _refuse(text: str) -> Response:
    return PlainTextResponse(text, status_code=403)


class Server:
    """Review as a local web application."""

    def __init__(self, project: Project, port: int, who: str) -> None:
        """port: 0 for any free port. Raises InputError if there are no checked results yet, or the port is in use."""
        self._session = Session(project, who)
        self._pictures = Pictures(project.max_pixels)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind(("127.0.0.1", port))
            self._socket.listen()  # requests sent before the server runs wait in the backlog
        except OSError as error:
            self._socket.close()
            why = error.strerror or error
            raise InputError(f"port {port}: {why}. Give another with --port, or 0 for any.") from None
        self.port: int = self._socket.getsockname()[1]
        token = secrets.token_urlsafe(24)
        self.address = f"http://127.0.0.1:{self.port}/?token={token}"
        self._app = Guard(_application(self._session, self._pictures), self.port, token)

    def run(self) -> None:
        """Serve requests until interrupted."""
        config = uvicorn.Config(self._app, log_level="warning", access_log=False, server_header=False, lifespan="off")
        try:
            uvicorn.Server(config).run(sockets=[self._socket])
        finally:
            self._pictures.close()


def serve(project: Project, port: int, who: str | None, opens_browser: bool, say: Callable[[str], None]) -> None:
    """Print the address on a line of its own, and serve until Ctrl-C. who: reviewer; None: the logged-in user."""
    try:
        user = who or getpass.getuser()
    except (OSError, KeyError):  # in a container the user may have no name
        user = "somebody"
    server = Server(project, port, user)
    say(server.address)
    sys.stdout.flush()
    if opens_browser:
        webbrowser.open(server.address)
    server.run()


def _application(session: Session, pictures: Pictures) -> Starlette:
    answers, drawing = _Answers(session, pictures), DrawingAnswers(session, pictures)
    questions: dict[str, Callable[[Query], Any]] = {
        "start": answers.start,
        "queue": answers.queue,
        "mark": answers.mark,
        "frame": answers.frame,
        "camera": answers.camera,
        "scan": answers.scan,
        "window.png": answers.window,
        "residual.png": answers.residual,
        "frame.png": answers.whole,
        "pose.png": answers.posed,
        "drawing.png": drawing.picture,
    }
    orders: dict[str, Callable[[Query, Any], Any]] = {
        "decide": answers.decide,
        "measure": answers.measure,
        "learn": answers.learn,
        "draw": drawing.draw,
        "save-camera": drawing.save,
        "save-learned": drawing.save_learned,
    }
    routes = [
        Route("/", _static("index.html")),
        *(Route(f"/static/{name}", _static(name)) for name in _FILES if name != "index.html"),
        Route("/favicon.ico", lambda request: Response(status_code=204)),
        *(Route(f"/api/{name}", _answering(answer)) for name, answer in questions.items()),
        *(Route(f"/api/{name}", _answering(answer), methods=["POST"]) for name, answer in orders.items()),
    ]
    return Starlette(routes=routes)


class _Answers:
    """Answers to requests, JSON or PNG, from query and body."""

    def __init__(self, session: Session, pictures: Pictures) -> None:
        self._session, self._pictures = session, pictures

    def start(self, query: Query) -> Any:
        session = self._session
        return {
            "project": session.project.title,
            "who": session.who,
            "poses": list(POSES),
            "scans": sample_names(list(session.project.scans), _OFFERED),
            "kinds": list(MARK_TABLES),
            "pose": session.project.pose,
            "file": session.camera_name,
            "cameras": len(session.project.cameras),
            "choices": session.choices(),
            "meaning": {str(choice): choice.meaning for choice in DecisionKind},
        }

    def queue(self, query: Query) -> Any:
        filters = Filters(**{one.name: query.get(one.name, "") for one in fields(Filters)})
        return self._session.page(filters, whole(query, "start", 0, 10**9))

    def mark(self, query: Query) -> Any:
        image, point, kind = query.get("image", ""), query.get("point", ""), query.get("kind", "")
        view, session = self._session.view(image), self._session
        others = [session.view(name) for name in session.similar_frames(image, point, kind)]
        return {
            **view.detail_json(point, kind),
            "decided": session.image_decisions(image),
            "others": [
                {
                    "image": other.scan.frame.image,
                    "place": other.place_px(point, kind).tolist(),
                    "half": other.window_px(point, kind),
                }
                for other in others
            ],
        }

    def frame(self, query: Query) -> Any:
        image = query.get("image", "")
        return {**self._session.view(image).frame_json(), "decided": self._session.image_decisions(image)}

    def camera(self, query: Query) -> Any:
        """Camera with marks to be learned: their names, and scans in which to click them."""
        entry = self._session.entry(query.get("key", ""))
        camera = self._session.project.image_camera(entry.images[0])
        return {
            "camera": camera.name,
            "fiducials": {one.id: one.xy_mm for one in camera.learned},
            "images": sample_names(entry.images, _OFFERED),
            "tried": sample_names(entry.images, _TRIED),
        }

    def scan(self, query: Query) -> Any:
        """Size of a scan, measured or not."""
        image = query.get("image", "")
        learned = self._session.project.image_camera(image).learned if self._session.project.cameras else ()
        size_px, pitch_um = self._pictures.size(self._session.scan_location(image))
        pitch_um = self._session.project.pitch_um or pitch_um
        most_mm = max((one.learned_mm for one in learned), default=0.0)
        half_px = 500.0 * most_mm / min(pitch_um) if pitch_um else _HALF_PX
        return {"image": image, "size": size_px, "half": max(_HALF_PX, round(half_px))}

    def window(self, query: Query) -> bytes:
        place = (whole(query, "col", -_WIDEST_PX, 10**6), whole(query, "row", -_WIDEST_PX, 10**6))
        return self._pictures.window(self._scan(query), *place, whole(query, "size", 8, _WIDEST_PX))

    def residual(self, query: Query) -> bytes:
        view = self._session.view(query.get("image", ""))
        point, kind = query.get("point", ""), query.get("kind", "")
        matrix, blur_px = view.pixel_from_mark(point, kind), view.mark(point, kind).quality.get("blur_px", 0.0)
        if matrix is None or blur_px <= 0:
            raise MeasurementError("nothing was fitted there")
        drawn = view.layout_marks[point].mark
        return self._pictures.residual(view.scan.scan, drawn, matrix, blur_px, view.window_px(point, kind))

    def whole(self, query: Query) -> bytes:
        return self._pictures.frame(self._scan(query))

    def posed(self, query: Query) -> bytes:
        pose = query.get("pose", "")
        if pose not in POSES:
            raise KeyError(pose)
        return self._pictures.upright(self._scan(query), pose)

    def decide(self, query: Query, body: Any) -> Any:
        given = parse_values(Decide, body)
        try:  # as lines of decisions.jsonl are
            decisions = [parse_decision(json.dumps(one).encode()) for one in given.decisions]
        except LineError as error:
            raise InputError(f"the decision{error}") from None
        self._session.decide(decisions, given.key)
        return self.queue(query)

    def measure(self, query: Query, body: Any) -> Any:
        given = parse_values(MeasureFrame, body)
        self._session.view(given.image)  # raises KeyError for an unknown image
        clicks = [Click(one.point, one.col_px, one.row_px) for one in given.clicks]
        return _trial_json(measured_from_clicks(self._session.learned, given.image, clicks))

    def learn(self, query: Query, body: Any) -> Any:
        """Measure a scan with templates learned from another scan or itself."""
        given = parse_values(ShownMarks, body)
        for name in (given.image, given.of):
            self._session.scan_location(name)  # raises KeyError for an unknown image
        return _trial_json(measured_as_shown(self._session.project, given.image, given.px, given.of))

    def _scan(self, query: Query) -> str:
        return self._session.scan_location(query.get("image", ""))


def _trial_json(scan: MeasuredScan) -> Any:
    pose = scan.frame.pose
    failure = "" if scan.failure is None else scan.failure.sentence
    return {
        "image": scan.frame.image,
        "marks": [mark_json(mark) for mark in scan.frame.marks],
        "pose": pose and f"{pose.name}{'' if pose.decided else ' (assumed)'}",
        "problems": [failure] if failure else list(map(str, scan.frame.problems)),
    }


def _static(name: str) -> Callable[[Request], Response]:
    content = resources.files("pipeline.review").joinpath("static", name).read_bytes()
    return lambda request: Response(content, media_type=f"{_FILES[name]}; charset=utf-8")


def _answering(answer: Callable[..., Any]) -> Callable[[Request], Any]:
    """Handler of requests. answer: returns JSON or PNG from the query and, of a POST request, the body.

    Errors of the user become messages, among them TypeError and ValueError, with which records and marks refuse values
    of requests; others are faults of the program.
    """

    async def answering(request: Request) -> Response:
        try:
            given = [request.query_params, *([await _body(request)] if request.method == "POST" else [])]
            found = await anyio.to_thread.run_sync(answer, *given)
        except KeyError as error:
            return PlainTextResponse(f"There is no {error.args[0]!r} here (any more).", 404)
        except (InputError, MeasurementError, OSError, TypeError, ValueError) as error:
            return PlainTextResponse(str(error), 400)
        return Response(found, media_type="image/png") if isinstance(found, bytes) else JSONResponse(found)

    return answering


async def _body(request: Request) -> Any:
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > _LARGEST_BODY:
            raise InputError("that is too much for one request.")
    return parse_json(data)
