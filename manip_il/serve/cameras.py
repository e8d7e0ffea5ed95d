"""Cameras over ZMQ, in the format of LeRobot's own image server: JSON with JPEG in base64."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import zmq
from lerobot.cameras.zmq.image_server import encode_image

from manip_il.errors import UsageError
from manip_il.serve.station import Station
from manip_il.sim import render
from manip_il.sim.config import CameraConfig
from manip_il.sim.view import Clock

RATE = 30  # pictures per second
_QUALITY = 90  # JPEG quality


class Cameras:
    """A thread that streams a station's cameras on one port, `RATE` times per second."""

    def __init__(self, station: Station, cameras: CameraConfig, port: int):
        """Open the port, render the first pictures and start the stream.

        Args:
            station: The station whose world the cameras show.
            cameras: Names and picture size of the cameras.
            port: TCP port on this computer.

        Raises:
            UsageError: If the port is taken.
            RenderError: If there is no off-screen OpenGL.
        """
        self._station, self.config = station, cameras
        self._data = mujoco.MjData(station.env.scene.model)
        self._socket: Any = zmq.Context.instance().socket(zmq.PUB)
        self._socket.setsockopt(zmq.SNDHWM, 2)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._stop = threading.Event()
        # an OpenGL context belongs to the thread that made it; the new thread makes its own
        render.close()
        self._thread = ThreadPoolExecutor(1)
        try:
            self._socket.bind(f"tcp://127.0.0.1:{port}")
            self._thread.submit(self._send).result()
        except BaseException as error:
            self._release()
            if isinstance(error, zmq.ZMQError):
                raise UsageError(
                    f"--camera_port={port} cannot be used ({error}); give another one"
                ) from error
            raise
        self._running = self._thread.submit(self._run)

    def close(self) -> None:
        """Stop the thread and free the port.

        Raises the error that has ended the stream, if one has.
        """
        self._stop.set()
        self._release()
        self._running.result()

    def _release(self) -> None:
        self._thread.submit(render.close)
        self._thread.shutdown()
        self._socket.close()

    def _run(self) -> None:
        clock = Clock(RATE)
        while not self._stop.is_set():
            clock.wait()
            self._send()

    def _send(self) -> None:
        env = self._station.env
        self._data.qpos[:], self._data.mocap_pos[:], self._data.mocap_quat[:] = self._station.seen
        images = render.pictures(env.scene, self._data, self.config, env.world.variation)
        # RGB is encoded without swapping and the client's `imdecode` does not swap either, so red
        # stays red.
        texts = {name: encode_image(image, _QUALITY) for name, image in images.items()}
        self._socket.send_string(
            json.dumps({"timestamps": dict.fromkeys(texts, time.time()), "images": texts})
        )
