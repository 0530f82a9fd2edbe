"""Serve the files of the page and nothing else; they contain no data of a run."""

from functools import cache
from http import HTTPStatus
from importlib.resources import files

from websockets.datastructures import Headers
from websockets.http11 import Response

FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/live.css": ("live.css", "text/css; charset=utf-8"),
    "/uplot.js": ("uplot/uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "/uplot.css": ("uplot/uPlot.min.css", "text/css; charset=utf-8"),
}
"""Path of each, its file and its type."""
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Connection": "close",
}


@cache
def _content(name: str) -> bytes:
    return files("hilctl.desk").joinpath("page", name).read_bytes()


def file_response(path: str) -> Response:
    """Return the file at a path, or 404."""
    if path not in FILES:
        return plain_response(HTTPStatus.NOT_FOUND, "no such file")
    name, kind = FILES[path]
    return _response(HTTPStatus.OK, kind, _content(name))


def plain_response(status: HTTPStatus, text: str) -> Response:
    """Return a response with one line of text."""
    return _response(status, "text/plain; charset=utf-8", f"{text}\n".encode())


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    more = {"Content-Type": kind, "Content-Length": str(len(body))}
    return Response(status.value, status.phrase, Headers({**_HEADERS, **more}), body)
