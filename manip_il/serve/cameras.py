"""Cameras over ZMQ, as LeRobot's own image server sends them: JSON with JPEG in base64."""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Callable
from typing import Any

import cv2
import mujoco
import zmq

from manip_il.errors import RenderError, UsageError
from manip_il.serve.station import Station
from manip_il.sim import render
from manip_il.sim.config import CameraConfig

RATE = 30  # pictures a second
_QUALITY: list[int] = [cv2.IMWRITE_JPEG_QUALITY, 90]


class Cameras:
    """A thread that shows a station's world on one port, `RATE` times a second.

    shown: how many so far. Raises `UsageError` for a port that is taken, `RenderError` without off-screen OpenGL.
    """

    def __init__(self, station: Station, cameras: CameraConfig, port: int):
        self._station, self._cameras = station, cameras
        self.shown, self._took = 0, 0.0
        self._data = mujoco.MjData(station.env.scene.model)
        self._socket: Any = zmq.Context.instance().socket(zmq.PUB)
        self._socket.setsockopt(zmq.SNDHWM, 2)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            self._socket.bind(f"tcp://127.0.0.1:{port}")
        except zmq.ZMQError as error:
            raise UsageError(f"--camera_port={port} cannot be used ({error}); give another one") from error
        self._stop, self._began = threading.Event(), threading.Event()
        self._error: RenderError | None = None
        render.close()  # OpenGL belongs to the thread that made it: from here on that is ours
        self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)
        self._thread.start()
        self._began.wait()
        if self._error is not None:
            raise self._error

    def close(self, warn: Callable[[str], None]) -> None:
        """End the thread, free the port, and warn of a machine that was too slow."""
        self._stop.set()
        self._thread.join()
        self._socket.close()
        if self._took > self.shown / RATE:
            rate = self.shown / self._took
            warn(f"pictures were drawn at {rate:.0f} a second here; choose smaller or fewer ones for {RATE}")

    def _run(self) -> None:
        try:
            due = time.perf_counter()
            while not self._stop.wait(max(0.0, due - time.perf_counter())):
                begun = time.perf_counter()
                self._socket.send_string(self._message())
                self._began.set()
                self.shown, self._took = self.shown + 1, self._took + time.perf_counter() - begun
                due = max(due + 1 / RATE, time.perf_counter())
        except RenderError as error:
            self._error = error
            self._began.set()
        finally:
            render.close()

    def _message(self) -> str:
        env = self._station.env
        self._data.qpos[:], self._data.mocap_pos[:] = self._station.seen
        images = render.pictures(env.scene, self._data, self._cameras, env.world.variation)
        # RGB goes in as it is and comes out of the client's `imdecode` as it is, so that red stays red.
        coded = {name: cv2.imencode(".jpg", one, _QUALITY)[1] for name, one in images.items()}
        texts = {name: base64.b64encode(one.tobytes()).decode() for name, one in coded.items()}
        return json.dumps({"timestamps": dict.fromkeys(texts, time.time()), "images": texts})
