"""Poses for other programs, as they come: one UDP datagram of JSON a frame and body. Waits for nobody.

Keys: ``body``, ``frame``, ``timestamp_ns``, ``status`` (positioned or refused), ``reason`` and ``detail`` (as in
frames.csv), ``position_mm`` and ``quaternion_xyzw`` of T_world_sensor, ``covariance`` (6 x 6, of δ = (translation mm,
rotation rad), T_true = T · exp(δ), sensor coordinates), ``p_chance``, ``matched``, ``residual_mm``, ``latency_ms``.
What is not known is null; a refused frame has no pose.
"""

import math
import socket
from urllib.parse import urlsplit

import msgspec

from trifix.errors import ConfigError
from trifix.live import Rates
from trifix.records import Fix, NoFix, Step

_LOOPBACK = "127.0.0.1"
_DETAIL = 300  # characters, so that a datagram stays below 1472 bytes, which networks pass on whole


class Publisher:
    """Sends steps to ``udp://HOST:PORT``; without a host, to this machine itself.

    Raises:
        ConfigError: the address is none, or the host is unknown.
    """

    def __init__(self, url: str) -> None:
        self.lost = 0
        """Datagrams that the network did not take."""
        try:
            parts = urlsplit(url)
            host, port = parts.hostname or _LOOPBACK, parts.port
        except ValueError:
            host, port = "", None
        if parts.scheme != "udp" or not port or parts.path not in ("", "/"):
            raise ConfigError(f"{url} is no address to publish at, expected udp://HOST:PORT, such as udp://:5005.")
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except socket.gaierror as error:
            raise ConfigError(f"{url}: the host {host} is not known ({error.strerror}).") from error
        self._address = found[4]
        self._socket = socket.socket(found[0], found[1])
        self._socket.setblocking(False)

    def send(self, body: str, step: Step, rates: Rates) -> None:
        """Sends one step; what the network does not take at once is lost."""
        try:
            self._socket.sendto(datagram(body, step, rates), self._address)
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Sends nothing more."""
        self._socket.close()


def datagram(body: str, step: Step, rates: Rates) -> bytes:
    """What is sent of a step."""
    message: dict[str, object] = {"body": body, "frame": step.frame.index, "timestamp_ns": step.frame.timestamp_ns}
    match step.fix:
        case Fix() as fix:
            message |= {
                "status": "positioned",
                "reason": None if fix.reason is None else fix.reason.name,
                "position_mm": fix.T_world_sensor.t_mm.tolist(),
                "quaternion_xyzw": fix.T_world_sensor.quaternion_xyzw.tolist(),
                "covariance": fix.cov.tolist(),
                "matched": len(fix.point),
                "residual_mm": _known(fix.rms_mm),
            }
        case NoFix() as refusal:
            message |= {
                "status": "refused",
                "reason": refusal.why.name,
                "position_mm": None,
                "quaternion_xyzw": None,
                "covariance": None,
                "matched": refusal.matched,
                "residual_mm": _known(refusal.residual_mm),
            }
    message |= {
        "p_chance": _known(step.fix.p_chance),
        "detail": step.fix.detail[:_DETAIL],
        "latency_ms": _known(rates.latency_ms),
    }
    return msgspec.json.encode(message)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
