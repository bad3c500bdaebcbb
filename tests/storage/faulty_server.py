"""A server on loopback that hands requests on to another one, and fails as it is told to."""

import http.client
import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

PASS_ON, REPLY_503, REPLY_LATE, DROP_REPLY, REPLY_403 = "pass", "error", "slow", "drop", "deny"
CUT_BODY, HALVE_BODY = "cut", "short"  # bodies: less than announced, or half of it announced as all

ACCESS_DENIED_BODY = b"<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>"


class FaultyServer:
    """A server in front of another on loopback."""

    def __init__(self, port):
        self.fate = lambda number, method, path: PASS_ON  # of a request, by its number from 1
        self.seen, self._n_requests, self._lock = Counter(), 0, threading.Lock()  # by fate
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _make_handler(self, port))
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
            self._n_requests += 1
            fate = self.fate(self._n_requests, method, path)
            self.seen[fate] += 1
        return fate


def _make_handler(faulty_server, port):
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self):
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            fate = faulty_server.next(self.command, self.path)
            if fate == REPLY_503:
                return self._reply(503, {}, b"")
            if fate == REPLY_403:
                return self._reply(403, {}, ACCESS_DENIED_BODY)
            if fate == REPLY_LATE:
                time.sleep(0.05)
            upstream = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            upstream.request(self.command, self.path, body, dict(self.headers))
            response = upstream.getresponse()
            content = response.read()
            upstream.close()
            if fate == DROP_REPLY:  # it was done, but nobody is told
                self.close_connection = True
                self.connection.close()
                return None
            if fate == HALVE_BODY:
                headers = {k: v for k, v in response.getheaders() if k.lower() != "content-length"}
                # within a line: a log that is cut between two lines is a log
                return self._reply(response.status, headers, content[: len(content) // 2 + 3])
            if fate == CUT_BODY:
                self.close_connection = True
                headers = {**dict(response.getheaders()), "Content-Length": str(len(content))}
                return self._reply(response.status, headers, content[: len(content) // 2])
            return self._reply(response.status, dict(response.getheaders()), content)

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
