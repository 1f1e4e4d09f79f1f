"""The server of `pcdata view`: on this machine alone, to whoever knows its address, and never a path of the disk.

It answers ``GET`` and ``HEAD`` of five addresses below a random token; samples and stages are numbers, so there is no
path to leave. The name by which it was asked must be this machine's own: a foreign page that lets its name lead here
(DNS rebinding) is refused. Nothing may be read by other pages (no CORS), kept, framed or guessed at.
"""

from __future__ import annotations

import hmac
import io
import json
import re
import secrets
import socket
import sys
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pcdata.errors import ConfigError, OutOfRangeError
from pcdata.report.html.page import content_policy, served_page
from pcdata.report.serving.samples import Samples

HOST = "127.0.0.1"
_MOST_AT_ONCE = 16  # requests; more wait for their turn
_PATIENCE = 20.0  # seconds that a request waits for its turn, and an answer of no length for being taken
_ASKING = 10.0  # seconds for all of a request: less than others wait, so that whoever says little holds up nobody
_SLOWEST = 50_000  # bytes a second that an answer is taken with, as over a forwarded port
_HOST_NAMES = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE | re.ASCII)
_SAMPLE = re.compile(r"sample/([0-9]{1,12})", re.ASCII)
_CLOUD = re.compile(r"cloud/([0-9]{1,12})/([0-9]{1,4})", re.ASCII)
_FIRST = re.compile(r"[0-9]{1,12}", re.ASCII)
_LONGEST_TEXT = 200  # characters that are searched for
_JSON, _TEXT, _HTML = "application/json", "text/plain; charset=utf-8", "text/html; charset=utf-8"


class ViewServer(ThreadingHTTPServer):
    """Serves samples on 127.0.0.1 until it is shut down.

    Args:
        samples: what is shown.
        title: of the page.
        port: where; 0 = one that is free.

    Raises:
        ConfigError: the port cannot be had.
    """

    daemon_threads = True
    request_queue_size = 64
    allow_reuse_address = sys.platform != "win32"  # there it would let another program listen at the same port

    def __init__(self, samples: Samples, *, title: str, port: int = 0) -> None:
        self.samples = samples
        self.page = served_page(title, len(samples)).encode()
        self.token = secrets.token_urlsafe(24)
        self._once: str | None = secrets.token_urlsafe(24)
        self._turns = threading.BoundedSemaphore(_MOST_AT_ONCE)
        self._opening = threading.Lock()
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise ConfigError(
                f"view --port {port}: cannot listen there: {error}; give another port, or leave it out"
            ) from error

    @property
    def address(self) -> str:
        """Where the page is, for whoever started the server."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    @property
    def opening_address(self) -> str:
        """An address that leads to the page once: command lines of browsers, where it stands, can be read by others."""
        return f"http://{HOST}:{self.server_port}/{self._once}/"

    def opens(self, word: str) -> bool:
        """Whether this is the word that leads to the page once; from then on it does not."""
        with self._opening:
            if self._once is None or not _same(word, self._once):
                return False
            self._once = None
            return True

    def server_close(self) -> None:
        """Listen and read no more."""
        super().server_close()
        self.samples.close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begin a thread for a request, once fewer than all turns are taken."""
        if not self._turns.acquire(timeout=_PATIENCE):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._turns.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one request, and give the turn back."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._turns.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say in one line what broke; a client that went away is no fault."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            print(f"view: {type(error).__name__}: {error}", file=sys.stderr)


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    timeout = _PATIENCE
    server_version = "pcdata"
    sys_version = ""

    def setup(self) -> None:
        """Read what is asked by one deadline: a timeout begins anew with every byte."""
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(_Asked(self.connection, time.monotonic() + _ASKING))

    def do_GET(self) -> None:
        try:
            status, kind, content, more = self._answer()
        except OutOfRangeError:
            status, kind, content, more = HTTPStatus.NOT_FOUND, _TEXT, b"no such sample\n", {}
        except Exception as error:  # told here, not to the client
            print(f"view: {type(error).__name__}: {error}", file=sys.stderr)
            status, kind, content, more = HTTPStatus.INTERNAL_SERVER_ERROR, _TEXT, b"this could not be shown\n", {}
        self._send(status, kind, content, more)

    do_HEAD = do_GET

    def _answer(self) -> tuple[HTTPStatus, str, bytes, dict[str, str]]:
        refused = HTTPStatus.FORBIDDEN
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not _HOST_NAMES.fullmatch(hosts[0].strip()):
            return refused, _TEXT, b"asked by a name that is not this machine's: use the address that was printed\n", {}
        try:
            address = urlsplit(self.path)
        except ValueError:
            return HTTPStatus.BAD_REQUEST, _TEXT, b"no address\n", {}
        if not self.path.startswith("/") or self.path.startswith("//"):
            return HTTPStatus.BAD_REQUEST, _TEXT, b"no address of this server\n", {}
        word, slash, rest = address.path[1:].partition("/")
        if not _same(word, self.server.token):
            if slash and not rest and self.command == "GET" and self.server.opens(word):
                return HTTPStatus.SEE_OTHER, _TEXT, b"", {"Location": f"/{self.server.token}/"}
            return refused, _TEXT, b"use the whole address that pcdata view printed\n", {}
        if not slash:
            return HTTPStatus.SEE_OTHER, _TEXT, b"", {"Location": f"/{self.server.token}/"}
        return self._found(rest, address.query)

    def _found(self, rest: str, query: str) -> tuple[HTTPStatus, str, bytes, dict[str, str]]:
        samples = self.server.samples
        if not rest:
            return HTTPStatus.OK, _HTML, self.server.page, {}
        if rest == "samples":
            try:
                asked = parse_qs(query, max_num_fields=8)
            except ValueError:
                return HTTPStatus.BAD_REQUEST, _TEXT, b"too much is asked\n", {}
            first, text = (asked.get(name, [""])[0] for name in ("from", "find"))
            if (first and not _FIRST.fullmatch(first)) or len(text) > _LONGEST_TEXT:
                return HTTPStatus.BAD_REQUEST, _TEXT, b"from is a number, and find a short text\n", {}
            return HTTPStatus.OK, _JSON, _json(samples.names(int(first or 0), text)), {}
        if match := _SAMPLE.fullmatch(rest):
            return HTTPStatus.OK, _JSON, _json(samples.description(int(match[1]))), {}
        if match := _CLOUD.fullmatch(rest):
            return HTTPStatus.OK, "application/octet-stream", samples.cloud(int(match[1]), int(match[2])), {}
        return HTTPStatus.NOT_FOUND, _TEXT, b"no such page\n", {}

    def _send(self, status: HTTPStatus, kind: str, content: bytes, more: dict[str, str]) -> None:
        self.connection.settimeout(_PATIENCE + len(content) / _SLOWEST)  # of all that is sent
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **_SAFE, **more}.items():
            self.send_header(name, value)
        if kind != _HTML:  # the page says by itself what it may do
            self.send_header("Content-Security-Policy", content_policy() + "; frame-ancestors 'none'")
        else:
            self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer what is no request of ours, as plain text that repeats nothing of it."""
        status = HTTPStatus.METHOD_NOT_ALLOWED if code == HTTPStatus.NOT_IMPLEMENTED else HTTPStatus(code)
        more = {"Allow": "GET, HEAD"} if status is HTTPStatus.METHOD_NOT_ALLOWED else {}
        self.close_connection = True
        if not getattr(self, "command", None):  # not even that could be read
            self.command, self.request_version = "GET", "HTTP/1.0"
        self._send(status, _TEXT, f"{status.phrase}\n".encode(), more)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: addresses hold the token."""


class _Asked(io.RawIOBase):
    """What a connection says until a deadline."""

    def __init__(self, connection: socket.socket, deadline: float) -> None:
        self._connection = connection
        self._deadline = deadline

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request took too long")
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


_SAFE = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Connection": "close",
}


def _json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


def _same(word: str, secret: str) -> bool:
    """Compare in a time that does not tell how much of it is right."""
    return hmac.compare_digest(word.encode("utf-8", "surrogateescape"), secret.encode())
