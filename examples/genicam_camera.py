"""Two GenICam cameras (GigE Vision, USB3 Vision) in place of OpenCV's, with the time at which they exposed.

Needs `pip install harvesters` and the GenTL producer (a .cti file) of the cameras' maker; both cameras should share a
trigger and, by PTP, a clock. A camera of any other kind needs the same two methods, ``read`` and ``close``.

Run: python examples/genicam_camera.py PRODUCER.cti calibration.yaml LEFT_SERIAL RIGHT_SERIAL OUT
"""

import sys
from pathlib import Path

import numpy as np
from harvesters.core import Harvester, TimeoutException

from trifix import CameraFrames, Config, Live, Positioner, ResultsWriter, Shot, TwoCameras
from trifix.config import to_toml
from trifix.files.calibrations import read_rig

WAIT_S = 1.0


class GenicamCamera:
    """One camera, found by its serial number; after it was gone, found again."""

    def __init__(self, harvester: Harvester, serial_number: str) -> None:
        self._harvester, self._serial_number = harvester, serial_number
        self._acquirer = None
        self._open()

    def read(self) -> Shot | str | None:
        try:
            if self._acquirer is None:
                self._harvester.update()
                self._open()
            with self._acquirer.fetch(timeout=WAIT_S) as buffer:
                part = buffer.payload.components[0]
                image = part.data.reshape(part.height, part.width).copy()  # the buffer is used again
                return Shot(image.astype(np.uint8, copy=False), int(buffer.timestamp_ns))
        except TimeoutException:
            return f"camera {self._serial_number} has sent no image for {WAIT_S:g} s: is its trigger on?"
        except Exception as error:  # whatever the maker's producer raises when a cable is pulled
            self.close()
            return f"camera {self._serial_number} is gone ({error})."

    def close(self) -> None:
        if self._acquirer is not None:
            self._acquirer.destroy()
            self._acquirer = None

    def _open(self) -> None:
        self._acquirer = self._harvester.create({"serial_number": self._serial_number})
        self._acquirer.remote_device.node_map.PixelFormat.value = "Mono8"
        self._acquirer.start()


def main(producer: str, calibration: str, left: str, right: str, out: str) -> None:
    with Harvester() as harvester:
        harvester.add_file(producer)
        harvester.update()
        cameras = TwoCameras(GenicamCamera(harvester, left), GenicamCamera(harvester, right), max_skew_ms=1.0)
        source, config = CameraFrames(cameras, read_rig(Path(calibration))), Config()
        with ResultsWriter(Path(out), "genicam", "images", to_toml(config), is_online=True) as results:
            live = Live({"": Positioner(config)}, [lambda body, step, rates: results.write(step, rates.dropped)])
            live.follow(source)
            try:
                while not live.wait(0.2):
                    print(live.status("").sentence, end="\r", flush=True)
            except KeyboardInterrupt:
                live.stop()
                live.wait()
            results.finish()


if __name__ == "__main__":
    main(*sys.argv[1:])
