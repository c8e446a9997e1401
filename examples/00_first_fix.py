"""The pose of every frame of a recording; `trifix demo` makes this one."""

from pathlib import Path

from trifix import Fix, Positioner, read_recording

recording = read_recording(Path("demo/recording"))
for step in Positioner().run(recording):
    match step.fix:
        case Fix(T_world_sensor=pose, rms_mm=rms):
            print(step.frame.index, pose.t_mm.round(2), f"residual {rms:.3f} mm")
        case no_fix:
            print(step.frame.index, no_fix.why.value)
