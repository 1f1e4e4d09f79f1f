"""`pcdata view`: what is served, to whom, and what is refused."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from pcdata.errors import ConfigError
from pcdata.report.html.packing import PackedCloud
from pcdata.report.serving import server as server_module
from pcdata.report.serving.samples import MOST_LISTED, Samples
from pcdata.report.serving.server import ViewServer
from tests.report.html.decoding import decoded
from tests.report.serving.serving import Counted, ask, ask_raw, served

HOSTILE = "<script>alert(1)</script>\u202e"


@pytest.fixture(scope="module")
def source() -> Counted:
    return Counted(["first", "second", HOSTILE, "damaged", "broken", *(f"more {number}" for number in range(20))])


@pytest.fixture(scope="module")
def server(source) -> Iterator[ViewServer]:
    with served(source) as running:
        yield running


def test_a_sample_and_its_points_come_when_they_are_asked_for(source):
    own = Counted(source.ids)
    with served(own) as server:
        assert ask(server)[0] == 200
        assert own.loads == []
        status, headers, content = ask(server, "sample/1")
        assert (status, headers["content-type"]) == (200, "application/json")
        assert own.loads == ["second"]
        said = json.loads(content)
        assert said["name"] == "second"
        (stage,) = said["stages"]
        assert stage["cloud"]["blob"] == "cloud/1/0"
        status, headers, content = ask(server, "cloud/1/0")
        assert (status, headers["content-type"]) == (200, "application/octet-stream")
        found = decoded(PackedCloud(stage["cloud"], content))
        assert abs(found["points"] - own.load("second").points.numpy()).max() < 1e-5
        assert found["labels"][:, 0].tolist() == list(range(51))
        assert own.loads == ["second", "second"]  # the second time here: what was read is kept


def test_names_are_listed_and_found(server):
    found = json.loads(ask(server, "samples?find=MORE%201")[2])
    assert found["matching"] == 11
    assert found["samples"][:2] == [[6, "more 1"], [15, "more 10"]]
    assert json.loads(ask(server, "samples?find=nowhere")[2])["samples"] == []
    assert json.loads(ask(server, "samples")[2])["total"] == 25


@pytest.mark.parametrize(
    "query", ["from=-1", "from=x", "from=%D9%A1", "from=" + "9" * 40, "find=" + "a" * 300, "a=1&" * 99]
)
def test_queries_that_are_none_are_refused(server, query):
    status, _, content = ask(server, f"samples?{query}")
    assert status == 400
    assert b"Traceback" not in content


def test_a_sample_that_cannot_be_read_says_so_and_the_rest_goes_on(server, capsys):
    damaged = json.loads(ask(server, "sample/3")[2])
    assert damaged["stages"] == []
    assert "cut short" in damaged["problem"]
    broken = json.loads(ask(server, "sample/4")[2])
    assert broken["problem"].startswith("ZeroDivisionError")
    assert "Traceback" not in capsys.readouterr().err
    assert ask(server, "sample/0")[0] == 200


@pytest.mark.parametrize(
    "rest",
    [
        "../../../../etc/passwd",
        "..%2f..%2f..%2fetc%2fpasswd",
        "%2e%2e/%2e%2e/etc/passwd",
        "....//....//etc/passwd",
        "..\\..\\windows\\win.ini",
        "sample/../../etc/passwd",
        "sample/0/../../../etc/passwd",
        "sample//etc/passwd",
        "sample/%00",
        "sample/0%00.json",
        "sample/-1",
        "sample/1e3",
        "sample/%D9%A1",
        "sample/0;/etc",
        "sample/999999999999",
        "sample/" + "9" * 400,
        "cloud/0",
        "cloud/0/1",
        "cloud/0/-1",
        "cloud/0/0/0",
        "cloud/99/0",
        "file:///etc/passwd",
        "manifest.json",
        "viewer.js",
        ".git/config",
    ],
)
def test_there_is_no_way_to_a_file(server, rest):
    status, _, content = ask(server, rest)
    assert status == 404
    assert content in (b"no such page\n", b"no such sample\n")


@pytest.mark.parametrize("token", ["", "x", "..", "%2e%2e", "favicon.ico", "robots.txt", "A" * 32, "%E9"])
def test_without_the_token_nothing_is_told(server, source, token):
    loads = len(source.loads)
    for rest in ("", "samples", "sample/0", "cloud/0/0"):
        status, _, content = ask(server, rest, token=token)
        assert status == 403
        assert content == b"use the whole address that pcdata view printed\n"
    status, _, _ = ask(server, "/")
    assert status == 403
    assert len(source.loads) == loads


def test_a_token_that_is_nearly_right_is_wrong(server):
    for wrong in (server.token[:-1], server.token + "A", server.token.swapcase(), server.token[::-1]):
        assert ask(server, token=wrong)[0] == 403
    assert ask(server, f"/{server.token}")[0] == 303  # the slash was left out


@pytest.mark.parametrize(
    "host",
    [
        *(
            "evil.example",
            "evil.example:8000",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "127.0.0.1@evil.example",
        ),
        *("", " ", "0.0.0.0", "192.168.0.7", "127.0.0.1:8000:9", "127.0.0.1:", "127.0.0.2", "[::2]", "127.0.0.1:x"),
    ],
)
def test_another_host_is_refused(server, host):
    status, _, content = ask(server, Host=host)
    assert status == 403
    assert b"by a name that is not this machine's" in content


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "LOCALHOST:1234", "[::1]:9000", "127.0.0.1:22"])
def test_a_forwarded_port_is_this_machine(server, host):
    assert ask(server, "samples", Host=host)[0] == 200


def test_no_host_and_two_hosts_are_refused(server):
    for lines in ("", "Host: localhost\r\nHost: localhost\r\n", "Host: localhost\r\nHost: evil.example\r\n"):
        answer = raw(server, f"GET /{server.token}/ HTTP/1.1\r\n{lines}\r\n".encode())
        assert answer.startswith(b"HTTP/1.0 403")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "get", "X" * 50])
def test_methods_that_could_change_something_are_refused(server, method):
    status, headers, content = ask(server, method=method)
    assert status == 405
    assert headers["allow"] == "GET, HEAD"
    assert content == b"Method Not Allowed\n"


def test_head_is_get_without_its_content(server):
    for rest in ("", "samples", "sample/1", "cloud/1/0"):
        got, headers, content = ask(server, rest)
        told, told_headers, nothing = ask(server, rest, method="HEAD")
        assert (told, nothing) == (got, b"")
        assert told_headers["content-length"] == str(len(content))
        assert told_headers["content-type"] == headers["content-type"]


@pytest.mark.parametrize(("rest", "method"), [("", "GET"), ("samples", "GET"), ("nothing", "GET"), ("", "POST")])
def test_every_answer_is_closed_to_other_pages(server, rest, method):
    _, headers, _ = ask(server, rest, method=method, Origin="http://evil.example")
    assert not [name for name in headers if name.startswith("access-control")]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cache-control"] == "no-store"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert "Python" not in headers["server"]


def test_the_page_runs_its_script_alone_and_names_are_text(source):
    with served(source, title=f"{HOSTILE}") as running:
        page = ask(running)[2].decode()
        assert "<script>alert" not in page
        assert "default-src 'none'" in page
        assert "connect-src 'self'" in page
        listed = ask(running, "samples?find=alert")[2]
        assert json.loads(listed)["samples"] == [[2, "<script>alert(1)</script>\\u202e"]]


def test_the_address_for_a_browser_opens_once(source):
    with served(source) as running:
        once = "/" + running.opening_address.split("/", 3)[3]
        assert running.token not in once
        assert ask_raw(running, once, "GET", {"Host": "evil.example"})[0] == 403
        assert ask_raw(running, once, "HEAD", {})[0] == 403
        status, headers, _ = ask_raw(running, once, "GET", {})
        assert (status, headers["location"]) == (303, f"/{running.token}/")
        assert ask_raw(running, once, "GET", {})[0] == 403


def test_many_requests_at_once_read_each_sample_once(source):
    own = Counted(source.ids)
    with served(own) as running, ThreadPoolExecutor(24) as pool:
        places = list(range(5, 15)) * 8
        answers = list(pool.map(lambda place: ask(running, f"cloud/{place}/0"), places))
        assert {status for status, _, _ in answers} == {200}
        for place, (_, _, content) in zip(places, answers):
            assert len(zlib.decompress(content)) >= 6 * (50 + place)
    assert sorted(own.loads) == sorted(source.ids[5:15])
    assert own.most_at_once == 1


def test_memory_is_bounded_by_forgetting_what_was_seen_longest_ago(source):
    own = Counted(source.ids)
    samples = Samples(own, most_kept=1)
    samples.description(0)
    samples.cloud(0, 0)
    assert own.loads == ["first"]
    samples.description(1)
    samples.description(0)
    assert own.loads == ["first", "second", "first"]


def test_a_million_names_are_listed_in_parts():
    own = Counted([f"sample {number:07}" for number in range(1_000_000)])
    with served(own) as running:
        assert len(ask(running)[2]) < 1_000_000  # the page does not hold them
        last = json.loads(ask(running, "samples?from=999999")[2])
        assert last["from"] == 999_800
        assert len(last["samples"]) == MOST_LISTED
        assert json.loads(ask(running, "samples?from=999999999999")[2])["samples"] == last["samples"]
        assert json.loads(ask(running, "samples?find=0999999")[2])["samples"] == [[999_999, "sample 0999999"]]


def raw(server: ViewServer, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=20) as connection:
        connection.sendall(request)
        parts = []
        while part := connection.recv(65536):
            parts.append(part)
        return b"".join(parts)


@pytest.mark.parametrize(
    "request_line",
    [
        *(b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"\xff\xfe\r\n\r\n"),
        *(b"GET " + b"/a" * 40_000 + b" HTTP/1.1\r\n\r\n", b"GET http://[ HTTP/1.1\r\nHost: localhost\r\n\r\n"),
        b"GET /\xe9/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n",
    ],
)
def test_what_is_no_request_is_answered_in_words(server, capsys, request_line):
    answer = raw(server, request_line)
    assert b"Traceback" not in answer
    assert not answer or b" 4" in answer[:14] or b" 5" in answer[:14]
    assert "Traceback" not in capsys.readouterr().err
    assert ask(server, "samples")[0] == 200


def test_a_client_that_goes_away_is_no_fault(server, capsys):
    for rest in ("", "cloud/1/0", "sample/1"):
        with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
            connection.sendall(f"GET /{server.token}/{rest} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            # Reset at once instead of an orderly end.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
        connection.sendall(b"GET /")  # and half a request
    assert ask(server, "samples")[0] == 200
    assert capsys.readouterr().err == ""


def test_connections_that_say_nothing_give_their_turn_back(source, monkeypatch):
    monkeypatch.setattr(server_module, "_ASKING", 0.2)
    with served(Counted(source.ids)) as running:
        idle = [socket.create_connection(("127.0.0.1", running.server_port)) for _ in range(40)]
        try:
            assert ask(running, "samples")[0] == 200
            assert threading.active_count() < 40
        finally:
            for connection in idle:
                connection.close()


def test_connections_that_say_a_letter_now_and_then_give_their_turn_back(source, monkeypatch):
    monkeypatch.setattr(server_module, "_ASKING", 0.5)
    with served(Counted(source.ids)) as running:
        slow = [socket.create_connection(("127.0.0.1", running.server_port)) for _ in range(16)]
        over = threading.Event()

        def say() -> None:
            while not over.wait(0.05):
                for connection in slow:
                    with suppress(OSError):
                        connection.sendall(b"G")

        speaker = threading.Thread(target=say)
        speaker.start()
        try:
            assert ask(running, "samples")[0] == 200
        finally:
            over.set()
            speaker.join()
            for connection in slow:
                connection.close()


def test_an_answer_is_taken_as_slowly_as_over_a_forwarded_port(source, monkeypatch):
    monkeypatch.setattr(server_module, "_PATIENCE", 0.2)
    with served(Counted(source.ids)) as running:
        running.page = bytes(4 << 20)
        with socket.socket() as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
            connection.connect(("127.0.0.1", running.server_port))
            connection.sendall(f"GET /{running.token}/ HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            time.sleep(1.0)  # longer than the patience with a request
            taken = 0
            while part := connection.recv(1 << 16):
                taken += len(part)
    assert taken > 4 << 20


def test_a_port_that_is_taken_is_told(server):
    with pytest.raises(ConfigError, match="cannot listen there"):
        ViewServer(Samples(Counted(["a"])), title="", port=server.server_port)
