"""The page on this machine: what it asks for, and what it is answered."""

import getpass
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
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from measure.errors import MeasurementError
from measure.fiducial_options import Click
from measure.marks.poses import POSES
from pipeline.errors import InputError
from pipeline.files.decisions_file import KINDS, MEANING, Choice, Decision
from pipeline.files.project_file import Project
from pipeline.review.pictures import Pictures
from pipeline.review.safety import Guard
from pipeline.review.session import Filters, Session
from pipeline.review.trial import measured_from_clicks

_FILES = {"review.js": "text/javascript", "review.css": "text/css", "index.html": "text/html"}
_LARGEST_BODY = 200_000  # bytes: decisions about a roll of a thousand frames
_WIDEST_PX = 60_000


class Server:
    """A review as a web application on a port of this machine."""

    def __init__(self, project: Project, port: int, who: str) -> None:
        """port: 0 takes any that is free. Raises InputError where nothing is judged yet, or the port is taken."""
        self._session = Session(project, who)
        self._pictures = Pictures(project.max_pixels)
        self._socket = _bound(port)
        self.port: int = self._socket.getsockname()[1]
        token = secrets.token_urlsafe(24)
        self.address = f"http://127.0.0.1:{self.port}/?token={token}"
        self._app = Guard(_application(self._session, self._pictures), self.port, token)

    def run(self) -> None:
        """Answer until it is interrupted."""
        config = uvicorn.Config(self._app, log_level="warning", access_log=False, server_header=False, lifespan="off")
        try:
            uvicorn.Server(config).run(sockets=[self._socket])
        finally:
            self._pictures.close()


def serve(project: Project, port: int, who: str | None, opens_browser: bool, say: Callable[[str], None]) -> None:
    """Print the address on a line of its own, and answer until Ctrl-C. who: decides; None: who is logged in."""
    server = Server(project, port, who or _logged_in())
    say(server.address)
    sys.stdout.flush()
    if opens_browser:
        webbrowser.open(server.address)
    server.run()


def _logged_in() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # of a container whose user has no name
        return "somebody"


def _bound(port: int) -> socket.socket:
    own = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        own.bind(("127.0.0.1", port))
        own.listen()  # so that who has the address is answered, if a moment later
    except OSError as error:
        own.close()
        raise InputError(f"port {port}: {error.strerror or error}. Give another with --port, or 0 for any.") from None
    return own


def _application(session: Session, pictures: Pictures) -> Starlette:
    answers = _Answers(session, pictures)
    routes = [
        Route("/", _static("index.html")),
        *(Route(f"/static/{name}", _static(name)) for name in _FILES if name != "index.html"),
        Route("/favicon.ico", lambda request: Response(status_code=204)),
        Route("/api/start", _json(answers.start)),
        Route("/api/queue", _json(answers.queue)),
        Route("/api/mark", _json(answers.mark)),
        Route("/api/frame", _json(answers.frame)),
        Route("/api/window.png", _png(answers.window)),
        Route("/api/residual.png", _png(answers.residual)),
        Route("/api/frame.png", _png(answers.whole)),
        Route("/api/pose.png", _png(answers.posed)),
        Route("/api/decide", _json(answers.decide), methods=["POST"]),
        Route("/api/measure", _json(answers.measure), methods=["POST"]),
    ]
    return Starlette(routes=routes)


class _Answers:
    """What each request is answered: from its query and its body, JSON or a picture."""

    def __init__(self, session: Session, pictures: Pictures) -> None:
        self._session, self._pictures = session, pictures

    def start(self, query: "_Query", body: Any) -> Any:
        session = self._session
        return {
            "project": session.project.path.stem,
            "who": session.who,
            "poses": list(POSES),
            "choices": session.choices(),
            "meaning": {str(choice): meaning for choice, meaning in MEANING.items()},
        }

    def queue(self, query: "_Query", body: Any) -> Any:
        filters = Filters(**{one.name: query.text(one.name) for one in fields(Filters)})
        return self._session.page(filters, query.whole("start", 0, 10**9))

    def mark(self, query: "_Query", body: Any) -> Any:
        image, point, kind = query.text("image"), query.text("point"), query.text("kind")
        seen, session = self._session.looking.at(image), self._session
        others = [session.looking.at(name) for name in session.looking.others(image, point, kind)]
        return {
            **seen.mark_json(point, kind),
            "decided": session.decided_in(image),
            "others": [
                {
                    "image": other.scan.frame.image,
                    "place": other.place_px(point, kind).tolist(),
                    "half": other.window_px(point, kind),
                }
                for other in others
            ],
        }

    def frame(self, query: "_Query", body: Any) -> Any:
        image = query.text("image")
        return {**self._session.looking.at(image).frame_json(), "decided": self._session.decided_in(image)}

    def window(self, query: "_Query") -> bytes:
        place = (query.whole("col", -_WIDEST_PX, 10**6), query.whole("row", -_WIDEST_PX, 10**6))
        return self._pictures.window(self._scan(query), *place, query.whole("size", 8, _WIDEST_PX))

    def residual(self, query: "_Query") -> bytes:
        seen = self._session.looking.at(query.text("image"))
        point, kind = query.text("point"), query.text("kind")
        matrix, blur_px = seen.pixel_from_mark(point, kind), seen.mark(point, kind).quality.get("blur_px", 0.0)
        if matrix is None or blur_px <= 0:
            raise MeasurementError("nothing was fitted there")
        drawn = seen.drawn[point].mark
        return self._pictures.residual(seen.scan.scan, drawn, matrix, blur_px, seen.window_px(point, kind))

    def whole(self, query: "_Query") -> bytes:
        return self._pictures.frame(self._scan(query))

    def posed(self, query: "_Query") -> bytes:
        pose = query.text("pose")
        if pose not in POSES:
            raise KeyError(pose)
        return self._pictures.posed(self._scan(query), pose)

    def decide(self, query: "_Query", body: Any) -> Any:
        given = body.get("decisions") if isinstance(body, dict) else None
        if not isinstance(given, list) or not given:
            raise InputError("decisions are missing.")
        self._session.decide([_decision(one) for one in given])
        return self.queue(query, None)

    def measure(self, query: "_Query", body: Any) -> Any:
        if not isinstance(body, dict):
            raise InputError("clicks are missing.")
        image, clicks = str(body.get("image", "")), body.get("clicks")
        self._session.looking.at(image)  # raises for one that is none
        if not isinstance(clicks, list) or len(clicks) < 3:
            raise InputError("three clicks on named marks or more are needed.")
        told = [Click(str(one["point"]), float(one["col_px"]), float(one["row_px"])) for one in clicks]
        scan = measured_from_clicks(self._session.project, image, told)
        marks = [
            {
                "point": mark.point,
                "kind": mark.kind,
                "status": str(mark.status),
                "reason": str(mark.reason),
                "center": None if mark.center_px is None else mark.center_px.round(3).tolist(),
            }
            for mark in scan.frame.marks
        ]
        pose = scan.frame.pose
        failure = "" if scan.failure is None else scan.failure.sentence
        return {
            "marks": marks,
            "pose": pose and pose.name,
            "problems": [failure] if failure else list(map(str, scan.frame.problems)),
        }

    def _scan(self, query: "_Query") -> str:
        return self._session.looking.at(query.text("image")).scan.scan


class _Query:
    """The values of a request's query."""

    def __init__(self, request: Request) -> None:
        self._values = request.query_params

    def text(self, name: str) -> str:
        return self._values.get(name, "")

    def whole(self, name: str, least: int, most: int) -> int:
        """Raises InputError for what is no such number."""
        try:
            value = round(float(self._values.get(name, "0")))
        except (ValueError, OverflowError):
            value = least - 1
        if not least <= value <= most:
            raise InputError(f"{name} must be a whole number from {least} to {most}.")
        return value


def _decision(given: Any) -> Decision:
    if not isinstance(given, dict):
        raise InputError("a decision is an object.")
    texts = {
        name: given.get(name, "") for name in ("image", "point", "kind", "pose", "note", "fingerprint", "decision")
    }
    if not all(isinstance(value, str) and len(value) < 4000 for value in texts.values()):
        raise InputError("names of a decision are text.")
    if texts["decision"] not in list(Choice) or (texts["point"] and texts["kind"] not in KINDS):
        raise InputError(f"{texts['decision']!r} about {texts['kind']!r} is no decision.")
    choice = Choice(texts.pop("decision"))
    if not texts["point"] and choice not in (Choice.POSE, Choice.UNDO):
        raise InputError("a decision about a mark needs its name.")
    numbers: Any = {name: given.get(name) for name in ("col_px", "row_px")} if choice is Choice.PLACE else {}
    if not all(isinstance(one, int | float) and abs(one) < 1e7 for one in numbers.values()):
        raise InputError("place needs col_px and row_px.")
    return Decision(decision=choice, window=_four(given.get("window")), **texts, **numbers)


def _four(window: Any) -> tuple[float, float, float, float] | None:
    if window is None:
        return None
    if not isinstance(window, list) or len(window) != 4:
        raise InputError("window is four numbers.")
    col, row, width, height = (float(one) for one in window)
    return col, row, width, height


def _static(name: str) -> Callable[[Request], Response]:
    content = resources.files("pipeline.review").joinpath("static", name).read_bytes()
    return lambda request: Response(content, media_type=f"{_FILES[name]}; charset=utf-8")


def _json(answer: Callable[[_Query, Any], Any]) -> Callable[[Request], Any]:
    async def answering(request: Request) -> Response:
        try:
            body = await _body(request) if request.method == "POST" else None
            return JSONResponse(await anyio.to_thread.run_sync(answer, _Query(request), body))
        except Exception as error:
            return _refusal(error)

    return answering


def _png(picture: Callable[[_Query], bytes]) -> Callable[[Request], Any]:
    async def answering(request: Request) -> Response:
        try:
            return Response(await anyio.to_thread.run_sync(picture, _Query(request)), media_type="image/png")
        except Exception as error:
            return _refusal(error)

    return answering


async def _body(request: Request) -> Any:
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > _LARGEST_BODY:
            raise InputError("that is too much for one request.")
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        raise InputError("that is no JSON.") from None


def _refusal(error: Exception) -> Response:
    """What went wrong in a sentence that the page shows; a fault of the program itself stays one."""
    match error:
        case KeyError():
            return PlainTextResponse(f"There is no {error.args[0]!r} here (any more).", 404)
        case InputError() | MeasurementError() | OSError() | TypeError() | ValueError():
            return PlainTextResponse(str(error), 400)
    raise error
