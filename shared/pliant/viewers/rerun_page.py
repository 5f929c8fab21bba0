"""Rerun's page for browsers, which may reach this machine alone.

Whatever it is told, that page fetches fonts from Google, asks GitHub for its newest release and
reports its use to Rerun's makers.  So it is handed on with a policy, which the browser enforces.
"""

import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.error import URLError
from urllib.request import urlopen

from pliant.errors import ResultError
from pliant.viewers.rerun_program import LOOPBACK

_HANDED_ON = ("Content-Type", "rerun-final-length")  # the second one for its progress bar
_ELSEWHERE = re.compile(rb"<link[^>]*https://[^>]*>")  # connects before the policy is asked
_PATIENCE_S = 30.0


class RerunPage:
    """Serves the page at a port of this machine."""

    def __init__(self, port: int, *, behind: int, data: int) -> None:
        """Take the port.

        behind: the port at which Rerun's program has its page.    data: the one for the data.
        Raises ResultError where the port is taken.
        """
        policy = (
            "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
            "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
            f"worker-src 'self' blob:; connect-src 'self' data: blob: http://{LOOPBACK}:{data}"
        )

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                try:
                    at = f"http://{LOOPBACK}:{behind}{self.path}"
                    with urlopen(at, timeout=_PATIENCE_S) as page:
                        content, headers = page.read(), page.headers
                except URLError:
                    self.send_error(404)
                    return
                content = _ELSEWHERE.sub(b"", content) if self.path.startswith("/?") else content
                self.send_response(200)
                for name in _HANDED_ON:
                    if name in headers:
                        self.send_header(name, headers[name])
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Content-Security-Policy", policy)
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), Handler)
        except OSError:
            raise ResultError(
                f"port {port} is taken here: another viewer may be open; choose another --web-port"
            ) from None
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()
