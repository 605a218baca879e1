"""A web server on loopback that does, request by request, what a script says."""

from __future__ import annotations

import re
import socket
import struct
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple

LINES = re.compile(r"bytes=(\d+)-(\d+)")


class File(NamedTuple):
    data: bytes
    headers: dict[str, str]


class Request(NamedTuple):
    path: str
    headers: dict[str, str]
    connection: int


Act = Callable[["Handler", File], None]


class ScriptedServer(ThreadingHTTPServer):
    """Serves `files` by range; each request first takes one act from `script`, as long as there are any."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, File] = {}
        self.script: list[Act] = []
        self.always: Act | None = None
        self.requests: list[Request] = []
        self.closing = threading.Event()  # ends stalls
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)

    def put(self, path: str, data: bytes, **headers: str) -> str:
        """Makes a file, or replaces it, and gives its url; a header ETag or Last_Modified is sent with it."""
        self.files[path] = File(data, {name.replace("_", "-"): value for name, value in headers.items()})
        return f"http://127.0.0.1:{self.server_port}/{path}"

    def act_for(self, request: Request) -> Act:
        with self._lock:
            self.requests.append(request)
            return self.script.pop(0) if self.script else self.always or serve

    def handle_error(self, request, client_address) -> None:
        """A client that hangs up is nothing to speak of."""

    def __enter__(self) -> ScriptedServer:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.closing.set()
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: ScriptedServer

    def do_GET(self) -> None:
        act = self.server.act_for(Request(self.path, dict(self.headers), self.client_address[1]))
        path = self.path.lstrip("/").rpartition("127.0.0.1/")[2]
        file = self.server.files.get(path) or self.server.files.get(path.partition("?")[0])
        if file is None and act is serve:
            answer(404)(self, File(b"", {}))
        else:
            act(self, file or File(b"", {}))

    def asked(self, size: int) -> tuple[int, int]:
        """First byte and byte after the last one of the range asked for, cut to `size`."""
        first, last = map(int, LINES.fullmatch(self.headers["Range"]).groups())
        return first, min(last + 1, size)

    def begin(self, file: File, first: int, stop: int) -> None:
        """The headers of the answer with bytes [first, stop)."""
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{stop - 1}/{len(file.data)}")
        self.send_header("Content-Length", str(stop - first))
        for name, value in file.headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


def serve(handler: Handler, file: File) -> None:
    """What a good server does."""
    first, stop = handler.asked(len(file.data))
    if first >= len(file.data):
        answer(416, Content_Range=f"bytes */{len(file.data)}", **file.headers)(handler, file)
        return
    handler.begin(file, first, stop)
    handler.wfile.write(file.data[first:stop])


def answer(status: int, body: bytes = b"an error page", **headers: str) -> Act:
    """A status and nothing of the file."""

    def act(handler: Handler, file: File) -> None:
        handler.send_response(status)
        for name, value in headers.items():
            handler.send_header(name.replace("_", "-"), value)
        handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        handler.wfile.write(body)

    return act


def cut(count: int) -> Act:
    """All headers, `count` bytes of the body, and the connection is closed."""

    def act(handler: Handler, file: File) -> None:
        first, stop = handler.asked(len(file.data))
        handler.begin(file, first, stop)
        handler.wfile.write(file.data[first : min(stop, first + count)])
        handler.close_connection = True

    return act


def reset(count: int | None = None) -> Act:
    """As `cut`, but the connection is torn down; None: before the headers."""

    def act(handler: Handler, file: File) -> None:
        if count is not None:
            cut(count)(handler, file)
        handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        handler.connection.close()
        handler.close_connection = True

    return act


def stall(count: int | None = None) -> Act:
    """As `cut`, but the connection stays open and silent; None: before the headers."""

    def act(handler: Handler, file: File) -> None:
        if count is not None:
            cut(count)(handler, file)
        handler.server.closing.wait(120)
        handler.close_connection = True

    return act


def drip(seconds: float) -> Act:
    """A byte every `seconds`."""

    def act(handler: Handler, file: File) -> None:
        first, stop = handler.asked(len(file.data))
        handler.begin(file, first, stop)
        for position in range(first, stop):
            if handler.server.closing.wait(seconds):
                break
            handler.wfile.write(file.data[position : position + 1])
        handler.close_connection = True

    return act


def drip_headers(seconds: float) -> Act:
    """A status line, and then a byte of a header every `seconds`."""

    def act(handler: Handler, file: File) -> None:
        handler.wfile.write(b"HTTP/1.1 206 Partial Content\r\nX-Long: ")
        while not handler.server.closing.wait(seconds):
            handler.wfile.write(b"x")
        handler.close_connection = True

    return act


def whole(handler: Handler, file: File) -> None:
    """Ignores the range."""
    answer(200, file.data, **file.headers)(handler, file)


def garbage(handler: Handler, file: File) -> None:
    """No HTTP at all."""
    handler.wfile.write(b"\x16\x03\x01 nonsense\r\n\r\n")
    handler.close_connection = True


def parts_of(most: int) -> Act:
    """Fewer bytes than asked for, and says so, as some servers do."""

    def act(handler: Handler, file: File) -> None:
        first, stop = handler.asked(len(file.data))
        stop = min(stop, first + most)
        handler.begin(file, first, stop)
        handler.wfile.write(file.data[first:stop])

    return act


def elsewhere(handler: Handler, file: File) -> None:
    """As many bytes as asked for, from 7 bytes further on."""
    first, stop = handler.asked(len(file.data) - 7)
    handler.begin(file, first + 7, stop + 7)
    handler.wfile.write(file.data[first + 7 : stop + 7])


def hang_up_after(handler: Handler, file: File) -> None:
    """A good answer, after which the server closes the connection without having said that it would."""
    serve(handler, file)
    handler.close_connection = True
