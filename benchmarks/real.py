"""Do lengths on the real recordings come out as they are known, and do two halves of a recording agree as predicted?

Run: python benchmarks/real.py DATA [--figure docs/images/real.png]

Each recording goes through the whole program: positioned, revised, adjusted. Targets are named by the truth beside it,
for counting alone. Then all distances among them are compared with the known layout, and with those of the other half
of the frames, positioned and adjusted apart: distances depend on no coordinates. DATA is the folder of the recordings.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cyclopts
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from trifix.bundle import Constraints, adjust_steps
from trifix.config import Config
from trifix.experiments.figures import png_of
from trifix.files.maps import read_map
from trifix.files.recordings import read_recording
from trifix.files.truth import Truth, read_truth
from trifix.geometry.alignment import align
from trifix.outputs.figures import style_of
from trifix.positioner import Positioner
from trifix.records import Dots, Fix, Frame, ReferenceMap, Step, StereoDots, TargetState

MOSTLY = 0.8  # of its sightings, that make a target the true one
NEAR_PX = 5.0  # a detected dot is the labelled one within this distance
BOOFCV_HALVES = ([0, 5, 7, 9, 11, 13, 15, 20], [21, 23, 24, 25, 28, 30, 47, 50])
"""Frames of the two halves of boofcv_dots: no exposure of its one camera stands in two of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where targets are, in any coordinates."""

    id: Int[np.ndarray, "k"]
    """Their true identities, ascending."""
    xyz_mm: Float[np.ndarray, "k 3"]
    """Their places (mm)."""
    cov_mm2: Float[np.ndarray, "k3 k3"]
    """Covariance of all places together (mm²)."""

    def of(self, ids: Int[np.ndarray, "c"]) -> "Layout":
        """Some of them."""
        at = np.searchsorted(self.id, ids)
        entries = (3 * at[:, None] + np.arange(3)).ravel()
        return Layout(ids, self.xyz_mm[at], self.cov_mm2[np.ix_(entries, entries)])


@dataclass(frozen=True, slots=True)
class Agreement:
    """Two layouts beside each other."""

    targets: int
    """Targets in common."""
    error_mm: float
    """Differences of all distances (mm, rms)."""
    worst_mm: float
    """The largest (mm)."""
    sigma_mm: float
    """What the covariances of both predict for it (mm, rms)."""
    normalised: float
    """Root mean square of the differences over their predicted sigmas: 1 is honest."""
    beyond_two: float
    """Share beyond two sigmas; 0.05 is honest."""
    spread: float
    """Standard deviation that ``normalised`` squared has about 1 if the covariances are right: distances are
    correlated, so they are worth far fewer than their number."""
    shape: float
    """χ² per degree of freedom of all places at once, shift and turn (and scale) free: 1 ± ``shape_spread``."""
    shape_spread: float
    """Its standard deviation."""
    bent: float
    """The same with a smooth distortion free as well: every coordinate a polynomial of second degree in all three."""
    scale: float
    """The first layout's size over the second's."""


def main(data: Path, /, *, figure: Path | None = None) -> None:
    """Print the tables.

    Args:
        data: Folder of the real recordings.
        figure: PNG to draw.
    """
    known: dict[str, Agreement] = {}
    halves: dict[str, Agreement] = {}
    small = ["dice_plate/subset", *(f"chess_subset/seed_{k}" for k in (1, 2, 3))]
    for name in small:
        folder, is_scaled = data / name, name.startswith("chess")
        for level in ("dots", "points"):
            frames, is_stated = frames_of(folder, level)
            measure(f"{name}, {level}", folder, frames, is_stated, is_scaled, known, halves)
    frames = detected_frames(data / "dice_plate")
    measure("dice_plate, our dots", data / "dice_plate/subset", frames, False, False, known, halves)
    boofcv = data / "boofcv_dots"
    parts = boofcv_halves(boofcv)
    for k, part in enumerate(parts):
        known[f"boofcv_dots, half {k + 1}"] = compare(part, layout_of(read_map(boofcv / "map_given.csv")), True)
    halves["boofcv_dots, dots, first and second"] = compare(*parts)

    print_table("Against the known layout", known)
    print_table("Two halves, adjusted apart", halves)
    print("\n| cluster | frames | rms residual, mm | README: rigid, mm | odd and even | first and second half |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for cluster in RIGID_MM:
        steps = cluster_steps(data, cluster)
        placed = [step for step in steps if isinstance(step.fix, Fix)]
        if not placed:
            print(f"| {cluster} | 0 | – | {RIGID_MM[cluster]:.3f} | – | – |")
            continue
        split = [cluster_halves(data, cluster, steps, is_interleaved) for is_interleaved in (True, False)]
        print(
            f"| {cluster} | {len(placed)} | {rms_residual_mm(placed):.3f} | {RIGID_MM[cluster]:.3f} | "
            + " | ".join(f"{each.normalised:.2f}" for each in split)
            + " |"
        )
    if figure is not None:
        figure.write_bytes(png_of(drawn(known, halves)))


def measure(
    name: str,
    folder: Path,
    frames: Sequence[Frame],
    is_stated: bool,
    is_scaled: bool,
    known: dict[str, Agreement],
    halves: dict[str, Agreement],
) -> None:
    """Adds what a recording's lengths are, and how its halves agree."""
    truth = read_truth(folder / "truth")
    given = layout_of(read_map(folder / "map_given.csv"))
    known[name] = compare(layout(adjusted(frames, is_stated), truth), given, is_scaled)
    for how, (a, b) in splits(frames).items():
        halves[f"{name}, {how}"] = compare(layout(adjusted(a, is_stated), truth), layout(adjusted(b, is_stated), truth))


def splits(frames: Sequence[Frame]) -> dict[str, tuple[Sequence[Frame], Sequence[Frame]]]:
    """The two ways of making halves."""
    middle = (len(frames) + 1) // 2
    return {"odd and even": (frames[::2], frames[1::2]), "first and second": (frames[:middle], frames[middle:])}


# --- recordings ------------------------------------------------------------------------------------------------------


def frames_of(folder: Path, level: str) -> tuple[list[Frame], bool]:
    """The frames of a recording, and whether it states its noise."""
    recording = read_recording(folder / f"recording_{level}")
    return list(recording), recording.is_noise_stated


def adjusted(frames: Iterable[Frame], is_noise_stated: bool = False) -> Sequence[Step]:
    """Frames through the whole program, from nothing."""
    positioner = Positioner(is_noise_stated=is_noise_stated)
    steps = [step.remembered() for step in positioner.run(frames)]
    revised = [replace(step, identification=None) for step in positioner.revise(steps)]
    return adjust_steps(revised, positioner.config, is_noise_stated=is_noise_stated)[0]


def detected_frames(plate: Path) -> list[Frame]:
    """The images of dice_plate with dots found by trifix, those of its irregular part alone."""
    positioner = Positioner()
    frames = []
    for image, given in zip(
        read_recording(plate / "recording"), read_recording(plate / "subset" / "recording_dots"), strict=True
    ):
        found, part = positioner.find_dots(image), given.content
        assert found is not None
        assert isinstance(part, StereoDots)
        frames.append(
            replace(
                given, content=StereoDots(nearest(found.dots.left, part.left), nearest(found.dots.right, part.right))
            )
        )
    return frames


def nearest(dots: Dots, given: Dots) -> Dots:
    """The dot beside each given one, under its row, where there is one."""
    apart_px = np.linalg.norm(dots.uv_px[:, None] - given.uv_px[None], axis=2)
    at, is_there = apart_px.argmin(axis=0), apart_px.min(axis=0) < NEAR_PX
    rows = at[is_there]
    return Dots(dots.uv_px[rows], dots.cov_px2[rows], dots.ellipse[rows], dots.label[rows], given.row[is_there])


def boofcv_halves(folder: Path, every: int = 1) -> tuple[Layout, Layout]:
    """Two layouts of the cards, from halves of the recording that share no exposure; by every so many frames."""
    frames, truth = frames_of(folder, "dots")[0], read_truth(folder / "truth")
    a, b = (layout(adjusted([frames[k] for k in rows[::every]]), truth) for rows in BOOFCV_HALVES)
    return a, b


# --- clusters of four markers ----------------------------------------------------------------------------------------

RIGID_MM = {
    "01_04": 0.037, "05_08": 0.035, "09_12": 0.026, "13_16": 0.041, "17_20": 0.027, "21_24": 0.060, "25_28": 0.039,
    "29_32": 0.108, "41_44": 0.101,
}  # fmt: skip
"""By the recording's README: rms misfit of each cluster to its mean shape."""
PROOF = 1e-3
"""Chance that is let pass here. Four markers among 54 prove 1e-5; the default, 1e-9, refuses every frame."""


def cluster_steps(data: Path, cluster: str) -> list[Step]:
    """The frames of a cluster on its given map."""
    folder = data / "optotrak_clusters/clusters" / f"markers_{cluster}"
    config = Config()
    config = replace(config, verify=replace(config.verify, max_p_chance=PROOF))
    positioner = Positioner(config, read_map(folder / "map_given.csv"), is_map_frozen=True)
    steps = [step.remembered() for step in positioner.run(read_recording(folder / "recording_points"))]
    return list(positioner.revise(steps))


def cluster_halves(data: Path, cluster: str, steps: Sequence[Step], is_interleaved: bool) -> Agreement:
    """How the shapes agree that two halves of the frames give.

    The given map only says which marker is which and where the world is, as its places are given a sigma of 1 mm.
    """
    given = read_map(data / "optotrak_clusters/clusters" / f"markers_{cluster}" / "map_given.csv")
    vague = replace(given, cov_mm2=np.tile(np.eye(3), (len(given), 1, 1)))
    placed = [step for step in steps if isinstance(step.fix, Fix)]
    middle = len(placed) // 2
    parts = (placed[::2], placed[1::2]) if is_interleaved else (placed[:middle], placed[middle:])
    a, b = (layout_of(adjust_steps(part, None, Constraints(vague), is_noise_stated=True)[0][-1].map) for part in parts)
    return compare(a, b)


def rms_residual_mm(placed: Sequence[Step]) -> float:
    """Distance of the points from their targets (mm, rms)."""
    residual = np.concatenate([step.fix.residual_mm for step in placed if isinstance(step.fix, Fix)])
    return float(np.sqrt((residual**2).mean()))


# --- layouts ---------------------------------------------------------------------------------------------------------


def layout_of(map: ReferenceMap) -> Layout:
    """All targets of a map under their own identities; independent of each other unless it knows better."""
    order = np.argsort(map.id)
    rows = map.rows(order)
    joint = rows.joint_mm2
    if joint is None:
        k = len(rows)
        joint = np.zeros((3 * k, 3 * k))
        joint.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)] = rows.cov_mm2
    return Layout(rows.id, rows.xyz_mm, joint)


def layout(steps: Sequence[Step], truth: Truth) -> Layout:
    """The trusted targets of an adjusted map under their true identities.

    A target is the true one of at least four in five of its sightings; of two that are the same, the one seen more.
    """
    votes: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for step in steps:
        if not isinstance(step.fix, Fix) or step.points is None:
            continue
        for identity, labels in zip(step.map.id[step.fix.target].tolist(), _labels(step, truth), strict=True):
            votes[identity].update(labels)
    map = steps[-1].map
    row_of: dict[int, int] = {}
    for row in np.flatnonzero(map.state == TargetState.trusted).tolist():
        seen = votes[int(map.id[row])]
        if not seen:
            continue
        true, count = seen.most_common(1)[0]
        is_more = true not in row_of or map.sightings[row] > map.sightings[row_of[true]]
        if true >= 0 and count >= MOSTLY * seen.total() and is_more:
            row_of[true] = row
    ids = np.array(sorted(row_of), dtype=np.int64)
    found = map.rows(np.array([row_of[each] for each in ids.tolist()], dtype=np.int64))
    return layout_of(replace(found, id=ids))


def _labels(step: Step, truth: Truth) -> list[list[int]]:
    """What each identified point of a step truly is: one label for a point, one for each dot otherwise."""
    assert step.points is not None
    assert isinstance(step.fix, Fix)
    if step.dots is None or step.matches is None:
        assert truth.id_of_point is not None
        return [[each] for each in truth.id_of_point[step.points.row[step.fix.point]].tolist()]
    assert truth.id_of_dot is not None
    match = step.points.match[step.fix.point]
    left = truth.id_of_dot[step.dots.left.row[step.matches.left[match]]]
    right = truth.id_of_dot[step.dots.right.row[step.matches.right[match]]]
    return np.stack([left, right], axis=1).tolist()


# --- comparing -------------------------------------------------------------------------------------------------------


def compare(a: Layout, b: Layout, is_scale_free: bool = False) -> Agreement:
    """How two layouts agree, each with errors of its own; with one factor on all lengths of ``a`` left open."""
    ids = np.intersect1d(a.id, b.id)
    a, b = a.of(ids), b.of(ids)
    k = len(ids)
    i, j = np.triu_indices(k, 1)
    T = align(b.xyz_mm, a.xyz_mm)
    R = np.kron(np.eye(k), T.R)
    C = a.cov_mm2 + R @ b.cov_mm2 @ R.T  # of the difference, in the coordinates of a
    offset = a.xyz_mm[i] - a.xyz_mm[j]
    length, other = np.linalg.norm(offset, axis=1), np.linalg.norm(b.xyz_mm[i] - b.xyz_mm[j], axis=1)
    scale = float((length @ other) / (other @ other)) if is_scale_free else 1.0
    along = offset / length[:, None]
    J = np.zeros((len(i), k, 3))
    J[np.arange(len(i)), i], J[np.arange(len(i)), j] = along, -along
    lengthens = J.reshape(len(i), -1)
    sigma = np.sqrt(((lengthens @ C) * lengthens).sum(axis=1))
    error = length / scale - other
    z = error / sigma
    by_sigma = lengthens / sigma[:, None]
    CG = C @ by_sigma.T @ by_sigma  # the sum of squared correlations is the trace of its square
    y = T.apply(b.xyz_mm)
    shape, dof = _chi2(a.xyz_mm - y, y, C, is_scale_free, is_bent=False)
    bent, bent_dof = _chi2(a.xyz_mm - y, y, C, is_scale_free, is_bent=True)
    return Agreement(
        targets=k,
        error_mm=float(np.sqrt((error**2).mean())),
        worst_mm=float(np.abs(error).max()),
        sigma_mm=float(np.sqrt((sigma**2).mean())),
        normalised=float(np.sqrt((z**2).mean())),
        beyond_two=float((np.abs(z) > 2).mean()),
        spread=float(np.sqrt(2 * np.trace(CG @ CG)) / len(i)),
        shape=shape / dof,
        shape_spread=float(np.sqrt(2 / dof)),
        bent=bent / bent_dof if bent_dof > 0 else float("nan"),
        scale=scale,
    )


def _chi2(
    off_mm: Float[np.ndarray, "k 3"],
    at_mm: Float[np.ndarray, "k 3"],
    C: Float[np.ndarray, "k3 k3"],
    is_scale_free: bool,
    is_bent: bool,
) -> tuple[float, int]:
    """Least eᵀ C⁻¹ e of what is left when the free motions have been taken out, and its degrees of freedom."""
    p = at_mm - at_mm.mean(axis=0)
    k, zero = len(p), np.zeros(len(p))
    x, y, z = p.T / np.abs(p).max()
    free = [np.tile(axis, (k, 1)) for axis in np.eye(3)]
    free += [np.stack(turn, axis=1) for turn in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    free += [p] if is_scale_free else []
    if is_bent:
        powers = (x, y, z, x * x, y * y, z * z, x * y, y * z, z * x)
        free += [power[:, None] * axis for power in powers for axis in np.eye(3)]
    F = np.stack([each.ravel() for each in free], axis=1)
    L = np.linalg.cholesky(C)
    weighed, e = np.linalg.solve(L, F), np.linalg.solve(L, off_mm.ravel())
    U, s, _ = np.linalg.svd(weighed / np.linalg.norm(weighed, axis=0), full_matrices=False)
    U = U[:, s > 1e-7 * s[0]]  # of a plane, some distortions are others
    left = e - U @ (U.T @ e)
    return float(left @ left), 3 * k - U.shape[1]


def smooth_share(steps: Sequence[Step]) -> tuple[float, float]:
    """Share of the squared residuals that varies smoothly over each image (a linear field), and what noise makes it."""
    fields, total, free, count = 0.0, 0.0, 0, 0
    for step in steps:
        fix, rig = step.fix, step.frame.rig
        if not isinstance(fix, Fix) or rig is None or step.centres is None or step.matches is None:
            continue
        assert step.points is not None
        match = step.points.match[fix.point]
        in_left = fix.T_world_sensor.inverse().apply(step.map.xyz_mm[fix.target])
        uv_left = step.centres.left.uv_px[step.matches.left[match]]
        uv_right = step.centres.right.uv_px[step.matches.right[match]]
        for uv, image in (
            (uv_left, rig.left.project(in_left)),
            (uv_right, rig.right.project(rig.T_right_left.apply(in_left))),
        ):
            off, X = uv - image, np.column_stack([np.ones(len(uv)), uv - uv.mean(axis=0)])
            field = X @ np.linalg.lstsq(X, off, rcond=None)[0]
            fields, total, free, count = (
                fields + (field**2).sum(),
                total + (off**2).sum(),
                free + 6,
                count + 2 * len(uv),
            )
    return fields / total, free / count


# --- telling ---------------------------------------------------------------------------------------------------------


def print_table(title: str, rows: dict[str, Agreement]) -> None:
    """A table in Markdown."""
    print(f"\n{title}\n")
    head = "recording", "targets", "error, rms · worst, mm", "predicted, mm", "normalised", "beyond 2"
    print("| " + " | ".join((*head, "shape χ²", "smooth", "scale")) + " |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, a in rows.items():
        print(
            f"| {name} | {a.targets} | {a.error_mm:.4f} · {a.worst_mm:.4f} | {a.sigma_mm:.4f} | {a.normalised:.2f} | "
            f"{100 * a.beyond_two:.0f} % | {a.shape:.2f} ± {a.shape_spread:.2f} | {a.bent:.2f} | {a.scale:.5f} |"
        )


def drawn(known: dict[str, Agreement], halves: dict[str, Agreement]) -> Figure:
    """Error against predicted sigma, one point a comparison."""
    ink, faint, grid = "#1b1f24", "#66707c", "#dde1e6"
    with mpl.rc_context(style_of(ink, faint, grid)):  # type: ignore[arg-type]
        figure = Figure(figsize=(7, 4.4), layout="constrained")
        axes = figure.subplots()
        ends = np.array([2e-4, 1.0])
        axes.fill_between(ends, ends / 1.5, ends * 1.5, color="#cfe3f1", linewidth=0, label="within a factor of 1.5")
        for rows, mark, colour, label in (
            (halves, "o", "#0072b2", "two halves of a recording"),
            (known, "D", "#d55e00", "against the known layout"),
        ):
            sigma, error = np.array([(each.sigma_mm, each.error_mm) for each in rows.values()]).T
            axes.plot(sigma, error, mark, ms=5, mfc=colour, mec="none", label=label)
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
        axes.set(xlabel="predicted sigma of a length (mm, rms)", ylabel="what came out (mm, rms)")
        axes.legend(loc="upper left")
        return figure


if __name__ == "__main__":
    cyclopts.run(main)
