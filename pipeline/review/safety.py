"""Access control of the review server: only the page itself, in the browser that was given the address.

Any page open in the same browser can send requests to 127.0.0.1 (CSRF), and a foreign host name can resolve to it (DNS
rebinding). Every request is therefore checked for its Host, its Origin and a cookie that only this browser has.
"""

import hmac
import secrets
from collections.abc import Mapping
from urllib.parse import parse_qs

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
        answer = self._refusal(Request(scope))
        await (answer or self._app)(scope, receive, _add_headers(send))

    def _refusal(self, request: Request) -> Response | None:
        """Response to an unauthorised request, or the redirect that sets the cookie; None for an authorised request."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if host not in self._hosts:
            return _refused(f"This server answers to {self._hosts[0]} only.\n")
        needs_origin = request.method not in ("GET", "HEAD")
        if origin != f"http://{host}" and (origin is not None or needs_origin):
            return _refused("Only the page itself may ask this.\n")
        if request.url.path == "/" and (given := _token(request)):
            return self._welcome() if hmac.compare_digest(given.encode(), self._token.encode()) else _refused(_SPENT)
        own = request.cookies.get(self._cookie, "")
        return None if hmac.compare_digest(own.encode(), self._secret.encode()) else _refused(_SPENT)

    def _welcome(self) -> Response:
        """Redirect that replaces the token in the address, where others could read it, by a cookie."""
        answer = RedirectResponse("/", status_code=303)
        answer.set_cookie(self._cookie, self._secret, httponly=True, samesite="strict")
        return answer


def _token(request: Request) -> str:
    return (parse_qs(request.url.query).get("token") or [""])[0]


def _refused(text: str) -> Response:
    return PlainTextResponse(text, status_code=403)


def _add_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            own: Mapping[str, str] = HEADERS
            message["headers"] = [*message["headers"], *((k.lower().encode(), v.encode()) for k, v in own.items())]
        await send(message)

    return sending
