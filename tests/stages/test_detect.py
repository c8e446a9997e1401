"""The detector: centres and covariances against rendered truth, what it refuses, and real recordings."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from trifix.errors import ConfigError
from trifix.kernels import detection
from trifix.records import Dots
from trifix.stages.detect import DetectOptions, detect

FINE = 8  # samples of the renderer per pixel and direction
GOLDEN = Path(__file__).parent.parent / "golden" / "detect.csv"
DARK, BRIGHT = DetectOptions(polarity="dark"), DetectOptions(polarity="bright")


class Scene(NamedTuple):
    """Ellipses u, v, a, b, θ, the coverage of each pixel by them, and its derivative by a common shift."""

    ellipses: np.ndarray
    coverage: np.ndarray
    by_u: np.ndarray
    by_v: np.ndarray


def mean_over_pixels(fine: np.ndarray) -> np.ndarray:
    h, w = fine.shape
    return fine.reshape(h // FINE, FINE, w // FINE, FINE).mean(axis=(1, 3), dtype=float)


def render(ellipses: np.ndarray, width_px: int, height_px: int, blur_px: float) -> Scene:
    """Area of each pixel covered by blurred ellipses, sampled FINE² times with smooth edges of one sample."""
    fine = np.zeros((height_px * FINE, width_px * FINE), dtype=np.float32)
    for u, v, a, b, theta in ellipses:
        reach = int((a + 2) * FINE)
        rows = slice(max(0, int(v * FINE) - reach), max(0, int(v * FINE) + reach))
        columns = slice(max(0, int(u * FINE) - reach), max(0, int(u * FINE) + reach))
        window = fine[rows, columns]
        dv = (np.arange(window.shape[0]) + rows.start + 0.5)[:, None] / FINE - 0.5 - v
        du = (np.arange(window.shape[1]) + columns.start + 0.5)[None, :] / FINE - 0.5 - u
        x, y = du * np.cos(theta) + dv * np.sin(theta), dv * np.cos(theta) - du * np.sin(theta)
        q = np.hypot(x / a, y / b)
        distance = (q - 1) * q / (np.hypot(x / a**2, y / b**2) + 1e-9)
        np.maximum(window, np.clip(0.5 - distance * FINE, 0, 1), out=window)
    if blur_px > 0:
        fine = cv2.GaussianBlur(fine, (0, 0), blur_px * FINE)
    by_u, by_v = ((np.roll(fine, 1, k) - np.roll(fine, -1, k)) * (FINE / 2) for k in (1, 0))
    return Scene(ellipses, mean_over_pixels(fine), mean_over_pixels(by_u), mean_over_pixels(by_v))


def grid(rng: np.random.Generator, diameter_px: float, tilt_deg: float, blur_px: float, rows: int) -> Scene:
    """Rows × rows equal dots at random phases and in random directions."""
    pitch = int(diameter_px + 6 * blur_px + 12)
    v, u = np.mgrid[0:rows, 0:rows].reshape(2, -1) * pitch + pitch / 2 + rng.uniform(-0.5, 0.5, (2, rows**2))
    a = np.full(rows**2, diameter_px / 2)
    b = a * np.cos(np.radians(tilt_deg))
    return render(np.stack([u, v, a, b, rng.uniform(0, np.pi, rows**2)], axis=1), rows * pitch, rows * pitch, blur_px)


def expose(
    scene: Scene, around: float, inside: float, noise: float, rng: np.random.Generator, slope: float = 0.0
) -> np.ndarray:
    """An 8-bit image under light that changes by ``slope`` per pixel across the image; 16-bit for levels above 255."""
    dtype = np.uint8 if max(around, inside) < 256 else np.uint16
    h, w = scene.coverage.shape
    light = 1 + slope * (np.arange(w) - w / 2)
    grey = (around + (inside - around) * scene.coverage) * light + noise * rng.standard_normal((h, w))
    return np.clip(np.rint(grey), 0, np.iinfo(dtype).max).astype(dtype)


def pair(dots: Dots, uv_px: np.ndarray) -> np.ndarray:
    """Row of the dot nearest to each given centre; each must be found, once, and nothing else."""
    distance = np.hypot(*(uv_px[:, None] - dots.uv_px[None]).transpose(2, 0, 1))
    nearest = distance.argmin(axis=1)
    assert len(dots) == len(uv_px)
    assert sorted(nearest) == list(range(len(uv_px)))
    return np.asarray(nearest)


def normalised(dots: Dots, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Errors (px) and their squares weighed by the stated covariances."""
    row = pair(dots, scene.ellipses[:, :2])
    error = dots.uv_px[row] - scene.ellipses[:, :2]
    return error, np.einsum("ni,ni->n", error, np.linalg.solve(dots.cov_px2[row], error[:, :, None])[:, :, 0])


def bound_px(scene: Scene, step: float, noise: float) -> float:
    """Cramér-Rao bound of the mean error of a centre (px, both directions) if all else were known."""
    J = np.stack([scene.by_u.ravel(), scene.by_v.ravel()]) * step
    information = J @ J.T / (noise**2 + 1 / 12) / len(scene.ellipses)
    return float(np.sqrt(np.trace(np.linalg.inv(information))))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Sixteen dots, 6 to 14 px long, of all kinds."""
    rng = np.random.default_rng(5)
    v, u = np.mgrid[0:4, 0:4].reshape(2, -1) * 32 + 24 + rng.uniform(-4, 4, (2, 16))
    a = rng.uniform(3, 7, 16)
    return render(np.stack([u, v, a, a * rng.uniform(0.5, 1, 16), rng.uniform(0, 3, 16)], axis=1), 144, 144, 0.8)


@pytest.mark.parametrize(
    ("diameter_px", "tilt_deg", "blur_px", "levels", "slope", "at_most"),
    [
        # Not knowing how the light changes across the dot costs something above the bound, most where dots are large.
        (5.0, 0.0, 0.7, (180, 30), 0.0, 1.3),
        (5.0, 65.0, 0.7, (180, 30), 0.0, 1.4),
        (8.0, 45.0, 0.7, (20, 200), 0.0, 1.4),
        (8.0, 30.0, 1.5, (9000, 1500), 0.0, 1.3),
        (12.0, 65.0, 0.5, (180, 30), 0.001, 1.4),
        (20.0, 45.0, 0.7, (20, 200), 0.001, 1.6),
        (40.0, 30.0, 1.0, (180, 30), 0.001, 1.6),
    ],
)
def test_errors_reach_the_bound_and_follow_their_covariance(
    diameter_px: float, tilt_deg: float, blur_px: float, levels: tuple[float, float], slope: float, at_most: float
) -> None:
    rng = np.random.default_rng(int(diameter_px + tilt_deg))
    around, inside = levels
    noise = 0.013 * max(levels)
    rows, draws = (6, 5) if diameter_px < 15 else (3, 15)
    scene = grid(rng, diameter_px, tilt_deg, blur_px, rows)
    options = DARK if inside < around else BRIGHT
    found = [normalised(detect(expose(scene, around, inside, noise, rng, slope), options), scene) for _ in range(draws)]
    error, squares = np.array([e for e, _ in found]), np.concatenate([s for _, s in found])
    scatter = np.sqrt(np.mean(np.sum(error**2, axis=2)))
    assert 0.85 < scatter / bound_px(scene, inside - around, noise) < at_most
    # Chi-square with two degrees of freedom: mean 2, tails of 5 % beyond 5.99 and below 0.103.
    assert 0.65 < squares.mean() / 2 < 1.3
    assert np.mean(squares > 5.99) < 0.10
    assert 0.01 < np.mean(squares < 0.103) < 0.11


@pytest.mark.parametrize(
    ("diameter_px", "tilt_deg", "blur_px"), [(5, 30, 0.5), (16, 60, 0.5), (60, 65, 1), (200, 50, 1)]
)
def test_without_noise_the_centre_is_right_to_five_thousandths(
    diameter_px: float, tilt_deg: float, blur_px: float
) -> None:
    rng = np.random.default_rng(3)
    scene = grid(rng, diameter_px, tilt_deg, blur_px, 5 if diameter_px < 50 else 1)
    dots = detect(expose(scene, 40000, 9000, 0.0, rng), DARK)
    error, _ = normalised(dots, scene)
    assert np.hypot(*error.T).max() < 0.005
    long, short = dots.ellipse[:, 0], dots.ellipse[:, 1]
    np.testing.assert_allclose(long, diameter_px / 2, atol=0.16)
    np.testing.assert_allclose(short, diameter_px / 2 * np.cos(np.radians(tilt_deg)), atol=0.16)


def test_sharp_edges_own_up_to_aliasing() -> None:
    rng = np.random.default_rng(4)
    scene = grid(rng, 7, 30, 0.0, 8)
    error, squares = normalised(detect(expose(scene, 200, 20, 0.5, rng), DARK), scene)
    assert 0.002 < np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.02
    assert 0.5 < squares.mean() / 2 < 1.5


def test_strong_noise_hides_nothing_and_invents_nothing() -> None:
    rng = np.random.default_rng(6)
    scene = grid(rng, 12, 40, 0.8, 6)
    _, squares = normalised(detect(expose(scene, 180, 30, 20, rng), DARK), scene)
    assert 0.6 < squares.mean() / 2 < 1.5
    nothing = np.clip(rng.normal(100, 15, (300, 300)), 0, 255).astype(np.uint8)
    assert len(detect(nothing, DetectOptions())) == 0


def test_dots_are_found_among_clutter() -> None:
    rng = np.random.default_rng(7)
    scene = grid(rng, 9, 40, 0.7, 6)
    around = np.full(scene.coverage.shape, 120.0)
    for scale_px in (1, 2, 4, 8, 16):
        texture = cv2.GaussianBlur(rng.standard_normal(around.shape), (0, 0), scale_px)
        around += 25 * texture / texture.std()
    # Each dot stands on a clean label, as a sticker does.
    label = render(scene.ellipses * [1, 1, 1.9, 1.9, 1], *scene.coverage.shape[::-1], 0.7).coverage
    image = around * (1 - label) + 200 * label
    image = np.clip(image + (30 - image) * scene.coverage, 0, 255).astype(np.uint8)
    dots = detect(image, DARK)
    distance = np.hypot(*(scene.ellipses[:, None, :2] - dots.uv_px[None]).transpose(2, 0, 1)).min(axis=1)
    assert distance.max() < 0.1
    assert len(dots) < 2 * len(distance)


def textured(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Grey values of a ground whose texture has grains of 1 to 16 px, 120 on average."""
    h, w = shape
    ground = np.full(shape, 120.0)
    for grain_px in (1, 2, 4, 8, 16):
        grains = rng.standard_normal((h // grain_px + 1, w // grain_px + 1))
        ground += 10 * cv2.resize(grains, (w, h), interpolation=cv2.INTER_CUBIC)
    return ground


def test_small_oblique_dots_on_narrow_stickers_are_found_in_texture() -> None:
    rng, found = np.random.default_rng(11), []
    for diameter_px in (5.4, 6.0):
        ellipses = grid(rng, diameter_px, 63, 0.7, 4).ellipses
        ellipses[:, :2] = np.mgrid[0:4, 0:4].reshape(2, -1).T * 60 + 30 + ellipses[:, :2] % 1
        shape = (240, 240)
        scene = render(ellipses, *shape, 0.7)
        sticker = render(scene.ellipses * [1, 1, 2.6, 2.6, 1], *shape[::-1], 0.7).coverage
        for around, inside in ((210, 30), (25, 210)):
            image = textured(rng, shape) * (1 - sticker) + around * sticker
            image += (inside - around) * scene.coverage + 2 * rng.standard_normal(shape)
            dots = detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), DetectOptions())
            off = np.hypot(*(scene.ellipses[:, None, :2] - dots.uv_px[None]).transpose(2, 0, 1)).min(axis=1)
            found.extend(off < 0.3)
            assert len(dots) <= 16
    assert np.mean(found) > 0.95


def test_large_dots_on_narrow_stickers_are_found_in_texture() -> None:
    rng = np.random.default_rng(12)
    for diameter_px in (60, 116, 124, 150):
        scene = grid(rng, diameter_px, 10, 0.7, 1)
        shape = (300, 300)
        u, v, *form = scene.ellipses[0]
        ellipse = np.array([[150 + u % 1, 150 + v % 1, *form]])
        dot, sticker = (render(ellipse * [1, 1, k, k, 1], *shape, 0.7).coverage for k in (1.0, 1.45))
        image = textured(rng, shape) * (1 - sticker) + 25 * sticker + 185 * dot + 2 * rng.standard_normal(shape)
        dots = detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), BRIGHT)
        assert len(dots) == 1
        assert np.hypot(*(dots.uv_px[0] - ellipse[0, :2])) < 0.05


def test_texture_by_itself_has_no_dots() -> None:
    rng = np.random.default_rng(13)
    for _ in range(4):
        image = textured(rng, (700, 900)) + 2 * rng.standard_normal((700, 900))
        assert len(detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), DetectOptions())) == 0


@pytest.mark.parametrize(
    ("diameter_px", "share"), [(20, 0.2), (20, 0.4), (40, 0.1), (40, 0.5), (100, 0.05), (100, 0.3)]
)
def test_dots_hidden_in_part_are_refused(diameter_px: float, share: float) -> None:
    """What hides them is darker than their surround, or brighter, and has a straight edge; shares are of the area."""
    depth = np.linspace(0, 2, 1001)  # of a segment of the unit circle
    area = (np.arccos(1 - depth) - (1 - depth) * np.sqrt((2 * depth - depth**2).clip(0))) / np.pi
    cut = 1 - np.interp(share, area, depth)
    rng = np.random.default_rng(int(diameter_px))
    scene = grid(rng, diameter_px, 30, 0.7, 1)
    u, v, a, b, theta = scene.ellipses[0]
    rows, columns = np.mgrid[: scene.coverage.shape[0], : scene.coverage.shape[1]]
    x = (np.cos(theta) * (columns - u) + np.sin(theta) * (rows - v)) / a
    y = (np.cos(theta) * (rows - v) - np.sin(theta) * (columns - u)) / b
    for direction in np.radians([10, 100, 190, 280]):
        for other in (120, 235):
            beyond = np.clip(0.5 + b * (np.cos(direction) * x + np.sin(direction) * y - cut), 0, 1)
            image = (180 - 150 * scene.coverage) * (1 - beyond) + other * cv2.GaussianBlur(beyond, (0, 0), 0.7)
            image += 2 * rng.standard_normal(image.shape)
            assert len(detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), DARK)) == 0


def test_a_dot_that_tells_nothing_of_the_light_is_left_as_it_is() -> None:
    fit = np.arange(18.0)[None]
    left = detection.share_gradients(fit, np.zeros((1, 4)), np.zeros((1, 6, 6)), np.full(4, 1e-3))
    np.testing.assert_array_equal(left[0], fit[0, [0, 1, 7, 8, 9]])


def test_the_edge_of_a_sticker_near_the_dot_does_not_spoil_the_covariance() -> None:
    rng = np.random.default_rng(8)
    scene = grid(rng, 16, 30, 0.7, 8)
    sticker = render(scene.ellipses * [1, 1, 1.5, 1.5, 1], *scene.coverage.shape[::-1], 0.7).coverage
    light = np.repeat(np.linspace(80, 160, sticker.shape[1])[None], len(sticker), axis=0)
    image = light * (1 - sticker) + 30 * sticker + 170 * scene.coverage + 2 * rng.standard_normal(sticker.shape)
    error, squares = normalised(detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), BRIGHT), scene)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.02
    assert 0.7 < squares.mean() / 2 < 1.4


def test_auto_takes_the_polarity_of_the_dots(scene: Scene) -> None:
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    dark, bright = detect(image, DetectOptions()), detect(255 - image, DetectOptions())
    assert len(dark) == len(bright) == 16
    np.testing.assert_allclose(dark.uv_px, bright.uv_px, atol=0.01)
    np.testing.assert_array_equal(dark.uv_px, detect(image, DARK).uv_px)
    assert len(detect(image, BRIGHT)) == 0


def test_colour_and_depth_change_nothing(scene: Scene) -> None:
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    grey = detect(image, DARK)
    np.testing.assert_allclose(detect(np.repeat(image[:, :, None], 3, axis=2), DARK).uv_px, grey.uv_px, atol=1e-12)
    deep = detect(image.astype(np.uint16) * 200, DARK)
    np.testing.assert_allclose(deep.uv_px, grey.uv_px, atol=1e-3)
    np.testing.assert_allclose(deep.cov_px2, grey.cov_px2, rtol=0.02, atol=1e-9)


def test_transposing_the_image_swaps_the_coordinates(scene: Scene) -> None:
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    dots, swapped = detect(image, DARK), detect(image.T, DARK)
    row = pair(swapped, dots.uv_px[:, ::-1])
    np.testing.assert_allclose(swapped.uv_px[row][:, ::-1], dots.uv_px, atol=2e-3)
    np.testing.assert_allclose(swapped.cov_px2[row][:, ::-1, ::-1], dots.cov_px2, rtol=0.05, atol=1e-6)


def test_the_image_is_left_alone_and_the_answer_repeats(scene: Scene) -> None:
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    kept = image.copy()
    first, second = detect(image, DetectOptions()), detect(image, DetectOptions())
    np.testing.assert_array_equal(image, kept)
    np.testing.assert_array_equal(first.uv_px, second.uv_px)
    np.testing.assert_array_equal(first.cov_px2, second.cov_px2)


def test_dots_cut_by_the_border_are_left_out(scene: Scene) -> None:
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    u0, v0 = 24, 24  # near the centres of the first row and column
    dots = detect(image[v0:, u0:], DARK)
    inside = scene.ellipses[(scene.ellipses[:, :2] > 40).all(axis=1), :2]
    assert len(dots) == 9
    pair(dots, inside - [u0, v0])


def test_limits_are_kept(scene: Scene) -> None:
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    length = np.sort(2 * detect(image, DARK).ellipse[:, 0])
    middle = (length[7] + length[8]) / 2
    assert len(detect(image, replace(DARK, min_diameter_px=middle))) == 8
    assert len(detect(image, replace(DARK, max_diameter_px=middle))) == 8
    assert len(detect(image, replace(DARK, min_contrast=0.9))) == 0
    assert 0 < len(detect(image, replace(DARK, min_axis_ratio=0.75))) < 16


@pytest.mark.parametrize("shape", [(1, 1), (2, 40), (40, 40), (7, 9, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_an_empty_image_has_no_dots(shape: tuple[int, ...], dtype: type) -> None:
    dots = detect(np.full(shape, 77, dtype=dtype), DetectOptions())
    assert len(dots) == 0
    assert dots.cov_px2.shape == (0, 2, 2)
    assert dots.ellipse.shape == (0, 3)


def test_nothing_is_compiled_after_the_warm_up(scene: Scene) -> None:
    detection.warm_up()
    kernels = (detection.blobs, detection.fit_ellipses, detection.share_gradients, detection.distinct)
    before = [len(kernel.signatures) for kernel in kernels]
    image = expose(scene, 180, 30, 2, np.random.default_rng(0))
    for variant in (image, image[::2, ::2], image.astype(np.uint16), np.repeat(image[:, :, None], 3, axis=2)):
        detect(variant, DetectOptions())
    assert [len(kernel.signatures) for kernel in kernels] == before


def test_the_answer_is_the_golden_one(scene: Scene) -> None:
    """Columns u, v, cov uu, uv, vv, a, b, θ. A change here is a change of behaviour: say so when you renew the file."""
    dots = detect(expose(scene, 180, 30, 2, np.random.default_rng(0)), DARK)
    golden = np.loadtxt(GOLDEN, delimiter=",")
    found = np.column_stack([dots.uv_px, dots.cov_px2.reshape(-1, 4)[:, [0, 1, 3]], dots.ellipse])
    assert found.shape == golden.shape
    np.testing.assert_allclose(found[:, :2], golden[:, :2], atol=1e-3)
    np.testing.assert_allclose(found[:, 2:5], golden[:, 2:5], atol=1e-6)
    np.testing.assert_allclose(found[:, 5:7], golden[:, 5:7], atol=1e-2)


def labelled(folder: Path, timestamp_ns: int, camera: int) -> np.ndarray:
    """Centres of the true dots of one image, as their publisher's detector saw them."""
    dots = np.genfromtxt(folder / "recording_dots" / "dots.csv", delimiter=",", names=True)
    label = np.genfromtxt(folder / "truth" / "labels_dots.csv", delimiter=",", names=True)["id"]
    chosen = (dots["timestamp_ns"] == timestamp_ns) & (dots["camera"] == camera) & (label >= 0)
    return np.stack([dots["u"][chosen], dots["v"][chosen]], axis=1)


@pytest.mark.parametrize(
    ("recording", "frames", "recall", "rms_px", "most"),
    [("boofcv_dots", (0, 30, 60), 0.97, 0.05, 150), ("dice_plate", (2,), 0.97, 0.15, 115)],
)
def test_real_dots_are_found(
    data: Path, recording: str, frames: tuple[int, ...], recall: float, rms_px: float, most: int
) -> None:
    folder = data / recording
    for camera in (0, 1):
        files = sorted((folder / "recording" / f"cam{camera}" / "data").iterdir(), key=lambda file: int(file.stem))
        for k in frames:
            dots = detect(cv2.imread(str(files[k]), cv2.IMREAD_UNCHANGED), DetectOptions())
            truth = labelled(folder, int(files[k].stem), camera)
            distance = np.hypot(*(truth[:, None] - dots.uv_px[None]).transpose(2, 0, 1)).min(axis=1)
            assert np.mean(distance < 1) >= recall
            assert np.sqrt(np.mean(distance[distance < 1] ** 2)) < rms_px
            assert len(dots) <= most


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("min_diameter_px", 0.0, "detect.min_diameter_px is 0.0, expected more than 0 and less than"),
        (
            "max_diameter_px",
            3.0,
            "detect.min_diameter_px is 3.5, expected more than 0 and less than max_diameter_px = 3",
        ),
        ("min_diameter_px", float("nan"), "detect.min_diameter_px is nan, expected"),
        ("min_axis_ratio", 1.1, "detect.min_axis_ratio is 1.1, expected a fraction above 0 and at most 1."),
        ("min_contrast", -3.0, "detect.min_contrast is -3.0, expected a fraction above 0 and at most 1."),
        ("max_misfit", 0.0, "detect.max_misfit is 0.0, expected a fraction above 0 and at most 1."),
    ],
)
def test_impossible_options_are_refused(name: str, value: float, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        DetectOptions(**{name: value})  # type: ignore[arg-type]
    assert text in str(caught.value)


def test_options_may_be_left_out() -> None:
    assert len(detect(np.full((40, 60), 100, dtype=np.uint8))) == 0
