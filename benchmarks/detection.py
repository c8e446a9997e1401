"""The detector against what the light allows: bias, scatter, honesty, recall, false dots and time.

Run: python benchmarks/detection.py

Dots are rendered exactly: the share of each pixel's area that a blurred ellipse covers, integrated chord by chord. The
bound is Cramér and Rao's for the image's noise where centre, axes, direction, blur and both grey levels are unknown.
Time is compared with OpenCV's adaptiveThreshold and findContours on the same image, in turns.
"""

from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.special import ndtr

from trifix.kernels import detection
from trifix.sources.rendering import Renderer
from trifix.sources.simulation import simulate_frames
from trifix.stages.detect import DetectOptions, detect


class Case(NamedTuple):
    """Equal dots, at random phases and in random directions."""

    diameter_px: float
    tilt_deg: float
    blur_px: float
    around: float
    inside: float
    noise: float
    light_per_px: float = 0.0
    white: float = np.inf  # grey value at which the camera saturates


DARK, BRIGHT, DEEP = (180.0, 30.0, 2.0), (20.0, 200.0, 2.0), (1500.0, 9000.0, 100.0)
CASES = (
    Case(6, 0, 0.7, *DARK),
    Case(6, 60, 0.7, *DARK),
    Case(6, 45, 0.7, *BRIGHT),
    Case(10, 0, 0.7, *DEEP),
    Case(10, 60, 0.6, *DARK, 0.001),
    Case(16, 30, 1.0, *BRIGHT, 0.001),
    Case(16, 60, 0.7, *DEEP),
    Case(25, 45, 0.7, *DARK),
    Case(40, 0, 1.0, *BRIGHT),
    Case(40, 60, 0.7, *DARK),
    Case(6, 45, 2.0, *DARK),
    Case(20, 60, 2.0, *BRIGHT),
    Case(25, 45, 0.7, *DARK, 0.003),
    Case(12, 30, 0.7, 120, 88, 2),
    Case(12, 30, 0.7, 88, 120, 2),
    Case(16, 45, 0.9, 20, 300, 2, 0.0, 255),
    Case(60, 65, 1.0, *DEEP),
    Case(200, 45, 1.0, *DARK),
)


class Accuracy(NamedTuple):
    """What one case came to."""

    bias_px: float
    """Largest component of the mean error of noise-free images of 16 bit."""
    worst_px: float
    """Largest error of any noise-free dot."""
    scatter: float
    """Root mean square error in the noise, over the bound's."""
    chi2: float
    """Mean of the squared errors weighed by the stated covariances, over its expectation."""
    beyond: float
    """Share of them beyond what 5 % should exceed."""
    below: float
    """Share of them below what 5 % should."""
    recall: float
    """Share of dots found in the noise."""
    axis_bias_px: float
    """Largest mean error of a semi-axis without noise."""
    axis_scatter: float
    """Root mean square deviation of the semi-axes in the noise from their mean, over the bound's."""
    axis_to_centre: float
    """Variance of a semi-axis as found, over that of the centre as stated along it."""


def main(dots: int = 36, draws: int = 12, images: int = 60) -> None:
    detection.warm_up()
    table = Table(
        "dots",
        "bias, px",
        "worst, px",
        "scatter / bound",
        "chi² / 2",
        "beyond 95 %",
        "below 5 %",
        "found",
        *("axes: bias, px", "scatter / bound", "variance / centre's"),
    )
    for case in CASES:
        found = accuracy(case, dots if case.diameter_px <= 60 else 4, draws)
        name = f"{case.diameter_px} px, {case.tilt_deg}°, blur {case.blur_px}"
        name += f", {case.around:.0f} → {case.inside:.0f} ± {case.noise:.0f}"
        name += f", light {case.light_per_px}" * (case.light_per_px > 0) + ", saturated" * np.isfinite(case.white)
        table.add_row(name, *(f"{value:.4f}" for value in found[:2]), *(f"{value:.3f}" for value in found[2:]))
    Console().print(table)
    table = Table("images", "dots", "found, %", "false per 100 images", "centre rms, px", "ms")
    for name, count in (("head", images), ("statue", images), ("sizes", images), ("correlated noise", images // 4)):
        table.add_row(name, *searched(name, count))
    Console().print(table)
    table = Table(
        "partly hidden, % accepted (% of these off by more than 3 σ)", *(f"{d} px" for d in (6, 10, 20, 40, 100))
    )
    for share in (0.05, 0.1, 0.2, 0.3, 0.5):
        gone = [hidden(d, share, 40 if d < 100 else 20) for d in (6, 10, 20, 40, 100)]
        table.add_row(f"{share:.0%}", *(f"{100 * one.accepted:.0f} ({100 * one.beyond:.0f})" for one in gone))
    Console().print(table)
    table = Table("1280 x 1024, 63 dots", "detect, ms", "OpenCV, ms", "ratio")
    for name, (ours, theirs) in timed().items():
        table.add_row(name, f"{ours:.2f}", f"{theirs:.2f}", f"{ours / theirs:.2f}")
    Console().print(table)


def coverage(
    u: float, v: float, a: float, b: float, theta: float, blur_px: float, box: tuple[slice, slice]
) -> np.ndarray:
    """Share of each pixel's area in a box (rows, columns) that a blurred ellipse covers.

    The integral over each chord is in closed form; that over the chords is taken at the nodes of cos θ, where the
    chords' ends are smooth.
    """
    pixels_v, pixels_u = np.arange(box[0].start, box[0].stop), np.arange(box[1].start, box[1].stop)
    half = np.hypot(a * np.cos(theta), b * np.sin(theta))
    n = int(40 * half / min(1.0, 3 * blur_px)) + 60
    angle = (np.arange(n) + 0.5) * np.pi / n
    x = half * np.cos(angle)
    # Form E of the ellipse; the chord at x has its middle at E_uv / E_uu x, half-length √(det E / E_uu (1 - x²/E_uu)).
    slope = (a**2 - b**2) * np.sin(theta) * np.cos(theta) / half**2
    length = a * b / half * np.sin(angle)
    weight = half * np.sin(angle) * np.pi / n
    across = _box_normal(pixels_u[:, None] - u - x, blur_px) * weight
    along = _box_normal_integral(pixels_v[:, None] - v - slope * x + length, blur_px) - _box_normal_integral(
        pixels_v[:, None] - v - slope * x - length, blur_px
    )
    return np.asarray(along @ across.T)


def _box_normal(t: np.ndarray, s: float) -> np.ndarray:
    return np.asarray(ndtr((t + 0.5) / s) - ndtr((t - 0.5) / s))


def _box_normal_integral(t: np.ndarray, s: float) -> np.ndarray:
    return _ramp((t + 0.5) / s) * s - _ramp((t - 0.5) / s) * s


def _ramp(z: np.ndarray) -> np.ndarray:
    """Integral of the normal integral."""
    return z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)


def box_of(u: float, v: float, a: float, blur_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The pixels that a dot reaches."""
    reach = a + 6 * blur_px + 2
    low = np.maximum(np.floor([v - reach, u - reach]).astype(int), 0)
    high = np.minimum(np.ceil([v + reach, u + reach]).astype(int) + 1, shape)
    return slice(low[0], high[0]), slice(low[1], high[1])


def accuracy(case: Case, dots: int, draws: int) -> Accuracy:
    rng = np.random.default_rng(int(case.diameter_px * 100 + case.tilt_deg))
    rows = int(np.sqrt(dots))
    pitch = int(case.diameter_px + 6 * case.blur_px + max(14, 0.4 * case.diameter_px))
    size = rows * pitch
    v, u = np.mgrid[0:rows, 0:rows].reshape(2, -1) * pitch + pitch / 2 + rng.uniform(-0.5, 0.5, (2, rows**2))
    a = case.diameter_px / 2
    b = a * np.cos(np.radians(case.tilt_deg))
    ellipses = [(*centre, a, b, theta) for *centre, theta in zip(u, v, rng.uniform(0, np.pi, rows**2), strict=True)]
    covered = np.zeros((size, size))
    bound = axis_bound = 0.0
    for ellipse in ellipses:
        box = box_of(*ellipse[:3], case.blur_px, covered.shape)
        covered[box] += coverage(*ellipse, case.blur_px, box)
        cov = bound_px2(ellipse, case, box)
        bound += np.trace(cov[:2, :2]) / len(ellipses)
        axis_bound += np.trace(cov[2:, 2:]) / (2 * len(ellipses))
    light = 1 + case.light_per_px * (np.arange(size) - size / 2)
    grey = (case.around + (case.inside - case.around) * covered) * light
    options = DetectOptions(polarity="bright" if case.inside > case.around else "dark")
    deep = 65535 / case.white if np.isfinite(case.white) else 60000 / grey.max()
    still, _, still_axes, _ = errors(np.rint(grey * deep).clip(0, 65535).astype(np.uint16), ellipses, options)
    error, chi2, axes, along = [], [], [], []
    is_deep = np.isinf(case.white) and grey.max() > 255
    for _ in range(draws):
        noisy = np.rint(grey + case.noise * rng.standard_normal(grey.shape))
        noisy = noisy.clip(0, 65535).astype(np.uint16) if is_deep else noisy.clip(0, 255).astype(np.uint8)
        for kept, one in zip((error, chi2, axes, along), errors(noisy, ellipses, options), strict=True):
            kept.append(one)
    squares, axis = np.concatenate(chi2), np.concatenate(axes)
    axis_px2 = np.mean((axis - axis.mean(axis=0)) ** 2)
    return Accuracy(
        bias_px=float(np.abs(still.mean(axis=0)).max()),
        worst_px=float(np.hypot(*still.T).max()),
        scatter=float(np.sqrt(np.mean(np.sum(np.concatenate(error) ** 2, axis=1)) / bound)),
        chi2=float(squares.mean() / 2),
        beyond=float(np.mean(squares > 5.991)),
        below=float(np.mean(squares < 0.1026)),
        recall=len(squares) / (draws * len(ellipses)),
        axis_bias_px=float(np.abs(still_axes.mean(axis=0)).max()),
        axis_scatter=float(np.sqrt(axis_px2 / axis_bound)),
        axis_to_centre=float(axis_px2 / np.concatenate(along).mean()),
    )


def bound_px2(ellipse: tuple[float, ...], case: Case, box: tuple[slice, slice]) -> np.ndarray:
    """Cramér-Rao bound of the covariance of a dot's centre and semi-axes; of pixels that do not saturate."""
    x = np.array([*ellipse[:2], *_form(*ellipse[2:]), case.blur_px])
    step = 1e-3
    columns = []
    for i in range(len(x)):
        high, low = x.copy(), x.copy()
        high[i] += step
        low[i] -= step
        columns.append((_covered(high, box) - _covered(low, box)) / (2 * step) * (case.inside - case.around))
    J = np.stack([*columns, np.ones(columns[0].size), _covered(x, box)], axis=1)
    light = case.around + (case.inside - case.around) * _covered(x, box)
    J = J[light < case.white]
    a, b, theta = ellipse[2:]
    c, s = np.cos(theta), np.sin(theta)
    by_form = np.zeros((4, J.shape[1]))
    by_form[0, 0] = by_form[1, 1] = 1
    by_form[2, 2:5] = np.array([c * c, 2 * c * s, s * s]) / (2 * a)
    by_form[3, 2:5] = np.array([s * s, -2 * c * s, c * c]) / (2 * b)
    return np.asarray(by_form @ np.linalg.inv(J.T @ J / (case.noise**2 + 1 / 12)) @ by_form.T)


def _form(a: float, b: float, theta: float) -> tuple[float, float, float]:
    c, s = np.cos(theta), np.sin(theta)
    return (a * c) ** 2 + (b * s) ** 2, (a**2 - b**2) * c * s, (a * s) ** 2 + (b * c) ** 2


def _covered(x: np.ndarray, box: tuple[slice, slice]) -> np.ndarray:
    mean, spread = (x[2] + x[4]) / 2, np.hypot((x[2] - x[4]) / 2, x[3])
    theta = 0.5 * np.arctan2(2 * x[3], x[2] - x[4])
    return coverage(x[0], x[1], np.sqrt(mean + spread), np.sqrt(mean - spread), theta, x[5], box).ravel()


def errors(
    image: np.ndarray, ellipses: list[tuple[float, ...]], options: DetectOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of the dots found: errors (px), their squares weighed by the stated covariances, errors of the semi-axes (px),
    and stated variances of the centre along these (px²)."""
    dots, truth = detect(image, options), np.array(ellipses)
    distance = np.hypot(*(truth[:, None, :2] - dots.uv_px[None]).transpose(2, 0, 1))
    target, dot = np.nonzero(distance < 1.0)
    error, cov = dots.uv_px[dot] - truth[target, :2], dots.cov_px2[dot]
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])
    axis = np.stack([np.cos(truth[target, 4]), np.sin(truth[target, 4])], axis=1)
    along = np.stack([axis, axis[:, ::-1] * [-1, 1]], axis=1)
    return (
        *(error, squares, dots.ellipse[dot, :2] - truth[target, 2:4]),
        np.einsum("nki,nij,nkj->nk", along, cov, along),
    )


def searched(name: str, images: int) -> tuple[str, ...]:
    """Dots, share found, false ones per 100 images, rms error and median time of one kind of scene."""
    true, found, false, squares, ms = 0, 0, 0, [], []
    for image, uv, drawn in scenes(name, images):
        start = perf_counter()
        dots = detect(image)
        ms.append(1e3 * (perf_counter() - start))
        if len(uv) == 0:
            false += len(dots)
            continue
        distance = np.hypot(*(uv[:, None] - dots.uv_px[None]).transpose(2, 0, 1))
        hit = distance.min(axis=1, initial=np.inf) < 1.0
        true, found = true + len(uv), found + int(hit.sum())
        false += int((np.hypot(*(drawn[:, None] - dots.uv_px[None]).transpose(2, 0, 1)).min(axis=0) > 3.0).sum())
        squares.append(distance.min(axis=1, initial=np.inf)[hit] ** 2)
    rms = float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else np.nan
    share = 100 * found / true if true else np.nan
    return f"{true}", f"{share:.2f}", f"{100 * false / images:.1f}", f"{rms:.3f}", f"{np.median(ms):.2f}"


def scenes(name: str, images: int):  # type: ignore[no-untyped-def]
    """Images, the true centres of the dots to be found, and all that are drawn, be they too oblique or cut off."""
    rng = np.random.default_rng(1)
    for k in range(images):
        if name == "sizes":
            image, uv = all_sizes(rng)
            yield image, uv, uv
        elif name == "correlated noise":
            noise = cv2.GaussianBlur(rng.standard_normal((1024, 1280)), (0, 0), rng.uniform(0.5, 1.5))
            image = 100 + rng.uniform(3, 15) * noise / noise.std()
            yield np.clip(np.rint(image), 0, 255).astype(np.uint8), np.zeros((0, 2)), np.zeros((0, 2))
        elif k == 0:
            made = simulate_frames(name, 0, "images", images)
            scene = replace(made.scene, sensing=replace(made.scene.sensing, ghosts_per_image=0.0))
            renderer = Renderer(scene)
            for i in range(images):
                seen = made.seen[0]
                rows = seen.of_frame(i)
                image = renderer.render(i, np.random.default_rng(i))[0]
                h, w = image.shape
                uv, d = seen.uv_px[rows], seen.diameter_px[rows]
                whole = (np.minimum(uv, [w - 1, h - 1] - uv) > d[:, None]).all(axis=1)
                in_camera = made.truth.frames.T_map_sensor[i].inverse().apply(scene.targets.xyz_mm)
                yield image, uv[whole & (d >= 5)], scene.rig.left.project(in_camera[in_camera[:, 2] > 1])


def all_sizes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Dots of 5 to 200 px, tilted to 65°, dark or bright, on stickers on a textured ground in uneven light."""
    h, w = 1024, 1280
    ground = np.zeros((h, w))
    for scale_px in (1, 2, 4, 8, 16, 32):
        small = rng.standard_normal((h // scale_px + 1, w // scale_px + 1)).astype(np.float32)
        ground += cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC)
    ground = 100 + rng.uniform(3, 12) * ground
    is_bright = rng.random() < 0.5
    blur_px = rng.uniform(0.45, 1.0)
    sticker, dot = (25.0, 210.0) if is_bright else (210.0, 30.0)
    placed: list[tuple[float, float, float]] = []
    uv = []
    for _ in range(80):
        a = 0.5 * np.exp(rng.uniform(np.log(5), np.log(200)))
        b, theta = a * np.cos(np.radians(rng.uniform(0, 65))), rng.uniform(0, np.pi)
        rim = 1.4 * a + 3
        u, v = rng.uniform(rim + 1, w - rim - 2), rng.uniform(rim + 1, h - rim - 2)
        if any(np.hypot(u - x, v - y) < rim + r + 2 for x, y, r in placed):
            continue
        placed.append((u, v, rim))
        box = box_of(u, v, rim, blur_px, ground.shape)
        ground[box] += (sticker - ground[box]) * coverage(u, v, rim, b * rim / a, theta, blur_px, box)
        ground[box] += (dot - ground[box]) * coverage(u, v, a, b, theta, blur_px, box)
        uv.append((u, v))
    light = 1 - 0.3 * ((np.arange(w) / w - 0.4) ** 2 + ((np.arange(h) / h - 0.5) ** 2)[:, None])
    noisy = np.rint(ground * light + 2 * rng.standard_normal((h, w)))
    return noisy.clip(0, 255).astype(np.uint8), np.array(uv)


class Hidden(NamedTuple):
    """What became of dots that another thing hides in part."""

    accepted: float
    """Share of dots for which one was reported within half a diameter of the centre."""
    off_px: float
    """Median distance of those from the true centre; NaN where there were none."""
    beyond: float
    """Share of those off by more than three standard deviations as stated."""


def hidden(diameter_px: float, share: float, draws: int) -> Hidden:
    """Dark dots on light ground, tilted up to 60°, ``share`` of each beyond a straight edge of any other grey value."""
    rng = np.random.default_rng(int(100 * diameter_px + 1000 * share))
    # Depth of the segment of a unit circle that has the share of its area.
    depth = np.linspace(0, 2, 4001)
    area = (np.arccos(1 - depth) - (1 - depth) * np.sqrt(np.maximum(0, 2 * depth - depth**2))) / np.pi
    cut = 1 - np.interp(share, area, depth)
    accepted, off, beyond = 0, [], []
    for _ in range(draws):
        size = int(1.5 * diameter_px + 40)
        u, v = size / 2 + rng.uniform(-0.5, 0.5, 2)
        a, blur_px = diameter_px / 2, 0.7
        b, theta = a * np.cos(np.radians(rng.uniform(0, 60))), rng.uniform(0, np.pi)
        box = slice(0, size), slice(0, size)
        grey = 180 - 150 * coverage(u, v, a, b, theta, blur_px, box)
        along = rng.uniform(0, 2 * np.pi)
        # The line a unit circle is cut by, in pixels: normal · x = reach.
        c, s = np.cos(theta), np.sin(theta)
        x, y = np.cos(along) / a, np.sin(along) / b
        normal = np.array([c * x - s * y, s * x + c * y])
        length = np.hypot(*normal)
        rows, columns = np.mgrid[:size, :size]
        distance = (normal[0] * (columns - u) + normal[1] * (rows - v) - cut) / length
        beyond_edge = ndtr(distance / np.hypot(blur_px, 0.29))
        other = rng.choice([rng.uniform(90, 160), rng.uniform(200, 250)])
        grey += (other - grey) * beyond_edge
        image = np.rint(grey + 2 * rng.standard_normal(grey.shape)).clip(0, 255).astype(np.uint8)
        dots = detect(image, DetectOptions(polarity="dark"))
        error = dots.uv_px - [u, v]
        near = np.flatnonzero(np.hypot(*error.T) < diameter_px / 2)
        if len(near):
            accepted += 1
            best = near[np.argmin(np.hypot(*error[near].T))]
            off.append(np.hypot(*error[best]))
            beyond.append(error[best] @ np.linalg.solve(dots.cov_px2[best], error[best]) > 11.83)
    return Hidden(accepted / draws, float(np.median(off)) if off else np.nan, float(np.mean(beyond)) if off else np.nan)


def timed(repeats: int = 60) -> dict[str, tuple[float, float]]:
    """Milliseconds of the detector and of OpenCV's threshold and contours, medians of runs in turns."""
    rng = np.random.default_rng(2)
    covered = np.zeros((1024, 1280))
    v, u = np.mgrid[0:7, 0:9].reshape(2, -1) * 140.0 + rng.uniform(70, 110, (2, 63))
    for x, y in zip(u, v, strict=True):
        a = rng.uniform(4, 14)
        ellipse = (x, y, a, a * np.cos(np.radians(rng.uniform(0, 60))), rng.uniform(0, np.pi))
        box = box_of(x, y, a, 1.0, covered.shape)
        covered[box] += coverage(*ellipse, 1.0, box)
    image = np.rint(180 - 150 * covered + 2 * rng.standard_normal(covered.shape)).clip(0, 255).astype(np.uint8)
    ways = {
        "OpenCV": lambda: contours(image),
        "dark": lambda: detect(image, DetectOptions(polarity="dark")),
        "auto": lambda: detect(image),
    }
    ms: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            start = perf_counter()
            way()
            ms[name].append(1e3 * (perf_counter() - start))
    theirs = float(np.median(ms.pop("OpenCV")))
    return {name: (float(np.median(one)), theirs) for name, one in ms.items()}


def contours(image: np.ndarray) -> int:
    binary = cv2.adaptiveThreshold(image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 51, 10)
    return len(cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0])


if __name__ == "__main__":
    main()
