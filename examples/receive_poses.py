"""Receive what `trifix live --publish udp://:5005` sends; needs nothing but Python.

Run: python examples/receive_poses.py [PORT [COUNT]]
"""

import json
import socket
import sys

port = int(sys.argv[1]) if len(sys.argv) > 1 else 5005
left = int(sys.argv[2]) if len(sys.argv) > 2 else -1  # for ever

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
    receiver.bind(("127.0.0.1", port))
    print(f"listening at port {receiver.getsockname()[1]}", flush=True)
    while left != 0:
        pose = json.loads(receiver.recv(65536))
        where = pose["body"] or "sensor"
        if pose["status"] == "positioned":
            x, y, z = pose["position_mm"]
            sigma_mm = sum(pose["covariance"][i][i] for i in range(3)) ** 0.5
            print(f"{pose['frame']} {where} {x:.2f} {y:.2f} {z:.2f} mm, sigma {sigma_mm:.3f} mm", flush=True)
        else:
            print(f"{pose['frame']} {where} refused: {pose['reason']}", flush=True)
        left -= 1
