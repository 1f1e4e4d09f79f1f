"""A server of `pcdata view` in a thread, with samples that count who reads them."""

from __future__ import annotations

import http.client
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from pcdata import PointCloud
from pcdata.errors import CaptureError
from pcdata.report.serving.samples import Samples
from pcdata.report.serving.server import ViewServer


class Counted:
    """A source whose samples say how often they were read, and how many at once."""

    name = "counted"

    def __init__(self, ids: list[str]) -> None:
        self.ids = ids
        self.loads: list[str] = []
        self.most_at_once = 0
        self._now = 0

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> PointCloud:
        self._now += 1
        self.most_at_once = max(self.most_at_once, self._now)
        time.sleep(0.01)
        self.loads.append(sample_id)
        self._now -= 1
        if sample_id == "damaged":
            raise CaptureError("damaged: <b>the file</b> was cut short")
        if sample_id == "broken":
            raise ZeroDivisionError("a secret path /home/me")
        number = self.ids.index(sample_id)
        points = torch.rand(50 + number, 3, generator=torch.Generator().manual_seed(number))
        return PointCloud(points=points, labels=torch.arange(len(points)), frame_id="base")


@contextmanager
def served(source: Any, *, title: str = "title", **options: Any) -> Iterator[ViewServer]:
    with ViewServer(Samples(source, **options), title=title) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def ask(
    server: ViewServer, rest: str = "", *, method: str = "GET", token: str | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Ask below the token; ``rest`` with a leading slash is the whole path."""
    path = rest if rest.startswith("/") else f"/{server.token if token is None else token}/{rest}"
    return ask_raw(server, path, method, headers)


def ask_raw(server: ViewServer, path: str, method: str, headers: dict[str, str]) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in {"Host": f"127.0.0.1:{server.server_port}", **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()
