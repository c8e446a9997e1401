"""Frames from a program of your own: push each pair of images, and its pose comes back at once.

A recording takes the cameras' place here; it is the one that `trifix demo` makes.
"""

from pathlib import Path

from trifix import Fix, Positioner, StereoDots, StereoImages, read_recording

recording = read_recording(Path("demo/recording"))
positioner = Positioner(rig=recording.rig)
for frame in recording:
    match frame.content:
        case StereoImages(left=left, right=right) | StereoDots(left=left, right=right):
            step = positioner.push(left, right, frame.timestamp_ns)
            if isinstance(step.fix, Fix):
                print(step.frame.index, step.fix.T_world_sensor.t_mm.round(2))
