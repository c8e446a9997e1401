"""A user's arrays may be of any layout, read-only or of other numbers: the compiled loops are not compiled anew."""

import importlib
import pkgutil
from dataclasses import fields, replace

import numpy as np
from numba.core.registry import CPUDispatcher

import trifix.kernels
from constellations import RIG, STEP_NS, front_map, looking, scattered, seen_dots, seen_points
from trifix.positioner import Positioner
from trifix.records import Dots, Fix, Frame, ReferenceMap, SensorPoints, StereoDots


def odd(array: np.ndarray) -> np.ndarray:
    """The same numbers: integers in 32 bits, in a layout that no loop is compiled for, read-only."""
    if array.dtype == np.int64:
        array = array.astype(np.int32)
    out = np.repeat(array, 2)[::2] if array.ndim == 1 else np.asfortranarray(array)
    out.flags.writeable = False
    return out


def oddly(record: Dots | SensorPoints | ReferenceMap) -> Dots | SensorPoints | ReferenceMap:
    arrays = {each.name: getattr(record, each.name) for each in fields(record)}
    return replace(record, **{name: odd(a) for name, a in arrays.items() if isinstance(a, np.ndarray)})


def signatures() -> dict[str, int]:
    modules = [f"trifix.kernels.{each.name}" for each in pkgutil.iter_modules(trifix.kernels.__path__)]
    return {
        f"{name}.{kernel}": len(value.signatures)
        for name in modules
        for kernel, value in vars(importlib.import_module(name)).items()
        if isinstance(value, CPUDispatcher)
    }


def test_arrays_of_any_layout_compile_nothing_more():
    rng = np.random.default_rng(1)
    world = scattered(rng, 14)
    map = front_map(world[:12], 0.05)
    seen = []
    for k in range(4):
        T = looking(rng)
        points = seen_points(world, T, rng)
        dots = seen_dots(T.inverse().apply(world), rng, 0.1)
        seen += [Frame(2 * k, 2 * k * STEP_NS, RIG, points), Frame(2 * k + 1, (2 * k + 1) * STEP_NS, RIG, dots)]
    T = RIG.T_right_left
    rig = replace(RIG, T_right_left=replace(T, R=odd(T.R), t_mm=odd(T.t_mm)))
    asked = []
    for frame in seen:
        content = frame.content
        if isinstance(content, StereoDots):
            content = StereoDots(oddly(content.left), oddly(content.right))
        else:
            content = oddly(content)
        asked.append(replace(frame, rig=rig, content=content))
    for is_frozen in (True, False):
        plain = [step.fix for step in Positioner(map=map, is_map_frozen=is_frozen).run(seen)]
        before = signatures()
        fixes = [step.fix for step in Positioner(map=oddly(map), is_map_frozen=is_frozen).run(asked)]
        assert signatures() == before
        assert sum(isinstance(fix, Fix) for fix in plain) > 5
        for fix, other in zip(fixes, plain, strict=True):
            assert isinstance(fix, Fix) == isinstance(other, Fix)
            if isinstance(fix, Fix):
                np.testing.assert_array_equal(fix.T_world_sensor.t_mm, other.T_world_sensor.t_mm)
