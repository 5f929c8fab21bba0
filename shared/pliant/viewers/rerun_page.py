"""Rerun's page for browsers, restricted to this machine and to users with its address.

By itself, that page fetches fonts from Google, queries GitHub for its newest release and reports
its use to Rerun's makers.  So it is served with a content security policy, which the browser
enforces.

A port of this machine is open to all its users, and to every web site whose name an attacker
resolves to this machine (DNS rebinding).  So a request is answered only with the token of the
address, and under a name of this machine.  The data come from the same port: Rerun's own server
checks neither.
"""

import hmac
import re
import secrets
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.error import URLError
from urllib.parse import quote
from urllib.request import urlopen

from pliant.errors import ResultError
from pliant.viewers.rerun_data import RerunData
from pliant.viewers.rerun_program import LOOPBACK

_HANDED_ON = ("Content-Type", "rerun-final-length")  # the second one for its progress bar
_ELSEWHERE = re.compile(rb"<link[^>]*https://[^>]*>")  # connects before the policy is asked
_THIS_MACHINE = re.compile(r"(localhost|127\.0\.0\.1)(:\d+)?")  # any port: of a tunnel, too
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "worker-src 'self' blob:; connect-src 'self' data: blob:"
)
_DATA = "/run.rrd"
_PATIENCE_S = 30.0


class RerunPage:
    """Serves the page at a port of this machine."""

    def __init__(self, port: int, *, behind: int, data: RerunData) -> None:
        """Take the port.

        behind: the port at which Rerun's program has its page.    data: what it shows.
        Raises ResultError if the port is taken.
        """
        token = secrets.token_urlsafe()
        root = f"http://localhost:{port}/{token}"
        self.address = f"{root}/?url={quote(root + _DATA, safe='')}&hide_welcome_screen"
        """Where a browser finds it.  The welcome screen would have examples."""

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                given, slash, rest = self.path[1:].partition("/")
                if not _THIS_MACHINE.fullmatch(self.headers.get("Host", "")):
                    self.send_error(403)
                elif not hmac.compare_digest(given.encode(), token.encode()):
                    self.send_error(404)
                elif slash + rest == _DATA:
                    self._send_data()
                else:
                    self._send_page(slash + rest)

            def _send_data(self) -> None:
                self._begin()
                number = 0
                while (parts := data.since(number)) is not None:
                    for number, part in parts:  # noqa: B007  the last one is gone on from
                        self.wfile.write(part)
                    number += 1

            def _send_page(self, path: str) -> None:
                try:
                    at = f"http://{LOOPBACK}:{behind}{path}"
                    with urlopen(at, timeout=_PATIENCE_S) as page:
                        content, headers = page.read(), page.headers
                except URLError:
                    self.send_error(404)
                    return
                content = _ELSEWHERE.sub(b"", content) if path.startswith("/?") else content
                handed_on = {name: headers[name] for name in _HANDED_ON if name in headers}
                self._begin(handed_on | {"Content-Length": str(len(content))})
                self.wfile.write(content)

            def _begin(self, headers: dict[str, str] | None = None) -> None:
                self.send_response(200)
                for name, value in (headers or {}).items():
                    self.send_header(name, value)
                self.send_header("Content-Security-Policy", _POLICY)
                self.send_header("Referrer-Policy", "no-referrer")  # it would have the token
                self.end_headers()

            def handle(self) -> None:
                with suppress(ConnectionError):  # a browser leaves whenever it likes
                    super().handle()

            def log_message(self, format: str, *args: object) -> None:
                """Log nothing."""

        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), Handler)
        except OSError:
            raise ResultError(
                f"port {port} is in use, perhaps by another viewer: choose another --web-port"
            ) from None
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()
