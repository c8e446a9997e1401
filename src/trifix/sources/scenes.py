"""The simulated scenes: an object with targets, a rig, and the path of a hand.

The first five are modelled on the recordings of the paper (Khoury 2006, section 4), which were never published; the
rest are made to break matchers. A scene with fewer frames than its own number is either the beginning of the same
path or, where it tells a story (there and back, all round, something moves midway), the whole story told faster.

Knows nothing of what the cameras make of it.
"""

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from trifix.errors import SimulationError
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose, exp_rotation
from trifix.sources.surfaces import Surface, head, joined, rectangle, sphere

Track = Float[np.ndarray, "n 3"]
"""A point that moves: its position in map coordinates in every frame (mm)."""


@dataclass(frozen=True, slots=True)
class Sensing:
    """What the sensor makes of the targets in its view."""

    depth_mm: tuple[float, float] = (200.0, 650.0)
    """Nearest and farthest distance from each camera, along its axis, at which a target is detected."""
    max_incidence_deg: float = 65.0
    """Steepest angle between the target's normal and the ray at which it is detected."""
    sigma_px: float = 0.1
    """Noise of a dot seen head-on; it grows with 1 / cos(incidence)."""
    dropout: float = 0.02
    """Share of the visible dots that are missed."""
    ghosts_per_image: float = 0.3
    """Mean number of dots in an image that are no target."""
    ghosts_per_dot: float = 0.0
    """Mean number of further ones for each dot that is one."""
    epipolar_gate_px: float = 1.0
    """Dots this near to one another's epipolar line are taken as a stereo pair, true or false."""


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """The targets of a scene; the row is the identity."""

    xyz_mm: Float[np.ndarray, "k 3"]
    """Centre, map coordinates (mm)."""
    normal: Float[np.ndarray, "k 3"]
    """Unit normal, away from the object."""
    valid_from: Int[np.ndarray, "k"]
    """First frame in which it is there."""
    valid_to: Int[np.ndarray, "k"]
    """First frame in which it is there no more."""

    def __len__(self) -> int:
        return len(self.xyz_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that there is to be seen, and the path along which it is."""

    surface: Surface
    """The object."""
    targets: Targets
    """The targets on it."""
    rig: StereoRig
    """The sensor."""
    T_map_sensor: list[Pose]
    """Its pose in every frame."""
    diameter_mm: float = 6.0
    """Diameter of the targets."""
    sensing: Sensing = field(default_factory=Sensing)
    """What the sensor makes of them."""
    kidnapped: frozenset[int] = frozenset()
    """Frames before which the sensor was put somewhere else."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a scene is made."""

    summary: str
    """What it is, in one line."""
    frames: int
    """Its own number of frames."""
    build: Callable[[int, np.random.Generator, np.random.Generator], Scene]
    """The scene of a number of frames, from one source of chance for the targets and one for the path."""


def recipe_of(name: str) -> Recipe:
    """The recipe of a scene, or a SimulationError that names the nearest known one."""
    if name in SCENES:
        return SCENES[name]
    near = difflib.get_close_matches(name, SCENES, n=1, cutoff=0.0)[0]
    raise SimulationError(f"There is no scene {name!r}; did you mean {near!r}? Known are {', '.join(SCENES)}.")


# --- the sensor and the hand ---------------------------------------------------------------------------------------


def _rig(
    f_px: float = 1400.0,
    size_px: tuple[int, int] = (1280, 1024),
    baseline_mm: float = 150.0,
    crossing_mm: float = 450.0,
) -> StereoRig:
    """Two slightly different cameras whose axes nearly cross at a distance."""
    width, height = size_px

    def camera(k: float, du: float, dv: float) -> Camera:
        return Camera(
            *(f_px * k, f_px * k * 1.0008, (width - 1) / 2 + du, (height - 1) / 2 + dv),
            *(width, height, "radtan", (-0.082 * k, 0.041, 0.0004, -0.0003)),
        )

    inwards = np.arctan(0.5 * baseline_mm / crossing_mm)
    # no rig is assembled exactly: a fifth of a degree about the other two axes
    R_left_right = exp_rotation(np.array([0.0, -2 * inwards, 0.0])) @ exp_rotation(np.array([0.0035, 0.0, -0.003]))
    centre = baseline_mm * np.array([np.cos(inwards), 0.004, np.sin(inwards)])
    T_left_right = Pose(R_left_right, centre)
    return StereoRig(camera(1.0, 7.3, -4.1), camera(1.006, -5.6, 3.2), T_left_right.inverse())


def _wander(rng: np.random.Generator, t: Float[np.ndarray, "n"], period: float, amplitude: float) -> np.ndarray:
    """A smooth random swing about zero, rms amplitude/√2, as a hand's: three sines near one period (frames)."""
    total = np.zeros(len(t))
    for _ in range(3):
        total += np.sin(2 * np.pi * (t / (period * rng.uniform(0.6, 1.5)) + rng.random()))
    return np.asarray(total * amplitude / np.sqrt(3))


def _lapses(rng: np.random.Generator, t: Float[np.ndarray, "n"], every: int, length: int) -> np.ndarray:
    """0 most of the time and smoothly up to ±1 and back for about ``length`` frames, once in ``every`` frames."""
    total = np.zeros(len(t))
    (rng,) = rng.spawn(1)  # a longer path draws more: what else the hand does must not depend on it
    for block in range(int(t[-1]) // every + 1):
        start, spread, sign = rng.uniform(0.15, 0.9) * every, rng.uniform(0.7, 1.3), rng.choice([-1.0, 1.0])
        phase = (t - block * every - start) / (length * spread)
        inside = (phase > 0) & (phase < 1)
        total += sign * np.where(inside, np.sin(np.pi * phase.clip(0, 1)) ** 0.7, 0)
    return total


def _looking(rig: StereoRig, place: Track, aim: Track, up: Track, roll_rad: Float[np.ndarray, "n"]) -> list[Pose]:
    """T_map_sensor of a rig whose middle is at ``place`` and looks at ``aim``, with ``up`` upwards in the image."""
    right = rig.right_centre_mm
    inwards = 0.5 * np.arctan2(-rig.T_right_left.inverse().R[0, 2], rig.T_right_left.inverse().R[2, 2])
    # the middle of the rig: half-way to the right camera, turned by half of what the right camera is turned
    T_middle_left = Pose(exp_rotation(np.array([0.0, -inwards, 0.0])), 0.5 * right).inverse()
    poses = []
    for p, a, u, roll in zip(place, aim, up, roll_rad, strict=True):
        forward = (a - p) / np.linalg.norm(a - p)
        across = np.cross(forward, u)
        across /= np.linalg.norm(across)
        R = np.stack([across, np.cross(forward, across), forward], axis=1) @ exp_rotation(np.array([0, 0, roll]))
        poses.append(Pose(R, p) @ T_middle_left)
    return poses


def _round(
    rig: StereoRig,
    rng: np.random.Generator,
    azimuth_rad: Float[np.ndarray, "n"],
    distance_mm: float,
    elevation_deg: float = 22.0,
    rise_mm: float = 45.0,
    astray_mm: float = 20.0,
    lapse_mm: float = 0.0,
    lapse_every: int = 120,
    lapse_length: int = 40,
) -> list[Pose]:
    """A walk round an upright object at the origin; now and then the aim strays ``lapse_mm`` to a side."""
    n = len(azimuth_rad)
    t = np.arange(n, dtype=float)
    azimuth = azimuth_rad + _wander(rng, t, 140, 0.08)
    elevation = np.radians(elevation_deg) * (0.25 + _wander(rng, t, 150, 0.9))
    distance = distance_mm * (1 + _wander(rng, t, 150, 0.07))
    out = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    side = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(n)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    sideways = _wander(rng, t, 130, astray_mm) + lapse_mm * _lapses(rng, t, lapse_every, lapse_length)
    upwards = _wander(rng, t, 140, rise_mm) + 0.5 * lapse_mm * _lapses(rng, t, 2 * lapse_every, lapse_length)
    aim = side * sideways[:, None] + up * upwards[:, None]
    place = out * distance[:, None] + up * 0.5 * upwards[:, None]
    tremble = np.stack([_wander(rng, t, 9, 0.8) for _ in range(3)], axis=1)
    return _looking(rig, place + tremble, aim, up, _wander(rng, t, 150, 0.25))


def _over(
    rig: StereoRig,
    rng: np.random.Generator,
    aim: Track,
    distance_mm: Float[np.ndarray, "n"] | float,
    tilt_deg: float = 14.0,
    roll_rad: Float[np.ndarray, "n"] | float = 0.0,
) -> list[Pose]:
    """A path above a surface that lies flat (outwards is +z), following a point on it."""
    n = len(aim)
    t = np.arange(n, dtype=float)
    tilt = np.radians(tilt_deg)
    lean = np.stack([_wander(rng, t, 160, tilt), _wander(rng, t, 140, tilt), np.ones(n)], axis=1)
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    distance = distance_mm * (1 + _wander(rng, t, 190, 0.06))
    tremble = np.stack([_wander(rng, t, 9, 0.8) for _ in range(3)], axis=1)
    up = np.tile([0.0, 1.0, 0.0], (n, 1))
    astray = np.stack([_wander(rng, t, 110, 25.0), _wander(rng, t, 130, 25.0), np.zeros(n)], axis=1)
    aim = aim + astray
    return _looking(rig, aim + lean * distance[:, None] + tremble, aim, up, _wander(rng, t, 150, 0.25) + roll_rad)


def _lanes(
    s: Float[np.ndarray, "n"], x_mm: tuple[float, float], y_mm: tuple[float, float], lanes: int
) -> Float[np.ndarray, "n 3"]:
    """The point at share s of a closed path: there in lanes along x, back across them in lanes along y.

    With an odd number of lanes both ways end in opposite corners, so that nothing leaps.
    """
    u = 1 - np.abs(1 - 2 * (s % 1))  # there, and the same share of the other way back
    return np.where(
        (s % 1 < 0.5)[:, None], _one_way(u, x_mm, y_mm, lanes), _one_way(u, y_mm, x_mm, lanes)[:, [1, 0, 2]]
    )


def _one_way(
    s: Float[np.ndarray, "n"], x_mm: tuple[float, float], y_mm: tuple[float, float], lanes: int
) -> Float[np.ndarray, "n 3"]:
    """The point at share s of a path in lanes along x."""
    lane = np.minimum(np.floor(s * lanes), lanes - 1)
    done = s * lanes - lane
    along = np.where(lane % 2 == 0, done, 1 - done)
    # a lane begins and ends half-way to its neighbours
    across = (lane + np.interp(done, [0, 0.1, 0.9, 1], [-0.5, 0, 0, 0.5])).clip(0, lanes - 1) / (lanes - 1)
    return np.stack(
        [x_mm[0] + along * (x_mm[1] - x_mm[0]), y_mm[0] + across * (y_mm[1] - y_mm[0]), np.zeros(len(s))], axis=1
    )


def _still(xyz_mm: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, "k 3"], n: int) -> Targets:
    """Targets that stay where they are."""
    return Targets(xyz_mm, normal, np.zeros(len(xyz_mm), dtype=np.int64), np.full(len(xyz_mm), n))


# --- the paper's ---------------------------------------------------------------------------------------------------


def _statue(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    # few targets in view, and astray so often that about three frames in ten cannot be positioned by anyone
    rig = _rig(crossing_mm=430)
    surface = head(200)
    targets = _still(*surface.scatter(42, layout, spacing=0.75), n)
    poses = _round(
        *(rig, hand, _turns(targets, n, 750), 430),
        elevation_deg=25,
        rise_mm=25,
        lapse_mm=340,
        lapse_every=75,
        lapse_length=33,
    )
    return Scene(surface, targets, rig, poses)


def _plane(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig()
    surface = rectangle((0, 0, 0), (1000, 0, 0), (0, 1000, 0))
    aim = _lanes(np.arange(n) / 3680, (-10, 1010), (40, 960), 7)  # turning beyond the edge
    return Scene(surface, _still(*surface.scatter(118, layout), n), rig, _over(rig, hand, aim, 430))


def _sphere(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig(crossing_mm=470)
    surface = sphere(150)
    targets = _still(*surface.scatter(48, layout, spacing=0.7), n)
    azimuth = _turns(targets, n, 590)
    poses = _round(rig, hand, azimuth, 470, elevation_deg=32, lapse_mm=360, lapse_every=100, lapse_length=30)
    return Scene(surface, targets, rig, poses)


def _head(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig(crossing_mm=450)
    surface = head(175)
    targets = _still(*surface.scatter(33, layout, spacing=0.75), n)
    azimuth = _turns(targets, n, 800)
    poses = _round(rig, hand, azimuth, 450, rise_mm=20, lapse_mm=360, lapse_every=80, lapse_length=31)
    return Scene(surface, targets, rig, poses)


def _head_front(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig(crossing_mm=410)
    surface = head(180)
    azimuth = np.radians(72) * np.sin(2 * np.pi * np.arange(n) / 700)
    poses = _round(rig, hand, azimuth, 410, rise_mm=25, lapse_mm=340, lapse_every=80, lapse_length=30)
    xyz, normal = surface.scatter(28, layout, where=lambda xyz: xyz[:, 0] > 0)
    return Scene(surface, _still(xyz, normal, n), rig, poses)


def _turns(targets: Targets, n: int, frames_a_turn: int) -> Float[np.ndarray, "n"]:
    """The azimuth of a steady walk round, begun where a person would: before the side with most targets."""
    azimuth = np.radians(np.arange(0, 360, 10))
    towards = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))])
    facing = (targets.normal @ towards > np.cos(np.radians(50))).sum(axis=0)
    return np.asarray(azimuth[np.argmax(facing)] + 2 * np.pi * np.arange(n) / frames_a_turn)


# --- those that break matchers -------------------------------------------------------------------------------------


def _grid(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig()
    surface = rectangle((0, 0, 0), (900, 0, 0), (0, 700, 0))
    pitch_mm = 70.0
    x, y = (g.ravel() for g in np.meshgrid(45 + pitch_mm * np.arange(12), 35 + pitch_mm * np.arange(10)))
    xyz = np.stack([x, y, np.zeros(len(x))], axis=1)
    xyz[:, :2] += layout.normal(0, 0.01 * pitch_mm, (len(x), 2))
    aim = _lanes(np.arange(n) / 1000, (150, 750), (150, 550), 5)
    normal = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    return Scene(surface, _still(xyz, normal, n), rig, _over(rig, hand, aim, 430))


def _mirror(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig()

    def height(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        d = np.abs(x - 450)
        return np.asarray(45 * np.cos(d / 80) * np.cos(y / 95 + 0.6) + 25 * np.sin(d / 47 + y / 60))

    surface = rectangle((-450, 0, 0), (900, 0, 0), (0, 500, 0), height, cell_mm=10)
    xyz, normal = surface.scatter(32, layout, where=lambda p: p[:, 0] > 15)
    flip = np.array([-1.0, 1.0, 1.0])
    targets = _still(np.concatenate([xyz, flip * xyz]), np.concatenate([normal, flip * normal]), n)
    aim = _lanes(np.arange(n) / 1000, (-330, 330), (110, 390), 3)
    return Scene(surface, targets, rig, _over(rig, hand, aim, 430))


def _steps(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig()
    length = (0.0, 600.0, 0.0)
    levels = [0.0, 110.0, 40.0, 160.0, 70.0]
    parts = []
    for i, level in enumerate(levels):
        parts.append(rectangle((180.0 * i, 0, level), (180, 0, 0), length, cell_mm=15))
        if i:
            rise = (0.0, 0.0, level - levels[i - 1])  # u × v points to the lower side, whichever that is
            parts.append(rectangle((180.0 * i, 0, levels[i - 1]), rise, length, cell_mm=15))
    surface = joined(parts)
    targets = _still(*surface.scatter(90, layout), n)
    aim = _lanes(np.arange(n) / 1200, (140, 760), (120, 480), 3) + np.array([0, 0, 75])
    return Scene(surface, targets, rig, _over(rig, hand, aim, 430, tilt_deg=42))


def _corridor(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """Out along one wall, round at the end, back along the other, and round again: a loop of twelve metres."""
    rig = _rig(f_px=1150, crossing_mm=750)
    w, d, h = 1200.0, 6000.0, 1200.0
    parts = [
        rectangle((0, 0, 0), (w, 0, 0), (0, d, 0), cell_mm=60),
        rectangle((0, 0, 0), (0, d, 0), (0, 0, h), cell_mm=60),
        rectangle((w, 0, 0), (0, 0, h), (0, d, 0), cell_mm=60),
        rectangle((0, 0, 0), (0, 0, h), (w, 0, 0), cell_mm=60),
        rectangle((0, d, 0), (w, 0, 0), (0, 0, h), cell_mm=60),
    ]
    surface = joined(parts)
    xyz, normal = surface.scatter(900, layout)
    s = np.linspace(0, 1, n)
    y = np.interp(s, [0, 0.40, 0.5, 0.90, 1], [700, 5200, 5200, 700, 700])
    heading = np.radians(np.interp(s, [0, 0.36, 0.53, 0.86, 1], [150, 150, -30, -30, -210]))
    t = np.arange(n, dtype=float)
    heading = heading + _wander(hand, t, 150, 0.08)
    pitch = _wander(hand, t, 130, 0.28)
    forward = np.stack([np.cos(heading), np.sin(heading), pitch], axis=1)
    place = np.stack([np.full(n, w / 2) + _wander(hand, t, 170, 60), y, h / 2 + _wander(hand, t, 190, 70)], axis=1)
    place += np.stack([_wander(hand, t, 9, 0.8) for _ in range(3)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    poses = _looking(rig, place, place + 700 * forward, up, _wander(hand, t, 150, 0.15))
    sensing = Sensing(depth_mm=(250, 1300))
    return Scene(surface, _still(xyz, normal, n), rig, poses, diameter_mm=10.0, sensing=sensing)


def _moved(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """Midway, twelve of ninety targets move by 20 to 90 mm and eight are taken away."""
    rig = _rig()
    surface = _relief(900, 600)
    count, movers, midway = 90, 12, n // 2
    xyz, normal = surface.scatter(count, layout)
    leaving = layout.permutation(count)[: movers + 8]
    places, directions = surface.scatter(8 * count, layout, spacing=0.3)
    for k in leaving[:movers]:
        distance = np.linalg.norm(places - xyz[k], axis=1)
        room = np.linalg.norm(places[:, None] - xyz, axis=2).min(axis=1)
        new = layout.choice(np.nonzero((distance > 20) & (distance < 90) & (room > 15))[0])
        xyz, normal = np.vstack([xyz, places[new]]), np.vstack([normal, directions[new]])
    valid_from, valid_to = np.zeros(count + movers, dtype=np.int64), np.full(count + movers, n)
    valid_to[leaving] = midway
    valid_from[count:] = midway
    aim = _lanes(2 * np.arange(n) / n, (130, 770), (120, 480), 3)
    return Scene(surface, Targets(xyz, normal, valid_from, valid_to), rig, _over(rig, hand, aim, 430))


def _kidnap(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """A tour first; then, eight times, the sensor is put down somewhere else and another way round."""
    rig = _rig()
    surface = _relief(900, 600)
    targets = _still(*surface.scatter(80, layout), n)
    leaps = [round(n * (0.5 + 0.5 * k / 8)) for k in range(8)]
    aim = _lanes(np.minimum(2 * np.arange(n) / max(n, 1), 1.0), (130, 770), (120, 480), 3)
    roll = np.zeros(n)
    for first, last in zip(leaps, [*leaps[1:], n], strict=True):
        aim[first:last] = [hand.uniform(200, 700), hand.uniform(170, 430), 0]
        roll[first:last] = hand.uniform(-np.pi, np.pi)
    poses = _over(rig, hand, aim, 430, roll_rad=roll)
    return Scene(surface, targets, rig, poses, kidnapped=frozenset(k for k in leaps if 0 < k < n))


def _clutter(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig(crossing_mm=430)
    surface = head(200)
    targets = _still(*surface.scatter(45, layout, spacing=0.75), n)
    poses = _round(rig, hand, _turns(targets, n, 500), 430, rise_mm=25)
    sensing = Sensing(ghosts_per_image=0.0, ghosts_per_dot=1.0)
    return Scene(surface, targets, rig, poses, sensing=sensing)


def _dwell(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """Six tenths of the time over one corner of a plane, then over all of it."""
    rig = _rig()
    surface = rectangle((0, 0, 0), (900, 0, 0), (0, 700, 0))
    s = (np.arange(n) / n - 0.6).clip(0, 1) / 0.4
    aim = _lanes(s, (170, 760), (160, 560), 3)
    return Scene(surface, _still(*surface.scatter(75, layout), n), rig, _over(rig, hand, aim, 430))


def _closure(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """Once round, and a sixth of a turn more: the end sees the newest targets beside the first ones."""
    rig = _rig()
    surface = head(320)
    poses = _round(rig, hand, np.linspace(0, 2 * np.pi * 7 / 6, n), 430, rise_mm=50)
    return Scene(surface, _still(*surface.scatter(75, layout), n), rig, poses)


def _sparse(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """A tour from afar; then a nearer one, on which the cameras share few targets, and each sees others alone."""
    rig = _rig(baseline_mm=200, crossing_mm=700)
    surface = _relief(900, 600)
    targets = _still(*surface.scatter(30, layout, spacing=0.75), n)
    s = np.arange(n) / n
    distance = np.interp(s, [0, 0.47, 0.53, 1], [560, 560, 330, 330])
    return Scene(surface, targets, rig, _over(rig, hand, _lanes(2 * s, (130, 770), (120, 480), 3), distance))


def _demo(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    rig = _rig(f_px=1050, size_px=(960, 720), baseline_mm=90, crossing_mm=450)
    surface = head(230)
    azimuth = -0.5 + 0.017 * np.arange(n)
    poses = _round(rig, hand, azimuth, 450, elevation_deg=12, rise_mm=15, astray_mm=8)
    xyz, normal = surface.scatter(44, layout, where=lambda xyz: xyz[:, 0] > 0)
    return Scene(surface, _still(xyz, normal, n), rig, poses)


LINES_MM = (
    ((60.0, 500.0, 40.0), (940.0, 500.0, 40.0)),
    ((500.0, 60.0, 60.0), (500.0, 940.0, 60.0)),
    ((70.0, 90.0, 90.0), (930.0, 910.0, 90.0)),
    ((70.0, 910.0, 120.0), (930.0, 90.0, 120.0)),
    ((60.0, 150.0, 20.0), (940.0, 850.0, 300.0)),
    ((60.0, 850.0, 300.0), (940.0, 150.0, 20.0)),
    ((60.0, 300.0, 300.0), (940.0, 300.0, 20.0)),
    ((300.0, 60.0, 20.0), (300.0, 940.0, 300.0)),
)
"""Ends of the artefact's measuring lines, in eight directions through a volume of 1 x 1 x 0.3 m (mm)."""
ON_A_LINE = 6
"""Targets on each, evenly spaced: five test lengths from its first."""
BARS_MM = (((90.0, 20.0, 50.0), (910.0, 20.0, 50.0)), ((20.0, 90.0, 50.0), (20.0, 910.0, 50.0)))
"""Ends of its two scale bars (mm)."""


def _artefact(n: int, layout: np.random.Generator, hand: np.random.Generator) -> Scene:
    """Targets on posts over a plate of others; first come those of the lines, then the ends of the bars."""
    rig = _rig(crossing_mm=550)
    plate = rectangle((0, 0, 0), (1000, 0, 0), (0, 1000, 0))
    share = np.linspace(0, 1, ON_A_LINE)[:, None]
    posts = [(1 - share) * np.array(a) + share * np.array(b) for a, b in LINES_MM]
    ends = [np.array(bar) for bar in BARS_MM]
    xyz, normal = plate.scatter(130, layout)
    raised = np.concatenate([*posts, *ends])
    xyz = np.concatenate([raised, xyz])
    normal = np.concatenate([np.tile([0.0, 0.0, 1.0], (len(raised), 1)), normal])
    aim = _lanes(np.arange(n) / n, (80, 920), (80, 920), 5) + np.array([0.0, 0.0, 120.0])
    sensing = Sensing(depth_mm=(200, 800), sigma_px=0.03)
    return Scene(plate, _still(xyz, normal, n), rig, _over(rig, hand, aim, 450), diameter_mm=8.0, sensing=sensing)


def _relief(width_mm: float, depth_mm: float) -> Surface:
    """A landscape of gentle hills."""

    def height(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return np.asarray(30 * np.sin(x / 85 + 0.4) * np.cos(y / 75) + 20 * np.sin((x + 1.7 * y) / 110) + 10)

    return rectangle((0, 0, 0), (width_mm, 0, 0), (0, depth_mm, 0), height, cell_mm=10)


SCENES: dict[str, Recipe] = {
    "statue": Recipe("a statue of a head, circled: 42 targets, the paper's comparison", 1500, _statue),
    "plane": Recipe("a square metre of wall: 118 targets", 3680, _plane),
    "sphere": Recipe("a ball, seen from all sides: 48 targets", 2360, _sphere),
    "head": Recipe("an infant's head, several full turns: 33 targets", 3203, _head),
    "head-front": Recipe("the frontal half of an infant's head: 28 targets", 5571, _head_front),
    "grid": Recipe("a nearly regular grid (1 % jitter): every constellation resembles its neighbours", 1000, _grid),
    "mirror": Recipe("two halves, each the mirror image of the other", 1000, _mirror),
    "steps": Recipe("steps and walls that hide neighbours", 1200, _steps),
    "corridor": Recipe("a corridor of 6 m, out and back: 900 targets, drift and a long loop", 2400, _corridor),
    "moved": Recipe("midway, twelve targets are moved and eight removed", 1000, _moved),
    "kidnap": Recipe("the sensor is put down elsewhere, eight times", 1000, _kidnap),
    "clutter": Recipe("a head with as many false dots as true ones", 1000, _clutter),
    "dwell": Recipe("long over one region, then over all: misleads frequency counts", 1000, _dwell),
    "closure": Recipe("once round and a little more: misleads frequency counts", 1000, _closure),
    "sparse": Recipe("30 targets and wide gaps: often fewer than three for both cameras", 1000, _sparse),
    "artefact": Recipe("test lengths in eight directions through 1 x 1 x 0.3 m, dots good to 0.03 px", 800, _artefact),
    "demo": Recipe("a head with 44 targets, a short quiet tour, made to be rendered", 60, _demo),
}
