"""A server on loopback that hands requests on to another one, and fails as it is told to."""

import http.client
import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

PASS, ERROR, SLOW, DROP, DENY = "pass", "error", "slow", "drop", "deny"
CUT, SHORT = "cut", "short"  # bodies: less than announced, or half of it announced as all

DENIED = b"<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>"


class Faulty:
    """A server in front of another on loopback."""

    def __init__(self, port):
        self.fate = lambda number, method, path: PASS  # of a request, by its number from 1
        self.seen, self._number, self._lock = Counter(), 0, threading.Lock()  # by fate
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self, port))
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]

    def __enter__(self):
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()

    def next(self, method, path):
        with self._lock:
            self._number += 1
            fate = self.fate(self._number, method, path)
            self.seen[fate] += 1
        return fate


def _handler(faulty, port):
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self):
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            fate = faulty.next(self.command, self.path)
            if fate == ERROR:
                return self._reply(503, {}, b"")
            if fate == DENY:
                return self._reply(403, {}, DENIED)
            if fate == SLOW:
                time.sleep(0.05)
            other = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            other.request(self.command, self.path, body, dict(self.headers))
            answer = other.getresponse()
            content = answer.read()
            other.close()
            if fate == DROP:  # it was done, but nobody is told
                self.close_connection = True
                self.connection.close()
                return None
            if fate == SHORT:
                headers = {k: v for k, v in answer.getheaders() if k.lower() != "content-length"}
                # within a line: a log that is cut between two lines is a log
                return self._reply(answer.status, headers, content[: len(content) // 2 + 3])
            if fate == CUT:
                self.close_connection = True
                headers = {**dict(answer.getheaders()), "Content-Length": str(len(content))}
                return self._reply(answer.status, headers, content[: len(content) // 2])
            return self._reply(answer.status, dict(answer.getheaders()), content)

        def _reply(self, status, headers, content):
            self.send_response(status)
            for name, value in headers.items():
                if name.lower() not in ("connection", "server", "date", "transfer-encoding"):
                    self.send_header(name, value)
            if not any(name.lower() == "content-length" for name in headers):
                self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_PUT = do_HEAD = do_DELETE = do_POST = handle_any

        def log_message(self, *_): ...

    return Handler
