"""The newest frame is handed over once; what is dropped is counted, and a camera that stalls or fails is told."""

from __future__ import annotations

import itertools
import threading
import time

import pytest

import pcdata
from pcdata.errors import ConfigError
from pcdata.live import Fault, LatestFrame, LivePipeline, StalledError
from tests.live_stream import moved


def test_the_newest_is_taken_once_and_the_others_are_counted():
    camera = LatestFrame(timeout=0.05)
    for number in range(5):
        camera.put(number, stamp=float(number))
    assert camera.take() == (4, 4.0, 4)
    with pytest.raises(StalledError, match="after 5 frames"):
        camera.take()
    assert (camera.given, camera.dropped) == (5, 4)


def test_a_frame_that_lay_too_long_is_never_served():
    camera = LatestFrame(timeout=0.05, max_age=0.01)
    camera.put("old")
    time.sleep(0.03)
    with pytest.raises(StalledError):
        camera.take()
    assert camera.dropped == 1
    camera.put("new")
    assert camera.take().item == "new"


def test_what_the_camera_raises_is_raised_where_frames_are_taken_once():
    def read():
        raise OSError("unplugged")

    with LatestFrame.reading(read, timeout=0.5) as camera:
        with pytest.raises(OSError, match="unplugged"):
            camera.take()
        assert list(camera) == []


def test_a_stream_that_ends_ends_the_loop():
    numbers = iter(range(3))

    def read():
        time.sleep(0.02)
        return next(numbers)

    with LatestFrame.reading(read) as camera:
        assert [arrived.item for arrived in camera] == [0, 1, 2]


def test_closing_wakes_who_waits():
    camera, ended = LatestFrame(timeout=30), []
    waiter = threading.Thread(target=lambda: ended.extend(camera))
    waiter.start()
    camera.close()
    waiter.join(2)
    assert not waiter.is_alive()
    camera.put("late")  # a driver that has not heard of it yet
    assert camera.given == 0


@pytest.mark.parametrize("options", [{"timeout": 0}, {"max_age": -1.0}])
def test_times_that_cannot_be_meant_are_refused(options):
    with pytest.raises(ConfigError, match="above 0"):
        LatestFrame(**options)


def test_frames_of_many_threads_come_once_and_in_order():
    camera = LatestFrame(timeout=0.2)
    start = threading.Barrier(4)

    def put():
        start.wait()
        for _ in range(500):
            camera.put(object())

    threads = [threading.Thread(target=put) for _ in range(3)]
    for thread in threads:
        thread.start()
    start.wait()
    taken = []
    try:
        while True:
            taken.append(camera.take().number)
    except StalledError:
        pass
    assert taken == sorted(set(taken))
    assert taken[-1] == 1499
    assert camera.dropped + len(taken) == camera.given == 1500


def test_a_pipeline_follows_a_camera_through_a_stall(scene):
    live = LivePipeline(pcdata.Compose([pcdata.Deproject()]), like=scene, max_age=5.0)
    waits = itertools.chain([0.0, 0.0, 0.3, 0.0], [None])
    numbers = itertools.count()

    def read():
        wait = next(waits)
        if wait is None:
            raise StopIteration
        time.sleep(wait + 0.03)
        return {"frame": moved(scene, next(numbers))}

    with LatestFrame.reading(read, timeout=0.15) as camera:
        faults = [answer.fault for answer in live.follow(camera)]
        given = camera.given
    assert faults.count(Fault.STALLED) >= 1
    stats = live.stats()
    assert stats.clouds + stats.dropped == given == 4
    assert stats.faults == {"stalled": faults.count(Fault.STALLED)}


def test_a_slow_pipeline_drops_and_never_goes_back(scene, monkeypatch):
    live = LivePipeline(pcdata.Compose([pcdata.Deproject()]), like=scene)
    run = live._runs.run
    monkeypatch.setattr(live._runs, "run", lambda *given: (time.sleep(0.03), run(*given))[1])
    numbers = itertools.count()

    def read():
        time.sleep(0.005)
        number = next(numbers)
        if number == 60:
            raise StopIteration
        return {"frame": moved(scene, number), "stamp": float(number)}

    with LatestFrame.reading(read) as camera:
        stamps = [answer.stamp for answer in live.follow(camera)]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == 59.0
    assert live.stats().dropped == 60 - len(stamps) > 20
